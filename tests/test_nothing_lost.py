"""No command harms a file that it was not asked to write: each refuses it, before any work."""

import shutil

import pytest
import typer.main

from calib.cli.app import app

SPEC = "{lidar: hesai_pandarxt32, locations: 2, stops_per_location: 2, column_step: 400}"
IMPORT = "import table rec/stops.csv urdf rec/arm.urdf --rig rec/rig.yaml --rows stops"
# Every command that has an -o: what may stand before it. A new one belongs here as well.
FOLDERS = {
    "simulate": ["simulate rec/spec.yaml"],
    "import": [IMPORT],
    "fit": ["fit rec", "fit other --prior run --hold-out none"],
    "add": ["add run arm_axis_tilt"],
    "explain": ["explain rec"],
    "evaluate": ["evaluate run"],
    "export": ["export run --format yaml --force"],
    "apply": ["apply run rec", "apply run rec/scans/L00P00.parquet"],
}
FILES = {
    "report": ["report run", "report run again"],
    "plot": ["plot run chain"],
    "plan": ["plan run"],
    "effects": ["effects incidence_angle_bias"],
}
INSIDE = {"diagnose", "evaluate"}  # what they find stands in the run itself
# view makes runs by the same functions as add
READ = {"check", "compare", "moved", "reproduce", "view"}
ENDS = {"report": ".html", "plot": ".png", "plan": ".csv", "effects": ".png"}


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Two recordings, a run of the first, and files of somebody."""
    from calib.runs.calibrate import calibrate
    from calib.simulation import simulate

    folder = tmp_path_factory.mktemp("made")
    (folder / "spec.yaml").write_text(SPEC)
    for seed, name in enumerate(("rec", "other")):
        simulate(str(folder / "spec.yaml"), folder / name, seed)
    shutil.copy(folder / "spec.yaml", folder / "rec")
    calibrate([folder / "rec"], folder / "run", hold_out="none")
    shutil.copytree(folder / "run", folder / "again")
    (folder / "mine").mkdir()
    (folder / "mine/thesis.tex").write_text("all of it")
    (folder / "mine/rig.yaml").write_text("name: begun\n")
    (folder / "link").symlink_to("rec", target_is_directory=True)
    for end in sorted({*ENDS.values()}):
        (folder / f"link{end}").symlink_to("run/solution.yaml")
        (folder / f"a_folder{end}").mkdir()
    return folder


def contents(folder):
    return {p: p.read_bytes() if p.is_file() else None for p in sorted(folder.rglob("*"))}


def test_every_command_is_known_here():
    commands = typer.main.get_command(app).commands
    with_out = {n for n, c in commands.items() if any("--out" in p.opts for p in c.params)}
    assert with_out == {*FOLDERS, *FILES}
    assert commands.keys() == {*FOLDERS, *FILES, *INSIDE, *READ}


@pytest.mark.parametrize(
    "out",
    [
        *("rec", "rec/new", "rec/reference/new", "rec/scans/L00P00.parquet/new", "run/../rec"),
        *("link", "link/new", "link/../run/new", "run/residuals.parquet/new"),
        *(".", "mine", "mine/thesis.tex", "mine/thesis.tex/new"),
    ],
)
@pytest.mark.parametrize("words", [words for each in FOLDERS.values() for words in each])
def test_a_folder_that_is_not_its_own_is_refused(made, rigcal, monkeypatch, words, out):
    refused(made, rigcal, monkeypatch, words, out)


@pytest.mark.parametrize("out", ["rec/new", "run/new", "run/solution", "link", "a_folder"])
@pytest.mark.parametrize("words", [words for each in FILES.values() for words in each])
def test_a_file_that_is_not_its_own_is_refused(made, rigcal, monkeypatch, words, out):
    refused(made, rigcal, monkeypatch, words, f"{out}{ENDS[words.split()[0]]}")


@pytest.mark.parametrize(
    ("words", "out"),
    [
        ("report run", "page.pdf"),
        ("report run", "run/solution.yaml"),
        ("report run", "page"),
        ("plot run chain", "run/solution.yaml"),
        ("plan run", "run/solution.yaml"),
        ("plan run", "run"),
        ("plan run", "other"),
        ("evaluate run", "run"),
        ("evaluate run", "again"),
        ("evaluate run again", "."),
        ("add run arm_axis_tilt", "run"),
        ("fit other --prior run", "run"),
        ("fit rec", "other"),
        ("export run", "again"),
        ("apply run rec other/scans/L00P00.parquet rec/scans/L00P00.parquet", "new"),
        ("apply run rec", "other"),
        ("simulate spec.yaml", "real"),
        ("explain rec", "days"),
    ],
)
def test_what_else_would_be_lost_is_refused(made, rigcal, monkeypatch, words, out):
    """A page that is no PDF, a run that is the input, a measured recording, folders by date."""
    if not (made / "real").exists():
        shutil.copytree(made / "other", made / "real")
        shutil.copytree(made / "other", made / "days/20")
    refused(made, rigcal, monkeypatch, words, out)


def refused(made, rigcal, monkeypatch, words, out):
    monkeypatch.chdir(made)
    before = contents(made)
    code, said, err = rigcal(*words.split(), "-o", out)
    assert (code, said) == (2, ""), err
    assert err.startswith("rigcal: ") and err.count("\n") == 1
    assert contents(made) == before


def test_it_is_refused_before_any_work(made, rigcal, monkeypatch):
    """Nothing is read but the run itself and what the command line names."""
    monkeypatch.chdir(made)

    def work(*_, **__):
        raise AssertionError("it went to work")

    for place in (
        *("runs.calibrate.leave_out", "runs.calibrate.reopened", "evaluation.reopened"),
        *(
            "evaluation.correction.Correction",
            "exporters.Fitted",
            "intake.gather",
            "simulation._record",
        ),
        *("report.Evidence.of", "runs.explain.calibrate", "runs.diagnose.stand_of"),
        *("planning.stand_of",),
    ):
        monkeypatch.setattr(f"calib.{place}", work)
    for command, (words, *_) in {**FOLDERS, **FILES}.items():
        code, _, err = rigcal(*words.split(), "-o", f"rec/new{ENDS.get(command, '')}")
        assert code == 2, err


@pytest.mark.parametrize("words", ["diagnose run --no-refits", "evaluate run"])
def test_what_stands_in_a_run_is_written_and_nothing_else(made, rigcal, monkeypatch, words):
    monkeypatch.chdir(made)
    before = contents(made)
    assert rigcal(*words.split())[0] == 0
    after = contents(made)
    changed = {path for path in after if after[path] != before.get(path)} | after.keys() ^ before
    names = {path.relative_to(made / "run").parts[0] for path in changed}
    assert names <= {"diagnosis.json", "evaluation.json", "points.parquet"} and names


def test_an_export_takes_the_place_of_exports_alone(made, rigcal, monkeypatch):
    monkeypatch.chdir(made)
    assert rigcal("export", "run", "-o", "out", "--format", "yaml")[0] == 0
    assert rigcal("export", "run", "-o", "out", "--format", "kalibr")[0] == 0
    assert rigcal("export", "run", "-o", "out")[0] == 0
    names = {path.name for path in (made / "out").iterdir()}
    assert {"extrinsics.yaml", "kalibr.yaml", "arm.urdf"} <= names
    shutil.copy("rec/arm.urdf", "out")  # the maker's
    before = contents(made)
    code, _, err = rigcal("export", "run", "-o", "out")
    assert code == 2 and "arm.urdf was not written by rigcal" in err
    assert contents(made) == before
