"""Somebody else's Python runs only when the user says so on this command line.

The effect of the run writes a file when it is run; nothing else tells whether it was.
"""

import py_compile
import re
import shutil
from hashlib import sha256
from pathlib import Path

import pytest
import yaml

from calib.effects import load_effects, trust_in
from calib.problem.model import Model
from calib.runs.asked.commands import command_without
from calib.runs.calibrate import calibrate
from calib.runs.diagnose import diagnose
from calib.runs.run import MODEL, Run
from calib.view.desk import Desk, Findings
from calib.view.job import Change, Job
from chains.errors import InputError
from sensors.documents import write_yaml

from . import rigs

LEAN = """
from pathlib import Path

import numpy as np

from calib.effects import Effect, Param, Site

Path({mark!r}).touch()


class Lean(Effect):
    name, site, unit = "lean", Site.BEAM, "m"

    def params(self, rig):
        return (Param("amount", "m", 0.01),)

    def basis(self, view):
        basis = np.zeros((view.rows, 3, 1))
        basis[:, 0, 0] = np.sin(2 * view["azimuth_rad"])
        return basis
"""
# Commands that look at the run's effects; what they need beside the run, and what they write.
NEED_IT = {
    "add": ["{run}", "range_scale", "-o", "{out}"],
    "diagnose": ["{run}", "--no-refits"],
    "evaluate": ["{run}"],
    "report": ["{run}", "-o", "{out}.html"],
    "plot": ["{run}", "--list"],
}
DO_WITHOUT = {
    "export": ["{run}", "-o", "{out}"],
    "apply": ["{run}", "{scan}", "-o", "{out}"],
}
NEVER_LOOK = {"compare": ["{run}"]}


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A folder with a recording, a Python file, and a diagnosed run with its effect."""
    folder = tmp_path_factory.mktemp("trust")
    rigs.write(folder / "rec", seed=4)
    (folder / "mine.py").write_text(LEAN.format(mark=str(folder / "ran")))
    effects = load_effects(["ring_range_offset", str(folder / "mine.py:Lean")])
    run = calibrate([folder / "rec"], folder / "run", Model(effects), "none")
    assert run.trust == trust_in(effects)
    diagnose(run, refits=False)
    return folder


@pytest.fixture
def folder(made):
    """The same, the mark of code that ran being taken away."""
    (made / "ran").unlink(missing_ok=True)
    return made


def words(folder, tmp_path, arguments):
    scan = next((folder / "rec" / "scans").iterdir())
    return [a.format(run=folder / "run", out=tmp_path / "out", scan=scan) for a in arguments]


def digest(path):
    return sha256(Path(path).read_bytes()).hexdigest()


def test_the_run_keeps_the_hash_of_the_code(folder):
    (document,) = (e for e in Run.open(folder / "run").model["effects"] if not isinstance(e, str))
    assert document == {
        "python": str(folder / "mine.py"),
        "name": "Lean",
        "sha256": digest(folder / "mine.py"),
    }


@pytest.mark.parametrize("command", NEED_IT)
def test_without_trust_a_command_that_needs_the_code_refuses(folder, rigcal, tmp_path, command):
    code, out, err = rigcal(command, *words(folder, tmp_path, NEED_IT[command]))
    assert (code, out) == (2, "") and not (folder / "ran").exists()
    assert err.count("\n") == 1 and f"--trust {folder / 'mine.py'}" in err and "model.yaml" in err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("command", [*DO_WITHOUT, *NEVER_LOOK])
def test_without_trust_other_commands_do_without_it(folder, rigcal, tmp_path, command):
    arguments = (DO_WITHOUT | NEVER_LOOK)[command]
    code, out, err = rigcal(command, *words(folder, tmp_path, arguments), "--json")
    assert (code, err) == (0, "") and not (folder / "ran").exists()
    if command in DO_WITHOUT:
        assert "lean" in out and f"--trust {folder / 'mine.py'}" in out


@pytest.mark.parametrize("by", ["file", "hash"])
@pytest.mark.parametrize("command", ["evaluate", *DO_WITHOUT])
def test_with_trust_the_code_runs(folder, rigcal, tmp_path, command, by):
    trust = folder / "mine.py" if by == "file" else digest(folder / "mine.py")
    arguments = words(folder, tmp_path, (NEED_IT | DO_WITHOUT)[command])
    code, out, err = rigcal(command, *arguments, "--trust", trust)
    assert (code, err) == (0, "") and (folder / "ran").exists()
    assert "--trust" not in out


@pytest.mark.parametrize("command", ["add", "diagnose", "plot"])
def test_trust_reaches_the_commands_that_take_long(folder, rigcal, tmp_path, command):
    arguments = words(folder, tmp_path, NEED_IT[command])
    code, _, err = rigcal(command, *arguments, "--trust", folder / "mine.py")
    assert (code, err) == (0, "") and (folder / "ran").exists()


def test_a_file_that_has_changed_does_not_run(folder, rigcal, tmp_path):
    shutil.copytree(folder, tmp_path / "copy")
    run, mine = tmp_path / "copy" / "run", tmp_path / "copy" / "mine.py"
    document = yaml.safe_load((run / MODEL).read_text())
    document["effects"][1]["python"] = str(mine)
    write_yaml(run / MODEL, document)
    old = digest(mine)
    mine.write_text(mine.read_text() + "\n# changed\n")
    for trust in ([], ["--trust", mine], ["--trust", old], ["--trust", digest(mine)]):
        code, out, err = rigcal("evaluate", run, *trust)
        assert (code, out) == (2, "") and not (folder / "ran").exists()
        assert err.count("\n") == 1 and f"{mine}, which has changed since" in err


def test_a_file_that_has_moved_is_trusted_where_it_is_now(folder, rigcal, tmp_path):
    """A colleague sends a run and its file: paths are the colleague's."""
    run = shutil.copytree(folder / "run", tmp_path / "run")
    document = yaml.safe_load((run / MODEL).read_text())
    document["effects"][1]["python"] = "/home/colleague/mine.py"
    write_yaml(run / MODEL, document)
    found = command_without(Run.open(run), ["s1:scan"])
    assert found.endswith("--without s1:scan --trust /home/colleague/mine.py")
    code, _, err = rigcal("evaluate", run)
    assert code == 2 and "/home/colleague/mine.py, which is not there" in err
    assert digest(folder / "mine.py") in err
    code, _, err = rigcal("evaluate", run, "--trust", folder / "mine.py")
    assert (code, err) == (0, "") and (folder / "ran").exists()


def test_a_run_without_a_hash_runs_only_the_file_that_is_named(folder, tmp_path):
    """Runs of earlier versions have none."""
    model = {"effects": [{"python": str(folder / "mine.py"), "name": "Lean"}], "fixed": []}
    with pytest.raises(InputError, match="--trust"):
        Model.read(model)
    with pytest.raises(InputError, match="--trust"):
        Model.read(model, trust={"0" * 64: folder / "mine.py"})
    assert not (folder / "ran").exists()
    assert Model.read(model, trust={digest(folder / "mine.py"): None}).names == ("lean",)


def test_what_runs_is_what_was_hashed(folder, tmp_path):
    """Not a cached .pyc of other bytes that carries the same time stamp."""
    good, evil = tmp_path / "mine.py", tmp_path / "evil.py"
    good.write_text(LEAN.format(mark=str(tmp_path / "ran")))
    evil.write_text(f"open({str(tmp_path / 'evil')!r}, 'w')")
    cached = re.sub(r"evil(.*)$", r"mine\1", py_compile.compile(str(evil)))
    unchecked = py_compile.PycInvalidationMode.UNCHECKED_HASH
    py_compile.compile(str(evil), cfile=cached, invalidation_mode=unchecked)
    assert load_effects([str(good)])[0].name == "lean"
    assert (tmp_path / "ran").exists() and not (tmp_path / "evil").exists()


def test_naming_a_file_on_the_command_line_is_consent(folder, rigcal, tmp_path):
    """For that command, and for the same bytes where the run names them."""
    again = tmp_path / "again"
    code, _, err = rigcal(
        "fit", folder / "rec", "-o", again, "--effects", folder / "mine.py", "--hold-out", "none"
    )
    assert (code, err) == (0, "") and (folder / "ran").exists()
    (folder / "ran").unlink()
    code, _, err = rigcal("add", again, folder / "mine.py:Lean", "-o", tmp_path / "out")
    assert code == 2 and "in the model already" in err
    code, _, err = rigcal("add", again, "range_scale", "-o", tmp_path / "out")
    assert code == 2 and "--trust" in err


def test_a_spec_that_names_code_needs_trust(folder, rigcal, tmp_path):
    spec = tmp_path / "spec.yaml"
    write_yaml(
        spec,
        {
            "lidar": "hesai_pandarxt32", "locations": 1, "stops_per_location": 1,
            "column_step": 500, "acting": {str(folder / "mine.py"): 0.001},
        },
    )  # fmt: skip
    code, out, err = rigcal("simulate", spec, "-o", tmp_path / "rec")
    assert (code, out) == (2, "") and f"--trust {folder / 'mine.py'}" in err
    assert not (folder / "ran").exists() and not (tmp_path / "rec").exists()
    code, _, err = rigcal("simulate", spec, "-o", tmp_path / "rec", "--trust", folder / "mine.py")
    assert (code, err) == (0, "") and (folder / "ran").exists()


def test_the_workbench_offers_no_file_that_a_diagnosis_names(folder):
    """diagnosis.json comes with the run, and a click on Add must not run what it names."""
    mine = str(folder / "mine.py")
    candidate = {"effect": mine, "add": mine, "step": 1, "dressed_up": False}
    formulas = [{"name": "../x", "python": mine}, {"name": "../y", "site": "range"}]
    findings = Findings(
        heading="",
        sentences=[],
        candidates=[candidate],
        unexplained=[{"formula": formula} for formula in formulas],
        blunders=[],
        curves={},
    )
    offered = Desk.of([folder / "run"]).addable(findings)
    assert "range_scale" in offered
    assert all(name.partition("@")[0].isidentifier() for name in offered)


def test_the_workbench_runs_what_it_was_told_to_trust(folder, tmp_path):
    run = folder / "run"
    *_, last = Job(run, Change(tmp_path / "out", ["range_scale"])).listen()
    assert last.kind == "failed" and "--trust" in last.text and not (folder / "ran").exists()
    trust = {digest(folder / "mine.py"): None}
    assert Desk.of([run], trust).run.trust == trust
    *_, last = Job(run, Change(tmp_path / "out", ["range_scale"]), trust).listen()
    assert last.kind == "done" and (folder / "ran").exists()


@pytest.mark.parametrize("item", ["no.py", "abc123", "", "."])
def test_what_is_neither_file_nor_hash_is_refused(folder, rigcal, item):
    code, out, err = rigcal("evaluate", folder / "run", "--trust", item)
    assert (code, out) == (2, "") and err.count("\n") == 1 and "--trust" in err and "sha256" in err
