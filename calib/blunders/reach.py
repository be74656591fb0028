"""How far a mishap that is too small to be found could move an estimate.

An offset e of a group's whitened rows ``A`` moves estimates by ``C A^T e``, and is found with 80 %
power where ``e^T (I - H) e`` reaches the noncentrality d of its test. Of all offsets of that size
the worst moves estimate j, whose row of C is c, by

    sqrt(d) |(I - H)^(-1/2) A c|

(external reliability: Baarda 1968, A testing procedure for use in geodetic networks). Where others
hardly check a group, this is large.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from calib.blunders.judged import Blunder
from calib.blunders.others import Alike, Others, whitening
from calib.linear.layout import positions
from calib.residuals.groups import CAD, Group

PROMISED_SIGMAS = 3.0  # sigmas: what the diagnosis promises to name; see docs/one_thing_wrong.md


@dataclass(frozen=True)
class FurthestMoved:
    """The estimate that a mishap could move furthest, unseen.

    Args:
        estimate: its name, as ``lidar.tx``.
        sigmas: by how many of its sigmas.
    """

    estimate: str
    sigmas: float

    def document(self) -> dict[str, str | float]:
        """As diagnosis.json has it."""
        return {"estimate": self.estimate, "sigmas": self.sigmas}


def reaches(
    others: Others, blunders: Sequence[Blunder], sigma: Mapping[str, float]
) -> dict[Group, FurthestMoved]:
    """Group -> how far a mishap to it could move an estimate, unseen; of a scan, its
    place or its range zero, whichever is further.

    Args:
        others: as of `judge`.
        blunders: what it gave.
        sigma: estimates that count, each with its sigma in its own unit.
    """
    whole = others.whole
    names, columns = _estimates(others, sigma)
    if not names:
        return {}
    enough = {(b.group, b.shift.of_ranges): b.enough for b in blunders}
    kept = positions(whole.layout.size, whole.layout.kept)[columns]
    towards = whole.followed(others.kept[:, kept])
    wide = np.array([sigma[name] for name in names])
    found: dict[Group, FurthestMoved] = {}
    for group, of_ranges, moved in (m for some in others.alike(towards) for m in _moved(some)):
        if (group, of_ranges) not in enough:
            continue
        by = np.sqrt(enough[group, of_ranges]) * moved / wide
        worst = int(np.argmax(by))
        reach = FurthestMoved(names[worst], float(by[worst]))
        found[group] = max(found.get(group, reach), reach, key=lambda r: r.sigmas)
    return found


def hardly_checked(found: Mapping[Group, FurthestMoved]) -> list[str]:
    """In a sentence, which measurements could be wrong, unseen, and move an estimate further than
    anything should; none where none could. Of values on paper that nothing measured checks, the
    weak directions tell."""
    measured = [(group, each) for group, each in found.items() if group.where != CAD]
    far = sorted((m for m in measured if m[1].sigmas > PROMISED_SIGMAS), key=lambda m: -m[1].sigmas)
    if not far:
        return []
    group, worst = far[0]
    others = f"{len(far) - 1} other{'s' if len(far) > 2 else ''}"
    more = f", and so could {others} in diagnosis.json" if len(far) > 1 else ""
    return [
        f"A mishap too small to be found ({group}) could move {worst.estimate} by up to "
        f"{worst.sigmas:.1f} of its sigmas{more}: more stops would check it."
    ]


def _estimates(others: Others, sigma: Mapping[str, float]) -> tuple[list[str], np.ndarray]:
    """Names of the estimates that count, and their columns among all unknowns."""
    problem, layout, names, columns = others.problem, others.whole.layout, [], []
    for variable in problem.calibration:
        at = layout.at[variable]
        for dof, column in zip(problem.variables[variable].dofs, np.r_[at], strict=True):
            if sigma.get(name := f"{variable}.{dof}", 0.0) > 0.0:
                names.append(name)
                columns.append(column)
    return names, np.array(columns, int)


def _moved(some: Alike) -> Iterator[tuple[Group, bool, np.ndarray]]:
    """Groups, whether it is their range zero that is off, and by how much an offset of one squared
    sigma in the test moves each estimate (P,) at most; `some` have these columns of C."""
    for names in some.groups():
        own = some.rows[0].groups[names[0]]
        whiten, _ = whitening(own.T @ some.left @ own, some.size(own))
        moved = np.linalg.norm(whiten.mT @ own.T @ some.b, axis=1)
        for rows, group, each in zip(some.rows, names, moved, strict=True):
            yield group, rows.of_ranges, each
