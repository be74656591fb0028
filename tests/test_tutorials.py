"""Tutorials: what they show of an example and of commands is what is printed, figures are there."""

import re
import tomllib
from xml.etree import ElementTree

import pytest
import yaml

from .programs import ROOT, script
from .shown import blocks, unlike
from .test_docs import run_through

TUTORIALS = {  # the folder into which each has its example write, and the figure that it makes
    "tutorial_bumped_lidar": ("bumped", "bumped_lidar.svg"),
    "tutorial_rings": ("rings", "rings.svg"),
    "tutorial_what_is_missing": ("missing", "missing.svg"),
}


def page(name: str) -> str:
    return (ROOT / "docs" / f"{name}.md").read_text(encoding="utf-8")


def texts(svg: str) -> list[str]:
    """Words of a picture whose letters are drawn: matplotlib names each text in a comment."""
    return re.findall(r"<!-- (.*?) -->", svg)


def test_every_tutorial_is_tested():
    assert {path.stem for path in (ROOT / "docs").glob("tutorial_*.md")} == TUTORIALS.keys()


@pytest.mark.parametrize("name", TUTORIALS)
def test_a_tutorial_shows_output_and_a_figure_that_is_there(name):
    text = page(name)
    assert re.search(r"^```text\n", text, re.M)
    (picture,) = re.findall(r"!\[[^\]]+\]\((\S+)\)", text)
    assert ElementTree.parse(ROOT / "docs" / picture).getroot().tag.endswith("svg")


@pytest.mark.long
@pytest.mark.parametrize("name", TUTORIALS)
def test_a_tutorial_shows_what_is_printed(name, tmp_path):
    """And its figure has the words of the one that its command draws."""
    folder, figure = TUTORIALS[name]
    text = page(name)
    (program,) = re.findall(r"literalinclude\} \.\./(\S+)", text)
    assert f"`python {program} {folder}`" in text
    said = script(ROOT / program, [folder], tmp_path)
    said = said + run_through(ROOT / "docs" / f"{name}.md", tmp_path).said
    shown = blocks("text", text)
    assert shown
    for block in shown:
        assert not unlike(block, said)
    made, kept = ((path / figure).read_text("utf-8") for path in (tmp_path, ROOT / "docs/pictures"))
    words = [[w for w in texts(each) if not re.search(r"\d", w)] for each in (made, kept)]
    assert words[0] == words[1] and len(words[0]) > 1


def test_the_tutorial_of_rings_is_of_an_os0():
    program = (ROOT / "examples/02_per_ring_corrections.py").read_text("utf-8")
    assert "ouster_os0_128" in program and "OS0" in page("tutorial_rings").splitlines()[0]


# --------------------------------------------------------------------------- how to cite, the site


def test_the_version_to_cite_is_the_one_there_is():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text("utf-8"))
    assert cited["version"] == project["version"] and cited["license"] == project["license"]
    assert cited["authors"] == [{"name": project["authors"][0]["name"]}]
    assert cited["cff-version"] and cited["title"] == project["name"] and "doi" not in cited
    text = page("cite")
    assert f"version {project['version']}" in text and f"{{{project['version']}}}" in text


def test_pages_are_published_from_where_make_builds_them():
    steps = yaml.safe_load((ROOT / ".github/workflows/docs.yml").read_text("utf-8"))
    steps = steps["jobs"]["publish"]["steps"]
    made = next(k for k, step in enumerate(steps) if step.get("run") == "make docs")
    upload = next(k for k, s in enumerate(steps) if "upload-pages-artifact" in s.get("uses", ""))
    assert made < upload and "deploy-pages" in steps[-1]["uses"]
    rule = re.search(r"^docs:.*?\n\n", (ROOT / "Makefile").read_text(), re.M | re.S)[0]
    assert rule.split()[-1] == steps[upload]["with"]["path"] == "build/docs"
    assert '"sphinx.ext.githubpages"' in (ROOT / "docs/conf.py").read_text("utf-8")
