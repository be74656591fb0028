"""What is wrong at stops that follow each other, told as one thing that lasts."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from calib.blunders.chance import at_least
from calib.blunders.judged import LeftOut
from calib.blunders.told import size_told
from calib.problem.model import Source, labels
from calib.residuals.groups import JOINTS
from calib.rig.suspect import Spell, spells


def lasting(found: Sequence[LeftOut], sources: Sequence[Source]) -> Iterator[dict[str, Any]]:
    """Blunders of one scan, body or joint at stops that follow each other, as diagnosis.json has
    them: each by itself would hardly lie so.

    Args:
        found: the blunders.
        sources: the recordings that they are in.
    """
    by_what: dict[tuple[str, str, str], dict[str, LeftOut]] = {}
    for left in found:
        group = left.blunder.group
        if group.stop is not None:
            at_stops = by_what.setdefault((group.recording, group.kind, group.what), {})
            at_stops[group.stop] = left
    of = dict(zip(labels(sources), sources, strict=True))
    for (recording, _, _), at_stops in by_what.items():
        stops = of.get(recording, sources[0]).recording
        for spell in spells(stops.stops, stops.time_s, at_stops):
            yield _document(spell, [at_stops[stop] for stop in spell.wrong])


def told_once(
    last: Sequence[Mapping[str, Any]], blunders: Sequence[Mapping[str, Any]]
) -> list[Mapping[str, Any]]:
    """What lasts, and blunders that are no part of it, as diagnosis.json has them."""
    parts = {token for each in last for token in each["without"]}
    return [*last, *(each for each in blunders if each["without"] not in parts)]


def _document(spell: Spell, found: Sequence[LeftOut]) -> dict[str, Any]:
    group = found[0].blunder.group
    return {
        "kind": group.kind,
        "name": group.what,
        "recording": group.recording or None,
        "first": spell.stops[0],
        "last": spell.stops[-1],
        "p_value": spell.p_value,
        "without": [left.blunder.group.token for left in found],
        "sentence": _sentence(spell, found),
    }


def _sentence(spell: Spell, found: Sequence[LeftOut]) -> str:
    group = found[0].blunder.group
    worst = max(found, key=lambda left: left.blunder.leading()[0])
    *size, _ = worst.blunder.leading()
    where = str(spell) if not group.recording else f"{spell} of {group.recording}"
    off = (
        f", by {size_told(*size)} at {worst.blunder.group.where}" if worst.blunder.possible else ""
    )
    rivals = " or ".join(_in_common(found))
    either = f"; or it is {rivals}: nothing measured here tells them apart" if rivals else ""
    return (
        f"{where[0].upper()}{where[1:]} {group.named} {'are' if group.what == JOINTS else 'is'} "
        f"off{off}, against everything else{either}. Something changed {spell.since} and lasts: "
        "stops that are wrong each by itself would hardly follow each other so "
        f"(p = {at_least(spell.p_value):.1g})."
    )


def _in_common(found: Sequence[LeftOut]) -> list[str]:
    """What else may be wrong in its place at most of these stops."""
    count = Counter(rival.named for left in found for rival in left.rivals)
    return [name for name, times in count.items() if 2 * times > len(found)]
