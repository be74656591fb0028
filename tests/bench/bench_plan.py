"""Do planned stops tell rivals apart that stops so far cannot, and random stops less?

    python -m tests.bench.bench_plan [SEEDS]

Designs that confound: the LiDAR was never rolled; one location; a narrow range of every joint; a
joint that never moved. In each, pairs of effects of which one is found only at twice the size or
more because the other could stand for it. Five stops are planned for the pair, and five are drawn
from the same poses, ten times. A pair is told apart at a size if the effect that the rival hides
most is found beside it, at that many times the size from which it was found before had it no rival.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

import calib
from calib.linear.parallel import one_blas_thread
from calib.planning import planner_of
from calib.runs.run import Run
from tests.worlds import World, write

DESIGNS = {
    "never rolled": {"turned": (1, 1, 1, 0, 1, 0)},
    "one location": {"locations": 1, "stops": 9},
    "narrow range": {"turned": (0.25,) * 6},
    "joint 5 still": {"turned": (1, 1, 1, 1, 0, 1)},
    "joints 2, 3 still": {"turned": (1, 0, 0, 1, 1, 1)},
}
PAIRS = (
    ("arm_gravity_sag", "arm_joint_scale"),
    ("arm_joint_scale", "arm_joint_eccentricity"),
    ("arm_gravity_sag", "arm_joint_eccentricity"),
    ("azimuth_range_harmonic", "encoder_eccentricity"),
    ("faro_scale", "range_scale"),
    ("mount_bending", "arm_gravity_sag"),
    ("beam_origin_offset", "azimuth_range_harmonic"),
    ("range_scale", "near_range_bias"),
)
CONFOUNDED = 2.0
SIZES = (1.0, 1.5, 2.0)
STOPS, CANDIDATES, DRAWS = 5, 200, 10


class Case(NamedTuple):
    """A pair in a design: how many times larger than it was found before, had it no rival, the
    effect that is hidden most must be: before, with planned stops, with random ones (DRAWS,)."""

    design: str
    pair: str
    now: float
    planned: float
    random: np.ndarray
    seconds: float


def cases(seed: int, folder: Path, pairs: tuple = PAIRS) -> Iterator[Case]:
    """Every confounded pair of every design."""
    for design, knobs in DESIGNS.items():
        at = folder / f"{seed} {design}"
        write(World(**{"seed": seed, "locations": 3, "stops": 3, "beams": 1200, **knobs}), at)
        run = calib.fit([at], f"{at} run", hold_out="none")
        for pair in pairs:
            case = case_of(run, design, pair, seed)
            if case is not None:
                yield case


@one_blas_thread
def case_of(run: Run, design: str, pair: tuple[str, str], seed: int) -> Case | None:
    """What planned stops, and random ones, do for a pair in a design; None if it hides nothing."""
    planner = planner_of(run, ",".join(pair))
    found = planner.now.smallest
    hidden = max(pair, key=lambda name: found[name][1] / found[name][0])
    alone, beside = found[hidden]
    if not beside > CONFOUNDED * alone:
        return None
    poses, rng = planner.candidates(CANDIDATES, seed), np.random.default_rng(seed)
    start = time.perf_counter()
    best = planner.choose(poses, planner.look(poses, STOPS), STOPS)
    seconds = time.perf_counter() - start
    drawn = [rng.choice(len(poses.joints), STOPS, replace=False) for _ in range(DRAWS)]
    planned, *random = (
        planner.after(some).smallest[hidden][1] / alone
        for some in (best, *(poses.some(at) for at in drawn))
    )
    return Case(
        design=design,
        pair=f"{hidden} from {next(name for name in pair if name != hidden)}",
        now=beside / alone,
        planned=planned,
        random=np.array(random),
        seconds=seconds,
    )


def table(found: list[Case]) -> str:
    """What people read."""
    lines = [f"{'design':18s} {'pair':46s} {'now':>6s} {'planned':>8s} {'random':>7s} {'s':>5s}"]
    lines += [
        f"{c.design:18s} {c.pair:46s} {c.now:6.2f} {c.planned:8.2f} {np.median(c.random):7.2f} "
        f"{c.seconds:5.1f}"
        for c in found
    ]
    for size in SIZES:
        planned = np.mean([c.planned <= size for c in found])
        random = np.mean([c.random <= size for c in found])
        lines.append(
            f"told apart at {size:g} times the size: {100 * planned:.0f} % of {len(found)} pairs "
            f"by planned stops, {100 * random:.0f} % by random ones"
        )
    return "\n".join(lines)


if __name__ == "__main__":
    every: list[Case] = []
    for number in range(int(sys.argv[1]) if len(sys.argv) > 1 else 1):
        with tempfile.TemporaryDirectory() as made:
            every += cases(number, Path(made))
    print(table(every))
