"""The command line as its users meet it: exit codes, what stands on which stream, Ctrl-C."""

import json
import os
import pty
import re
import shutil
import signal
import sys
import threading
from contextlib import contextmanager
from pathlib import Path

import pytest

from calib.cli import main
from calib.cli.app import app, heeding_ctrl_c, progress_bar

from .programs import LIMIT_S, RIGCAL, execute, started

SPEC = "{lidar: hesai_pandarxt32, locations: 3, stops_per_location: 2, column_step: 200}"
COMMANDS = sorted(c.name or c.callback.__name__ for c in app.registered_commands)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A folder with a recording and a run, and what making them printed: folder, {command: out}."""
    folder = tmp_path_factory.mktemp("cli")
    (folder / "spec.yaml").write_text(SPEC)
    printed = {}
    for command, *arguments in (
        ["simulate", folder / "spec.yaml", "-o", folder / "rec", "--seed", 1],
        ["fit", folder / "rec", "-o", folder / "run", "--hold-out", "none"],
    ):
        done = execute([*RIGCAL, command, *arguments, "--json"])
        assert (done.returncode, done.stderr) == (0, "")
        printed[command] = done.stdout
    return folder, printed


@pytest.fixture
def folder(made):
    """The folder with a recording and a run."""
    return made[0]


@contextmanager
def at_a_terminal(*arguments):
    """A process whose stderr is a terminal, and a list that fills with what it shows there."""
    terminal, stderr = pty.openpty()
    shown = []

    def read():
        try:
            while chunk := os.read(terminal, 4096):
                shown.append(chunk.decode(errors="replace"))
        except OSError:  # the process has closed its side
            pass

    reader = threading.Thread(target=read, daemon=True)
    with started([*RIGCAL, *arguments], stderr=stderr) as process:
        os.close(stderr)
        reader.start()
        yield process, shown
    reader.join(LIMIT_S)
    os.close(terminal)


def contents(folder):
    return {p: p.read_bytes() if p.is_file() else None for p in folder.rglob("*")}


# -------------------------------------------------------------------------------------- exit codes


def test_without_arguments_stands_the_help(rigcal):
    code, out, err = rigcal()
    assert (code, err) == (0, "") and "Usage: rigcal" in out
    assert all(f" {command} " in out for command in COMMANDS)


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_help_and_json(rigcal, command):
    code, out, err = rigcal(command, "--help")
    assert (code, err) == (0, "") and "--json" in out


@pytest.mark.parametrize(
    ("arguments", "part"),
    [
        (["fitt"], "fitt"),
        (["fit", "rec", "-o", "run", "--hold"], "--hold"),
        (["--nope"], "--nope"),
        (["fit", "rec"], "--out"),
        (["fit", "-o", "run"], "REC"),
        (["check"], "recording"),
        (["check", "a", "b"], "b"),
        (["fit", "rec", "-o", "run", "--folds", "many"], "--folds"),
        (["simulate", "tinny", "-o", "rec"], "did you mean tiny"),
        (["simulate", "tiny", "-o", "rec", "--hide", "range_scale"], "EFFECT=SIZE"),
        (["effects", "ring_range_ofset"], "did you mean 'ring_range_offset'"),
        (["compare", "nowhere"], "nowhere"),
        (["add", "nowhere", "arm_axis_tilt", "-o", "run"], "nowhere"),
        (["add", "run", "-o", "grown"], "EFFECT"),
        (["add", "run", "arm_axis_tilt"], "--out"),
        (["fit", "rec", "-o", "run", "--effects", "own.yaml"], "own.yaml does not exist"),
        (["diagnose", "nowhere"], "nowhere: no run there"),
        (["diagnose"], "run"),
        (["explain", "rec"], "--out"),
        (["explain", "-o", "ladder"], "REC"),
        (["explain", "nowhere", "-o", "ladder"], "nowhere"),
        (["explain", "rec", "-o", "ladder", "--effects", "range_scal"], "did you mean"),
    ],
    ids=lambda value: "" if isinstance(value, str) else " ".join(value),
)
def test_wrong_usage_is_one_sentence_and_2(rigcal, tmp_path, monkeypatch, arguments, part):
    monkeypatch.chdir(tmp_path)
    code, out, err = rigcal(*arguments)
    assert code == 2 and out == ""
    assert err.startswith("rigcal: ") and err.count("\n") == 1 and part in err, err
    assert not list(tmp_path.iterdir())


def test_a_fault_of_the_program_is_one_sentence_and_1(rigcal, monkeypatch):
    def broken(*_):
        raise RuntimeError("the sky fell")

    monkeypatch.setattr("calib.effects.find", broken)
    monkeypatch.delenv("RIGCAL_TRACEBACK", raising=False)
    code, out, err = rigcal("effects", "ring_range_offset")
    assert code == 1 and out == "" and err.count("\n") == 1
    assert "internal fault: RuntimeError: the sky fell" in err
    monkeypatch.setenv("RIGCAL_TRACEBACK", "1")
    monkeypatch.setattr(sys, "argv", ["rigcal", "effects", "ring_range_offset"])
    with pytest.raises(RuntimeError):
        main()


def test_a_check_that_finds_problems_is_2_and_says_them_on_stdout(rigcal, tmp_path):
    (tmp_path / "rig.yaml").write_text("name: empty\n")
    code, out, err = rigcal("check", tmp_path, "--json")
    assert (code, err) == (2, "")
    assert any("stops.csv does not exist" in problem for problem in json.loads(out)["problems"])
    code, out, err = rigcal("check", tmp_path)
    assert (code, err) == (2, "") and "stops.csv" in out


# ----------------------------------------------------------------------------------------- streams


def test_json_of_what_takes_long_stands_alone_on_stdout(made):
    folder, printed = made
    written = json.loads(printed["simulate"])
    assert all(Path(written[key]).exists() for key in ("recording", "truth"))
    summary = json.loads((folder / "run/summary.json").read_text())
    told = json.loads(printed["fit"])
    assert told.pop("not_estimated") and told == summary


@pytest.mark.parametrize(
    ("arguments", "keys"),
    [
        (["check", "rec"], {"contents", "problems", "odd", "can", "cannot"}),
        (["compare", "run", "run"], {"rms_mm", "parameters", "ladder"}),
        (["diagnose", "run"], {"verdict", "candidates", "unexplained", "weak_directions"}),
        (["export", "run", "-o", "out"], {"files"}),
        (["effects"], {"name", "formula", "source"}),
        (["effects", "ring_range_offset"], {"name", "formula", "source"}),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_json_stands_alone_on_stdout(rigcal, folder, monkeypatch, arguments, keys):
    monkeypatch.chdir(folder)
    code, out, err = rigcal(*arguments, "--json")
    assert (code, err) == (0, "")
    document = json.loads(out)
    for part in document if isinstance(document, list) else [document]:
        assert keys <= part.keys()


def test_a_run_grows_and_the_ladder_says_by_what(rigcal, folder, monkeypatch):
    monkeypatch.chdir(folder)
    (folder / "lean.yaml").write_text(
        "{name: lean, site: range, unit: m, sigma: 0.01, basis: ['sin(2 * azimuth)']}"
    )
    code, out, err = rigcal("add", "run", "arm_axis_tilt", "lean.yaml", "-o", "grown", "--json")
    assert (code, err) == (0, "")
    assert json.loads(out)["converged"] is True
    code, out, err = rigcal("compare", "grown", "--json")
    assert (code, err) == (0, "")
    foot, top = json.loads(out)["ladder"]
    assert foot["grown_from"] is None and Path(foot["run"]) == Path(top["grown_from"])
    assert top["added"] == ["arm_axis_tilt", "lean"] and top["dropped"] == []
    code, out, err = rigcal("compare", "grown")
    assert "+ arm_axis_tilt, + lean" in out
    code, out, err = rigcal("add", "grown", "lean.yaml", "-o", "more")
    assert (code, out) == (2, "") and "'lean' is in the model already" in err
    assert not (folder / "more").exists()


def test_a_diagnosis_stands_in_the_run_as_it_is_printed(rigcal, folder, monkeypatch):
    monkeypatch.chdir(folder)
    code, out, err = rigcal("diagnose", "run", "--no-refits", "--json")
    assert (code, err) == (0, "")
    assert json.loads(out) == json.loads((folder / "run/diagnosis.json").read_text())
    code, out, err = rigcal("diagnose", "run", "--no-refits")
    assert (code, err) == (0, "") and out.startswith("verdict: ")


def test_a_run_that_cannot_be_diagnosed_is_one_sentence_and_2(rigcal, folder, tmp_path):
    shutil.copytree(folder / "run", tmp_path / "run")
    (tmp_path / "run/state.npz").unlink()
    code, out, err = rigcal("diagnose", tmp_path / "run")
    assert (code, out) == (2, "") and err.count("\n") == 1 and "fit it again" in err


def test_explain_prints_its_ladder_and_goes_on_from_what_is_there(rigcal, folder, monkeypatch):
    monkeypatch.chdir(folder)
    effects = "arm_link_length,arm_joint_offset,arm_axis_tilt,ring_range_offset"
    arguments = ["explain", "rec", "-o", "ladder", "--fix", "mount.tx", "--effects", effects]
    code, out, err = rigcal(*arguments)
    assert (code, err) == (0, "")
    assert "ladder/00" in out and re.search(r"^00 +start +\d", out, flags=re.M)
    assert "verdict: " in out
    runs = sorted(path.name for path in (folder / "ladder").iterdir())
    assert runs[0] == "00" and runs[-1] == "explanation.json"
    made = (folder / "ladder/00/summary.json").stat().st_mtime_ns
    code, out, err = rigcal(*arguments, "--json")
    assert (code, err) == (0, "")
    assert json.loads(out) == json.loads((folder / "ladder/explanation.json").read_text())
    assert (folder / "ladder/00/summary.json").stat().st_mtime_ns == made
    model = (folder / "ladder/00/model.yaml").read_text()
    assert "mount.tx" in model and "arm_axis_tilt" in model


@pytest.mark.parametrize(
    "command",
    [["check", "rec"], ["compare", "run"], ["diagnose", "run"], ["effects"]],
    ids=" ".join,
)
def test_without_json_people_are_told_on_stdout(rigcal, folder, monkeypatch, command):
    monkeypatch.chdir(folder)
    code, out, err = rigcal(*command)
    assert (code, err) == (0, "") and len(out.splitlines()) > 3
    with pytest.raises(json.JSONDecodeError):
        json.loads(out)


def test_progress_is_shown_at_a_terminal_and_never_on_stdout(folder):
    with at_a_terminal("check", folder / "rec", "--json") as (process, shown):
        out = process.stdout.read()
        assert process.wait(LIMIT_S) == 0
    assert "━" in "".join(shown), "a bar"
    assert json.loads(out)["problems"] == []


# ------------------------------------------------------------------------------------------ Ctrl-C


class PressesCtrlC:
    """Once it is freed, where Python drops what is raised."""

    def __del__(self):
        signal.raise_signal(signal.SIGINT)


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_ctrl_c_counts_even_if_python_drops_it():
    before = signal.getsignal(signal.SIGINT)
    with heeding_ctrl_c(), progress_bar() as progress:
        progress("fitting", 0, 2)
        pressed = PressesCtrlC()
        del pressed
        with pytest.raises(KeyboardInterrupt):
            progress("fitting", 1, 2)
    with heeding_ctrl_c(), progress_bar() as progress:
        progress("fitting", 0, 2)  # the next command knows nothing of it
    assert signal.getsignal(signal.SIGINT) is before


def test_an_interrupted_fit_leaves_the_earlier_run_as_it_was(folder):
    before = contents(folder)
    arguments = ["fit", folder / "rec", "-o", folder / "run", "--hold-out", "stop", "--folds", 5]
    with at_a_terminal(*arguments) as (process, shown):
        while not list(folder.glob(".run.rigcal/kept/*/*.npz")):  # beside its result
            assert process.poll() is None, "".join(shown)
            threading.Event().wait(0.01)
        process.send_signal(signal.SIGINT)
        assert process.wait(60) == 130
        assert process.stdout.read() == ""
    assert "rigcal: interrupted" in "".join(shown)
    said = re.sub(r"\s+", " ", re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", "".join(shown)))
    assert "what was done of it is kept, for the same command to go on from" in said
    assert {path.name for path in (folder / ".run.rigcal").iterdir()} == {"kept"}
    shutil.rmtree(folder / ".run.rigcal")
    assert contents(folder) == before
