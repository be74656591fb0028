"""The factor graph: which rows depend on which unknowns, and the information of each kind."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from calib.problem.unknowns import Role, Unknown
from calib.recalibration.newer import blocks_of
from calib.report import plots
from calib.report.chart import Absent, Chart
from calib.report.evidence import Evidence
from calib.runs.asked.factors import estimate_of
from calib.solve.estimate import Estimate
from calib.solve.without import RowsOfKind, kinds_of

if TYPE_CHECKING:
    from calib.report.plots import Axes, Figure

BLOCK_NAMES = {
    "beams": "{rows} beams\nof {blocks} scans",
    "tracker": "{rows} numbers\nof the tracker",
    "level": "{rows} numbers\nof levels",
    "target": "{rows} numbers\nof {blocks} targets",
    "prior": "the earlier run,\n{rows} numbers",
}
SHORT_NAMES = {"level": "levels", "target": "targets", "prior": "earlier"}
GROUPS = {
    Role.PLACE: "places of the rig",
    Role.JOINTS: "joint readings",
    Role.TARGET: "targets",
    Role.GRAVITY: "gravity",
    Role.ZERO: "zeros of levels",
    Role.PLANE: "planes",
    Role.SURFACE: "parts of surfaces",
    Role.SCATTER: "scatter by chance",
}
MOST_BITS = 12.0  # at which the colours end: CAD's mm would be known to a quarter of a micrometre
LEAST_BITS = 0.05  # a sigma that is 3 % larger
MOST_ROWS = 40  # unknowns that are drawn one by one


@dataclass(frozen=True)
class Row:
    """An unknown of the calibration, or a group of others, as it is drawn.

    Args:
        name: as it is drawn.
        dim: of how many numbers.
        kinds: kinds of rows that depend on it.
        bits: kind -> bits per parameter that would be lost without it; empty of a group.
        beyond: bits per parameter beyond CAD; None where CAD says nothing, and of a group.
    """

    name: str
    dim: int
    kinds: frozenset[str]
    bits: Mapping[str, float]
    beyond: float | None = None


def graph(evidence: Evidence) -> Iterator[Chart | Absent]:
    """The factor graph of the run."""
    yield Chart(
        "graph",
        "The factor graph: which rows constrain which unknowns, and their information",
        "Left: the unknowns with their dimensions; below the dotted line those that are "
        "estimated and not reported. A line joins an unknown to the rows that depend on it, "
        "thicker for more information. Right: bits per parameter that would be lost without the "
        "rows of one kind, and the bits that all rows add to CAD. One bit halves a sigma.",
        lambda: _draw(*_found(evidence)),
        wide=True,
    )


def _found(evidence: Evidence) -> tuple[list[Row], list[RowsOfKind]]:
    """What is drawn: it takes some passes over the beams."""
    estimate = estimate_of(evidence.run, evidence.progress)
    kinds = kinds_of(estimate)
    return graph_rows(estimate, kinds), kinds


def graph_rows(estimate: Estimate, kinds: Sequence[RowsOfKind]) -> list[Row]:
    """The unknowns of the calibration one by one, and the others by what they stand for."""
    at, C = blocks_of(estimate.variables), estimate.covariance
    out = []
    for unknown in estimate.variables:
        k = at[unknown.name]
        bits = {kind.name: _bits(kind.covariance[k, k], C[k, k]) for kind in kinds}
        cad = unknown.prior_covariance if unknown.kind == "vector" else None
        out.append(
            Row(
                name=unknown.name,
                dim=unknown.dim,
                kinds=frozenset(kind.name for kind in kinds if unknown.name in kind.variables),
                bits=bits,
                beyond=None if cad is None else _bits(cad, C[k, k]),
            )
        )
    others: dict[str, list[Unknown]] = {}
    for unknown in estimate.problem.variables.values():
        if unknown.name not in at:
            others.setdefault(GROUPS.get(unknown.role, unknown.name), []).append(unknown)
    for name, some in others.items():
        mine = {unknown.name for unknown in some}
        spoken = frozenset(kind.name for kind in kinds if mine & kind.variables)
        out.append(Row(name, sum(unknown.dim for unknown in some), spoken, {}))
    return out


def _bits(before: np.ndarray, after: np.ndarray) -> float:
    """By how many bits per parameter one covariance (n, n) is smaller than another."""
    larger, smaller = (np.linalg.slogdet(matrix)[1] for matrix in (before, after))
    return float((larger - smaller) / (2 * np.log(2) * len(after)))


def _draw(rows: Sequence[Row], kinds: Sequence[RowsOfKind]) -> Figure:
    rows = rows[:MOST_ROWS]
    height = 1.5 + 0.27 * len(rows)
    figure, grid = plots.axes(plots.WIDE_IN, height, 1, 2, sharey=True, width_ratios=(1.35, 1.0))
    _lines(grid[0, 0], rows, kinds)
    _cells(figure, grid[0, 1], rows, [kind.name for kind in kinds])
    grid[0, 0].set_yticks(
        range(len(rows)), [f"{row.name} ({row.dim})" for row in rows], fontsize=8.5
    )
    grid[0, 0].set_ylim(len(rows) - 0.5, -0.5)
    return figure


def _lines(ax: Axes, rows: Sequence[Row], kinds: Sequence[RowsOfKind]) -> None:
    """Unknowns on the left, rows on the right, and what joins them."""
    places = np.linspace(0, len(rows) - 1, 2 * len(kinds) + 1)[1::2]
    colours = dict(zip((kind.name for kind in kinds), plots.LINES, strict=False))
    for kind, y in zip(kinds, places, strict=True):
        for i, row in enumerate(rows):
            if kind.name in row.kinds:
                width = 0.8 + 4.0 * min(max(row.bits.get(kind.name, 0.0), 0.0) / MOST_BITS, 1.0)
                colour = colours[kind.name] if row.bits else plots.PALE
                ax.plot([0, 1], [i, y], color=colour, linewidth=width, alpha=0.75, zorder=1)
        ax.plot(1, y, "s", color=colours[kind.name], markersize=11, zorder=3)
        text = BLOCK_NAMES.get(kind.name, kind.name).format(rows=kind.rows, blocks=kind.blocks)
        ax.text(1.06, y, text, va="center", fontsize=8.5)
    ax.plot(np.zeros(len(rows)), range(len(rows)), "o", color=plots.INK, markersize=5, zorder=3)
    last = sum(bool(row.bits) for row in rows) - 0.5
    ax.axhline(last, color=plots.PALE, linewidth=0.8, linestyle=":")
    ax.set_xlim(-0.05, 1.75)
    ax.set_xticks([])
    ax.grid(False)
    for side in ("bottom", "left"):
        ax.spines[side].set_visible(False)
    ax.tick_params(left=False)


def _cells(figure: Figure, ax: Axes, rows: Sequence[Row], kinds: Sequence[str]) -> None:
    """Bits per parameter, as a map with numbers."""
    values = np.full((len(rows), len(kinds) + 1), np.nan)
    for i, row in enumerate(rows):
        if row.bits:
            values[i] = [*(row.bits[kind] for kind in kinds), np.nan]
            values[i, -1] = np.nan if row.beyond is None else row.beyond
    shown = np.ma.masked_invalid(np.where(values < LEAST_BITS, np.nan, values))
    ax.imshow(shown, "Blues", vmin=0.0, vmax=MOST_BITS, aspect="auto", interpolation="nearest")
    for i, k in np.argwhere(np.isfinite(values)):
        dark = values[i, k] > 0.6 * MOST_BITS
        text = f"{values[i, k]:.1f}" if values[i, k] >= LEAST_BITS else "0"
        colour = "white" if dark else plots.INK
        ax.text(k, i, text, ha="center", va="center", fontsize=8, color=colour)
    labels = [f"lost\nwithout\n{SHORT_NAMES.get(kind, kind)}" for kind in kinds]
    ax.set_xticks(range(len(kinds) + 1), [*labels, "by all,\nbeyond\nCAD"], fontsize=8)
    ax.axvline(len(kinds) - 0.5, color=plots.PALE, linewidth=0.8)
    ax.grid(False)
    ax.tick_params(left=False)
    ax.set_title("bits per parameter")
