"""What nobody has named: its formula, from the residuals of a fit."""

from __future__ import annotations

from calib.blunders.chance import LEVELS
from calib.diagnosis.formulas.found import Formula, settled
from calib.diagnosis.formulas.pursuit import pursue
from calib.diagnosis.formulas.table import Table
from calib.solve.estimate import Estimate
from calib.solve.fit import Progress

__all__ = ["Formula", "find"]


def find(estimate: Estimate, progress: Progress) -> list[Formula]:
    """Formulas of what ranges do beyond a fit, strongest first; none where chance explains it all.

    Args:
        estimate: a fit; without scans nothing is found.
        progress: as of `fit.solve`.
    """
    if not estimate.scans:
        return []
    table = Table.of(estimate, lambda done, total: progress("reading residuals", done, total))
    steps = pursue(table, LEVELS["structure"], progress)
    return settled(table, steps) if steps else []
