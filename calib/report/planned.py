"""A plan as a folder: the stops as a table, all that they are worth, and a picture of both."""

from __future__ import annotations

import textwrap
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from calib import outputs
from calib.linear.parallel import one_blas_thread
from calib.outputs.kinds import PLANNED
from calib.planning import Plan, inputs_of
from calib.report import plots
from calib.runs.run import Run
from calib.show.plan import achieved, aim, known_rows
from sensors.documents import write_json
from sensors.stops import write_columns

if TYPE_CHECKING:
    from calib.report.plots import Axes, Figure

MOST_SIGMAS = 20  # parameters that are drawn, those that gain most
TABLE, WAY, DOCUMENT, PICTURE = "stops.csv", "way.csv", "plan.json", "before_after.svg"
MEASURED = "#b8b8b8"


@one_blas_thread
def write_plan(plan: Plan, out: Path | str, run: Run | Path) -> None:
    """Write a plan as a folder: ``stops.csv``; ``way.csv``, every pose on the way over them;
    ``plan.json`` as ``--json`` prints it; ``before_after.svg``.

    Args:
        plan: the stops, and what they are worth.
        out: the folder.
        run: what was planned for.

    Raises:
        InputError: the folder is there, and is something else.
    """
    with outputs.folder(out, PLANNED, inputs_of(run)) as folder:
        write_columns(folder / TABLE, plan.columns())
        way = plan.document()["way"]
        write_columns(folder / WAY, {key: [row[key] for row in way] for key in way[0]})
        write_json(folder / DOCUMENT, plan.document())
        warning = run.warning if isinstance(run, Run) else ()
        plots.save(before_after(plan), folder / PICTURE, warning)


def before_after(plan: Plan) -> Figure:
    """What a plan achieves, in the house style; see `_drawn`."""
    with plots.styled():
        return _drawn(plan)


def _drawn(plan: Plan) -> Figure:
    """How well each parameter is known without and with the stops, and the arm's joints at them
    beside those at which it was measured; the title says what they achieve."""
    rows = sorted(known_rows(plan), key=lambda row: row.after / row.now)[:MOST_SIGMAS]
    figure, grid = plots.axes(
        2 * plots.HALF_IN, 1.6 + 0.24 * max(len(rows), 8), columns=2, width_ratios=(1, 1)
    )
    left, right = grid[0]
    at, ratio = np.arange(len(rows)), [row.after / row.now for row in rows]
    left.hlines(at, ratio, 1.0, color="#d5d5d5", lw=3, zorder=1)
    left.plot(np.ones(len(rows)), at, "o", color=plots.BEFORE, label="now", zorder=2)
    left.plot(ratio, at, "o", color=plots.AFTER, label="with the planned stops", zorder=3)
    left.set_yticks(at, [row.name for row in rows])
    left.tick_params(axis="y", labelsize=8.5)
    left.set_ylim(len(rows) - 0.5, -0.5)
    left.set_xlim(0.0, 1.05)
    left.set_xlabel("expected sigma, of what it is now")
    left.set_title(f"The {len(rows)} sigmas that fall most")
    left.legend(loc="upper center", bbox_to_anchor=(0.5, -0.12), ncols=2)
    _joints(right, plan)
    title = f"{len(plan.stops)} stops {aim(plan.document())}. {achieved(plan)[0]}"
    figure.suptitle("\n".join(textwrap.wrap(title, 110)), x=0.01, ha="left", weight="bold")
    return figure


def _joints(ax: Axes, plan: Plan) -> None:
    """Joints of the stops: measured, and planned with their numbers."""
    names = [name for name, _ in plan.joints]
    scale = np.array([np.degrees(1.0) if kind == "revolute" else 1e3 for _, kind in plan.joints])
    shown, planned = plan.measured.joints * scale, plan.poses.joints * scale
    each = np.arange(len(names))
    for joints, beside, look in (
        (shown, -0.15, {"color": MEASURED, "ms": 4}),
        (planned, 0.05, {"color": plots.AFTER, "ms": 5}),
    ):
        ax.plot(np.tile(each + beside, (len(joints), 1)), joints, "o", **look)
    for number, row in enumerate(planned, start=1):
        for k, value in enumerate(row.tolist()):
            ax.annotate(str(number), (k + 0.13, value), fontsize=7, va="center")
    ax.set_xticks(each, names, rotation=30, ha="right")
    ax.set_ylabel("joint, degrees" + ("" if (scale < 1e3).all() else " or mm"))
    ax.set_title("Joints at stops: grey measured, blue planned")
