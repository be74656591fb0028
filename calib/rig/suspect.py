"""Something in a recording that is likely wrong, told before any fit; and what lasts from stop to
stop."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sensors.stops import in_time


@dataclass(frozen=True)
class Suspect:
    """A group of numbers that one mishap may have spoiled together.

    Args:
        kind: "body", "joints", "scan", "target", "frame", "rings", "surface" or "intensity".
        name: which of that kind.
        sentence: what is odd, for people.
        stops: at which; empty where at all.
        size, unit: of the error, where it has one.
    """

    kind: str
    name: str
    sentence: str
    stops: tuple[str, ...] = ()
    size: float | None = None
    unit: str | None = None

    def documents(self) -> list[dict[str, Any]]:
        """An entry for each stop, or one for all, with the keys of a diagnosis's blunders."""
        fields = {"kind": self.kind, "name": self.name, "size": self.size, "unit": self.unit}
        return [fields | {"stop": stop} for stop in (*self.stops,) or (None,)]


# Of the stops, and in any case: choices. Loggers and trackers spoil a few % of rows.
MOST_ALONE, FEW_ALONE = 0.1, 5
SO_BY_CHANCE = 0.01  # a choice: how often stops each wrong by itself may follow each other so


@dataclass(frozen=True)
class Spell:
    """Stops that follow each other in time, and what is wrong at them is wrong for as long.

    Args:
        stops: their names, from the first to the last at which it is wrong.
        wrong: names of those of them at which it is.
        before, after: the stops next to them; None where the recording begins or ends.
        p_value: how likely as many wrong stops would lie within as few, were each wrong by itself.
    """

    stops: tuple[str, ...]
    wrong: tuple[str, ...]
    before: str | None
    after: str | None
    p_value: float

    @property
    def course(self) -> str:
        """When it began and ended, by the stops between which it did."""
        began = f"began between {self.before} and {self.stops[0]}" if self.before else ""
        ended = f"ended between {self.stops[-1]} and {self.after}" if self.after else ""
        if not ended:
            return f"{began} and lasts to the end"
        return f"{began} and {ended}" if began else f"was there from the first stop and {ended}"

    def __str__(self) -> str:
        most = len(self.wrong) < len(self.stops)
        of = f"{len(self.wrong)} of {len(self.stops)}" if most else f"all {len(self.stops)}"
        return f"at {of} stops from {self.stops[0]} to {self.stops[-1]}"


def spells(stops: Sequence[str], time_s: np.ndarray, wrong: Collection[str]) -> list[Spell]:
    """Spans of stops in which so many are wrong that it is no chance, the least likely first.

    Of m stops among n that are each wrong by themselves, k or more lie within w that follow each
    other with the hypergeometric tail; there are n - w + 1 such spans of each of n lengths
    (Bonferroni). The next span is sought among the stops beside it.

    Args:
        stops: names of those at which it might be.
        time_s: (n,) of each; where one has none, the order of rows counts.
        wrong: names of those at which it is.
    """
    if len(wrong) < 3:  # of two no span is significant, however many stops there are
        return []
    from scipy.stats import hypergeom

    names, out = in_time(stops, time_s), []
    bad = np.isin(names, [*wrong])
    while bad.sum() > 2:
        n, edges = len(names), np.diff(bad.astype(int), prepend=0, append=0)
        first, end = np.flatnonzero(edges == 1)[:, None], np.flatnonzero(edges == -1)[None, :]
        width, sums = end - first, np.concatenate([[0], np.cumsum(bad)])
        tail = hypergeom.sf(sums[end] - sums[first] - 1, n, bad.sum(), width)
        p = np.where(width > 0, tail * (n - width + 1) * n, np.inf)
        i, j = np.unravel_index(p.argmin(), p.shape)
        if p[i, j] >= SO_BY_CHANCE:
            break
        a, b = int(first[i, 0]), int(end[0, j])
        spell = Spell(
            stops=tuple(names[a:b]),
            wrong=tuple(name for name, is_bad in zip(names[a:b], bad[a:b], strict=True) if is_bad),
            before=names[a - 1] if a else None,
            after=names[b] if b < n else None,
            p_value=float(p[i, j]),
        )
        out.append(spell)
        names, bad = [*names[:a], *names[b:]], np.concatenate([bad[:a], bad[b:]])
    return out


def rare(found: Sequence[Suspect], of: int) -> Iterator[str | Suspect]:
    """Stops at which a body is far off, each by itself, among so many; or one sentence about all of
    them, as more than a few are no mishaps: something acts at every stop, and shows at some."""
    if len(found) <= max(FEW_ALONE, MOST_ALONE * of):
        yield from found
        return
    worst = max(found, key=lambda one: one.size or 0.0)
    yield (
        f"at {len(found)} of {of} stops, here and there, {worst.name} is far from where other "
        f"stops put it, by up to {1e3 * (worst.size or 0.0):.3g} mm at {worst.stops[0]}. So many "
        "are hardly mishaps: does something act at all stops (a lag of the readings, a load, a "
        "joint that slips)? Once it is fitted, 'rigcal diagnose' tests for that"
    )


def listed(names: Sequence[Any], most: int = 3, between: str = ", ") -> str:
    """The first few names, and how many more there are."""
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return between.join(map(str, names[:most])) + more
