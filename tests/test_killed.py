"""Commands that are killed: what they were to replace is there, whole, old or new.

Each command that writes is killed before every step that changes a folder outside its draft, with
and without a system that can exchange two folders; and at moments drawn by chance. What the steps
themselves do is tested in tests/calib/test_outputs_killed.py, without commands.
"""

import itertools
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from calib import outputs
from calib.outputs.workshop import KEPT
from calib.rig import load_rig
from calib.runs.run import Run

from .programs import LIMIT_S, ROOT

ARM = "{lidar: null, mesh: false, targets: 0, locations: 3, stops_per_location: 4}"
LEAN = "{lidar: hesai_pandarxt32, locations: 2, stops_per_location: 2, column_step: 400}"
IMPORT = "import table arm/stops.csv urdf arm/arm.urdf --rig arm/rig.yaml --rows stops -o got"


@dataclass(frozen=True)
class Case:
    """A command and what it writes.

    Args:
        words: the command.
        written: what it writes, names in the world; all of it is old or all of it new.
        several: whether it moves several things, which whoever looks first then finishes.
    """

    words: str
    written: tuple[str, ...]
    several: bool = False


CASES = {
    "simulate": Case("simulate arm.yaml -o sim --seed 2", ("sim", "sim.truth.json"), True),
    "import": Case(f"{IMPORT} --most-stops 9", ("got",)),
    "fit": Case("fit arm -o fitted --hold-out none", ("fitted",)),
    "add": Case("add run arm_axis_tilt -o grown", ("grown",)),
    "diagnose": Case("diagnose looked --no-refits", ("looked",)),
    "explain": Case("explain arm -o ladder", ("ladder",), True),
    "evaluate": Case("evaluate judged", ("judged",), True),
    "evaluate -o": Case("evaluate seen -o judgement", ("judgement",)),
    "export": Case("export run -o exported", ("exported",)),
    "apply": Case("apply seen lean -o applied", ("applied",)),
    "plot": Case("plot run chain -o chain.png", ("chain.png",)),
    "report": Case("report run -o page.html", ("page.html",)),
}
QUICK = ("simulate", "fit", "evaluate", "export", "apply")  # each way of writing once


class World:
    """A folder with recordings and runs, and a zygote that runs commands in it."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.kept = folder / "world", folder / "kept"
        self.told, self.steps = folder / "told", folder / "steps"
        self.folder.mkdir()
        self.kept.mkdir()
        self.zygote = subprocess.Popen(
            [sys.executable, ROOT / "tests/zygote.py"],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
            env=os.environ | {"PYTHONPATH": str(ROOT)},
        )  # fmt: skip
        assert self.zygote.stdout.readline() == "ready\n"

    def start(self, words: str, at: int | None = None, exchange: bool = True, most=None) -> int:
        self.steps.unlink(missing_ok=True)
        request = {
            "argv": words.split(), "cwd": str(self.folder), "at": at, "exchange": exchange,
            "steps": str(self.steps), "told": str(self.told), "most": most,
        }  # fmt: skip
        print(json.dumps(request), file=self.zygote.stdin, flush=True)
        return int(self.zygote.stdout.readline())

    def ended(self) -> int:
        return int(self.zygote.stdout.readline())

    def run(self, words: str, at: int | None = None, exchange: bool = True, most=None) -> int:
        self.start(words, at, exchange, most)
        return self.ended()

    def did(self, words: str) -> None:
        assert self.run(words) == 0, self.said()

    def said(self) -> str:
        return self.told.read_text()

    def keep(self, name: str) -> None:
        """Keep something as it is, to be brought back."""
        source = self.folder / name
        (shutil.copytree if source.is_dir() else shutil.copyfile)(source, self.kept / name)

    def restore(self, case: Case) -> None:
        """All that a command writes as it was, and nothing left of a killed one."""
        for path in (*self.folder.glob(".*.rigcal"), *map(self.folder.joinpath, case.written)):
            if path.is_dir():
                shutil.rmtree(path)
            else:
                path.unlink(missing_ok=True)
        for name in case.written:
            kept = self.kept / name
            if kept.exists():
                (shutil.copytree if kept.is_dir() else shutil.copyfile)(kept, self.folder / name)

    def contents(self, case: Case) -> dict:
        """All that a command writes, but for how long it took."""
        found = {}
        for name in case.written:
            top = self.folder / name
            for path in (top, *top.rglob("*")):
                if path.is_file():
                    found[str(path.relative_to(self.folder))] = said(path)
        return found


def said(path: Path) -> object:
    if path.name == "summary.json":
        return {key: x for key, x in json.loads(path.read_text()).items() if key != "seconds"}
    if path.suffix == ".npz":
        with np.load(path) as arrays:
            return {name: arrays[name].tobytes() for name in arrays.files}
    if path.suffix == ".html":
        return re.sub(r"<th>written</th><td>[^<]*", "", path.read_text())
    return path.read_bytes()


def make(world: World) -> None:
    """What the cases begin from: every output there already, and other than it will be."""
    for name, text in (("arm.yaml", ARM), ("lean.yaml", LEAN)):
        (world.folder / name).write_text(text)
    world.did("simulate arm.yaml -o arm --seed 1")
    world.did("simulate lean.yaml -o lean --seed 1")
    world.did("simulate arm.yaml -o sim --seed 1")
    world.did(IMPORT)
    world.did("fit arm -o run --hold-out none --effects arm_joint_offset")
    world.did("fit lean -o seen --hold-out none")
    folder = world.folder
    for name in ("fitted", "grown", "looked"):
        shutil.copytree(folder / "run", folder / name)
    (folder / "looked/diagnosis.json").write_text("{}")
    (folder / "ladder").mkdir()
    shutil.copytree(folder / "run", folder / "ladder/00")
    (folder / "ladder/explanation.json").write_text("{}")
    world.did("evaluate seen -o judgement")
    world.did("export run -o exported --format yaml --format urdf")
    world.did("apply seen lean -o applied")
    shutil.copytree(folder / "seen", folder / "judged")
    shutil.copytree(folder / "judgement/points.parquet", folder / "judged/points.parquet")
    for name in ("judgement", "judged"):  # a pair of which each tells whether it is the old one
        (folder / name / "points.parquet/_columns.yaml").write_text("old: columns\n")
        (folder / name / "evaluation.json").write_text("{}")
    (folder / "exported/extrinsics.yaml").write_text("# by rigcal, long ago\n")
    (folder / "applied/lean/stops.csv").write_text("old\n")
    (folder / "chain.png").write_text("old")
    (folder / "page.html").write_text("old")
    for case in CASES.values():
        for name in case.written:
            world.keep(name)


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    world = World(tmp_path_factory.mktemp("killed"))
    try:
        make(world)
        yield world
    finally:
        world.zygote.kill()
        world.zygote.wait(LIMIT_S)


def leftovers(world: World) -> list[Path]:
    """What commands leave that are killed, but for parts that the same one will go on from."""
    hidden = [path for path in world.folder.rglob(".*") if path.name != outputs.CLOUDS_MARK]
    return [path for path in hidden if KEPT not in path.parts and path not in parts(world)]


def parts(world: World) -> list[Path]:
    """Workshops in which nothing is but such parts."""
    works = world.folder.rglob(".*.rigcal")
    return [work for work in works if [path.name for path in work.iterdir()] == [KEPT]]


def look(path: Path) -> None:
    """Open what a command wrote, as the next command would."""
    if (path / "model.yaml").is_file():
        Run.open(path)
    elif (path / "rig.yaml").is_file():
        load_rig(path)
    elif (path / "00").is_dir():
        outputs.settle(path)
        Run.open(path / "00")
    else:
        outputs.settle(path)


def found_whole(world: World, case: Case, old: dict, new: dict, caplog) -> None:
    """What a killed command left is old or new, and once somebody has looked nothing else."""
    left = any(path.name != "lock" for each in leftovers(world) for path in each.glob("*"))
    if not case.several and (there := world.contents(case)):  # none where one was put aside
        assert there in (old, new), "before anybody looks"
    caplog.clear()
    for name in case.written:
        look(world.folder / name)
    assert ("was cut short" in caplog.text) == left
    if case is CASES["explain"]:  # its rungs are whole each, and it goes on from them
        return
    assert world.contents(case) in (old, new)
    assert leftovers(world) == []


@pytest.mark.long
@pytest.mark.parametrize("name", [*QUICK, "import", "plot"])
def test_a_full_disk_is_one_sentence_and_changes_nothing(world, name):
    """No file may grow beyond a few lines, which the system answers as it does a full disk."""
    case = CASES[name]
    world.restore(case)
    old = world.contents(case)
    assert world.run(case.words, most=1000) == 2
    assert re.fullmatch(r"rigcal: .* cannot be written: .*; nothing was .*again\n", world.said())
    assert world.contents(case) == old and leftovers(world) == []


def killed_at_every_step(world: World, case: Case, caplog, exchange=True, all_steps=True) -> None:
    world.restore(case)
    old = world.contents(case)
    assert world.run(case.words, exchange=exchange) == 0, world.said()
    steps, new = world.steps.read_text().splitlines(), world.contents(case)
    assert old != new and leftovers(world) == []
    for at in points(steps) if all_steps else around_renames(steps):
        world.restore(case)
        code = world.run(case.words, at, exchange)
        assert code == (-signal.SIGKILL if at < len(steps) else 0), at
        found_whole(world, case, old, new, caplog)
        if parts(world):
            assert world.run(case.words) == 0, world.said()
            assert world.contents(case) == new and parts(world) == []
    assert world.run(case.words) == 0, world.said()
    assert world.contents(case) == new and leftovers(world) == []


def points(steps: list[str]) -> list[int]:
    """Steps to be killed at, and after them all: of those that sweep, which are many, a few."""
    sweeping = [k for k, step in enumerate(steps) if step in ("os.remove", "os.rmdir")]
    some = {*sweeping[:2], *sweeping[len(sweeping) // 2 :][:1], *sweeping[-2:]}
    return [k for k in range(len(steps) + 1) if k not in sweeping or k in some]


def around_renames(steps: list[str]) -> list[int]:
    """Before each rename, and after the last."""
    renames = [k for k, step in enumerate(steps) if step == "os.rename"]
    return [*renames, renames[-1] + 1]


@pytest.mark.long
@pytest.mark.parametrize("name", QUICK)
def test_a_command_killed_at_a_rename_leaves_old_or_new(world, name, caplog):
    killed_at_every_step(world, CASES[name], caplog, all_steps=False)


@pytest.mark.long
@pytest.mark.parametrize("words", ["fit lean -o leaned", "add seen range_scale -o leaned"])
def test_a_fit_that_is_killed_goes_on_from_what_it_knows(world, words):
    """To the same bytes, from any of its passes; a fit that is asked anything else knows nothing.

    The estimate takes the same way on two processes as on threads.
    """
    case = Case(words, ("leaned",))
    world.restore(case)
    assert world.run(words) == 0, world.said()
    steps, new = world.steps.read_text().splitlines(), world.contents(case)
    renames = around_renames(steps)
    used = []
    for at, how in zip(renames[1:-3:4], itertools.cycle(["", " --workers 2"])):
        world.restore(case)
        assert world.run(words + how, at) == -signal.SIGKILL
        assert world.run(f"-v {words}") == 0, world.said()
        assert world.contents(case) == new and leftovers(world) == parts(world) == []
        told = re.search(r"^rigcal: (\d+) answers of passes", world.said(), re.M)
        used.append(int(told[1]) if told else 0)
    assert used == sorted(used) and used[0] > 0 and used[-1] > 5
    world.restore(case)
    assert world.run(words, renames[-5]) == -signal.SIGKILL
    other = "fit lean -o leaned --effects range_offset"
    assert world.run(f"-v {other}") == 0 and "answers of passes" not in world.said()
    assert leftovers(world) == parts(world) == []


@pytest.mark.long
@pytest.mark.parametrize("exchange", [True, False], ids=["exchange", "aside"])
@pytest.mark.parametrize("name", CASES)
def test_a_command_killed_before_any_step_leaves_old_or_new(world, name, exchange, caplog):
    killed_at_every_step(world, CASES[name], caplog, exchange)


@pytest.mark.long
def test_sixty_commands_killed_by_chance_leave_old_or_new(world, caplog):
    chance = np.random.default_rng(2)
    for case in CASES.values():
        world.restore(case)
        old, began = world.contents(case), time.monotonic()
        world.did(case.words)
        took, new = time.monotonic() - began, world.contents(case)
        for _ in range(60 // len(CASES)):
            world.restore(case)
            process = world.start(case.words)
            time.sleep(chance.uniform(0.0, took))
            with suppress(ProcessLookupError):
                os.kill(process, signal.SIGKILL)
            assert world.ended() in (-signal.SIGKILL, 0)
            found_whole(world, case, old, new, caplog)
        world.did(case.words)
        assert world.contents(case) == new and leftovers(world) == []
