"""How alike two logs of speed are, one shifted against the other."""

from __future__ import annotations

import numpy as np

from chains.se3 import Array

LEAST_LIKE = 0.75  # correlation below which two motions are not the same
RIVAL = 0.8  # of the best evidence, at another offset: then nobody knows which is right
LOBE_S = 1.0  # within it of the best, a peak is the same one
LEAST_OVERLAP = 0.3  # of the shorter log


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
