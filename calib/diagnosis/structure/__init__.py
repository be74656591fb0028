"""Structure: what could be missing that no effect of the catalogue describes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import chain, combinations, permutations

import numpy as np

from calib.diagnosis.score import UNFELT
from calib.diagnosis.structure.empirical import (
    Binned,
    DirectionShape,
    EachAlone,
    JointShape,
    OfPose,
    PoseShape,
    PoseSlope,
    RingSlope,
)
from calib.effects import CATALOGUE, Effect, Param, Site
from calib.effects.rig import MountSlip
from calib.problem.model import Source
from calib.rig import Rig

# Bins of a covariate, of each of two, and of azimuth, whose harmonics turn several times about. A
# choice: what has half the period of three bins is seen, and looks are few; `formulas` sees finer.
COVARIATE_BINS, PAIR_BINS = 12, 6
AZIMUTH_BINS = 24
# Of columns of the stops: with more parameters than a fifth of these, tests have no power.
STOPS_A_BIN = 5
STOPS_A_LINE = 8  # a choice: a line takes two, and six are left to say how stops scatter
DIRECTION_WAVES = 6  # orders, a turn: a choice, as catalogued ones are the first and the second
# Azimuths that a wave is told from, of so many different ones: a choice; of fewer, as where scans
# were thinned to five columns, waves make up a value of its own for each column.
AZIMUTHS_A_WAVE, ONE_AZIMUTH_RAD = 6, 0.01
POSE_WAVES = 4  # of a pose over a column: its quarters, as 12 bins have thirds of those
# What a range error may depend on alone, and the pairs that matter; others pair with range.
POINT = ("range_m", "incidence_rad", "azimuth_rad", "elevation_rad", "intensity")
PAIRS = (*combinations(POINT[:4], 2), ("intensity", "range_m"), ("label", "incidence_rad"))


# What a column of the stops may act on: an offset by stop alone may be chance, but one that differs
# from ring to ring, or with range, is none.
WITH_OWN = ("range_m", "elevation_rad")


def singly(
    effects: Sequence[Effect], of_rigs: Mapping[str, Sequence[np.ndarray]], felt: np.ndarray
) -> tuple[list[Effect], dict[str, np.ndarray]]:
    """Structure as it is tested, and the columns of each, of its parameters in every rig that has
    it.

    Args:
        effects: as a look has them.
        of_rigs: of each, its columns in every rig.
        felt: (Q,) size of what rows tell of a column: of those that they hardly feel, beside
            others of the effect, nothing is tested.
    """
    out, at = [], {name: np.concatenate(each) for name, each in of_rigs.items()}
    for effect in effects:
        if not isinstance(effect, EachAlone):
            out.append(effect)
            continue
        rigs = of_rigs.get(effect.name, ())
        for number in range(max(map(len, rigs), default=0)):
            mine = np.array([columns[number] for columns in rigs if number < len(columns)])
            if felt[mine].max() > UNFELT * felt[at[effect.name]].max():
                out.append(one := effect.alone(number))
                at[one.name] = mine
    return out, at


def of_look(effect: Effect) -> Effect:
    """The effect whose unknowns a look has, for one that was tested."""
    return (effect.one_of or effect) if isinstance(effect, EachAlone) else effect


def what_moves(effect: Effect) -> str | None:
    """What structure moves, where it is no error of a range or a joint."""
    return effect.what if isinstance(effect, OfPose | DirectionShape) else None


def ring_of(effect: Effect) -> int | None:
    """The ring that shows structure most, where each is tested alone."""
    return effect.only if isinstance(effect, RingSlope) else None


def covariates() -> set[str]:
    """Columns that structure may depend on in any recording."""
    return {*POINT, "time_s", *chain(*PAIRS)}


def structure(sources: Sequence[Source], sample: Mapping[str, np.ndarray]) -> list[Effect]:
    """Effects without a formula, over every covariate that there is.

    Args:
        sources: the recordings.
        sample: covariate -> its values at some of the points; empty without a LiDAR.
    """
    out: list[Effect] = []
    own = [c for c in sample if c not in covariates() - {"time_s"}]
    wanted = [(c,) for c in (*POINT, *own) if c in sample]
    wanted += [p for p in PAIRS if all(c in sample for c in p)]
    wanted += [(c, point) for c in own for point in WITH_OWN if point in sample]
    stops = sum(len(s.recording.stops) for s in sources)
    for names in wanted:
        by_stop = stops if set(names) & set(own) else 0
        edges = {c: _edges(sample[c], _bins(c, len(names), by_stop)) for c in names}
        if all(len(e) for e in edges.values()):
            centres = {c: _centres(sample[c], e) for c, e in edges.items()}
            out.append(Binned(edges, centres, {c: _ends(sample[c]) for c in names}))
    ends = {c: _ends(sample[c]) for c in ("range_m", *own) if c in sample}
    out += [RingSlope(c, (low, high)) for c, (low, high) in ends.items() if high > low]
    azimuth = sample.get("azimuth_rad", np.zeros(0))
    apart = len(np.unique(np.rint(azimuth / ONE_AZIMUTH_RAD)))
    if orders := min(DIRECTION_WAVES, apart // AZIMUTHS_A_WAVE):
        out += [DirectionShape(x, _ends(azimuth), orders) for x in ("elevation", "azimuth")]
    joints: dict[str, list[np.ndarray]] = {}
    for name, values in (each for s in sources for each in _moving(s)):
        joints.setdefault(name, []).append(values)
    seen = {name: _ends(np.concatenate(values)) for name, values in joints.items()}
    out += [JointShape(j, j, seen[j]) for j in joints]
    out += [JointShape(i, k, seen[k]) for i, k in permutations(joints, 2)]
    return [*out, *_moved(sources)]


def formulas_of(slip: MountSlip, rig: Rig) -> tuple[tuple[str, Param], ...]:
    """Where formulas act that move what a slip moves, and for each its parameter."""
    moves = slip.params(rig)
    if slip.site is Site.ROOT:  # no formula moves all that hangs there
        return ()
    if slip.site is Site.EDGE and moves:
        edge = rig.tree.edge_names[slip.edge(rig)]
        return tuple((f"{edge}.{move.name}", move) for move in moves)
    # The tracker turns bodies about its own axes, and a formula acts in those of each body.
    return tuple((f"tracker:{move.name}", move) for move in moves if "." in move.name)


def _moved(sources: Sequence[Source]) -> Iterator[PoseShape | PoseSlope]:
    """Mount, tracked bodies, tracker and what the rig stands on, moved by every column that changes
    from stop to stop."""
    stops = sum(len(s.recording.stops) for s in sources)
    slips = [e for e in CATALOGUE if isinstance(e, MountSlip) and e.jumps]
    slips = [e for e in slips if any(e.params(s.rig) for s in sources)]
    columns = set.intersection(
        *({"time_s", *s.recording.covariates} & {*s.columns} for s in sources)
    )
    for column in sorted(columns):
        values = np.concatenate([s.columns[column] for s in sources])
        low, high = _ends(values)
        for slip in slips if high > low else ():
            each = max(len(slip.params(s.rig)) for s in sources)
            if waves := min(POSE_WAVES, stops // (STOPS_A_BIN * each)):
                yield PoseShape(slip, column, (low, high), waves)
            elif stops >= STOPS_A_LINE:
                formulas = {formulas_of(slip, s.rig) for s in sources}
                every = formulas.pop() if len(formulas) == 1 else ()  # it acts in every rig
                yield PoseSlope(slip, column, (low, high), every)


def _moving(source: Source) -> Iterator[tuple[str, np.ndarray]]:
    """Revolute joints that turned, and their values (K,)."""
    for name, kind, values in zip(
        source.rig.joint_names, source.rig.joint_kinds, source.recording.joints.T, strict=False
    ):
        if kind == "revolute" and len(values) and np.ptp(values) > 1e-3:
            yield name, values


def _ends(values: np.ndarray) -> tuple[float, float]:
    """The least and the largest value; NaN where none is finite."""
    values = values[np.isfinite(values)]
    return (float(values.min()), float(values.max())) if len(values) else (np.nan, np.nan)


def _bins(covariate: str, together: int, stops: int) -> int:
    """How many bins of a covariate, alone or of a pair; where one of them is the same for all beams
    of a stop, no more than that many stops can tell."""
    usual = PAIR_BINS if together > 1 else COVARIATE_BINS
    if stops:
        return max(2, min(usual, round((stops / STOPS_A_BIN) ** (1.0 / together))))
    return AZIMUTH_BINS if covariate == "azimuth_rad" and together == 1 else usual


def _centres(values: np.ndarray, edges: np.ndarray) -> np.ndarray:
    values = values[np.isfinite(values)]
    index = np.searchsorted(edges, values)
    count = np.bincount(index, minlength=len(edges) + 1)
    total = np.bincount(index, values, len(edges) + 1)
    return total / np.maximum(count, 1)


def _edges(values: np.ndarray, bins: int) -> np.ndarray:
    """Values between bins of about equal count; between all values where they are few."""
    values = values[np.isfinite(values)]
    distinct = np.unique(values)
    if len(distinct) <= bins:
        return (distinct[1:] + distinct[:-1]) / 2
    return np.unique(np.quantile(values, np.arange(1, bins) / bins))
