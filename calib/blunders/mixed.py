"""Targets under each other's names, or mirrored: no fit to them comes to an optimum, and everything
else that then stands out may follow from that."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from calib.blunders.told import otherwise, whole
from calib.problem.model import Source, labels
from calib.rig.scale import mixed_up


def mixed_targets(sources: Sequence[Source]) -> Iterator[dict[str, Any]]:
    """Targets that scanner and tracker number otherwise, or see as in a mirror, as blunders of
    `diagnosis.json`; of several recordings that share them, once."""
    said: set[tuple[object, ...]] = set()
    for label, source in zip(labels(sources), sources, strict=True):
        targets, spec = source.recording.targets, source.rig.target
        for each in mixed_up(targets, spec) if targets and spec else ():
            where = str(source.recording.folder / "targets.csv")
            measured = (each.sentence, *source.measured_targets.values())
            if measured not in said:
                said.add(measured)
                found = otherwise("target", each.name, where, whole(f"{where}: {each.sentence}"))
                yield found | {"recording": label or None}
