"""Residual structure: residuals over what they depend on, the formula found, and what it leaves."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from calib.report import plots
from calib.report.chart import Absent, Chart
from calib.report.charts.residuals import axis_label, shown_unit, spoken
from calib.report.evidence import Evidence
from calib.show.scale import round_up
from chains.errors import InputError

if TYPE_CHECKING:
    from calib.report.plots import Figure

UPRIGHT_COLUMNS = ("ring", "elevation_rad")  # what goes up where there are two
BINS_IN_SCALE = 0.98  # of the bins: what the scale shows
READING = (
    "Means in bins, on one scale: what the model leaves without the formula, the formula, and what "
    "is left with it."
)
WRONG = "diagnosis.json has a picture of another version; diagnose the run again"


@dataclass(frozen=True)
class FormulaPicture:
    """Mean residuals over one or two columns.

    Args:
        covariates: their names.
        edges: of the bins of each, in the column's unit.
        unit: of the three: mm, or mrad of a joint.
        measured, formula, left: (B,) or (B, C) of the bins; NaN where no beams are.
        title: the finding, in a sentence.
        says: the formula.
        averaged: further columns of the formula, which the picture averages over.
    """

    covariates: tuple[str, ...]
    edges: tuple[np.ndarray, ...]
    unit: str
    measured: np.ndarray
    formula: np.ndarray
    left: np.ndarray
    title: str
    says: str
    averaged: tuple[str, ...]

    @classmethod
    def read(cls, each: Mapping[str, Any]) -> FormulaPicture:
        """Of a formula as diagnosis.json has it.

        Raises:
            InputError: that is none of this version.
        """
        try:
            document = each["picture"]
            unit = str(document["unit"])
            names = tuple(map(str, document["covariates"]))
            edges = tuple(np.array(e, float) for e in document["edges"])
            keys = ("measured", "formula", "left")
            values = {key: np.array(document[key], float) for key in keys}
            over = tuple(map(str, each["covariates"]))
            held_out = [each["held_out_rms_mm"][key] for key in ("before", "after")]
            what = "Ranges depend" if unit == "mm" else "A joint's angle depends"
            title = _title(f"{what} on {' and '.join(map(spoken, over))}", held_out)
            says = str(each["says"])
        except (KeyError, TypeError, ValueError, AttributeError):
            raise InputError(WRONG) from None
        shape = tuple(len(e) - 1 for e in edges)
        known = all(e.ndim == 1 and len(e) > 1 and (np.diff(e) > 0).all() for e in edges)
        if not known or len(names) not in (1, 2) or any(v.shape != shape for v in values.values()):
            raise InputError(WRONG)
        rest = tuple(name for name in over if name not in names)
        return cls(
            covariates=names,
            edges=edges,
            unit=unit,
            **values,
            title=title,
            says=says,
            averaged=rest,
        )

    @property
    def limit(self) -> float:
        """The end of the scale, the same for all three."""
        sizes = np.abs(np.concatenate([v.ravel() for v in (self.measured, self.formula)]))
        known = sizes[np.isfinite(sizes)]
        return round_up(float(np.quantile(known, BINS_IN_SCALE))) if len(known) else 1.0

    @property
    def label(self) -> str:
        """Of its scale."""
        return f"mean residual, {self.unit}"

    def figure(self, narrow: bool = False) -> Figure:
        """The three of them, side by side, or one below the other where it is to be narrow."""
        return _curve(self) if len(self.covariates) == 1 else _maps(self, narrow)

    @property
    def reading(self) -> str:
        """How to read it."""
        over = f" Averaged over {' and '.join(map(spoken, self.averaged))}."
        return f"{self.says}. {READING}{over if self.averaged else ''}"


def pictures(diagnosis: Mapping[str, Any] | None) -> list[FormulaPicture]:
    """Of all formulas of a diagnosis.

    Raises:
        InputError: one is of another version.
    """
    found = (diagnosis or {}).get("unexplained", ())
    return [FormulaPicture.read(each) for each in found if "picture" in each]


def formulas(evidence: Evidence) -> Iterator[Chart | Absent]:
    """A chart for each formula of residual structure."""
    if evidence.diagnosis is None:
        yield Absent("formula", f"not diagnosed; 'rigcal diagnose {evidence.run.folder}' does it")
        return
    found = charts_of(evidence.diagnosis)
    yield from found or [Absent("formula", "the diagnosis found no formula beyond this model")]


def charts_of(diagnosis: Mapping[str, Any] | None, narrow: bool = False) -> list[Chart]:
    """The charts of a diagnosis; narrow ones for a panel.

    Raises:
        InputError: one is of another version.
    """
    found = pictures(diagnosis)
    return [
        Chart(
            "formula" if len(found) == 1 else f"formula-{i}",
            each.title,
            each.reading,
            partial(each.figure, narrow),
            wide=len(each.covariates) > 1,
            answer=True,
        )
        for i, each in enumerate(found, 1)
    ]


def _title(what: str, held_out: list[float | None]) -> str:
    if None in held_out:
        return f"{what}, and a formula describes it"
    before, after = map(float, held_out)
    fall = f"the held-out error goes from {before:.2f} to {after:.2f} mm"
    return f"{what}; with a formula for it {fall}"


def _parts(picture: FormulaPicture) -> dict[str, np.ndarray]:
    parts = {
        "measured": picture.measured,
        "formula": picture.formula,
        "left": picture.left,
    }
    rms = {k: np.sqrt(np.nanmean(np.square(v))) if np.isfinite(v).any() else 0.0
           for k, v in parts.items()}  # fmt: skip
    return {f"{name}, {rms[name]:.2f} {picture.unit} rms": values for name, values in parts.items()}


def _maps(picture: FormulaPicture, narrow: bool) -> Figure:
    """Three maps on one scale."""
    across, up = (1, 0) if picture.covariates[0] in UPRIGHT_COLUMNS else (0, 1)
    names = picture.covariates
    x, y = (shown_unit(names[i])[1] * picture.edges[i] for i in (across, up))
    size = (plots.NARROW, 5.4, 3, 1) if narrow else (plots.WIDE_IN, 3.0, 1, 3)
    figure, grid = plots.axes(*size, sharex=True, sharey=True)
    for ax, (title, values) in zip(grid.flat, _parts(picture).items(), strict=True):
        rows = values.T if up == 1 else values
        drawn = plots.signed_cells(ax, x, y, rows, picture.limit)
        ax.set_title(title)
    for ax in grid[-1]:
        ax.set_xlabel(axis_label(names[across]))
    for ax in grid[:, 0]:
        ax.set_ylabel(axis_label(names[up]))
    where = {"orientation": "horizontal", "aspect": 35} if narrow else {"aspect": 25}
    figure.colorbar(drawn, ax=list(grid.flat), extend="both", label=picture.label, **where)
    return figure


def _curve(picture: FormulaPicture) -> Figure:
    """Points and the formula above, what is left below, on one scale."""
    (name,), (edges,) = picture.covariates, picture.edges
    edges = shown_unit(name)[1] * edges
    x = (edges[1:] + edges[:-1]) / 2
    figure, grid = plots.axes(plots.HALF_IN, 3.6, 2, sharex=True, sharey=True)
    top, bottom = grid[:, 0]
    top.plot(x, picture.measured, "o", ms=3.5, color=plots.BEFORE, label="measured")
    top.stairs(picture.formula, edges, baseline=None, lw=1.5, color=plots.INK, label="formula")
    bottom.plot(x, picture.left, "o", ms=3.5, color=plots.AFTER, label="left")
    for ax in (top, bottom):
        ax.axhline(0, color=plots.PALE, linewidth=1, zorder=1)
        ax.set_ylabel(picture.label)
    bottom.set_xlabel(axis_label(name))
    figure.legend(loc="outside upper left", ncols=3)
    return figure
