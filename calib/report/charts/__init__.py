"""Every figure of a report. A new one is a function and its line in `SECTIONS`."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping

from calib.report.chart import Absent, Chart
from calib.report.charts import (
    bodies,
    fit,
    formulas,
    graph,
    groups,
    knowledge,
    links,
    misfit,
    residuals,
    unseen,
    walls,
)
from calib.report.evidence import Evidence

Charts = Callable[[Evidence], Iterator[Chart | Absent]]

SECTIONS: Mapping[str, tuple[Charts, ...]] = {
    "How good it is": (fit.ladder, fit.variance, fit.scatter),
    "What does not fit": (
        *(groups.groups, misfit.by_stop, misfit.by_thing, misfit.moves_from_cad),
    ),
    "What was found": (formulas.formulas, knowledge.findings),
    "The calibration": (
        *(links.chain, links.moves, links.effects, bodies.workspace, knowledge.budget),
    ),
    "What is left": (
        *(unseen.unseen, unseen.every_stop),
        *(residuals.ring_map, walls.walls, residuals.thrown_away, residuals.curves),
        *(bodies.tracked, bodies.targets),
    ),
    "What could not be determined": (knowledge.correlation,),
}
ON_REQUEST: tuple[Charts, ...] = (graph.graph,)  # figures that no report has: ask for them by name
