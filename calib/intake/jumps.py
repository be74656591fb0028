"""A clock that was set while it ran: from then on other offsets bring motions together."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from calib.intake.likeness import LEAST_LIKE, best_of, likeness_of, vertex
from chains.se3 import Array

JUMP_PARTS = 8  # of a log, whose offsets are sought one by one, wherever they may be
COUNTERPARTS = 0.9  # of a part's samples must have a counterpart
FEWEST_SAMPLES = 10  # that are known of a part; with fewer any log is like it
FEWEST_TOLD = 4  # parts that tell their offsets: two before a jump, and two after it
APART_S = 0.1  # offsets that differ by less are one that drifts
AS_MUCH_LEFT = 1e-3  # of all that splits differ by: at rest one leaves as much as another


@dataclass(frozen=True)
class Jump:
    """Two offsets, in steps, and the step of the first log from which on the second holds.

    Args:
        lags: (2,) by how many steps the second log is behind, before the jump and after it.
        at: (2,) the last step before it, and the first after it, that tell.
        likeness: correlation of all that has a counterpart, at these offsets.
        spread: standard error of either, in steps, from how those of parts scatter about them.
    """

    lags: Array
    at: tuple[int, int]
    likeness: float
    spread: float


def own_lags(a: Array, b: Array, step_s: float) -> tuple[Array, Array]:
    """Of parts of a log of speed `a`, where each begins (n,), and the lag (n,) at which it alone is
    like the log `b`, to a fraction of a step; of those that are like it clearly at one."""
    ends = np.linspace(0, len(a), JUMP_PARTS + 1).astype(int)
    first, found = [], []
    for low, high in pairwise(ends.tolist()):
        if np.isfinite(a[low:high]).sum() < FEWEST_SAMPLES:
            continue
        lag, like, count = likeness_of(a[low:high], b)
        like = np.where(count > COUNTERPARTS * np.isfinite(a[low:high]).sum(), like, np.nan)
        if not np.isfinite(like).any():
            continue
        best, rivalled = best_of(lag, like, count, step_s)
        if like[best] >= LEAST_LIKE and not rivalled:
            first.append(low)
            found.append(lag[best] - low + vertex(like, best))
    return np.array(first, int), np.array(found)


def jump_of(a: Array, b: Array, step_s: float) -> Jump | None:
    """The jump of a clock between two logs of speed at even steps; None where parts of the logs do
    not tell of one, and one alone."""
    first, lags = own_lags(a, b, step_s)
    if len(lags) < FEWEST_TOLD:
        return None
    after = 1 + int(np.argmax(np.abs(np.diff(lags))))
    before, behind = lags[:after], lags[after:]
    spread = max(np.ptp(before), np.ptp(behind)) * step_s
    medians = np.array([np.median(before), np.median(behind)])
    if min(len(before), len(behind)) < 2 or spread > APART_S:
        return None
    if abs(medians[1] - medians[0]) * step_s < max(APART_S, 2.0 * spread):
        return None
    at = _when(a, b, np.round(medians).astype(int), first[after - 1], first[after])
    errors = [_counterpart(b, lag, len(a)) for lag in np.round(medians).astype(int)]
    there = np.concatenate([errors[0][: at[0] + 1], errors[1][at[1] :]])
    mine = np.concatenate([a[: at[0] + 1], a[at[1] :]])
    known = np.isfinite(mine) & np.isfinite(there)
    off = np.concatenate([before - medians[0], behind - medians[1]])
    return Jump(
        lags=medians,
        at=at,
        likeness=float(np.corrcoef(mine[known], there[known])[0, 1]),
        spread=float(np.std(off) / np.sqrt(len(off) - 2.0)),
    )


def _when(a: Array, b: Array, lags: Array, low: int, high: int) -> tuple[int, int]:
    """Between which steps of `a` the jump is, from two parts that begin at `low` and at `high`: the
    split after which the second offset leaves less than the first, and before which more. Where
    both leave the same, as at rest, it is anywhere between."""
    end = min(high + (high - low), len(a))
    there = (np.nan_to_num(_counterpart(b, lag, len(a))) for lag in lags)  # unknown: as if at rest
    left = [np.square(np.nan_to_num(a) - each)[low:end] for each in there]
    whole = np.append(0.0, np.cumsum(left[0])) + left[1].sum() - np.append(0.0, np.cumsum(left[1]))
    alike = np.flatnonzero(whole <= whole.min() + AS_MUCH_LEFT * np.ptp(whole))
    return low + int(alike[0]) - 1, low + int(alike[-1])


def _counterpart(b: Array, lag: int, count: int) -> Array:
    """What a log has at so many steps of the other; NaN where it is not."""
    at = np.arange(count) + lag
    there = (at >= 0) & (at < len(b))
    return np.where(there, b[np.clip(at, 0, len(b) - 1)], np.nan)
