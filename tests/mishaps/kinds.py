"""What a mishap is, and the list of all of them."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

from .scene import Scene

TIMES = (1, 3, 10)  # the detectable size, where a mishap has a size


@dataclass(frozen=True)
class Done:
    """What was done to a recording.

    Args:
        right: patterns, as of fnmatch, of names any of which is right; none: it has no name.
        group: patterns of names that the data may not tell from these.
        shifts: effect, parameter -> by how much the truth changed with it: a URDF that says
            something else has another error.
        unsure: frames and effects that have no single truth any more.
    """

    right: frozenset[str] = frozenset()
    group: frozenset[str] = frozenset()
    shifts: dict[tuple[str, str], float] = field(default_factory=dict)
    unsure: frozenset[str] = frozenset()


def done(
    right: Iterable[str] = (),
    group: Iterable[str] = (),
    shifts: dict[tuple[str, str], float] | None = None,
    unsure: Iterable[str] = (),
) -> Done:
    """A `Done` of any collections."""
    return Done(frozenset(right), frozenset(group), shifts or {}, frozenset(unsure))


@dataclass(frozen=True)
class Mishap:
    """A kind of mishap.

    Args:
        name: of the kind.
        apply: does it to a scene, so many times the detectable size, and says what it did.
        needs: what a recording must have, of `Scene.features`.
        sized: whether it can be large or small.
        harmless: whether a calibration need not change.
    """

    name: str
    apply: Callable[[Scene, float], Done]
    needs: frozenset[str]
    sized: bool
    harmless: bool

    @property
    def times(self) -> tuple[int, ...]:
        """At which multiples of the detectable size."""
        return TIMES if self.sized else (10,)


MISHAPS: dict[str, Mishap] = {}


def mishap(
    *needs: str, sized: bool = False, harmless: bool = False
) -> Callable[[Callable[[Scene, float], Done]], Callable[[Scene, float], Done]]:
    """Put a function into the list, under its name in words."""

    def enter(apply: Callable[[Scene, float], Done]) -> Callable[[Scene, float], Done]:
        name = apply.__name__.replace("_", " ")
        assert name not in MISHAPS, name
        MISHAPS[name] = Mishap(
            name=name, apply=apply, needs=frozenset(needs), sized=sized, harmless=harmless
        )
        return apply

    return enter
