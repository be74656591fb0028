"""What Python asks of a run: its tables, figures, diagnosis and factor graph, as methods of `Run`.

Importing this gives them to runs, which know nothing of how they are shown; `calib` imports it with
the first name that has to do with runs.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

from calib.runs.run import Run
from calib.show import notebook  # noqa: F401 - so that they are shown as well

if TYPE_CHECKING:
    import pandas

    from calib.diagnosis import Diagnosis
    from calib.report.plots import Figure
    from calib.solve.graph import FactorGraph


def table(run: Run) -> pandas.DataFrame:
    """Every parameter with its estimate, sigma and unit, and how far it is from CAD.

    Columns as of `calib.runs.asked.tables.parameters`; SI.

    Raises:
        InputError: the run is incomplete, or pandas is not installed.
    """
    from calib.runs.asked.tables import parameters
    from sensors.numbers import data_frame

    return data_frame(parameters(run))


def residuals(run: Run, kind: str = "beams") -> pandas.DataFrame:
    """What is left of every row, measured minus predicted; units in the names of columns.

    Args:
        run: the run.
        kind: "beams", "tracker", "level", "target" or "prior".

    Raises:
        InputError: the run has none of that kind, or pandas is not installed.
    """
    from calib.runs.asked.tables import residuals as found
    from sensors.numbers import data_frame

    return data_frame(found(run, kind))


def plot(run: Run, name: str) -> Figure:
    """A figure of the run's report, as a `matplotlib.figure.Figure`.

    Args:
        run: the run.
        name: what ``rigcal plot RUN --list`` lists, "ladder" say.

    Raises:
        InputError: there is no such figure, or not of this run, or a recording has changed.
    """
    from calib.report import Evidence, figure, plots

    found = figure(Evidence.of([run]), name)
    found._repr_png_ = partial(plots.png, found)  # what a notebook shows of it
    return found


def diagnose(run: Run) -> Diagnosis:
    """Where the model fails and which effect it lacks; written to the run, as `calib.diagnose`."""
    from calib.runs.diagnose import diagnose as find

    return find(run)


def graph(run: Run) -> FactorGraph:
    """The `gtsam.NonlinearFactorGraph`, the `gtsam.Values` at its optimum, and the key of each
    unknown: ``graph, values, keys = run.graph()``. See `calib.solve.graph.FactorGraph`.

    Raises:
        InputError: a recording is not where or what it was.
    """
    from calib.runs.asked.factors import graph_of

    return graph_of(run)


for _method in (table, residuals, plot, diagnose, graph):
    setattr(Run, _method.__name__, _method)
