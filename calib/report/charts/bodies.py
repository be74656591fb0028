"""What trackers and targets say against where the chain puts them, as arrows."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from calib.evaluation.at_poses import Predicted, over_workspace, says_where_the_base_is
from calib.report import plots
from calib.report.chart import Absent, Chart
from calib.report.evidence import Evidence
from calib.residuals.targets import HangingTarget
from calib.residuals.tracker import TrackedBody
from calib.results.outstanding import STANDS_OUT
from calib.show.scale import round_up

if TYPE_CHECKING:
    from calib.report.plots import Figure

MOST_ARROWS = 1500  # arrows of a body that can be told apart
WITHIN_COLOURS = 0.98  # of the poses lie within the scale of colours; the rest have its end
LENGTH = 0.06  # of the picture, for the longest arrow; rounding makes it up to 2.5 times that


@dataclass(frozen=True)
class Arrows:
    """Measured positions (n, 3) m, and measured less predicted there (n, 3) m."""

    at_m: np.ndarray
    off_m: np.ndarray

    @property
    def rms_mm(self) -> float:
        """Of the arrows' lengths."""
        return float(1e3 * np.sqrt(np.mean(np.sum(np.square(self.off_m), axis=1))))


def tracked(evidence: Evidence) -> Iterator[Chart | Absent]:
    """Where the tracker saw each body, and how far from where the chain puts it."""
    blocks = evidence.problem.bodies
    if not blocks:
        yield Absent("tracker", "nothing tracks this rig")
        return
    bodies = {name: _seen([b for b in blocks if b.body == name], evidence.values)
              for name in dict.fromkeys(b.body for b in blocks)}  # fmt: skip
    sigma_mm = 1e3 * np.sqrt(3) * max(b.sigma_m for b in blocks)
    worst = max(bodies, key=lambda name: bodies[name].rms_mm)
    yield _chart(
        "tracker",
        f"Tracked bodies lie {bodies[worst].rms_mm:.2f} mm rms or less from where the chain puts "
        f"them ({worst}); the tracker's noise alone is {sigma_mm:.2f} mm",
        evidence.sources[0].rig.world,
        bodies,
        sigma_mm,
    )


def workspace(evidence: Evidence) -> Iterator[Chart | Absent]:
    """How far off an arm is, and how well that is known, wherever its joints can take it."""
    if evidence.has_beams or not says_where_the_base_is(evidence.problem):
        yield Absent("workspace", "no arm is seen by a tracker alone")
        return
    measured, drawn = over_workspace(evidence.run, evidence.estimate, evidence.progress)
    told = [1e3 * np.median(each.sigma_m) for each in (measured, drawn)]
    yield Chart(
        "workspace",
        f"As drawn, the arm brings '{drawn.body}' up to {1e3 * drawn.error_m.max():.2g} mm off; "
        f"corrected, its place is known to {told[0]:.2g} mm at the measured poses, and to "
        f"{told[1]:.2g} mm (median) wherever the joints can take it",
        "A dot per pose, drawn over all that the joints can turn, from the side (how far out from "
        "the axis of the arm's foot, and how high) and from above; in colour what is said of it. "
        "The dashed line holds the poses that were measured: nothing has checked the model "
        "beyond it.",
        lambda: _workspace(measured, drawn),
        wide=True,
    )


def _workspace(measured: Predicted, drawn: Predicted) -> Figure:
    figure, grid = plots.axes(plots.WIDE_IN, 3.4, 1, 3)
    off, known = (drawn.error_m, "off as drawn, mm"), (drawn.sigma_m, "known to, mm (sigma)")
    sides = ("out from the axis of the foot, m", "height above the foot, m")
    above = ("x of the foot, m", "y of the foot, m")
    panels = ((_section, sides, off), (_section, sides, known), (_above, above, known))
    for ax, (view, (across, up), (metres, what)) in zip(grid[0], panels, strict=True):
        top = np.quantile(1e3 * metres, WITHIN_COLOURS)
        dots = ax.scatter(*view(drawn), 9, c=1e3 * metres, cmap="viridis", vmin=0.0, vmax=top, lw=0)
        ax.plot(*_outline(view(measured)), "--", color=plots.BEFORE, lw=1.5)
        ax.set_aspect("equal", adjustable="box")
        ax.set_xlabel(across)
        ax.set_ylabel(up)
        bar = figure.colorbar(dots, ax=ax, extend="max", orientation="horizontal", location="top")
        bar.set_label(what)
    return figure


def _above(found: Predicted) -> np.ndarray:
    """(2, K) as seen from above, m."""
    return found.place_m[:, :2].T


def _section(found: Predicted) -> np.ndarray:
    """(2, K) distance from the axis of the arm's foot, and height above it, m."""
    at = found.place_m
    return np.stack([np.hypot(at[:, 0], at[:, 1]), at[:, 2]])


def _outline(at: np.ndarray) -> np.ndarray:
    """(2, n) the convex outline, closed, of points (2, K); themselves where they lie on a line."""
    try:
        corners = ConvexHull(at.T).vertices
    except QhullError:
        return at
    return at[:, np.append(corners, corners[0])]


def targets(evidence: Evidence) -> Iterator[Chart | Absent]:
    """Where the scanner saw each target's sphere, and how far from where the tracker puts it."""
    blocks = [b for b in evidence.problem.blocks if isinstance(b, HangingTarget)]
    if not blocks:
        yield Absent("targets", "the recording has no targets")
        return
    off = []
    for block in blocks:
        whitened, _ = block.evaluate(evidence.values, derivatives=False)
        off.append(block.sigma_sphere_m * whitened[6:9])
    arrows = Arrows(np.array([b.faro_m for b in blocks]), np.array(off))
    sigma_mm = 1e3 * np.sqrt(3) * blocks[0].sigma_sphere_m
    yield _chart(
        "targets",
        f"Spheres lie {arrows.rms_mm:.2f} mm rms from where the tracker's markers put them; their "
        f"noise is {sigma_mm:.2f} mm",
        evidence.sources[0].rig.reference_frame,
        {"sphere": arrows},
        sigma_mm,
    )


def _seen(blocks: Sequence[TrackedBody], values: Mapping[str, np.ndarray]) -> Arrows:
    at, off = [], []
    for block in blocks:
        predicted = block.seen(values).T
        at.append(block.measured[:, :3, 3])
        off.append(block.measured[:, :3, 3] - predicted[:, :3, 3])
    return Arrows(np.concatenate(at), np.concatenate(off))


def _chart(
    name: str, title: str, frame: str, bodies: Mapping[str, Arrows], sigma_mm: float
) -> Chart:
    scale = magnification(list(bodies.values()))
    return Chart(
        name,
        title,
        f"Each arrow starts where something was measured and points from where the chain puts it "
        f"to there, {scale:g} times as long as it is; seen from above, and from the side, in the "
        f"axes of '{frame}'. Arrows at random are noise; neighbours that agree are an error.",
        lambda: _draw(bodies, scale, frame),
        wide=True,
        quiet=all(arrows.rms_mm < STANDS_OUT * sigma_mm for arrows in bodies.values()),
    )


def magnification(groups: Sequence[Arrows]) -> float:
    """By how much arrows are drawn longer: the longest takes a fair part of the picture."""
    at = np.concatenate([g.at_m for g in groups])
    longest = max(float(np.linalg.norm(g.off_m, axis=1).max()) for g in groups)
    extent = max(float(np.ptp(at, axis=0).max()), 1e-3)
    return round_up(LENGTH * extent / max(longest, 1e-9))


def _draw(bodies: Mapping[str, Arrows], scale: float, frame: str) -> Figure:
    figure, grid = plots.axes(plots.WIDE_IN, 3.2, 1, 2)
    for ax, (i, k), what in zip(grid[0], ((0, 1), (0, 2)), ("above", "the side"), strict=True):
        for (name, arrows), colour in zip(bodies.items(), _colours(len(bodies)), strict=True):
            some = slice(None, None, len(arrows.at_m) // MOST_ARROWS + 1)
            at, off = arrows.at_m[some], arrows.off_m[some]
            ax.plot(at[:, i], at[:, k], ".", ms=3, color=colour, label=name)
            ax.quiver(at[:, i], at[:, k], off[:, i], off[:, k], color=colour, angles="xy",
                      scale_units="xy", scale=1 / scale, width=0.004)  # fmt: skip
        ax.set_title(f"from {what}")
        ax.set_aspect("equal", adjustable="datalim")
        ax.margins(0.12)
        ax.set_xlabel(f"{'xyz'[i]} of {frame}, m")
        ax.set_ylabel(f"{'xyz'[k]}, m")
    handles, labels = grid[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper left", ncols=4)
    return figure


def _colours(count: int) -> list[str]:
    return [plots.LINES[i % len(plots.LINES)] for i in range(count)]
