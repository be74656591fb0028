"""The pages of docs/: every command and program on them is run, and says what they show."""

import re
import shlex
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass
from pathlib import Path

import pytest
import yaml

from calib.diagnosis.formulas.factors import FACTOR_KINDS
from calib.diagnosis.verdict import worth_adding
from calib.effects import CATALOGUE
from calib.effects.own.formula import FormulaEffect
from calib.problem.model import Source
from calib.problem.without import leave_out
from calib.rig import load_rig
from calib.runs.run import Run

from .programs import ROOT, rigcal, script
from .shown import blocks, shape, unlike
from .thinned import thinned

PAGES = sorted((ROOT / "docs").glob("*.md"))
TOKEN = "L02P01:base_markers"


@dataclass
class Session:
    """A page, the folder in which all on it was run, and what that printed."""

    text: str
    folder: Path
    said: str


def run_through(page: Path, folder: Path) -> Session:
    """Run the blocks of a page, one after another."""
    text, said = page.read_text(encoding="utf-8"), []
    for language, block in re.findall(r"^```(\w+)\n(.*?)^```", text, flags=re.M | re.S):
        if language == "python":
            (folder / "block.py").write_text(block)
            said.append(script(folder / "block.py", [], folder))
        for line in block.splitlines() if language == "sh" else ():
            program, *words = shlex.split(line, comments=True)
            assert program == "rigcal"
            said.append(rigcal(words, folder))
    return Session(text, folder, "\n".join(said))


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    """The page about blunders, run."""
    return run_through(ROOT / "docs/one_thing_wrong.md", tmp_path_factory.mktemp("docs"))


def test_readme_is_short_and_the_site_has_every_page():
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    assert len(readme.splitlines()) <= 120
    index = (ROOT / "docs/index.md").read_text(encoding="utf-8").splitlines()
    assert PAGES and all(page.stem in index for page in PAGES if page.stem != "index")


def test_readme_links_to_every_page_that_is_not_of_the_site_alone():
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    alone = {"index", "start", "api", "glossary", *(p.stem for p in PAGES if "tutorial" in p.stem)}
    assert all(f"(docs/{p.name})" in readme for p in PAGES if p.stem not in alone)


def test_tutorials_show_programs_that_are_there():
    shown = [
        (page.parent / path).resolve()
        for page in PAGES
        for path in re.findall(r"literalinclude\} (\S+)", page.read_text(encoding="utf-8"))
    ]
    assert len(shown) >= 3 and all(path.parent == ROOT / "examples" for path in shown)
    assert all(path.is_file() for path in shown)


@pytest.mark.long
def test_the_site_is_built_without_a_warning(tmp_path):
    pytest.importorskip("sphinx", reason="the site needs what 'make docs' installs")
    words = ["-m", "sphinx", "-W", "--keep-going", "-q", "-b", "html", "docs", str(tmp_path)]
    done = subprocess.run([sys.executable, *words], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr

    def text(page):
        return re.sub("<[^>]+>", "", (tmp_path / page).read_text(encoding="utf-8"))

    assert "(1 / cos(incidence) - 1)" in text("catalogue/incidence_angle_bias.html")
    assert "calib.fit" in text("api.html")
    assert (tmp_path / ".nojekyll").is_file()
    pictures = {path.stem for path in (tmp_path / "_images").glob("*.svg")}
    assert len(pictures & {effect.name for effect in CATALOGUE}) > 55


@pytest.mark.slow
def test_the_page_about_python_runs_and_shows_what_is_printed(tmp_path):
    """The measurement that its graph takes up moves what it is of, and makes it better known."""
    session = run_through(ROOT / "docs/api.md", tmp_path)
    for block in blocks("text", session.text):
        assert not unlike(block, session.said)
    assert "the recordings are the same" in " ".join(session.said.split()).lower()
    found = re.search(r"moves by (\S+) mm, and is known to (\S+) mm", session.said).groups()
    solution = Run.open(tmp_path / "grown").solution
    at = solution.names.index("lidar.tx")
    variance = 1e6 * solution.graph[at, at]
    share = variance / (variance + 0.3**2)
    now = 0.2 * share, (variance * (1.0 - share)) ** 0.5
    assert [float(each) for each in found] == pytest.approx(now, abs=0.001)
    for figure in ("chain.png", "graph.png"):
        assert (tmp_path / figure).read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
def test_the_page_about_trust_runs(tmp_path):
    """Its file of code leaves no effect in what was exported, and is evaluated when trusted."""
    session = run_through(ROOT / "docs/trust.md", tmp_path)
    words = " ".join((tmp_path / "extrinsics" / "extrinsics.yaml").read_text().split())
    assert "model.yaml names effects of a Python file" in session.said
    assert "--trust" in session.said and "lean: " in words
    assert (tmp_path / "run" / "evaluation.json").is_file()


@pytest.mark.long
def test_the_page_about_ones_own_effects_shows_what_is_printed(tmp_path):
    session = run_through(ROOT / "docs/your_own_effects.md", tmp_path)
    shown = blocks("text", session.text)
    assert len(shown) == 2
    for part in shown:
        assert not unlike(part, session.said)
    for run, before, name in (("grown", "run", "humid_air"), ("described", "plain", "empirical_")):
        runs = [Run.open(tmp_path / each) for each in (run, before)]
        now, then = (each.summary["rms_mm"]["held_out"] for each in runs)
        assert runs[0].effects[-1].startswith(name) and now < 0.8 * then
    table = re.search(r"\|---\|---\|\n(.*?)\n\n", session.text, flags=re.S)[1]
    cells = (re.findall(r"`(\w[^`]*)`", row.split("|")[1]) for row in table.splitlines())
    places = [place for cell in cells for place in cell]
    rig, effect = load_rig(tmp_path / "rec"), yaml.safe_load((tmp_path / "mine.yaml").read_text())
    for place in places:
        for word, name in (("NAME", "joint_1"), ("FRAME", "mount"), ("BODY", "mount_markers")):
            place = place.replace(word, name)
        assert FormulaEffect.read(effect | {"site": place}, "mine.yaml", {}).params(rig), place
    assert len(places) == 9


@pytest.mark.long
@pytest.mark.parametrize(
    "part", [(3, 6), pytest.param(None, marks=pytest.mark.long)], ids=["in part", "whole"]
)
def test_the_page_about_formulas_shows_what_is_printed(tmp_path, shared, part):
    """Of a part of the recording but for the figures."""
    name = "known_ring_by_temperature"
    if part:
        thinned(shared / "recordings" / name, tmp_path / name, *part)
    else:
        (tmp_path / name).symlink_to(shared / "recordings" / name)
    session = run_through(ROOT / "docs/formulas.md", tmp_path)
    shown = blocks("text", session.text)
    assert len(shown) == 2
    for block in shown:
        assert shape(block) in shape(session.said) if part else not unlike(block, session.said)
    fall = r"held-out error goes from (\S+) to (\S+) mm"
    before, after = map(float, re.search(fall, " ".join(session.said.split())).groups())
    assert after < before / 2
    assert (tmp_path / "formula.png").is_file()


def test_the_page_about_formulas_has_every_term():
    text = (ROOT / "docs/formulas.md").read_text(encoding="utf-8")
    table = re.search(r"\| term \| formula \|\n\|---\|---\|\n(.*?)\n\n", text, flags=re.S)[1]
    listed = set(re.findall(r"`([^`]+)`", table))
    columns = {
        text.format("a", "b", x="x") for kind in FACTOR_KINDS.values() for text in kind.columns
    }
    assert listed == columns - {"1"}


def test_the_page_about_same_bytes_shows_what_is_printed(tmp_path):
    page = run_through(ROOT / "docs/same_bytes.md", tmp_path)
    (shown,) = blocks("text", page.text)
    assert page.said.endswith(shown)
    keys = re.findall(r"`(\w+)`", re.search(r"\|---\|---\|\n(.*?)\n\n", page.text, flags=re.S)[1])
    assert set(keys) == set(Run.open(tmp_path / "grown").model)


@pytest.mark.long
def test_the_page_about_large_recordings_shows_what_is_printed(tmp_path):
    page = run_through(ROOT / "docs/scale.md", tmp_path)
    (shown,) = (block for block in blocks("text", page.text) if "identical" in block)
    assert shown in page.said
    (shown,) = (block for block in blocks("text", page.text) if "first answer" in block)
    assert " ".join(shown.split()) in " ".join(page.said.split())


@pytest.mark.slow
def test_the_page_about_chance_shows_what_is_printed(tmp_path):
    session = run_through(ROOT / "docs/by_chance.md", tmp_path)
    shown = blocks("text", session.text)
    assert len(shown) == 2 and not any(unlike(part, session.said) for part in shown)
    found = Run.open(tmp_path / "run").diagnosis()
    assert worth_adding(found["candidates"]) == ["stop_range_scatter"]
    assert not found["unexplained"] and not found["blunders"]
    (told,) = found["scatter"]
    assert told["sd"] == pytest.approx(0.0009, abs=3 * told["sigma"])
    listed = re.findall(r"^\| `(\w+)` \|", session.text, flags=re.M)
    assert listed == [effect.name for effect in CATALOGUE if effect.by_chance]
    sigma = Run.open(tmp_path / "grown").solution.shared.effects["ring_range_offset"].sigma
    assert f"{1e3 * sigma.mean():.2f} mm" in session.text


@pytest.mark.long
def test_the_page_about_plans_shows_what_is_printed(tmp_path):
    session = run_through(ROOT / "docs/plan.md", tmp_path)
    shown = blocks("text", session.text)
    assert len(shown) == 4 and not any(unlike(part, session.said) for part in shown)
    table = (tmp_path / "stops.csv").read_text().splitlines()
    assert table[0] == "location," + ",".join(f"joint_{k}" for k in range(1, 7))
    assert len(table) == 6


@pytest.mark.slow
def test_what_the_page_shows_is_what_is_printed(session):
    shown = blocks("text", session.text)
    assert len(shown) == 2
    for part in shown:
        assert not unlike(part, session.said)


@pytest.mark.slow
def test_the_command_that_diagnose_prints_is_the_one_of_the_page(session):
    run = Run.open(session.folder / "run")
    found = run.diagnosis()
    assert [b["without"] for b in found["blunders"]] == [TOKEN]
    assert found["command"] in session.said.splitlines()
    words = shlex.split(found["command"])
    assert words[:3] == ["rigcal", "fit", str((session.folder / "rec").resolve())]
    assert words[3:] == ["-o", "run-without", "--without", TOKEN]
    assert found["blunders"][0]["indistinguishable_from"] == ["L02P01:joints"]


@pytest.mark.slow
def test_every_group_stands_in_the_diagnosis_and_one_is_wild(session):
    found = Run.open(session.folder / "run").diagnosis()
    wild = [g["token"] for g in found["groups"] if g["statistic"] > g["limit"]]
    assert wild == [TOKEN] and found["groups"][0]["token"] == TOKEN
    others = {"rings", "mesh:scale"}
    assert {*others, *(g["token"] for g in found["groups"])} == found["detectable"].keys()
    assert {g["kind"] for g in found["groups"]} >= {"body", "scan", "joints", "target", "frame"}
    assert all(0 <= g["p_value"] <= 1 and g["dof"] > 0 for g in found["groups"])
    mended = Run.open(session.folder / "without").diagnosis()
    assert mended["verdict"] == "adequate" and mended["command"] is None
    assert not [g for g in mended["groups"] if g["statistic"] > g["limit"]]
    assert TOKEN not in {g["token"] for g in mended["groups"]}


@pytest.mark.slow
def test_the_report_says_it_near_the_verdict_and_draws_it(session):
    html = (session.folder / "report.html").read_text(encoding="utf-8")
    top = html[: html.index("<nav")]
    assert 'class="verdict red"' in top
    for said in (TOKEN, "or L02P01:joints: nothing tells them apart", f"--without {TOKEN}</pre>"):
        assert said in top, said
    figure = html[html.index('<figure id="groups"') :]
    figure = figure[: figure.index("</figure>")]
    assert f"{TOKEN} is " in figure and "times further off than chance allows" in figure
    svg = ElementTree.fromstring(figure[figure.index("<svg") : figure.index("</svg>") + 6])
    texts = {"".join(e.itertext()).strip() for e in svg.iter() if e.tag.endswith("text")}
    assert {TOKEN, "base_markers", "scan", "L02P01", "cad"} <= texts


@pytest.mark.slow
def test_what_was_left_out_stands_wherever_the_result_is_shown(session):
    run = Run.open(session.folder / "without")
    assert run.left_out == run.summary["without"] == [TOKEN]
    assert re.search(rf"left out +{TOKEN}", session.said)
    for file in (session.folder / "extrinsics").iterdir():
        assert f"Left out: {TOKEN}" in file.read_text(), file.name
    provenance = yaml.safe_load((session.folder / "extrinsics/extrinsics.yaml").read_text())
    assert provenance["provenance"]["left_out"] == [TOKEN]


@pytest.mark.slow
def test_every_name_in_the_table_is_one(session):
    """With a name of this recording in the place of each word in capitals."""
    source = Source.open(session.folder / "rec")
    table = re.search(r"\|---\|---\|---\|\n(.*?)\n\n", session.text, flags=re.S)[1]
    cells = [re.findall(r"`([^`]+)`", row.split("|")[2]) for row in table.splitlines()]
    tokens = [t if ":" in t else f"TARGET:{t}" for row in cells for t in row]
    words = {
        "TARGET": first_target(session.folder),
        "STOP": "L00P00",
        "JOINT": "joint_2",
        "BODY": "base_markers",
    }
    words |= {"EFFECT.PARAMETER": "arm_link_length.joint_3", "FRAME": "lidar"}
    words |= {"_N": f"_{int(source.reference.surface.max())}"}  # of parts there are more
    assert len(tokens) == 14
    for token in (t for t in tokens if not t.endswith(".level")):  # this rig has none
        for word, name in words.items():
            token = token.replace(word, name)
        assert leave_out([source], [token])[0] is not source, token


def first_target(folder: Path) -> str:
    """The name of a recording's first target."""
    return (folder / "rec/targets.csv").read_text().splitlines()[1].partition(",")[0]


@pytest.mark.slow
def test_the_table_of_what_a_diagnosis_holds_is_right(session):
    found = Run.open(session.folder / "run").diagnosis()
    part = session.text[session.text.index("## In `diagnosis.json`") :]
    named = set(re.findall(r"`(\w+)`", part.partition("## Sources")[0])) - {"bad_data"}
    known = {*found, *found["blunders"][0], *found["groups"][0]}
    assert named <= known, named - known
    assert {*found["groups"][0]} <= named
