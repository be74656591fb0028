"""The calibration as tables: where every link is, how far that is from CAD, and every effect."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from calib.report.data import Cell, Table
from calib.report.evidence import Evidence
from calib.results.outstanding import shown
from calib.results.solution import Solution
from calib.rig import Rig
from calib.runs.estimates import VariableEstimate, drawn
from calib.show.tables import LISTED_PARAMETERS, estimate_texts
from chains import escape, se3

SIX = ("x, mm", "y, mm", "z, mm", "roll, deg", "pitch, deg", "yaw, deg")
NUMBER_COLUMNS = (
    *("sigma", "prior sigma", "unit", "estimate/sigma", "estimate/prior sigma", "identifiable"),
)


def calibration_tables(evidence: Evidence) -> list[Table]:
    """Poses of all links, their differences from CAD, and effects; those that have rows."""
    links = [row for row in evidence.estimates if row.parent is not None]
    effects = [row for row in evidence.estimates if row.parent is None]
    few = [row for row in effects if len(row.parameters) <= LISTED_PARAMETERS]
    prior = evidence.prior_sigma
    tables = [
        _poses(evidence.run.solution, [source.rig for source in evidence.sources]),
        Table(
            id="table-links",
            title="How far every link is from CAD",
            reading="Per link T_cad exp(twist) in the child's axes: tx ty tz along them, rx ry rz "
            "about them. A link without a difference has no CAD pose.",
            columns=("link", "in", "parameter", "difference", *NUMBER_COLUMNS),
            rows=[
                [Cell(row.variable), Cell(row.parent), *cells]
                for row in links
                for cells in _numbers(row, prior, [*range(3, 6), *range(3)])
            ],
            folded=True,
        ),
        _effects("table-effects", "Joints, lengths and other effects", few, prior),
    ]
    for row in effects:
        if len(row.parameters) > LISTED_PARAMETERS:
            name = f"table-effect-{escape.identifier(row.variable)}"
            tables.append(_effects(name, row.variable, [row], prior))
    return [table for table in tables if table.rows]


def _effects(
    name: str,
    title: str,
    rows: Sequence[VariableEstimate],
    prior: dict[str, float],
) -> Table:
    return Table(
        id=name,
        title=title,
        reading="Instruments are corrected by taking the estimate off, geometry by adding it.",
        columns=("effect", "parameter", "estimate", *NUMBER_COLUMNS),
        rows=[[Cell(row.variable), *cells] for row in rows for cells in _numbers(row, prior)],
        folded=True,
    )


def _numbers(
    row: VariableEstimate, prior: dict[str, float], order: Sequence[int] | None = None
) -> Iterator[list[Cell]]:
    """Cells of each number of a variable that was not held: its name, itself, `NUMBER_COLUMNS`; and
    of its shape, if it has one, whose name ends with its unit and which no CAD has."""
    if row.shape is not None:
        name, _, of = row.shape.name.rpartition("_")
        scale, unit = shown(of)
        value, spread = estimate_texts(row.shape.value, row.shape.sigma, of)
        yield [
            Cell(name),
            _cell(scale * row.shape.value, value.lstrip("+")),
            _cell(scale * row.shape.sigma, spread),
            Cell(""),
            Cell(unit),
            *(Cell(""), Cell("")),
            Cell("yes" if row.shape.sigma else "no"),
        ]
    for k in range(len(row.parameters)) if order is None else order:
        estimate, sigma = float(row.estimate[k]), float(row.sigma[k])
        if sigma == 0.0:
            continue
        before = prior.get(f"{row.variable}.{row.parameters[k]}", np.nan)
        before = np.nan if np.isnan(estimate) else before  # of a link without CAD it is no drawing
        scale, unit = shown(row.units[k])
        value, spread = estimate_texts(estimate, sigma, row.units[k])
        yield [
            Cell(row.parameters[k]),
            _cell(scale * estimate, value),
            _cell(scale * sigma, spread),
            _cell(scale * before, f"{scale * before:.3g}"),
            Cell(unit),
            _cell(estimate / sigma, f"{estimate / sigma:+.1f}"),
            _cell(estimate / before, f"{estimate / before:+.1f}"),
            Cell("yes" if row.told[k] else "no"),
        ]


def _cell(value: float, text: str) -> Cell:
    """A number; an empty cell of NaN."""
    return Cell(text, value) if np.isfinite(value) else Cell("")


def _poses(solution: Solution, rigs: Sequence[Rig]) -> Table:
    """T_parent_child of every link as fitted and, below it, as in CAD."""
    parts = {"": solution.shared} | {f"{name}/": p for name, p in solution.recordings.items()}
    rows = []
    for prefix, part in parts.items():
        mine = [rig for rig in rigs if not prefix or rig.name == prefix[:-1]]
        for name, frame in part.frames.items():
            poses = {"the fit": frame.T_parent_child, "CAD": drawn(name, mine)}
            for source, T in poses.items():
                if T is not None:
                    words = (prefix + name, frame.parent, source)
                    rows.append([*map(Cell, words), *_six(T)])
    return Table(
        id="table-poses",
        title="Where every link is",
        reading="T_parent_child: the link's origin in its parent, and URDF's roll, pitch and yaw, "
        "about the parent's fixed x, then y, then z.",
        columns=("link", "in", "by", *SIX),
        rows=rows,
    )


def _six(T: np.ndarray) -> list[Cell]:
    mm, deg = 1e3 * T[:3, 3], np.degrees(se3.to_rpy(T))
    return [
        *(Cell(f"{value:z.2f}", float(value)) for value in mm),
        *(Cell(f"{value:z.3f}", float(value)) for value in deg),
    ]
