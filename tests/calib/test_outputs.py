"""Where a command may write, and that what it writes is whole: without any command."""

import contextlib
import errno
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from calib import outputs
from calib.outputs import moves
from chains.errors import InputError

from .folders import contents, fill, recording, run

# ------------------------------------------------------------------------------- what is not ours


@pytest.mark.parametrize(
    ("out", "words"),
    [
        ("rec", "rec exists and is read here"),
        ("rec/run", "rec/run lies inside .*rec, which is read here"),
        ("rec/../rec/scans", "lies inside"),
        ("link/run", "lies inside"),
        ("link", "is read here"),
        (".", "rec, which is read here, lies inside"),
        ("other/run", "lies inside the recording"),
        ("done/run", "lies inside the run"),
        ("mine", r"mine exists and is no run \(it has no model.yaml\)"),
        ("mine/notes.txt", "is a file; give a folder"),
        ("mine/notes.txt/run", "cannot be written"),
        ("round", "cannot be written"),
        ("n" * 300, "cannot be written"),
    ],
)
def test_what_is_not_to_be_written_is_refused_and_left_alone(tmp_path, out, words):
    rec = recording(tmp_path / "rec")
    (rec / "scans").mkdir()
    recording(tmp_path / "other")
    run(tmp_path / "done")
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/notes.txt").write_text("all of it")
    (tmp_path / "link").symlink_to(rec, target_is_directory=True)
    (tmp_path / "round").symlink_to(tmp_path / "round")
    before = contents(tmp_path)
    with (
        pytest.raises(InputError, match=words) as error,
        outputs.folder(tmp_path / out, outputs.RUN, [rec]),
    ):
        pytest.fail("it was let through")
    assert "\n" not in str(error.value)
    assert contents(tmp_path) == before
    assert not [*tmp_path.rglob("*.rigcal")]


@pytest.mark.parametrize("out", ["s3://bucket/run", Path("s3://bucket/run")])
def test_a_url_is_no_place_to_write(out, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with (
        pytest.raises(InputError, match=r"^s3://bucket/run: an output is written to this machine"),
        outputs.folder(out, outputs.RUN),
    ):
        pytest.fail("it was let through")
    assert [*tmp_path.iterdir()] == []


def test_a_file_is_no_part_of_what_is_read(tmp_path):
    done = run(tmp_path / "run")
    (tmp_path / "page.html").symlink_to(done / "solution.yaml")
    for out in (done / "solution.yaml", done / "page.html", tmp_path / "page.html"):
        with pytest.raises(InputError, match="lies inside"):
            outputs.refuse(out, None, [done])
    with pytest.raises(InputError, match="is a folder"):
        outputs.refuse(tmp_path, None)
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(InputError, match="no ordinary file"):
        outputs.refuse(tmp_path / "pipe", None)


def test_a_file_that_is_read_is_not_written_over_by_its_folder(tmp_path):
    (tmp_path / "logs").mkdir()
    (tmp_path / "logs/a.csv").write_text("a week")
    with pytest.raises(InputError, match="is read here, lies inside"):
        outputs.refuse(tmp_path / "logs", outputs.RECORDING, [tmp_path / "logs/a.csv"])
    assert outputs.refuse(tmp_path / "rec", outputs.RECORDING, [tmp_path / "logs/a.csv"])


def test_a_kind_is_told_by_what_lies_in_it(tmp_path):
    rec, done = recording(tmp_path / "rec"), run(tmp_path / "run")
    for folder in (rec, done):  # as earlier versions wrote into them
        (folder / "extrinsics.yaml").write_text("# Written by rigcal")
        (folder / "evaluation.json").write_text("{}")
        (folder / "points.parquet").mkdir()
        (folder / "points.parquet/_columns.yaml").write_text("")
    export = tmp_path / "export"
    export.mkdir()
    (export / "arm.urdf").write_text("<!-- Written by rigcal -->")
    urdf = tmp_path / "urdf"
    urdf.mkdir()
    (urdf / "arm.urdf").write_text("<robot/>")
    kinds = (outputs.RECORDING, outputs.RUN, outputs.EXPORT, outputs.EVALUATION, outputs.CLOUDS)
    found = {f.name: [k.name for k in kinds if not k.lacks(f)] for f in (rec, done, export, urdf)}
    assert found == {"rec": ["recording"], "run": ["run"], "export": ["export"], "urdf": []}


def test_a_ladder_holds_runs_and_nothing_else(tmp_path):
    run(tmp_path / "ladder/00")
    (tmp_path / "ladder/explanation.json").write_text("{}")
    assert outputs.refuse(tmp_path / "ladder", outputs.LADDER)
    recording(tmp_path / "days/01")
    with pytest.raises(InputError, match="holds 01"):
        outputs.refuse(tmp_path / "days", outputs.LADDER)


def test_what_is_write_protected_is_not_replaced(tmp_path, monkeypatch):
    """As root sees an immutable file, and others what they have protected by its mode."""
    done = run(tmp_path / "run")
    protected = str(done / "residuals.parquet/a.parquet")
    monkeypatch.setattr(os, "access", lambda path, mode: str(path) != protected)
    said = "a.parquet is write-protected"
    with pytest.raises(InputError, match=said), outputs.folder(done, outputs.RUN):
        pytest.fail("it was let through")
    with outputs.entries(done, outputs.RUN) as new:  # which leaves that file alone
        (new / "diagnosis.json").write_text("{}")


# ------------------------------------------------------------------------------- what is replaced


@pytest.mark.parametrize("exchange", [True, False])
def test_parts_are_replaced_and_what_somebody_put_there_stays(tmp_path, monkeypatch, exchange):
    if not exchange:
        monkeypatch.setattr(moves, "exchange", lambda one, other: False)
    done = run(tmp_path / "run")
    (done / "diagnosis.json").write_text("of the old one")
    (done / "notes").mkdir()
    (done / "notes/a.txt").write_text("mine")
    (done / "notes/link").symlink_to("../model.yaml")
    done.chmod(0o750)
    with outputs.folder(done, outputs.RUN) as new:
        assert contents(done)["model.yaml"] == "old", "it is made beside"
        fill(new)
    found = contents(done)
    assert found.pop("notes/a.txt") == "mine" and found.pop("notes/link") == "new"
    assert set(found) == {"model.yaml", "solution.yaml", "residuals.parquet/a.parquet"}
    assert set(found.values()) == {"new"}
    assert done.stat().st_mode & 0o777 == 0o750
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


def test_a_link_to_a_folder_stays_one(tmp_path):
    (tmp_path / "disk").mkdir()
    done = run(tmp_path / "disk/run")
    (tmp_path / "run").symlink_to(done, target_is_directory=True)
    with outputs.folder(tmp_path / "run", outputs.RUN) as new:
        fill(new)
    assert (tmp_path / "run").is_symlink() and contents(done)["model.yaml"] == "new"


def test_the_folder_in_which_a_shell_stands_stays_the_same(tmp_path, monkeypatch):
    done = run(tmp_path / "run")
    (done / "diagnosis.json").write_text("of the old one")
    (done / "notes.txt").write_text("mine")
    monkeypatch.chdir(done)
    with outputs.folder(".", outputs.RUN) as new:
        fill(new)
    assert Path.cwd() == done.resolve() and contents(Path())["model.yaml"] == "new"
    assert "diagnosis.json" not in contents(done) and contents(done)["notes.txt"] == "mine"


def test_what_fails_leaves_the_old_one_and_no_other(tmp_path):
    done = run(tmp_path / "run")
    before = contents(tmp_path)
    with pytest.raises(RuntimeError), outputs.folder(done, outputs.RUN) as new:
        fill(new)
        raise RuntimeError
    with pytest.raises(RuntimeError), outputs.folder(tmp_path / "a/b/run", outputs.RUN) as new:
        raise RuntimeError
    assert contents(tmp_path) == before and [p.name for p in tmp_path.iterdir()] == ["run"]


def test_two_that_belong_together_are_moved_both_or_none(tmp_path, monkeypatch):
    done = run(tmp_path / "run")
    before = contents(tmp_path)
    move, moved = moves._move, []

    def full(source, target, aside):
        if moved:
            raise OSError(errno.EPERM, os.strerror(errno.EPERM), str(target))
        moved.append(target)
        return move(source, target, aside)

    monkeypatch.setattr(moves, "_move", full)
    with (
        pytest.raises(InputError, match="Operation not permitted"),
        outputs.entries(done, outputs.RUN) as new,
    ):
        (new / "model.yaml").write_text("new")
        (new / "solution.yaml").write_text("new")
    assert len(moved) == 1 and contents(tmp_path) == before


# ------------------------------------------------------------------------------------- who writes


HOLD = """
import sys
from calib import outputs
with outputs.folder(sys.argv[1], outputs.RUN) as new:
    (new / "model.yaml").write_text("theirs")
    print("in", flush=True)
    sys.stdin.readline()
"""


@contextlib.contextmanager
def writer(path):
    """Another process that writes there, until it is told to end."""
    how = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    root = str(Path(outputs.__file__).parents[2])
    env = os.environ | {"PYTHONPATH": root}
    with subprocess.Popen([sys.executable, "-c", HOLD, str(path)], env=env, **how) as process:
        assert process.stdout.readline() == "in\n"
        try:
            yield process
        finally:
            process.kill()


def test_two_processes_do_not_write_one_folder(tmp_path, caplog):
    done = run(tmp_path / "run")
    with writer(done) as other:
        said = f"being written by process {other.pid}; wait for it"
        with pytest.raises(InputError, match=said), outputs.folder(done, outputs.RUN):
            pytest.fail("it was let in")
        outputs.settle(done)  # a reader leaves the draft of a living process alone
        assert [*tmp_path.glob(".run.rigcal/draft/model.yaml")] and not caplog.text
        with outputs.folder(tmp_path / "other", outputs.RUN) as new:
            fill(new)
    assert not caplog.text, "that one has nothing to do with it"
    with outputs.folder(done, outputs.RUN) as new:  # it was killed: its lock died with it
        fill(new)
    assert contents(done)["model.yaml"] == "new" and "the earlier one stands" in caplog.text


def test_one_process_does_not_write_one_folder_twice(tmp_path):
    with outputs.folder(tmp_path / "run", outputs.RUN) as new:
        fill(new)
        again = outputs.folder(tmp_path / "run", outputs.RUN)
        with pytest.raises(InputError, match="being written"), again:
            pytest.fail("it was let in")
    assert contents(tmp_path / "run")["model.yaml"] == "new"


def test_a_workshop_that_is_a_link_or_lies_is_not_followed(tmp_path):
    """A folder that a colleague sent may bring along what looks like a workshop."""
    mine = tmp_path / "mine"
    for name in ("draft", "whole", "entries"):
        run(mine / name)
    before = contents(mine)
    (tmp_path / ".a.rigcal").symlink_to(mine)
    outputs.settle(tmp_path / "a")
    with pytest.raises(InputError, match="is a link"), outputs.folder(tmp_path / "a", outputs.RUN):
        pytest.fail("it was followed")
    work = tmp_path / ".b.rigcal"
    (work / "beside").mkdir(parents=True)
    (work / "beside/mine").write_text("evil")
    (work / "beside/b.truth.json").write_text("ours")
    inodes = {"beside/../../mine/draft": 1, "beside/mine": 1, "entries/../x": 1, "/etc/passwd": 1}
    record = {"process": 1, "inodes": inodes, "dropped": ["../mine", "/etc"]}
    (work / "lock").write_text(json.dumps(record))
    outputs.settle(tmp_path / "b")
    assert contents(mine) == before and not work.exists()
    assert sorted(p.name for p in tmp_path.iterdir()) == [".a.rigcal", "mine"]
