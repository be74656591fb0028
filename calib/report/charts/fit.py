"""How good the fit is: the ladder, what the error is made of, and whether sigmas are honest."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from calib.diagnosis.verdict.matters import HELD_OUT_BY_CHANCE
from calib.report import plots
from calib.report.chart import Absent, Chart
from calib.report.evidence import Evidence, folder_name
from calib.report.statistics import Z_EDGES
from calib.results.errors import over_expected
from calib.runs.ladder import FORMULA, Rung

if TYPE_CHECKING:
    from calib.report.plots import Figure

STEEP = 8.0  # largest over smallest error from which a scale is logarithmic
NO_ERROR = 1e-9  # of the largest: what rounding leaves of no error, which is on no such scale


def error_mm(rung: Rung) -> tuple[str, float]:
    """The error that counts: of stops held out, or of the fit where none were."""
    rms = rung.run.summary["rms_mm"]
    held_out = rms.get("held_out")
    return ("fit", rms["fit"]) if held_out is None else ("held-out", held_out)


def ladder(evidence: Evidence) -> Iterator[Chart | Absent]:
    """Errors rung by rung, and what is expected."""
    kind, last = error_mm(evidence.rungs[-1])
    floor = evidence.run.summary["rms_mm"]["noise_floor"]
    first = error_mm(evidence.rungs[0])[1]
    way = f" from {first:.2f}" if len(evidence.rungs) > 1 else ""
    over = over_expected(evidence.run.summary)
    near = "still above" if over > HELD_OUT_BY_CHANCE else "down to" if over > 1.0 else "below"
    yield Chart(
        "ladder",
        f"The {kind} error went{way} to {last:.2f} mm, {near} the {floor:.2f} mm expected"
        if way
        else f"The {kind} error is {last:.2f} mm, {near} the {floor:.2f} mm expected",
        "A row per run, each named by what it added to the one above. Blue: rms error of stops "
        "that its fit never saw; hollow: of those it saw; green: what would be left if the model "
        "were right. An error at the green mark is as small as the noise allows."
        + (f" A diamond: {FORMULA}." if any(rung.empirical for rung in evidence.rungs) else ""),
        lambda: _ladder(evidence),
        wide=True,
        answer=True,
    )


def _ladder(evidence: Evidence) -> Figure:
    rungs = evidence.rungs
    names = [f"{folder_name(r.run.folder)}\n{r.step}" for r in rungs]
    rms = [r.run.summary["rms_mm"] for r in rungs]
    figure, grid = plots.axes(plots.WIDE_IN, 1.3 + 0.55 * (len(rungs) + 1))
    ax, y = grid[0, 0], np.arange(1, len(rungs) + 1)
    ax.plot(rms[0]["nominal"], 0, "s", color=plots.BEFORE, label="nothing fitted")
    ax.plot([r["fit"] for r in rms], y, "o", mfc="white", color=plots.PALE, label="stops seen")
    floors = [r["noise_floor"] for r in rms]
    ax.plot(floors, y, "|", ms=15, mew=3, color=plots.FLOOR, label="expected")
    shown = [error_mm(r)[1] for r in rungs]
    label = "stops held out" if rms[-1].get("held_out") is not None else "fit; none held out"
    ax.plot(shown, y, "o-", ms=8, color=plots.AFTER, label=label)
    described = [i for i, rung in enumerate(rungs) if rung.empirical]
    if described:
        at = np.array(shown)[described], y[described]
        ax.plot(*at, "D", ms=9, mfc="white", mew=2, color=plots.AFTER, label="with a formula")
    for value, at in zip([rms[0]["nominal"], *shown], range(len(rungs) + 1), strict=True):
        plots.number_above(ax, f"{value:.2f}", value, at)
    ax.set_yticks(range(len(rungs) + 1), ["as in CAD", *names])
    ax.set_ylim(len(rungs) + 0.5, -0.6)
    values = [rms[0]["nominal"], *shown, *floors, *(r["fit"] for r in rms)]
    if max(values) > STEEP * min(values) and min(values) > NO_ERROR * max(values):
        plots.log_axis(ax, min(values), max(values))
    ax.set_xlabel(f"rms of the {evidence.run.summary['residual']} residual, mm")
    ax.margins(x=0.08)
    figure.legend(loc="outside upper left", ncols=5)
    return figure


def variance(evidence: Evidence) -> Iterator[Chart | Absent]:
    """What the error of stops held out is made of."""
    if not evidence.has_beams:
        yield Absent("variance", "there are no scans, so no noise of ranges to take apart")
        return
    parts = variance_mm(evidence)
    left = parts["unexplained"]
    largest = max(parts, key=parts.get)
    floor = evidence.run.summary["rms_mm"]["noise_floor"]
    yield Chart(
        "variance",
        f"{left:.2f} mm of the error is unexplained, more than all noise together ({floor:.2f} mm)"
        if left > floor
        else f"The largest part of what is expected is the {largest}: {parts[largest]:.2f} mm, "
        f"{100 * parts[largest] ** 2 / floor**2:.0f} % of the variance",
        "Independent parts, which add in squares. Range noise, angle noise and reference are the "
        "rows' own sigmas; pose is the uncertainty of the LiDAR's place at a held-out stop; "
        "chance is scatter from stop to stop. Together they are the expected error; the rest of "
        "the error is unexplained.",
        lambda: _bars(parts, "contribution to the rms error, mm"),
    )


def variance_mm(evidence: Evidence) -> dict[str, float]:
    """Parts of the error in mm, which add up in squares: to what is expected, then to all of it."""
    rms = evidence.run.summary["rms_mm"]
    error, floor = error_mm(evidence.rungs[-1])[1], rms["noise_floor"]
    parts = {n: 1e3 * np.sqrt(v) for n, v in evidence.after.variance_m2.items()}
    if rms.get("held_out") is not None:
        solution = evidence.run.solution
        for part in (solution.shared, *solution.recordings.values()):
            by_chance = {n: e for n, e in part.effects.items() if e.names == ("sd",)}
            parts |= {f"chance, as {n} has it": 1e3 * e.estimate[0] for n, e in by_chance.items()}
        of_rows = sum(v * v for v in parts.values())
        parts["pose of an unseen stop"] = np.sqrt(max(floor**2 - of_rows, 0.0))
    parts["unexplained"] = np.sqrt(max(error**2 - floor**2, 0.0))
    return {name: float(v) for name, v in parts.items()}


def _bars(parts: dict[str, float], label: str) -> Figure:
    figure, grid = plots.axes(plots.HALF_IN, 0.9 + 0.32 * len(parts))
    ax = grid[0, 0]
    colours = [plots.BEFORE if name == "unexplained" else plots.AFTER for name in parts]
    bars = ax.barh(list(parts), list(parts.values()), color=colours, height=0.6)
    ax.bar_label(bars, fmt="%.2f", padding=3)
    ax.invert_yaxis()
    ax.margins(x=0.12)
    ax.grid(False, axis="y")
    ax.set_xlabel(label)
    return figure


def scatter(evidence: Evidence) -> Iterator[Chart | Absent]:
    """Residuals over their sigmas."""
    if not evidence.has_beams:
        yield Absent("scatter", "there are no scans, so no residuals of beams")
        return
    width = _width(evidence.after.z)
    says = "as wide as" if abs(width - 1) < 0.15 else "narrower than" if width < 1 else "wider than"
    lost = 100 * (1 - evidence.after.kept / max(evidence.after.rows, 1))
    yield Chart(
        "scatter",
        f"Residuals are {says} their sigmas ({width:.2f} of them); {lost:.1f} % were thrown out",
        "Share of beams by residual over sigma, on a logarithmic scale, and the normal "
        "distribution that correct sigmas would give. The sigmas include the errors of the "
        "reference, which the fit estimates surface by surface, so a good fit is a little "
        "narrower; long tails are mixed pixels and moved objects.",
        lambda: _scatter(evidence),
    )


def _width(z: np.ndarray) -> float:
    """Half the distance between the quantiles that lie one sigma off, of counts by `Z_EDGES`."""
    below = np.concatenate([[0.0], np.cumsum(z)]) / max(z.sum(), 1)
    return float(np.diff(np.interp([0.15866, 0.84134], below, Z_EDGES))[0] / 2)


def _scatter(evidence: Evidence) -> Figure:
    figure, grid = plots.axes(plots.HALF_IN, 2.6)
    ax, middle = grid[0, 0], (Z_EDGES[1:] + Z_EDGES[:-1]) / 2
    step = Z_EDGES[1] - Z_EDGES[0]
    bell = np.exp(-0.5 * middle**2) / np.sqrt(2 * np.pi)
    ax.plot(middle, bell, color=plots.INK, linestyle="--", label="honest sigmas")
    pairs = (
        (evidence.before, evidence.earlier, plots.BEFORE),
        ("now", evidence.after, plots.AFTER),
    )
    for label, statistics, colour in pairs:
        share = statistics.z / max(statistics.z.sum(), 1) / step
        ax.step(middle, np.where(share > 0, share, np.nan), where="mid", color=colour, label=label)
    ax.set_yscale("log")
    ax.set_yticks([1e-4, 1e-3, 1e-2, 1e-1, 1.0], ["0.0001", "0.001", "0.01", "0.1", "1"])
    ax.set_yticks([], minor=True)
    ax.set_ylim(bottom=1e-4)
    ax.set_xlabel("residual over its sigma")
    ax.set_ylabel("share of beams per sigma")
    figure.legend(loc="outside upper left", ncols=3)
    return figure
