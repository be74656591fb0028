"""What is wrong at stops that follow each other, told as one thing that lasts."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

from calib.blunders.chance import at_least
from calib.blunders.judged import LeftOut
from calib.blunders.told import size_told
from calib.problem.model import Source, labels
from calib.residuals.groups import JOINTS, Group
from calib.rig.suspect import Spell, spells


def lasting(
    found: Sequence[LeftOut], looked_at: Iterable[Group], sources: Sequence[Source]
) -> Iterator[dict[str, Any]]:
    """Blunders of one scan, body or joint at stops that follow each other, as diagnosis.json has
    them: each by itself would hardly lie so.

    Args:
        found: the blunders.
        looked_at: all groups of rows that might be some.
        sources: the recordings that they are in.
    """
    by_what: dict[tuple[str, str, str], dict[str, LeftOut]] = {}
    for left in found:
        if left.blunder.group.stop is not None:
            at_stops = by_what.setdefault(_wherever(left.blunder.group), {})
            at_stops[left.blunder.group.stop] = left
    there = {what: {*at_stops} for what, at_stops in by_what.items()}
    for group in looked_at:
        there.get(_wherever(group), set()).add(str(group.stop))
    of = dict(zip(labels(sources), sources, strict=True))
    for what, at_stops in by_what.items():
        recording = of.get(what[0], sources[0]).recording
        seen = [k for k, stop in enumerate(recording.stops) if stop in there[what]]
        stops = [recording.stops[k] for k in seen]
        for spell in spells(stops, recording.time_s[seen], at_stops):
            yield _document(spell, [at_stops[stop] for stop in spell.wrong])


def _wherever(group: Group) -> tuple[str, str, str]:
    """What of a recording it is, at whichever stop."""
    return group.recording, group.kind, group.what


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
    verb = "are" if group.what == JOINTS else "is"
    return (
        f"{where[0].upper()}{where[1:]} {group.named} {verb} off{off}, against everything "
        f"else{either}. This {spell.course}: stops that are wrong each by itself would hardly "
        f"follow each other so (p = {at_least(spell.p_value):.1g})."
    )


def _in_common(found: Sequence[LeftOut]) -> list[str]:
    """What else may be wrong in its place at most of these stops."""
    count = Counter(rival.named for left in found for rival in left.rivals)
    return [name for name, times in count.items() if 2 * times > len(found)]
