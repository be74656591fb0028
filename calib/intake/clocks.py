"""Clocks brought together: how far one is ahead of another, from the motion that both logged."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib.intake.jumps import Jump, jump_of
from calib.intake.likeness import LEAST_LIKE, LEAST_S, best_of, likeness_of, parts_of, vertex
from calib.intake.motion import Motion, motions
from chains.errors import InputError
from chains.frames import Edge
from chains.se3 import Array
from sensors.documents import nearest
from sensors.readers.base import Sweeps, Track

RATE_WINDOW_S = 0.2  # rates are smoothed over it before they are compared
# From the first part to the last; less is below the time that an arm takes to settle.
DRIFT_S = 0.02
# Of offsets that bend: squares of the steps from one to the next, over those of what they are off
# their mean (von Neumann 1941, Ann. Math. Stat. 12). Of eight that err by themselves, 0.6 % are
# below, of five 1.7 %, by 400,000 draws; of one sine over eight it is 0.5.
SMOOTH = 0.6
WHOLLY_LIKE = 0.98  # where motions are alike by more, no clock was set: it would tear them apart
FINEST = 1 / 20  # of a step: no more is believed of a parabola
# The sigma of what is added, of how far off left-out offsets are predicted. These err by themselves
# and by the mean of two others, 1 + 1/2 variances; a time between two of them by 2/3 on average.
PREDICTED = 2 / 3  # the root of 2/3 over 3/2


@dataclass(frozen=True)
class Added:
    """What is added to a clock's times: one offset, or where clocks drift apart one that changes.

    Args:
        offset_s: (P,) what is added at each time `at_s`, linear between and beyond; one of each
            where it is the same always.
        at_s: (P,) rising, times of that clock.
    """

    offset_s: Array
    at_s: Array

    @classmethod
    def always(cls, offset_s: float) -> Added:
        """The same offset at all times."""
        return cls(np.array([offset_s]), np.zeros(1))

    def to(self, time_s: Array) -> Array:
        """Times on the other clock."""
        if len(self.at_s) == 1:
            return time_s + self.offset_s[0]
        k = np.clip(np.searchsorted(self.at_s, time_s) - 1, 0, len(self.at_s) - 2)
        slope = np.diff(self.offset_s) / np.diff(self.at_s)
        return time_s + self.offset_s[k] + slope[k] * (time_s - self.at_s[k])


@dataclass(frozen=True)
class Offset:
    """What is added to one clock to give another: s, with its sigma, and how alike motions are.

    Args:
        offset_s: of all of both logs together.
        sigma_s: of what is added, over the times of the logs.
        likeness: correlation of the two motions at that offset.
        added: what is to be added, its change included.
        drift_s: by how much the offset changes from the first part of the logs to the last; 0 where
            it merely scatters.
        jump_at_s: when the clock was set, by its own times; None where it was not.
    """

    offset_s: float
    sigma_s: float
    likeness: float
    added: Added
    drift_s: float = 0.0
    jump_at_s: float | None = None


@dataclass(frozen=True)
class Aligned:
    """Logs on one clock, and what was understood and looked odd on the way."""

    tracks: list[Track]
    sweeps: list[Sweeps]
    understood: list[str]
    odd: list[str]


def align(
    tracks: Sequence[Track],
    sweeps: Sequence[Sweeps],
    edges: Sequence[Edge],
    given_s: Mapping[str, float],
) -> Aligned:
    """Bring logs onto one clock: the LiDAR's, or else the joints', or else the first.

    Args:
        tracks, sweeps: logs against any clocks.
        edges: the arm's chain; empty where there is none.
        given_s: clock -> what its owner says is to be added to it.

    Raises:
        InputError: an offset is ambiguous, or clocks have nothing in common; the flag is
            --clock-offset NAME=SECONDS.
    """
    spans = _spans(tracks, sweeps)
    if wrong := [name for name in given_s if name not in spans]:
        raise InputError(
            f"--clock-offset {wrong[0]}: there is no such clock{nearest(wrong[0], spans)}"
        )
    main = _main(tracks, sweeps, spans)
    known = {main: Added.always(0.0)} if main is not None else {}
    known |= {name: Added.always(float(s)) for name, s in given_s.items()}
    out = Aligned([], [], [], [])
    if len(spans) > 1:
        out.understood.append(f"clocks: all times are those of {main}")
    out.understood.extend(f"clocks: {n} {s:+.4f} s, as given" for n, s in given_s.items())
    heard = {
        c: [m for t in tracks if t.clock == c for m in motions(t, edges, RATE_WINDOW_S)]
        for c in spans
    }
    moving = [c for c in spans if heard[c]]
    for clock in sorted((c for c in spans if c not in known), key=lambda c: c not in moving):
        others = [(c, m) for c in known for m in heard[c]]
        known[clock] = _offset(clock, heard[clock], others, known, spans, main, out)
    still = Added.always(0.0)
    for track in tracks:
        time_s = known.get(track.clock, still).to(track.time_s)
        out.tracks.append(replace(track, time_s=time_s))
    for one in sweeps:
        out.sweeps.append(replace(one, time_s=known.get(one.clock, still).to(one.time_s)))
    return out


def _spans(tracks: Sequence[Track], sweeps: Sequence[Sweeps]) -> dict[str, tuple[float, float]]:
    """Clock -> first and last time of what it stamped."""
    spans: dict[str, tuple[float, float]] = {}
    for log in (*tracks, *sweeps):
        time_s = log.time_s[np.isfinite(log.time_s)]
        if len(time_s):
            low, high = spans.get(log.clock, (np.inf, -np.inf))
            spans[log.clock] = (min(low, float(time_s.min())), max(high, float(time_s.max())))
    return spans


def _main(
    tracks: Sequence[Track], sweeps: Sequence[Sweeps], spans: Mapping[str, tuple[float, float]]
) -> str | None:
    """The clock that the others are brought to."""
    first = [s.clock for s in sweeps] + [t.clock for t in tracks if t.kind == "joints"]
    return next((clock for clock in (*first, *spans) if clock in spans), None)


def _offset(
    clock: str, mine: Sequence[Motion], others: Sequence[tuple[str, Motion]],
    known: Mapping[str, Added], spans: Mapping[str, tuple[float, float]], main: str, out: Aligned,
) -> Added:  # fmt: skip
    """What is added to a clock, from motion where there is some, else from nothing but overlap."""
    pairs = [(c, a, b) for a in mine for c, b in others if {a.kind, b.kind} <= _alike(a.kind)]
    offsets = [
        (estimate(a, replace(b, time_s=known[c].to(b.time_s))), c, a, b) for c, a, b in pairs
    ]
    told = [entry for entry in offsets if entry[0] is not None]
    if not told:
        return _by_overlap(clock, spans, known, main, out)
    best, _, a, b = max(told, key=lambda entry: entry[0].likeness)
    if best.likeness < LEAST_LIKE:
        raise InputError(
            f"clock {clock}: its motion ({a.name}) is like that of {b.name} at no offset (the best "
            f"correlation is {best.likeness:.2f}); say --clock-offset {clock}=SECONDS"
        )
    if np.isnan(best.sigma_s):
        raise InputError(
            f"clock {clock}: the motions of {a.name} and {b.name} repeat, so they fit at several "
            f"offsets, {best.offset_s:.2f} s being one; say --clock-offset {clock}=SECONDS"
        )
    out.understood.append(
        f"clocks: {clock} {best.offset_s:+.4f} ± {best.sigma_s:.4f} s, from the motion of "
        f"{a.name} and {b.name} (correlation {best.likeness:.2f})"
    )
    if best.jump_at_s is not None:
        before_s, after_s = best.added.offset_s[[0, -1]]
        out.odd.append(
            f"clock {clock} was set at {best.jump_at_s:.1f} s, or the other was: what is added to "
            f"its times is {before_s:+.3f} s before that and {after_s:+.3f} s from then on"
        )
    elif len(best.added.at_s) > 1:
        shape = "a straight line" if len(best.added.at_s) == 2 else "straight pieces"
        within_s = float(np.ptp(best.added.offset_s))
        there = (
            f", and by as much as {within_s:.3f} s in between"
            if within_s > 2 * abs(best.drift_s)
            else ""
        )
        out.odd.append(
            f"clock {clock} drifts by {best.drift_s:+.3f} s from the beginning to the end{there}; "
            f"its times were corrected along {shape}"
        )
    return best.added


def _alike(kind: str) -> set[str]:
    """Kinds of motion that can be compared."""
    return {"turn"} if kind == "turn" else {"joints", "shift"}


def _by_overlap(
    clock: str, spans: Mapping[str, tuple[float, float]], known: Mapping[str, Added], main: str,
    out: Aligned,
) -> Added:  # fmt: skip
    (a0, a1), (b0, b1) = spans[clock], spans[main]
    if min(a1, b1) < max(a0, b0):
        raise InputError(
            f"clock {clock} runs from {a0:.3f} to {a1:.3f} s and {main} from {b0:.3f} to {b1:.3f} "
            f"s; they do not overlap, and no motion determines their offset: say --clock-offset "
            f"{clock}=SECONDS"
        )
    out.odd.append(
        f"clock {clock} is taken for the same as {main}: their times overlap, and no motion that "
        f"both logged says otherwise; --clock-offset {clock}=SECONDS corrects it"
    )
    return Added.always(0.0)


# ------------------------------------------------------------------------------- two motions


def estimate(mine: Motion, other: Motion) -> Offset | None:
    """What is added to the times of `mine` so that it moves when `other` does.

    Both speeds are correlated at all offsets at which enough of them overlaps, masked where either
    is not known. The offset is the best of all (`best_of`), to a fraction of a sample by a
    parabola. Its sigma comes from the scatter of the offsets of parts of the logs; where clocks
    drift apart, from how well these predict each other.

    Returns:
        None where one of the two hardly moves; a sigma of NaN where another offset is as good.
    """
    step_s = float(np.clip(min(_step(mine), _step(other)), 0.002, 0.1))
    a, b = (_grid(motion, step_s) for motion in (mine, other))
    if min(np.nanstd(a), np.nanstd(b)) < 1e-3 or min(len(a), len(b)) * step_s < LEAST_S:
        return None
    lag, likeness, count = likeness_of(a, b)
    if not np.isfinite(likeness).any():
        return None
    best, rivalled = best_of(lag, likeness, count, step_s)
    peak_s = (lag[best] + vertex(likeness, best)) * step_s
    offset_s = float(other.time_s[0] - mine.time_s[0] + peak_s)
    top = float(likeness[best])
    always = Added.always(offset_s)
    if top < WHOLLY_LIKE and (jump := jump_of(a, b, step_s)) and jump.likeness > top:
        return _jumped(mine, float(other.time_s[0] - mine.time_s[0]), jump, step_s)
    if rivalled and top > LEAST_LIKE:
        return Offset(offset_s, np.nan, top, added=always)
    at, shift_s = parts_of(a, b, int(lag[best]), step_s)
    drift_s = _drift(shift_s)
    if _bends(shift_s):
        drift_s = drift_s or float(shift_s[-1] - shift_s[0])
    elif abs(drift_s) < DRIFT_S:
        return Offset(offset_s, _standard_error(shift_s, step_s), top, added=always)
    ahead_s = float(other.time_s[0] - mine.time_s[0]) + int(lag[best]) * step_s
    added, missed_s = _pieces(mine.time_s[0] + at * step_s, ahead_s + shift_s)
    sigma_s = max(PREDICTED * float(np.sqrt(np.mean(np.square(missed_s)))), FINEST * step_s)
    return Offset(offset_s, sigma_s, top, added=added, drift_s=drift_s)


def _jumped(mine: Motion, ahead_s: float, jump: Jump, step_s: float) -> Offset:
    """What is added to the times of `mine` where a clock was set; `ahead_s` is by how much the
    other log begins later."""
    before_s, after_s = (ahead_s + lag * step_s for lag in jump.lags)
    low_s, high_s = (mine.time_s[0] + k * step_s for k in jump.at)
    some = np.flatnonzero((mine.time_s >= low_s) & (mine.time_s <= high_s))
    gaps = np.diff(mine.time_s[some])
    at_s = (low_s + high_s) / 2
    if len(gaps) and gaps.max() > abs(after_s - before_s) / 2:  # its own times tell when
        at_s = float(mine.time_s[some[np.argmax(gaps)]] + gaps.max() / 2)
    return Offset(
        offset_s=float(before_s),
        sigma_s=max(float(jump.spread) * step_s, FINEST * step_s),
        likeness=jump.likeness,
        added=Added(
            np.array([before_s, before_s, after_s, after_s]),
            np.array([mine.time_s[0], at_s, np.nextafter(at_s, np.inf), mine.time_s[-1]]),
        ),
        jump_at_s=at_s,
    )


def _step(motion: Motion) -> float:
    return float(np.median(np.diff(motion.time_s)))


def _grid(motion: Motion, step_s: float) -> Array:
    """Speed at even steps from its first time; NaN within pauses."""
    speed, time_s = motion.speed, motion.time_s
    at = np.arange(time_s[0], time_s[-1], step_s)
    known = np.isfinite(speed)
    if known.sum() < 2:
        return np.full(len(at), np.nan)
    grid = np.interp(at, time_s[known], speed[known])
    after = np.clip(np.searchsorted(time_s[known], at), 1, known.sum() - 1)
    grid[np.diff(time_s[known])[after - 1] > 0.5] = np.nan
    return grid


def _standard_error(shift_s: Array, step_s: float) -> float:
    """Of an offset, from how those of parts of the logs scatter."""
    if len(shift_s) < 3:
        return step_s
    spread = 1.4826 * np.median(np.abs(shift_s - np.median(shift_s)))
    return max(float(spread / np.sqrt(len(shift_s))), FINEST * step_s)


def _pieces(at_s: Array, offset_s: Array) -> tuple[Added, Array]:
    """Straight pieces through offsets that drift, or one line, whichever predicts each inner offset
    from the others better; and by how much it misses each of these."""
    by_line, by_pieces = [], []
    for i in range(1, len(at_s) - 1):
        others, x = np.delete(np.arange(len(at_s)), i), at_s[i] - at_s[0]
        line = np.polyfit(at_s[others] - at_s[0], offset_s[others], 1)
        by_line.append(offset_s[i] - np.polyval(line, x))
        by_pieces.append(offset_s[i] - np.interp(at_s[i], at_s[others], offset_s[others]))
    if np.square(by_pieces).sum() < np.square(by_line).sum():
        return Added(offset_s, at_s), np.array(by_pieces)
    line = np.polyfit(at_s - at_s[0], offset_s, 1)
    ends = at_s[[0, -1]]
    return Added(np.polyval(line, ends - at_s[0]), ends), np.array(by_line)


def _bends(offset_s: Array) -> bool:
    """Whether offsets change by as much as a drift, and one after the other: each is far nearer to
    the next than they are to each other."""
    if len(offset_s) < 5 or np.ptp(offset_s) < DRIFT_S:
        return False
    steps, off = np.diff(offset_s), offset_s - offset_s.mean()
    return bool(steps @ steps < SMOOTH * (off @ off))


def _drift(offset_s: Array) -> float:
    """By how much offsets change from the first part to the last; 0 where they merely scatter."""
    if len(offset_s) < 4:
        return 0.0
    part = np.arange(len(offset_s)) - (len(offset_s) - 1) / 2
    slope = float(part @ offset_s / (part @ part))
    left = offset_s - offset_s.mean() - slope * part
    sigma = np.sqrt(left @ left / (len(part) - 2) / (part @ part))
    return slope * (len(part) - 1) if abs(slope) > 4 * sigma else 0.0
