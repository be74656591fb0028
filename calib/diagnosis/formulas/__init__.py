"""Residual structure: its formula, from the residuals of a fit."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from calib.blunders.chance import LEVELS
from calib.diagnosis.formulas.arm import joint_tables
from calib.diagnosis.formulas.found import JOINT_SITE, RANGE_SITE, Formula, settled
from calib.diagnosis.formulas.pursuit import ConfirmedTerm, pursue
from calib.diagnosis.formulas.table import BeamTable, Projection
from calib.diagnosis.stand import Stand
from calib.linear.layout import Layout
from calib.problem import Problem
from calib.solve.fit import Progress

__all__ = ["Formula", "find"]


def find(stand: Stand, progress: Progress, by_location: bool = False) -> list[Formula]:
    """Formulas of what ranges do beyond a fit, strongest first; without scans, of what that joint
    does which explains most. None where chance explains it all.

    Args:
        stand: a model, fitted.
        progress: as of `fit.solve`.
        by_location: whether all beams of a location may err together, not those of a stop only.
    """
    if stand.estimate.scans:
        table = BeamTable.of(
            stand.estimate, lambda done, total: progress("reading residuals", done, total)
        )
        if by_location:
            table = table.clustered(_locations(stand.estimate.problem))
        steps = pursue(table, LEVELS["structure"], progress)
        return settled(table, steps, RANGE_SITE) if steps else []
    tables = dict(joint_tables(stand))
    alpha = LEVELS["structure"] / max(len(tables), 1)
    first = {name: pursue(table, alpha, progress, most=1) for name, table in tables.items()}
    left = {name: _left(tables[name], steps) for name, steps in first.items() if steps}
    if not left:
        return []
    joint = min(left, key=left.__getitem__)
    steps = pursue(tables[joint], alpha, progress, found=first[joint])
    return settled(tables[joint], steps, JOINT_SITE + joint)


def _left(table: BeamTable, steps: Sequence[ConfirmedTerm]) -> float:
    """Chi-square of all that was measured, beside some terms."""
    columns = np.hstack([step.form.term.columns(table.covariates) for step in steps])
    return Projection.of(table, table.sigma_m**-2.0).fitted(columns)[0].chi2


def _locations(problem: Problem) -> np.ndarray:
    """The number (S,) of the location of each stop, in the order of a layout."""
    name = {
        (source.recording.folder, i): f"{source.recording.folder} {location}"
        for source in problem.sources
        for i, location in enumerate(source.recording.location)
    }
    return np.unique([name[key] for key in Layout.of(problem).stops], return_inverse=True)[1]
