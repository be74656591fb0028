"""Do planned stops tell rivals apart that stops so far cannot, and random stops less?

    python -m tests.bench.bench_plan [DESIGNS]

Twenty designs that confound: the LiDAR was never rolled; one location; a mesh of one wall; a narrow
range of every joint; joints that never moved. In each, pairs of effects of which one is found only
at twice the size or more because the other could stand for it. Five stops are planned for the pair,
and five are drawn from the same poses, ten times. A pair is told apart at a size if the effect that
the rival hides most is found beside it, at that many times the size from which it was found before
had it no rival. How many drawn stops it takes to do as well as the five planned is counted on the
sums per stop, in ten orders.

A rival hides some of an effect wherever the arm is. So of each pair it is counted as well how many
times larger the effect must be, had it a rival, once all poses were measured that stops are chosen
from; where that is half as many times as in the design, or less, it is the design that confounds.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

import calib
from calib.linear.parallel import one_blas_thread
from calib.planning import planner_of
from calib.planning.criteria import chosen, found_from
from calib.planning.planner import Planner
from calib.planning.worth import Known
from calib.runs.run import Run
from tests.worlds import World, write

ONE = {"locations": 1, "stops": 9}
WALL = 2  # number of a wall among the room's rectangles


def still(*joints: int) -> dict[str, tuple[float, ...]]:
    """A design in which some joints never moved."""
    return {"turned": tuple(0.0 if k in joints else 1.0 for k in range(1, 7))}


DESIGNS = {
    "never rolled": still(4, 6),
    "one location": ONE,
    "narrow range": {"turned": (0.25,) * 6},
    **{f"joint {k} still": still(k) for k in range(1, 7)},
    "joints 2, 3 still": still(2, 3),
    "joints 1, 2 still": still(1, 2),
    "joints 4, 5 still": still(4, 5),
    "joints 5, 6 still": still(5, 6),
    "joints 3, 5 still": still(3, 5),
    # The arm bends less, so that every stop sees some of the wall.
    "one wall": {"meshed": (WALL,), "turned": (1.0, 0.4, 0.4, 0.4, 0.4, 1.0)},
    "joints 2, 3, 5 still": still(2, 3, 5),
    "very narrow range": {"turned": (0.1,) * 6},
    "one location, never rolled": ONE | still(4, 6),
    "one location, narrow": ONE | {"turned": (0.25,) * 6},
    "one location, joint 5 still": ONE | still(5),
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
MINUTES_A_STOP = 3.0  # to drive there, settle and scan; assumed


class Case(NamedTuple):
    """A pair in a design: how many times larger than it was found before, had it no rival, the
    effect that is hidden most must be: before, with planned stops, with random ones (DRAWS,); how
    many times larger it must be than without a rival once all poses are measured; and how many
    random stops do as well as the planned, in the median."""

    design: str
    pair: str
    now: float
    planned: float
    random: np.ndarray
    least: float
    as_good: float
    seconds: float

    @property
    def of_design(self) -> bool:
        """Whether it is the design that confounds them."""
        return self.now > CONFOUNDED * self.least


def cases(design: str, folder: Path, pairs: tuple = PAIRS) -> Iterator[Case]:
    """Every confounded pair of a design."""
    seed = list(DESIGNS).index(design)
    base = {"seed": seed, "locations": 3, "stops": 3, "beams": 1200}
    write(World(**{**base, **DESIGNS[design]}), folder)
    run = calib.fit([folder], f"{folder} run", hold_out="none")
    for pair in pairs:
        case = case_of(run, design, pair, seed)
        if case is not None:
            yield case


@one_blas_thread
def case_of(run: Run, design: str, pair: tuple[str, str], seed: int) -> Case | None:
    """What planned stops, and random ones, do for a pair in a design; None if it hides nothing."""
    planner = planner_of(run, ",".join(pair))

    def sizes(known: Known, name: str) -> tuple[float, float]:
        """From which it is found: had it no rival, and beside the rival."""
        rival = next(other for other in pair if other != name)
        return known.smallest[name][name], known.smallest[name][rival]

    hidden = max(pair, key=lambda name: np.divide(*sizes(planner.now, name)[::-1]))
    alone, beside = sizes(planner.now, hidden)
    if not beside > CONFOUNDED * alone:
        return None
    poses, rng = planner.candidates(CANDIDATES, seed), np.random.default_rng(seed)
    start = time.perf_counter()
    each = planner.look(poses, STOPS)
    best = chosen(planner.criterion(each), each, STOPS, lambda done, total: None)
    seconds = time.perf_counter() - start
    drawn = [rng.choice(len(poses.joints), STOPS, replace=False) for _ in range(DRAWS)]
    planned, *random = (
        sizes(planner.after(some), hidden)[1] / alone for some in map(poses.some, (best, *drawn))
    )
    without, with_rival = sizes(planner.endless(each), hidden)
    return Case(
        design=design,
        pair=f"{hidden} from {next(name for name in pair if name != hidden)}",
        now=beside / alone,
        planned=planned,
        random=np.array(random),
        least=with_rival / without,
        as_good=as_good(planner, each, best, hidden, rng),
        seconds=seconds,
    )


def as_good(
    planner: Planner, each: np.ndarray, best: list[int], name: str, rng: np.random.Generator
) -> float:
    """How many drawn stops, in the median, find an effect beside its rivals from as small a size as
    the best do."""
    scene, known = planner.scene, planner.lasting
    of = known.at([term.variable for term in scene.terms_of(name)])

    def size(told: np.ndarray) -> float:
        return found_from(replace(known, data=known.data + told), of)

    wanted = size(each[best].sum(axis=0))
    orders = (np.cumsum(each[rng.permutation(len(each))], axis=0) for _ in range(DRAWS))
    counts = [next((n for n, x in enumerate(o, 1) if size(x) <= wanted), len(o)) for o in orders]
    return float(np.median(counts))


def table(found: list[Case]) -> str:
    """What people read."""
    lines = [
        f"{'design':28s} {'pair':46s} {'now':>6s} {'planned':>8s} {'random':>7s} {'at all':>7s} "
        f"{'as good':>7s}"
    ]
    lines += [
        f"{c.design:28s} {c.pair:46s} {c.now:6.2f} {c.planned:8.2f} {np.median(c.random):7.2f} "
        f"{c.least:7.2f} {c.as_good:7.0f}"
        for c in found
    ]
    lines += ["", "all pairs", *_told(found)]
    lines += ["", "pairs that the design confounds", *_told([c for c in found if c.of_design]), ""]
    as_good = float(np.median([c.as_good for c in found]))
    takes, mine = MINUTES_A_STOP * as_good, MINUTES_A_STOP * STOPS
    lines.append(
        f"{STOPS} planned stops do as well as {as_good:.0f} random ones in the median: at "
        f"{MINUTES_A_STOP:g} minutes a stop {mine:.0f} minutes in the place of {takes:.0f}"
    )
    return "\n".join(lines)


def _told(found: list[Case]) -> Iterator[str]:
    """How many pairs are told apart at sizes, and of how many designs all of them."""
    by = {c.design: [other for other in found if other.design == c.design] for c in found}
    for size in SIZES:
        planned = np.mean([c.planned <= size for c in found])
        random = np.mean([c.random <= size for c in found])
        whole = np.mean([all(c.planned <= size for c in some) for some in by.values()])
        drawn = np.mean([np.all([c.random <= size for c in some], axis=0) for some in by.values()])
        yield (
            f"told apart at {size:g} times the size: {100 * planned:.0f} % of {len(found)} pairs "
            f"by planned stops, {100 * random:.0f} % by random ones; "
            f"all pairs of {100 * whole:.0f} and {100 * drawn:.0f} % of {len(by)} designs"
        )


if __name__ == "__main__":
    every: list[Case] = []
    for name in list(DESIGNS)[: int(sys.argv[1]) if len(sys.argv) > 1 else None]:
        with tempfile.TemporaryDirectory() as made:
            every += cases(name, Path(made) / "rec")
        print(name, len(every), file=sys.stderr, flush=True)
    print(table(every))
