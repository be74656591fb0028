"""The diagnosis' mean residual over one covariate, with the band of chance."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from calib.view.desk import DiagnosisCurve, Findings
from calib.view.shown import colours
from calib.view.shown.menu import NOTHING, fill

CURVE_PX = 180


class CurveOver:
    """A menu of covariates, and the curve over the one that is chosen.

    Args:
        gui: viser's.
        guarded: makes a callback of what a widget does.
    """

    def __init__(self, gui: Any, guarded: Callable[..., Any]) -> None:
        self._curves: dict[str, tuple[str, DiagnosisCurve]] = {}  # by heading
        self._over = gui.add_dropdown("Curve over", [NOTHING])
        self._over.on_update(guarded(self._draw))
        self._plot = gui.add_uplot(
            *_chart(None),
            scales={"x": {"time": False}},
            bands=({"series": (2, 3), "fill": "rgba(0, 0, 0, 0.08)"},),
            height=CURVE_PX,
        )

    def show(self, findings: Findings | None, effect: str) -> None:
        """Offer the curves of a diagnosis, and draw the one that shows an effect best."""
        curves = findings.curves if findings else {}
        self._over.visible = self._plot.visible = bool(curves)
        self._curves = {colours.column(n).heading: (n, curve) for n, curve in curves.items()}
        if curves:
            best = colours.column(findings.covariate_of(effect)).heading
            fill(self._over, list(self._curves), best)
            self._draw()

    def _draw(self) -> None:
        heading = self._over.value
        name, curve = self._curves[heading]
        self._plot.data, self._plot.series = _chart(curve, heading, colours.column(name).scale)


def _chart(curve: DiagnosisCurve | None, over: str = "", scale: float = 1.0) -> tuple[Any, Any]:
    """Data and series of a curve with its band; of none, two points."""
    if curve is None:
        curve = DiagnosisCurve(*(np.zeros(2),) * 3)
    data = (curve.centres * scale, curve.mean_mm, curve.band_mm, -curve.band_mm)
    edge = {"stroke": "#888888", "width": 1, "dash": (4, 4), "points": {"show": False}}
    series = (
        {"label": over},
        {"label": "mean residual, mm", "stroke": "#0072b2", "width": 2},
        {"label": "chance", **edge},
        {"label": "to", **edge},
    )
    return data, series
