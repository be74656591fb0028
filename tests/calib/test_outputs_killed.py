"""Writers that die before any step that changes a folder: what they write is old or new."""

import multiprocessing
import os
import shutil
import sys
from pathlib import Path

import pytest

from calib import outputs
from calib.outputs import moves
from chains.errors import CutShortError, InputError

from .folders import contents, fill, run

# Forked from a process that has loaded no more than this file: one of two gigabytes, as pytest is
# after many tests, takes three times as long.
FORKS = multiprocessing.get_context("forkserver")
FORKS.set_forkserver_preload([__name__])
STEPS = {"os.rename", "os.remove", "os.rmdir", "os.mkdir", "os.link", "os.truncate"}


def simulated(out: Path) -> None:
    with outputs.folder(out, outputs.SIMULATED, beside=["truth.json"]) as new:
        fill(new)
        for name in ("rig.yaml", "stops.csv", "truth.json"):
            (new / name).write_text("new")


def fitted(out: Path) -> None:
    with outputs.folder(out, outputs.RUN) as new:
        fill(new)


def in_its_own(out: Path) -> None:
    os.chdir(out if out.exists() else out.parent)
    fitted(out)


def evaluated(out: Path) -> None:
    with outputs.entries(out, outputs.RUN) as new:
        (new / "points.parquet").mkdir()
        (new / "points.parquet/a").write_text("new")
        (new / "evaluation.json").write_text("new")


def reported(out: Path) -> None:
    with outputs.file(out.with_name("page.html")) as file:
        file.write_text("new")


def before_all(folder: Path) -> Path:
    run(folder / "run")
    for name in ("page.html", "run.truth.json"):
        (folder / name).write_text("old")
    for name in ("run/evaluation.json", "run/notes.txt", "run/rig.yaml", "run/stops.csv"):
        (folder / name).write_text("old")
    (folder / "run/points.parquet").mkdir()
    (folder / "run/points.parquet/a").write_text("old")
    return folder


def die_before(step: int, write, out: Path, exchange: bool) -> int:
    """Write in a process that ends, as if killed, before a step; how many steps it took."""
    told, tell = FORKS.Pipe(duplex=False)
    child = FORKS.Process(target=write_until, args=(step, write, out, exchange, tell))
    child.start()
    tell.close()
    child.join()
    with told:
        try:
            return told.recv()
        except EOFError:
            return -1


def write_until(step: int, write, out: Path, exchange: bool, tell) -> None:
    """In a process of its own: write, and say how many steps that took, or die before a step."""
    count = 0

    def watch(event, arguments):
        nonlocal count
        if event in STEPS:
            if count == step:
                os._exit(9)
            count += 1

    if not exchange:
        moves.exchange = lambda one, other: False
    sys.addaudithook(watch)
    write(out)
    tell.send(count)
    os._exit(0)


@pytest.mark.parametrize("exchange", [True, False], ids=["exchange", "aside"])
@pytest.mark.parametrize(
    ("write", "there"),
    [
        *[(simulated, True), (fitted, True), (in_its_own, True), (evaluated, True)],
        *[(reported, True), (simulated, False), (in_its_own, False), (reported, False)],
    ],
)
@pytest.mark.long
def test_killed_before_any_step_it_is_old_or_new(tmp_path, caplog, write, there, exchange):
    begin = before_all(tmp_path / "begin") if there else tmp_path / "begin"
    begin.mkdir(exist_ok=True)
    world = tmp_path / "world"
    shutil.copytree(begin, world)
    steps = die_before(-1, write, world / "run", exchange)
    old, new = contents(begin), contents(world)
    assert steps > 5 and old != new and not [*world.glob(".*")]
    each = [(k, bool(k % 2)) for k in range(steps)] + [
        (k, False) for k in range(steps) if not there
    ]
    for step, reads in each:
        shutil.rmtree(world)
        shutil.copytree(begin, world)
        assert die_before(step, write, world / "run", exchange) == -1
        if reads:  # somebody reads it, or it is written again at once
            outputs.settle(world / "run")
            outputs.settle(world / "page.html")
            assert contents(world) in (old, new), step
            assert not [*world.rglob(".*.rigcal")]
        (fitted if write is in_its_own else write)(world / "run")
        assert contents(world) == new, step
        assert not [*world.rglob(".*.rigcal")]
    assert "the new one stands" in caplog.text
    assert ("the earlier one stands" if there else "nothing of it was kept") in caplog.text


def in_parts(out: Path, asked: str = "this") -> None:
    with outputs.folder(out, outputs.RUN) as new:
        fill(new)
        parts = outputs.kept(new, {"asked": asked}).each(
            "parts", 3, lambda some: ((f"{asked} {i}", b"%d" % i) for i in some)
        )
        for i, part in enumerate(parts):
            part.put(new / f"points.parquet/{i}")
            (new / f"points.parquet/{i}.told").write_text(part.told)


def in_other_parts(out: Path) -> None:
    in_parts(out, "that")


def only_parts_are_left(world: Path) -> bool:
    """Whether nothing that begins with a dot is there but parts that are kept."""
    left = [path for work in world.glob(".*") for path in work.iterdir()]
    return {path.name for path in left} <= {"kept"}


@pytest.mark.parametrize("again", [in_parts, in_other_parts], ids=["same", "other"])
@pytest.mark.parametrize("exchange", [True, False], ids=["exchange", "aside"])
@pytest.mark.long
def test_parts_that_were_done_are_used_by_the_same_command(tmp_path, caplog, exchange, again):
    """Killed before any step; and the next one is asked the same, or something else."""
    caplog.set_level("INFO", "rigcal")
    begin, world = before_all(tmp_path / "begin"), tmp_path / "world"
    shutil.copytree(begin, world)
    again(world / "run")
    new = contents(world)
    shutil.rmtree(world)
    shutil.copytree(begin, world)
    steps, old = die_before(-1, in_parts, world / "run", exchange), contents(begin)
    done = contents(world)
    for step in range(steps):
        shutil.rmtree(world)
        shutil.copytree(begin, world)
        assert die_before(step, in_parts, world / "run", exchange) == -1
        if step % 2:  # somebody reads it
            outputs.settle(world / "run")
            seen = {n: x for n, x in contents(world).items() if not n.startswith(".")}
            assert seen in (old, done), step
            assert only_parts_are_left(world), step
        again(world / "run")
        assert contents(world) == new, step
        assert not [*world.rglob(".*.rigcal")]
    assert "what it had done is kept, for the same command" in caplog.text
    used = [f"parts: {n} of 3 were done before" in caplog.text for n in (1, 2, 3)]
    assert used == [again is in_parts] * 3


def test_a_part_that_is_not_whole_is_done_again(tmp_path):
    """As after a loss of power, which may keep a file's name and lose what was in it."""
    done = []

    def work(some):
        done.append(list(some))
        return ((None, b"%d" % i) for i in some)

    kept = outputs.kept(tmp_path / "draft", {})
    files = [part.file for part in kept.each("parts", 5, work)]
    files[1].write_bytes(b"")
    files[2].unlink()
    files[3].with_name(f"{files[3].name}.json").write_text("[]")
    again = outputs.kept(tmp_path / "draft", {}).each("parts", 5, work)
    assert [part.file.read_bytes() for part in again] == [b"%d" % i for i in range(5)]
    assert done == [[0, 1, 2, 3, 4], [1, 2, 3]]


@pytest.mark.parametrize(
    ("error", "stays"),
    [
        *[(KeyboardInterrupt, True), (CutShortError("no more workers"), True)],
        *[(MemoryError, True), (OSError(28, "full"), False), (InputError("wrong"), False)],
    ],
)
def test_parts_stay_where_the_same_command_may_do_better(tmp_path, error, stays):
    def work(some):
        yield None, b"0"
        raise error

    def write():
        with outputs.folder(tmp_path / "run", outputs.RUN) as new:
            for part in outputs.kept(new, {}).each("parts", 2, work):
                part.put(new / "model.yaml")

    with pytest.raises((KeyboardInterrupt, MemoryError, InputError)):
        write()
    assert [path.name for path in tmp_path.glob(".*/*")] == ["kept"] * stays


@pytest.mark.skipif(sys.platform != "linux", reason="renameat2 is Linux's")
def test_two_folders_are_exchanged_in_one_step(tmp_path):
    run(tmp_path / "a", "a")
    run(tmp_path / "b", "b")
    assert moves.exchange(tmp_path / "a", tmp_path / "b")
    assert contents(tmp_path / "a")["model.yaml"] == "b"
    with pytest.raises(FileNotFoundError):
        moves.exchange(tmp_path / "a", tmp_path / "nowhere")
