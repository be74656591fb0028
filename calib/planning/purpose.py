"""What planned stops are for: the whole calibration or some of it, telling rivals apart, estimates
that single stops do little to, or predictions that are good wherever the arm can go."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from calib.diagnosis.stand import Stand
from calib.diagnosis.weak import to_be_told_apart
from calib.effects import CATALOGUE, Effect, Site, find, split
from calib.effects.scatter import StopPoseScatter, StopRangeScatter
from calib.problem.unknowns import Key, Unknown
from calib.runs.reopen import proposed
from calib.runs.run import Run
from chains.errors import InputError
from sensors.documents import nearest

ALL, RELIABILITY, SCATTER, WORKSPACE = "all", "reliability", "scatter", "workspace"
# What differs from stop to stop by chance, as a whole: the range zero, and where the LiDAR sits.
OF_STOPS = (StopRangeScatter, StopPoseScatter)


@dataclass(frozen=True)
class Purpose:
    """What a plan is for.

    Args:
        text: as the option ``--for`` has it.
        why: what it is, where a diagnosis says it; empty where the user did.
        components: those of the model that are to be known better; empty for all of them.
        tolerance: of each of those the sigma that is wanted, in its unit; empty without any.
        rivals: names of effects, each of which is to be told from the others and from the model;
            empty where that is not the purpose.
        added: those of them that are not in the model, and what is to scatter by chance.
    """

    text: str
    why: str = ""
    components: tuple[Key, ...] = ()
    tolerance: tuple[float, ...] = ()
    rivals: tuple[str, ...] = ()
    added: tuple[Effect, ...] = field(default=(), repr=False)

    def document(self) -> dict[str, Any]:
        """As JSON has it."""
        return {"for": self.text, "why": self.why or None, "rivals": list(self.rivals)}


def purpose_of(run: Run | None, stand: Stand, text: str | None) -> Purpose:
    """What a plan for a run is for.

    Args:
        run: with its diagnosis, if there is one; None of a rig alone, of which `text` says it.
        stand: its fit.
        text: ``all``; ``reliability``, so that no single stop carries an estimate; ``scatter``, as
            well as can be where stops err as a whole; ``workspace``, so that what the arm carries
            is predicted best wherever it can go; names of frames, effects or parameters of
            the model, with commas; or effects, of which one at least is not in the model. By
            default what the diagnosis says cannot be told apart, then what it says is hardly
            determined, then all.

    Raises:
        InputError: a name is not known.
    """
    if text is None:
        return _from_diagnosis(run, stand)
    if text in (ALL, RELIABILITY, WORKSPACE):
        return Purpose(text)
    if text == SCATTER:
        return Purpose(SCATTER, added=_of_stops(stand))
    names = split(text)
    found = [components(stand, name) for name in names]
    if not names or all(found):
        return Purpose(text, components=tuple(dict.fromkeys(key for some in found for key in some)))
    missing = [name for name, some in zip(names, found, strict=True) if not some]
    return Purpose(text, rivals=tuple(names), added=tuple(_effects(run, stand, missing)))


def _of_stops(stand: Stand) -> tuple[Effect, ...]:
    """What is to differ from stop to stop, beyond what the model has scatter already."""
    there, rigs = stand.model.names, [source.rig for source in stand.sources]
    effects = (effect() for effect in OF_STOPS if effect.name not in there)
    found = tuple(e for e in effects if any(e.params(rig) for rig in rigs))
    if not found and not set(there) & {effect.name for effect in OF_STOPS}:
        raise InputError(f"--for {SCATTER}: without a LiDAR nothing differs from stop to stop")
    return found


def _from_diagnosis(run: Run, stand: Stand) -> Purpose:
    document = run.diagnosis() or {"candidates": [], "weak_directions": []}
    rivals = to_be_told_apart(document["candidates"], document["weak_directions"])
    if rivals:
        why = "what the diagnosis cannot tell apart"
        return replace(purpose_of(run, stand, ",".join(rivals)), why=why)
    weak = [name for w in document["weak_directions"] for name in w["parameters"]]
    single = _single(stand)
    components = {single[name]: None for name in weak if name in single}
    if components:
        names = ",".join(key.name for key in components)
        return Purpose(
            names, "what the diagnosis finds hardly determined", components=tuple(components)
        )
    return Purpose(ALL)


def calibration(stand: Stand) -> list[Unknown]:
    """The unknowns of the model that describe the hardware."""
    problem = stand.estimate.problem
    return [problem.variables[name] for name in problem.calibration]


def _single(stand: Stand) -> dict[str, Key]:
    """Name of every component of the model -> its key."""
    return {key.name: key for unknown in calibration(stand) for key in unknown.keys}


def components(stand: Stand, name: str) -> list[Key]:
    """The components of the model that go by a name: a frame's or effect's, of whichever rig, or
    one of them."""
    mine = (u for u in calibration(stand) if name in (u.name, u.owner.effect))
    whole = [key for unknown in mine for key in unknown.keys]
    return whole or [key for text, key in _single(stand).items() if text == name]


def _effects(run: Run | None, stand: Stand, names: Sequence[str]) -> Iterator[Effect]:
    """Effects of the catalogue, of the user's own, or that a diagnosis has described."""
    known = [effect.family for effect in CATALOGUE]
    described = [n for n in names if n.partition("@")[0] not in known]
    own = [*stand.own, *(proposed(run, described) if run else ())]
    for name in names:
        try:
            effect = find(name, own)
        except InputError:
            every = list(dict.fromkeys([*stand.estimate.problem.calibration, *known, ALL]))
            raise InputError(
                f"--for {name}: neither in the model nor an effect{nearest(name, every)}; give a "
                f"frame, effect or parameter of the model, effects to be told apart, or {ALL}"
            ) from None
        yield _possible(effect, name, stand)


def _possible(effect: Effect, name: str, stand: Stand) -> Effect:
    """The effect, if stops can tell of it."""
    why = ""
    if effect.by_chance:
        why = "it is drawn by chance"
    elif effect.site is Site.NOISE:
        why = "it moves no mean, and how beams will scatter is not predicted"
    elif not any(effect.params(source.rig) for source in stand.sources):
        why = "this rig has nothing that it acts on"
    if why:
        raise InputError(f"--for {name}: {why}, so no stop can be planned for it")
    return effect
