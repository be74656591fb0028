"""What is known without the rows of one kind: how much each kind tells."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from calib.linear.layout import Layout
from calib.linear.linearise import linearise
from calib.problem.prior import JointPrior
from calib.solve.estimate import Estimate
from calib.solve.graph import Graph, KeptRows

BEAMS = KeptRows.kind


@dataclass(frozen=True)
class RowsOfKind:
    """All rows of one kind in an estimate.

    Args:
        name: "beams", "tracker", "level", "target" or "prior".
        blocks: how many scans, bodies or targets they are of.
        rows: how many.
        variables: the unknowns that they speak of, those that are eliminated included.
        covariance: (P, P) of the calibration without them, where the estimate is.
    """

    name: str
    blocks: int
    rows: int
    variables: frozenset[str]
    covariance: np.ndarray


def kinds_of(estimate: Estimate) -> list[RowsOfKind]:
    """Every kind of rows of an estimate that has its graph, but for what is known of each unknown
    by itself."""
    problem, out = estimate.problem, []
    if estimate.scans:
        rows = sum(int((met.part >= 0).sum()) for met in estimate.associations)
        covariance = _without(estimate, BEAMS)
        touched = _of_beams(estimate)
        out.append(RowsOfKind(BEAMS, len(estimate.scans), rows, touched, covariance=covariance))
    blocks = [*problem.blocks, *_priors(estimate)]
    for name in dict.fromkeys(block.kind for block in blocks):
        mine = [block for block in blocks if block.kind == name]
        out.append(
            RowsOfKind(
                name=name,
                blocks=len(mine),
                rows=sum(block.rows for block in mine),
                variables=frozenset(each for block in mine for each in block.variables),
                covariance=_without(estimate, name),
            )
        )
    return out


def _priors(estimate: Estimate) -> list[JointPrior]:
    """The earlier run that stood for CAD, where one did."""
    return [block for block in estimate.graph.blocks if isinstance(block, JointPrior)]


def _without(estimate: Estimate, kind: str) -> np.ndarray:
    """Covariance (P, P) of the calibration without the rows of a kind, linearised where they are
    in it; without an earlier run, CAD is in its place."""
    graph = _linearised(estimate, kind)
    return graph.covariance(estimate.values, [v.name for v in estimate.variables])


def _linearised(estimate: Estimate, *kinds: str) -> Graph:
    """The graph without the rows of some kinds."""
    blocks = [block for block in estimate.problem.blocks if block.kind not in kinds]
    problem = replace(estimate.problem, blocks=blocks)
    priors = [block for block in _priors(estimate) if block.kind not in kinds]
    held = frozenset(name for prior in priors for name in prior.variables)
    layout, beams = Layout.of(problem, kept=held), BEAMS not in kinds
    met = estimate.associations
    linear = linearise(problem, estimate.values, met, layout=layout, beams=beams)
    rows = [*layout.others, *priors, *KeptRows.of(linear)]
    return Graph(list(layout.outer().values()), rows, held)


def _of_beams(estimate: Estimate) -> frozenset[str]:
    """Unknowns that beams speak of."""
    others = {block.kind for block in estimate.problem.blocks}
    rows = _linearised(estimate, *sorted(others)).blocks
    found = {name for block in rows if isinstance(block, KeptRows) for name in block.variables}
    found |= {name for scan in estimate.scans for name in scan.stops.variables}
    return frozenset({*found, *estimate.problem.cells})
