"""A plan as a folder: stops or targets as a table, what they are worth, and a picture of both."""

from __future__ import annotations

import textwrap
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from calib import outputs
from calib.linear.parallel import one_blas_thread
from calib.outputs.kinds import PLANNED
from calib.planning import Plan, inputs_of
from calib.planning.room.hanging import TargetPlan
from calib.planning.room.ways import way_columns
from calib.report import plots
from calib.runs.run import Run
from calib.show.plan import achieved, achieved_by_targets, aim, known_rows
from sensors.documents import write_json
from sensors.stops import write_columns

if TYPE_CHECKING:
    from calib.report.plots import Axes, Figure

MOST_SIGMAS = 20  # parameters that are drawn, those that gain most
TABLE, WAY, DOCUMENT, PICTURE = "stops.csv", "way.csv", "plan.json", "before_after.svg"
TARGETS = "targets.csv"
MEASURED = "#b8b8b8"


@one_blas_thread
def write_plan(plan: Plan | TargetPlan, out: Path | str, run: Run | Path) -> None:
    """Write a plan as a folder: ``stops.csv`` and ``way.csv``, every pose on the way over them, or
    ``targets.csv``; ``plan.json`` as ``--json`` prints it; ``before_after.svg``.

    Args:
        plan: the stops, or targets, and what they are worth.
        out: the folder.
        run: what was planned for.

    Raises:
        InputError: the folder is there, and is something else.
    """
    document = plan.document()
    with outputs.folder(out, PLANNED, inputs_of(run)) as folder:
        if isinstance(plan, Plan):
            write_columns(folder / TABLE, plan.columns())
            names = [name for name, _ in plan.joints]
            write_columns(folder / WAY, way_columns(document["way"], names))
        else:
            write_columns(folder / TARGETS, plan.columns())
        write_json(folder / DOCUMENT, document)
        warning = run.warning if isinstance(run, Run) else ()
        plots.save(before_after(plan), folder / PICTURE, warning)


def before_after(plan: Plan | TargetPlan) -> Figure:
    """What a plan achieves, in the house style: how well each parameter is known without and with
    it, and beside that the arm's joints at the stops, or where targets hang; the title says what it
    achieves."""
    with plots.styled():
        if isinstance(plan, Plan):
            title = f"{len(plan.stops)} stops {aim(plan.document())}. {achieved(plan)[0]}"
            return _drawn(plan, title, _joints)
        return _drawn(plan, " ".join(achieved_by_targets(plan)), _hanging)


def _drawn(plan: Plan | TargetPlan, title: str, beside: Callable[[Axes, Any], None]) -> Figure:
    rows = sorted(known_rows(plan), key=lambda row: row.after / row.now)[:MOST_SIGMAS]
    figure, grid = plots.axes(
        2 * plots.HALF_IN, 1.6 + 0.24 * max(len(rows), 8), columns=2, width_ratios=(1, 1)
    )
    left, right = grid[0]
    at, ratio = np.arange(len(rows)), [row.after / row.now for row in rows]
    what = "stops" if isinstance(plan, Plan) else "targets"
    left.hlines(at, ratio, 1.0, color="#d5d5d5", lw=3, zorder=1)
    left.plot(np.ones(len(rows)), at, "o", color=plots.BEFORE, label="now", zorder=2)
    left.plot(ratio, at, "o", color=plots.AFTER, label=f"with the planned {what}", zorder=3)
    left.set_yticks(at, [row.name for row in rows])
    left.tick_params(axis="y", labelsize=8.5)
    left.set_ylim(len(rows) - 0.5, -0.5)
    left.set_xlim(0.0, 1.05)
    left.set_xlabel("expected sigma, of what it is now")
    left.set_title(f"The {len(rows)} sigmas that fall most")
    left.legend(loc="upper center", bbox_to_anchor=(0.5, -0.12), ncols=2)
    beside(right, plan)
    figure.suptitle("\n".join(textwrap.wrap(title, 110)), x=0.01, ha="left", weight="bold")
    return figure


def _hanging(ax: Axes, plan: TargetPlan) -> None:
    """Where targets hang, from above: those that were measured, and those planned with names and
    heights."""
    edges = plan.room_m[:, :, :2]
    ax.plot(*np.moveaxis(edges, 2, 0).swapaxes(1, 2), color="#d5d5d5", lw=0.7, zorder=1)
    ax.plot(*plan.hung_m[:, :2].T, "o", color=MEASURED, ms=6, zorder=2)
    ax.plot(*plan.spheres_m[:, :2].T, "o", color=plots.AFTER, ms=6, zorder=3)
    for row in plan.targets:
        text = f"{row['target']}, {row['z']:.2f} m"
        ax.annotate(text, (row["x"], row["y"]), (5, 4), textcoords="offset points", fontsize=8)
    ax.set_aspect("equal", adjustable="datalim")
    ax.set_xlabel("x, m")
    ax.set_ylabel("y, m")
    ax.set_title("Spheres from above: grey measured, blue planned, with z")


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
