"""What README shows is run, and does what it says."""

import re
import shlex
import signal
from glob import glob
from importlib import import_module

import pytest

from calib.rig import load_rig
from calib.simulation import load_spec, simulate

from .programs import ROOT, rigcal, script, started
from .shown import blocks, unlike

README, START, FORMATS, DAY_BY_DAY = (
    (ROOT / name).read_text(encoding="utf-8")
    for name in ("README.md", "docs/start.md", "docs/formats.md", "docs/day_by_day.md")
)


def commands(text=README):
    """A page's command lines, split into words, comments left out."""
    lines = (
        shlex.split(line, comments=True)
        for block in blocks("sh", text)
        for line in block.replace("\\\n", "").splitlines()
    )
    return [words for words in lines if words]


def look(command, folder):
    """Open the workbench, and leave it by Ctrl-C once it has said where it is."""
    with started([*command, "--no-open"], folder) as process:
        said = process.stdout.readline()
        process.send_signal(signal.SIGINT)
        assert process.wait(60) == 0
    assert re.search(r"http://(127\.0\.0\.1|localhost):\d+", said)
    return said


@pytest.fixture(scope="module")
def loop(tmp_path_factory):
    """A folder in which README's commands have been run in order, and what they said."""
    folder = tmp_path_factory.mktemp("readme")
    own = [words for words in commands() if words[0] != "make"]
    said = [
        look(words, folder) if words[1] == "view" else rigcal(words[1:], folder) for words in own
    ]
    return folder, "\n".join(said)


def test_every_command_line_is_one_of_two_programs():
    assert {words[0] for words in commands()} == {"make", "rigcal"}


def test_make_targets_exist():
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), flags=re.M))
    assert {words[1] for words in commands() if words[0] == "make"} <= targets


@pytest.mark.slow
def test_the_demo_ends_with_what_was_found_and_where_the_report_is(loop, monkeypatch, capsys):
    """Its last program, on the runs of README's loop, which hide the same effect."""
    recipe = re.search(r"^demo:.*?\n\n", (ROOT / "Makefile").read_text(), re.M | re.S)[0]
    *_, finding, last = recipe.strip().splitlines()
    assert "The report is demo/report.html" in last
    program = shlex.split(finding.strip().removeprefix("@"))[-1]
    monkeypatch.chdir(loop[0])
    exec(program.replace("demo/run", "run"))
    assert re.match(r"incidence_angle_bias is missing: .* mm\.\n$", capsys.readouterr().out)


@pytest.mark.slow
def test_the_loop_runs_and_leaves_what_it_names(loop):
    folder, said = loop
    names = {path.name for path in folder.iterdir()}
    made = {"run", "grown", "less", "report.html", "corrected", "extrinsics"}
    assert names == {"rec", "rec.truth.json", *made}
    files = {path.name for path in (folder / "extrinsics").iterdir()}
    assert {"extrinsics.yaml", "arm.urdf", "rig.urdf", "rings.csv"} <= files
    assert "<svg" in (folder / "report.html").read_text(encoding="utf-8")
    assert re.search(r"^lidar +[+-]\d+\.\d+ ± \d", said, flags=re.M)
    assert re.search(r"rms of stops held out +mm +\d", said)
    assert "incidence_angle_bias.amount" in said


@pytest.mark.slow
def test_what_readme_shows_is_what_is_printed(loop):
    for part in "\n".join(blocks("text", README)).split("\n\n"):
        assert not unlike(part, loop[1])


@pytest.mark.slow
def test_the_first_page_of_the_site_shows_what_is_printed(loop):
    """Its commands are README's, and more on the same runs."""
    folder, said = loop
    here = commands(START)
    more = [words for words in here if words not in commands()]
    assert {tuple(words) for words in here if words[1] in ("simulate", "fit", "add")} <= {
        tuple(words) for words in commands()
    }
    said = "\n".join([said, *(rigcal(words[1:], folder) for words in more)])
    shown = blocks("text", START)
    assert len(shown) == 2
    for block in shown:
        assert not unlike(block, said)


@pytest.mark.slow
def test_the_import_of_the_pages_makes_a_recording(tmp_path, monkeypatch):
    """Of files that example 8 writes for this; the shell would expand the stars."""
    simulate(
        load_spec("tiny").model_copy(update={"sweeps": 1, "occluded_share": 0.0}),
        tmp_path / "rec",
        1,
    )
    monkeypatch.syspath_prepend(str(ROOT / "examples"))
    import_module("foreign_files").write_files(tmp_path / "rec", tmp_path)
    (words,) = commands(DAY_BY_DAY)
    expanded = [sorted(glob(w, root_dir=tmp_path)) if "*" in w else [w] for w in words]
    said = rigcal([word for part in expanded for word in part][1:], tmp_path)
    assert "what was understood" in said
    stops = (tmp_path / "mine" / "stops.csv").read_text().splitlines()
    assert len(stops) == len((tmp_path / "rec" / "stops.csv").read_text().splitlines())


@pytest.mark.slow
def test_recording_and_run_hold_the_files_in_their_tables(loop):
    folder, _ = loop
    for title, made in (("A recording", ("rec",)), ("A run", ("run", "grown"))):
        rows = re.search(rf"## {title}\n.*?\n\|---\|---\|\n(.*?)\n\n", FORMATS, flags=re.S)[1]
        listed = [
            name for row in rows.splitlines() for name in re.findall("`([^`]+)`", row.split("|")[1])
        ]
        assert len(listed) >= 5
        stop = next((folder / "rec" / "scans").iterdir()).stem
        for name in listed:
            path = name.replace("<stop>", stop)
            at = [folder / one / within for one in made for within in (".", "reference")]
            found = [(place / path).exists() for place in at]
            assert any(found), f"the page lists {name}, which {made} has not"


@pytest.mark.slow
def test_the_rig_of_the_page_is_one(loop):
    folder, _ = loop
    text = next(block for block in blocks("yaml", FORMATS) if "lidar:" in block)
    (folder / "rec" / "rig.yaml").write_text(text)
    rig = load_rig(folder / "rec")
    assert rig.lidar.rings == 128
    assert list(rig.frame_sigma) == ["base_markers", "arm_base", "mount", "mount_markers", "lidar"]


@pytest.mark.slow
def test_python_in_readme_runs(tmp_path):
    (program,) = blocks("python", README)
    (tmp_path / "program.py").write_text(program)
    said = script(tmp_path / "program.py", [], tmp_path)
    assert "incidence_angle_bias is missing" in said
    assert (tmp_path / "extrinsics" / "extrinsics.yaml").is_file()


def test_files_that_readme_links_to_exist():
    linked = re.findall(r"\]\(([^)#:]+)\)", README) + re.findall(r"`(\w\w_\w+\.py)`", README)
    assert linked
    for name in linked:
        assert (ROOT / name).is_file() or (ROOT / "examples" / name).is_file(), name
    assert {path.name for path in (ROOT / "examples").glob("[0-9]*.py")} <= set(linked)
