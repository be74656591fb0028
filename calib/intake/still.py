"""Holds: the periods in which nothing moves, found in whatever logged motion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calib.intake.motion import Motion, motions
from chains.errors import InputError
from chains.frames import Edge
from chains.se3 import Array
from sensors.readers.base import Track

STILL_WINDOW_S = 0.25  # rates are smoothed over it: an arm takes longer to move
REST_SHARE = 0.1  # of the time at least, things are taken to be at rest
FACTOR = 3.0  # times the rms rate at rest: noise along one axis exceeds it 1 time in 370
WILD = 2.0  # times that again, and it is no noise, however short: a choice
SLOWEST, FASTEST = 0.003, 0.05  # rad/s or m/s between which the threshold lies
SETTLE_S = 0.3  # cut from both ends of a hold
# Ten turns of a LiDAR, by which its noise averages to a third; the rms rate is taken over it, too.
MIN_HOLD_S = 1.0


@dataclass(frozen=True)
class Holds:
    """The periods (H, 2) s in which all stands still, and what was understood."""

    spans_s: Array
    understood: list[str]


def find_holds(
    tracks: Sequence[Track],
    edges: Sequence[Edge],
    threshold: float | None = None,
    min_hold_s: float = MIN_HOLD_S,
) -> Holds:
    """Find when nothing moves: no joint, no tracked body, no gyro.

    A rate is small if it stays below three times its rms at rest, which is that of the quietest
    tenth of the log, held between 3 and 50 mrad/s (mm/s), or exceeds that as shortly and as little
    as noise does; `threshold` replaces all this. A log that
    does not see something, neither makes nor breaks a hold, and holds are cut short by 0.3 s at
    both ends, in which things settle.

    Args:
        tracks: logs on one clock.
        edges: the arm's chain; empty where there is none.
        threshold: rad/s or m/s.
        min_hold_s: shorter holds are none.

    Raises:
        InputError: there is no motion in the logs, or no hold.
    """
    rates = [_fastest(track, edges) for track in tracks]
    rates = [rate for rate in rates if rate is not None]
    if not rates:
        raise InputError(
            "no log shows when the rig stood still; give joints, a tracked body or a gyro, or a "
            "table with a row for every stop"
        )
    still, said = [], []
    for time_s, rate, name in rates:
        limit = threshold if threshold is not None else learned(time_s, rate)
        calm = rate < limit if threshold is not None else _at_rest(time_s, rate, limit)
        still.append(_spans(time_s, calm, ~np.isfinite(rate)))
        said.append(f"holds: {name} is at rest below {1e3 * limit:.1f} mrad/s or mm/s")
    together = still[0]
    for other in still[1:]:
        together = _both(together, other)
    together = together + np.array([SETTLE_S, -SETTLE_S])
    long = together[:, 1] - together[:, 0] >= min_hold_s - 1e-9
    spans = together[long]
    if not len(spans):
        raise InputError(
            f"nothing stands still for {min_hold_s + 2 * SETTLE_S:g} s anywhere in the logs, that "
            f"is {min_hold_s:g} s and {SETTLE_S:g} s to settle at both ends; say --still RAD_PER_S "
            "for what is at rest, or --min-hold SECONDS"
        )
    lengths = spans[:, 1] - spans[:, 0]
    said.append(
        f"holds: {len(spans)}, of {lengths.min():.1f} to {lengths.max():.1f} s, over "
        f"{spans[-1, 1] - spans[0, 0]:.0f} s"
    )
    said += _dropped(together[~long], min_hold_s)
    for own, (_, _, name) in zip(still, rates, strict=True):
        said += _broken(own, spans, name, min_hold_s)
    return Holds(spans, said)


def _dropped(short: Array, min_hold_s: float) -> list[str]:
    """What is said of periods (n, 2) too short to be holds; those that merely brush are none."""
    lengths = short[:, 1] - short[:, 0]
    lengths = lengths[lengths > 0]
    if not len(lengths):
        return []
    return [
        f"holds: {len(lengths)} more were dropped, as they last less than {min_hold_s:g} s after "
        f"{SETTLE_S:g} s to settle at both ends (the longest {lengths.max():.1f} s)"
    ]


def _broken(own: Array, spans: Array, name: str, min_hold_s: float) -> list[str]:
    """What is said of periods (n, 2) in which one log is at rest and no hold is, as another moves
    there."""
    own = own[own[:, 1] - own[:, 0] >= min_hold_s + 2 * SETTLE_S]
    meets = (own[:, None, 0] < spans[None, :, 1]) & (spans[None, :, 0] < own[:, None, 1])
    alone = own[~meets.any(axis=1)]
    if not len(alone):
        return []
    return [
        f"holds: {len(alone)} times {name} is at rest long enough while another log moves, first "
        f"from {alone[0, 0]:.1f} to {alone[0, 1]:.1f} s"
    ]


def learned(time_s: Array, rate: Array) -> float:
    """The rate below which something is at rest, from its rms over the quietest of all windows as
    long as a hold."""
    known = np.isfinite(rate)
    time_s, rate = time_s[known], rate[known]
    first = np.searchsorted(time_s, time_s - MIN_HOLD_S / 2)
    after = np.searchsorted(time_s, time_s + MIN_HOLD_S / 2, side="right")
    squares = np.concatenate([[0.0], np.cumsum(np.square(rate))])
    rms = np.sqrt((squares[after] - squares[first]) / (after - first))
    return float(np.clip(FACTOR * np.quantile(rms, REST_SHARE), SLOWEST, FASTEST))


def _fastest(track: Track, edges: Sequence[Edge]) -> tuple[Array, Array, str] | None:
    """Times and the size of all rates of a track, a metre counting for a radian."""
    moves = motions(track, edges if track.kind != "joints" else (), STILL_WINDOW_S)
    if not moves:
        return None
    rate = np.concatenate([_unbiased(motion) for motion in moves], axis=1)
    return moves[0].time_s, np.linalg.norm(rate, axis=1), track.name


def _unbiased(motion: Motion) -> Array:
    """Rates (N, D); of a gyro without what it reads at rest."""
    if motion.kind != "turn":
        return motion.rate
    change = np.linalg.norm(np.diff(motion.rate, axis=0, append=motion.rate[-1:]), axis=1)
    quiet = change <= np.nanquantile(change, REST_SHARE)
    return motion.rate - np.nanmedian(motion.rate[quiet], axis=0)


def _at_rest(time_s: Array, rate: Array, limit: float) -> Array:
    """(N,) whether a rate is below a limit, or a little above it so shortly that nothing goes
    further than it may in one window at rest, as where noise alone exceeds the limit."""
    fast = np.concatenate([[False], rate >= limit, [False]]).astype(int)
    starts, ends = np.flatnonzero(np.diff(fast) == 1), np.flatnonzero(np.diff(fast) == -1)
    went = np.concatenate([[0.0], np.cumsum(np.nan_to_num(rate) * np.gradient(time_s))])
    still = rate < limit
    for start, end in zip(starts, ends, strict=True):
        near = rate[start:end].max() < WILD * limit
        if near and went[end] - went[start] < limit * STILL_WINDOW_S:
            still[start:end] = True
    return still


def _spans(time_s: Array, still: Array, unknown: Array) -> Array:
    """Periods (H, 2) s in which a log says that all is still, or says nothing."""
    calm = np.concatenate([[False], still | unknown, [False]]).astype(int)
    starts, ends = np.flatnonzero(np.diff(calm) == 1), np.flatnonzero(np.diff(calm) == -1) - 1
    known = np.concatenate([[0], np.cumsum(~unknown)])
    seen = known[ends + 1] > known[starts]
    return np.stack([time_s[starts[seen]], time_s[ends[seen]]], axis=1)


def _both(a: Array, b: Array) -> Array:
    """Periods in both of two lists of periods, each in order."""
    low = np.maximum(a[:, None, 0], b[None, :, 0])
    high = np.minimum(a[:, None, 1], b[None, :, 1])
    met = high > low
    return np.stack([low[met], high[met]], axis=1)
