"""The world of tests about plans: an arm some of whose joints hardly moved, and a run of it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import calib
from calib.planning import Plan
from calib.runs.run import Run
from tests.worlds import World, write

# Joint 5 never turned; joints 2, 3 and 6 hardly did.
NARROW = World(seed=3, locations=2, stops=5, beams=1200, turned=(1, 0.3, 0.3, 1, 0, 0.3))
JOINTS = [f"joint_{k}" for k in range(1, 7)]


def fitted(world: World, folder: Path) -> Run:
    """A run of a world."""
    write(world, folder / "rec")
    return calib.fit([folder / "rec"], folder / "run", hold_out="none")


def followed(plan: Plan) -> World:
    """The narrow world in which a plan's stops were measured as well."""
    then = [(int(s["location"][1:]), tuple(s[name] for name in JOINTS)) for s in plan.stops]
    return replace(NARROW, then=tuple(then))


def make(folder: Path) -> None:
    """A recording of the narrow world, and its run."""
    fitted(NARROW, folder)


def run_of(once) -> Run:
    """A run of the narrow world that the caller may change."""
    return Run.open(once(make) / "run")
