"""How alike two logs of speed are, one shifted against the other, whole or in parts."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise

import numpy as np

from chains.se3 import Array

LEAST_LIKE = 0.75  # correlation below which two motions are not the same
RIVAL = 0.8  # of the best evidence, at another offset: then nobody knows which is right
LOBE_S = 1.0  # within it of the best, a peak is the same one
LEAST_OVERLAP = 0.3  # of the shorter log
LOG_PARTS = 8  # of the logs, whose own offsets tell the uncertainty
REACH_S = 0.25  # the offset of a part is sought within it: a clock 100 ppm off needs 40 min for it
LEAST_S = 2.0  # of a log: less has not one move of an arm in it


def likeness_of(a: Array, b: Array) -> tuple[Array, Array, Array]:
    """Lags (L,) in steps, the correlation (L,) of a(k) with b(k + lag), and how many samples of
    both are known there.

    Padfield, Masked object registration in the Fourier domain, IEEE TIP 21 (2012).
    """
    size = len(a) + len(b) - 1
    n = 1 << (size - 1).bit_length()
    known = [np.isfinite(x).astype(float) for x in (a, b)]
    values = [np.where(np.isfinite(x), x - np.nanmean(x), 0.0) for x in (a, b)]
    A, AA, M = (np.conj(np.fft.rfft(x, n)) for x in (values[0], values[0] ** 2, known[0]))
    B, BB, N = (np.fft.rfft(x, n) for x in (values[1], values[1] ** 2, known[1]))
    lags = np.arange(-(len(a) - 1), len(b))
    count, ab, sa, sb, saa, sbb = (
        np.fft.irfft(x, n)[lags] for x in (M * N, A * B, A * N, M * B, AA * N, M * BB)
    )
    least = LEAST_OVERLAP * min(known[0].sum(), known[1].sum())
    enough = count > max(least, 3)
    count = np.maximum(count, 1)
    spread_a = np.maximum(saa - sa**2 / count, 0)
    spread_b = np.maximum(sbb - sb**2 / count, 0)
    # An overlap in which one of them stands still says nothing, however alike the rest is.
    enough &= (spread_a > 0.1 * spread_a.max()) & (spread_b > 0.1 * spread_b.max())
    with np.errstate(invalid="ignore", divide="ignore"):
        likeness = (ab - sa * sb / count) / np.sqrt(spread_a * spread_b)
    return lags, np.where(enough, likeness, np.nan), count


def vertex(values: Array, k: int) -> float:
    """Where a parabola through a peak and its neighbours has its top, in steps from the peak."""
    if not 0 < k < len(values) - 1 or not np.isfinite(values[k - 1 : k + 2]).all():
        return 0.0
    before, at, after = values[k - 1 : k + 2]
    curve = before - 2 * at + after
    return 0.0 if curve >= 0 else float(np.clip((before - after) / (2 * curve), -1, 1))


def best_of(lag: Array, likeness: Array, count: Array, step_s: float) -> tuple[int, bool]:
    """Which of some lags (L,) in steps is the best, and whether another, far from it, is as good.

    The best is where a correlation r over n samples is the least likely by chance, the maximum of
    ``-n log(1 - r^2)``.
    """
    evidence = -count * np.log1p(-(np.clip(likeness, 0, 0.9999) ** 2))
    best = int(np.nanargmax(evidence))
    far = np.abs(lag - lag[best]) * step_s > LOBE_S
    rival = np.max(evidence, where=far & np.isfinite(evidence), initial=0.0)
    return best, bool(rival > RIVAL * evidence[best])


def correlation(a: Array, b: Array) -> float:
    """Of two logs (n,) where both are known; NaN where one of them stands still."""
    both = np.isfinite(a) & np.isfinite(b)
    if both.sum() < 3 or a[both].std() < 1e-4 or b[both].std() < 1e-4:
        return np.nan
    return float(np.corrcoef(a[both], b[both])[0, 1])


def parts_of(a: Array, b: Array, lag: int, step_s: float) -> tuple[Array, Array]:
    """Of parts of the logs, where the motion of each is in the first, in steps, and by how many
    seconds its own offset differs from that of all; parts that tell nothing are left out.

    Each is sought about the offset of all, then about the line through those found, as clocks that
    drift leave the reach of the former; and those not found, as clocks may drift unevenly, about
    what the two found next to it lead to.
    """
    start, end = max(0, -lag), min(len(a), len(b) - lag)
    reach = max(2, round(REACH_S / step_s))
    parts = list(pairwise(np.linspace(start, end, LOG_PARTS + 1).astype(int)))
    middle = np.array([low + _middle(a[low:high]) for low, high in parts])
    about, found = np.zeros(len(parts)), np.full(len(parts), np.nan)
    for _ in range(2):
        for i, (low, high) in enumerate(parts):
            found[i] = _own_lag(a, b, (low, high), lag + round(about[i]), reach, step_s) - lag
        told = np.isfinite(found)
        if told.sum() < 3:
            break
        about = np.polyval(np.polyfit(middle[told], found[told], 1), middle)
    for i, low, high in _from_neighbours(found, parts):
        near = np.flatnonzero(np.isfinite(found))
        near = near[np.argsort(np.abs(near - i), kind="stable")[:2]]
        led = np.polyval(np.polyfit(middle[near], found[near], len(near) - 1), middle[i])
        for guess in (led, found[near[0]]):
            if np.isnan(found[i]):
                found[i] = _own_lag(a, b, (low, high), lag + round(guess), reach, step_s) - lag
    told = np.isfinite(found)
    return middle[told], found[told] * step_s


def _from_neighbours(
    found: Array, parts: Sequence[tuple[int, int]]
) -> Iterator[tuple[int, int, int]]:
    """The parts, with their numbers, that are not found, outward from those that are."""
    known = np.flatnonzero(np.isfinite(found))
    if len(known):
        away = np.abs(np.arange(len(parts))[:, None] - known).min(axis=1)
        for i in np.argsort(away, kind="stable")[len(known) :].tolist():
            yield i, *parts[i]


def _middle(speed: Array) -> float:
    """Where a log tells its offset, in steps: at changes of speed, by the square of each."""
    told = np.nan_to_num(np.diff(speed)) ** 2
    if not told.any():
        return len(speed) / 2
    return float(np.average(np.arange(len(told)) + 0.5, weights=told))


def _own_lag(
    a: Array, b: Array, part: tuple[int, int], lag: int, reach: int, step_s: float
) -> float:
    """The lag of a part of a log, within a reach about a lag, to a fraction of a step; NaN where it
    is too short, moves too little, or is like the other nowhere there."""
    low, high = max(part[0], reach - lag, 0), min(part[1], len(b) - lag - reach)
    if (high - low) * step_s < LEAST_S / 2:
        return np.nan
    shifts = np.arange(-reach, reach + 1)
    like = [correlation(a[low:high], b[low + lag + s : high + lag + s]) for s in shifts]
    if not np.isfinite(like).all() or max(like) < LEAST_LIKE:
        return np.nan
    k = int(np.argmax(like))
    at_end = k in (0, len(shifts) - 1)
    return np.nan if at_end else lag + shifts[k] + vertex(np.array(like), k)
