"""What is left of the residuals along every covariate, and over ring and azimuth."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from calib.diagnosis.suggest import words
from calib.report import plots
from calib.report.chart import Absent, Chart
from calib.report.evidence import FIRST, Evidence
from calib.report.statistics import ResidualCurve, Statistics
from calib.show.scale import round_up
from chains import escape

if TYPE_CHECKING:
    from calib.report.plots import Axes, Figure

NO_BEAMS = "there are no scans, so no residuals of beams"
# Shown if residuals depend on it; temperature too.
FRONT = {*FIRST, "stop", "elapsed_s", "recording"}
ALWAYS = ("incidence_rad", "range_m")  # shown whatever is left
AXIS_UNITS = {
    "_rad": ("deg", 180.0 / np.pi),
    "_m": ("m", 1.0),
    "_s": ("min", 1 / 60),
    "_c": ("°C", 1.0),
}
BINS_OUT_BY_CHANCE = 0.02  # how seldom so many bins may lie outside their bands by chance
SELDOM = 0.01  # of the rows: things seen less decide no scale
FEWEST_THROWN = 0.05  # share at the end of the map's scale, at least
BEAMS_IN_HISTOGRAM = 0.9  # of the beams rejected: what the histogram shows
BEFORE_BEYOND = 5.0  # by how much what was before may lie beyond the scale of what is left
MOST_AXIS_NAMES = 40  # names of things along an axis
UPRIGHT_NAMES = 6  # of these; more are turned
LEAST_SAID_M = 5e-6  # what two digits of mm show
MARGINS = (0.72, 0.1, 0.5, 0.32)  # inches, for labels of four digits and a sign


def curves(evidence: Evidence) -> Iterator[Chart | Absent]:
    """A chart for each covariate of points and stops."""
    if not evidence.has_beams:
        yield Absent("residual-…", NO_BEAMS)
        return
    for name, now in evidence.after.curves.items():
        was, unseen = evidence.earlier.curves.get(name), _unseen(evidence, name)
        front = name in FRONT or "temperature" in name
        yield Chart(
            curve_id(name),
            _title(name, now, was, unseen, evidence.before),
            "Mean residual (measured less predicted) before, now and of stops held out; now "
            "alone; and the scatter of single residuals. Bands are 95 % intervals of the mean, "
            "clustered by stop and surface; where one contains zero, no significant residual is "
            "left.",
            partial(_curve, evidence, name),
            quiet=name not in ALWAYS and not (front and outside(now)[2]),
        )
    for name in FIRST:
        if name not in evidence.after.curves:
            yield Absent(curve_id(name), f"the recording has no {words(name)}, or only one value")


def curve_id(covariate: str) -> str:
    """The name of a covariate's chart."""
    return f"residual-{escape.identifier(re.sub('[._]', '-', _bare(covariate)))}"


def _bare(covariate: str) -> str:
    for suffix in AXIS_UNITS:
        if covariate.endswith(suffix):
            return covariate.removesuffix(suffix)
    return covariate


def shown_unit(covariate: str) -> tuple[str, float]:
    """Unit and factor in which a covariate is shown."""
    return next((u for suffix, u in AXIS_UNITS.items() if covariate.endswith(suffix)), ("", 1.0))


def spoken(covariate: str) -> str:
    """A covariate as a title names it."""
    known = words(covariate)
    return known if known != covariate else _bare(covariate).replace("_", " ")


def axis_label(covariate: str) -> str:
    """A covariate along an axis, with the unit in which it is shown."""
    unit = shown_unit(covariate)[0]
    return f"{spoken(covariate)}, {unit}" if unit else spoken(covariate)


def outside(curve: ResidualCurve) -> tuple[int, int, bool]:
    """How many bins lie outside their band about zero, of how many; whether chance does not."""
    from scipy.special import bdtrc

    known = np.isfinite(curve.band_m)
    out = int((np.abs(curve.mean_m[known]) > curve.band_m[known]).sum())
    return out, int(known.sum()), bool(bdtrc(out - 1, known.sum(), 0.05) < BINS_OUT_BY_CHANCE)


def _unseen(evidence: Evidence, name: str) -> ResidualCurve | None:
    """The curve of the stops held out, where there are any."""
    return evidence.held_out.curves.get(name) if evidence.held_out else None


def _title(
    name: str,
    now: ResidualCurve,
    was: ResidualCurve | None,
    unseen: ResidualCurve | None,
    before: str,
) -> str:
    out, bins, hangs = outside(now)
    earlier = ""
    if was is not None:
        size_mm = 1e3 * was.rms_m
        left = was.rms_m >= LEAST_SAID_M
        earlier = f"; {before}: {size_mm:.2f} mm rms" if left else f"; nor {before}"
    what = spoken(name)
    if not bins:
        return f"Nothing can be said of {what}: a single stop and surface"
    if hangs:
        return f"The residuals depend on {what}: {1e3 * now.rms_m:.2f} mm rms{earlier}"
    if unseen is not None and outside(unseen)[2] and unseen.rms_m > now.rms_m + LEAST_SAID_M:
        size_mm = 1e3 * unseen.rms_m
        return f"Over {what}, stops held out are off by {size_mm:.2f} mm rms; the fit absorbs it"
    inside = f"{bins - out} of {bins} bins within their band"
    return f"No significant dependence on {what} is left ({inside}{earlier})"


def _curve(evidence: Evidence, name: str) -> Figure:
    now, was = evidence.after.curves[name], evidence.earlier.curves.get(name)
    unseen = _unseen(evidence, name)
    unit = evidence.joint_units.get(name) or shown_unit(name)
    names = now.axis.names or ()
    margins = None if len(names) > UPRIGHT_NAMES else MARGINS
    figure, grid = plots.axes(
        plots.HALF_IN, 3.7, 3, margins=margins, sharex=True, height_ratios=(2.0, 2.0, 1.0)
    )
    top, middle, bottom = grid[:, 0]
    series = [(was, plots.BEFORE, evidence.before), (now, plots.AFTER, "now")]
    series += [(unseen, plots.HELD_OUT_COLOUR, "held out")]
    for curve, colour, label in series:
        if curve is not None:
            _draw(top, curve, colour, label, unit[1])
            _line(bottom, curve, colour, unit[1])
    _draw(middle, now, plots.AFTER, None, unit[1])
    bottom.margins(y=0.15)
    bottom.set_ylim(bottom=0)
    for ax, label in ((top, "mean, mm"), (middle, "now, mm"), (bottom, "sd, mm")):
        ax.set_ylabel(label)
    for ax, drawn in ((top, (was, now)), (middle, (now,))):
        ax.axhline(0, color=plots.PALE, linewidth=1, zorder=1)
        limit = max(_reach(curve, 1.0) for curve in drawn if curve is not None)
        if ax is top and unseen is not None:  # of few stops, so its band may leave the picture
            limit = max(limit, _reach(unseen, 0.0))
        if limit > 0:
            ax.set_ylim(-limit, limit)
    _name_bins(bottom, now, unit[0])
    if margins is None:
        figure.align_ylabels()
    figure.legend(loc="upper left" if margins else "outside upper left", ncols=3)
    return figure


def _reach(curve: ResidualCurve, bands: float) -> float:
    """How far, in mm, means and this part of their bands reach of things that are seen often;
    seldom ones may leave the picture."""
    known = np.isfinite(curve.mean_m)
    often = known & (curve.count >= SELDOM * curve.count.sum())
    size = np.abs(curve.mean_m) + bands * np.nan_to_num(curve.band_m)
    return 1.15e3 * float(size[often if often.any() else known].max(initial=0.0))


def _x(curve: ResidualCurve, times: float) -> np.ndarray:
    """Where its bins are drawn."""
    if curve.axis.names:
        return np.arange(curve.axis.bins, dtype=float)
    return times * curve.at


def _draw(ax: Axes, curve: ResidualCurve, colour: str, label: str | None, times: float) -> None:
    """Means with their bands: a line, or dots where bins are things."""
    x, mean, half = _x(curve, times), 1e3 * curve.mean_m, 1e3 * curve.band_m
    if curve.axis.names:
        ax.errorbar(x, mean, np.nan_to_num(half), fmt="o", ms=4, lw=1.2, color=colour, label=label)
        return
    order = np.argsort(x)
    order = order[np.isfinite(mean[order])]
    plots.band(ax, x[order], mean[order], half[order], colour)
    ax.plot(x[order], mean[order], ".-", ms=4, color=colour, label=label)


def _line(ax: Axes, curve: ResidualCurve, colour: str, times: float) -> None:
    known = np.isfinite(curve.std_m)
    style = "o" if curve.axis.names else "-"
    ax.plot(_x(curve, times)[known], 1e3 * curve.std_m[known], style, ms=4, lw=1.2, color=colour)


def _name_bins(ax: Axes, curve: ResidualCurve, unit: str) -> None:
    what = spoken(curve.axis.name)
    ax.set_xlabel(f"{what}, {unit}" if unit else what)
    names = curve.axis.names
    if names and len(names) <= MOST_AXIS_NAMES:
        ax.set_xticks(range(len(names)), names, rotation=45 if len(names) > UPRIGHT_NAMES else 0,
                      ha="right" if len(names) > UPRIGHT_NAMES else "center",
                      rotation_mode="anchor",
                      fontsize=8)  # fmt: skip


def ring_map(evidence: Evidence) -> Iterator[Chart | Absent]:
    """Mean residual over ring and azimuth: before, now, and of stops held out."""
    if not evidence.has_beams:
        yield Absent("map", NO_BEAMS)
        return
    maps = {evidence.before: 1e3 * evidence.earlier.map_m, "now": 1e3 * evidence.after.map_m}
    was, now = (float(np.sqrt(np.nanmean(np.square(m)))) for m in maps.values())
    if evidence.held_out:
        maps["held out"] = 1e3 * evidence.held_out.map_m
    yield Chart(
        "map",
        f"Over ring and azimuth the mean residual is {now:.2f} mm rms; {evidence.before}: "
        f"{was:.2f} mm",
        f"Every cell is the mean residual of all stops in one ring and "
        f"{360 / evidence.azimuths:.3g} degrees of azimuth: orange reads long, purple short, grey "
        "was not seen. All maps have one scale; what lies beyond it has the colour of its end. "
        "Stops held out are as a fit without them predicts them. Stripes along a ring are range "
        "zeros of rings; stripes across rings come from the encoder or the mount.",
        lambda: _ring_map(maps),
        wide=True,
    )


def map_limit(maps: Sequence[np.ndarray]) -> float:
    """The end of the one scale of some maps, of which the first is before: what is left now shows,
    though before may lie beyond it."""
    ends = [float(np.nanquantile(np.abs(each), 0.98)) for each in maps]
    return round_up(max(*ends[1:], ends[0] / BEFORE_BEYOND))


def _ring_map(maps: Mapping[str, np.ndarray]) -> Figure:
    figure, grid = plots.axes(plots.WIDE_IN, 3.4, 1, len(maps), sharey=True)
    limit = map_limit(list(maps.values()))
    for ax, (title, values) in zip(grid[0], maps.items(), strict=True):
        picture = plots.ring_map(ax, values, limit, title)
    plots.name_ring_maps(figure, grid, picture)
    return figure


def thrown_away(evidence: Evidence) -> Iterator[Chart | Absent]:
    """Where the beams are that the fit gave no weight, and by how much they are off."""
    if not evidence.has_beams:
        yield Absent("rejected", NO_BEAMS)
        return
    now = evidence.after
    found = (evidence.diagnosis or {}).get("rejected") or {}
    share = 100 * (1 - now.kept / max(now.rows, 1))
    told = f"{share:.2g} % of the beams that meet a surface were rejected"
    yield Chart(
        "rejected",
        found.get("sentence", "").rstrip(".") or told,
        "Left: share of the beams of each ring and azimuth that lie so far off that the fit gave "
        "them no weight. Mixed pixels and clutter fall everywhere, and scatter over all values; a "
        "patch or stripe, or a peak on the right, is an error. Right: how far off they are; what "
        "lies beyond the picture stands at its ends.",
        lambda: _thrown_away(now),
        wide=True,
        quiet=bool(found.get("explained")),
    )


def _thrown_away(now: Statistics) -> Figure:
    figure, grid = plots.axes(plots.WIDE_IN, 3.2, 1, 2, width_ratios=(1.6, 1.0))
    left, right = grid[0]
    extent = (-180, 180, -0.5, len(now.thrown) - 0.5)
    most = max(FEWEST_THROWN, float(np.nanmax(now.thrown)))
    picture = plots.share_map(left, 100 * now.thrown, extent, 100 * most)
    figure.colorbar(picture, ax=left, orientation="horizontal", aspect=35).set_label("thrown, %")
    left.set(xlabel="azimuth, deg", ylabel="ring", xticks=range(-180, 181, 90))
    sizes_mm = 1e3 * now.thrown_m
    if len(sizes_mm):
        reach = round_up(float(np.quantile(np.abs(sizes_mm), BEAMS_IN_HISTOGRAM)))
        right.hist(np.clip(sizes_mm, -reach, reach), np.linspace(-reach, reach, 81),
                   color=plots.BEFORE)  # fmt: skip
    right.set(xlabel="measured less predicted, mm", ylabel="beams")
    return figure
