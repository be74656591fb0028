"""Something in a recording that is likely wrong, told before any fit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any


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


def listed(names: Sequence[Any], most: int = 3, between: str = ", ") -> str:
    """The first few names, and how many more there are."""
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return between.join(map(str, names[:most])) + more
