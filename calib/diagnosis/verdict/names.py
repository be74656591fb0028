"""Whether the names that a search found are the answer, or stand in for something else."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from calib.diagnosis.screen import ODDS
from calib.diagnosis.search import Search
from calib.diagnosis.search.parts import Explained, in_place, likeliest_part
from calib.diagnosis.verdict.matters import (
    ABSORBED,
    HELD_OUT_BESIDE_SCATTER,
    HELD_OUT_BY_CHANCE,
    borne_out,
)
from calib.diagnosis.verdict.unnamed import Unnamed
from calib.results.holdout import Fall


def believed(found: Search, held_out: Mapping[str, Fall]) -> bool:
    """Whether the names that a search found are the answer; so they are where there are none.

    Args:
        found: the search.
        held_out: as of `conclude`.
    """
    return _names_hold(found) and not _leave_most(found, held_out)


def _leave_most(found: Search, held_out: Mapping[str, Fall]) -> bool:
    """Whether the names leave most of the held-out error, where that is further above its floor
    than chance puts it; not where stops confirm each name and scatter explains the rest."""
    falls = [held_out[s.effect.name] for s in found.found if s.effect.name in held_out]
    if not falls or falls[-1].takes_back or not found.looks[0].stand.estimate.scans:
        return False
    whole = replace(falls[-1], before_mm=falls[0].before_mm)
    if whole.after_mm <= HELD_OUT_BY_CHANCE * whole.floor_mm or whole.explained >= ABSORBED:
        return False
    rest = beside_scatter(found, held_out)
    scatters = rest and rest.after_mm <= HELD_OUT_BESIDE_SCATTER * rest.floor_mm
    return not (scatters and all(map(borne_out, falls)))


def beside_scatter(found: Search, held_out: Mapping[str, Fall]) -> Fall | None:
    """The held-out error of the model with what scatters by chance; None if nobody looked."""
    return next((held_out[n] for c in found.chance if (n := c.effect.name) in held_out), None)


def _names_hold(found: Search) -> bool:
    """Whether the names explain as much as a single residual structure, each at its price; so
    they do where there are none.

    A search may describe residual structure by several effects, each of which takes a part of it;
    where a name is right, no bins do better.
    """
    if not found.found:
        return True
    common = found.looks[-1].named.common
    explained = sum(step.candidate.test.statistic for step in found.found)
    parts = [likeliest_part(step.before, step.candidate, common) for step in found.found]
    together = Explained(
        statistic=sum(part.statistic for part in parts),
        dof=sum(part.dof for part in parts),
        price=sum(
            part.price + np.log(step.candidate.looks)
            for part, step in zip(parts, found.found, strict=True)
        ),
    )
    named = together.evidence(common)
    structure = in_place(explained, found.looks[0], found.looks[-1], common)
    bins = (evidence - np.log(c.looks) for c, evidence in structure)
    return named > max(bins, default=0.0) - ODDS


def dressed_up(
    found: Search, held_out: Mapping[str, Fall], hold: bool, formulas: Unnamed
) -> list[str]:
    """Names that stand in for residual structure. Where formulas were found of what the names
    leave, and stops held out bear out each name, only those do that predict nothing beside the
    formulas: bins explain more than the others because they take in the rest as well.

    Args:
        found: the search.
        held_out: as of `conclude`.
        hold: whether its names are the answer.
        formulas: of residual structure.
    """
    names = [step.effect.name for step in found.found]
    rest = [name for name in names if name not in formulas.needless]
    sure = all(name in held_out and borne_out(held_out[name]) for name in rest)
    if sure and formulas.formulas and not formulas.instead:
        return [name for name in names if name not in rest]
    worn = (not hold or found.dressed_up(i) for i in range(len(names)))
    return [n for n, each in zip(names, worn, strict=True) if each or n not in rest]


def absorbed(found: Search) -> float:
    """Share of the structure seen at first that the named effects account for."""
    before, after = (
        max((c.test.statistic - c.test.dof for c in look.unnamed.candidates), default=0.0)
        for look in (found.looks[0], found.looks[-1])
    )
    return 1.0 - max(after, 0.0) / max(before, after, 1e-9)
