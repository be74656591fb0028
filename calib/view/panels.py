"""The panel's pieces as HTML: legend, findings, ladder, the point that was clicked."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from calib.report import plots
from calib.results import outstanding
from calib.runs.ladder import FORMULA, Rung
from calib.runs.run import Run
from calib.show.headline import moved_sentence
from calib.show.tables import small
from calib.view.desk import Findings
from calib.view.scene import Points
from calib.view.shown import sizes
from calib.view.shown.colours import Scale, choices, column
from calib.view.shown.moves import Move
from chains.escape import html as escape

SHOWN_CANDIDATES = 6  # candidates in the table; the menu has all
DIGITS = {"m": 3, "mm": 2, "deg": 1, "°C": 2, "s": 1, "of the median": 3}  # that are told
MANY = 0.05  # of the beams: so many beyond a scale are worth another scale
KEY_EM = 0.4  # of a dot of the usual size, in the key of sizes
BAR = "#7fb2d9"
STRIPED = f"repeating-linear-gradient(45deg,{BAR} 0 6px,#dcebf6 6px 10px)"  # of a rung by a formula
_FRAME = "padding:0 1.2em .4em .75em;font-size:12px;line-height:1.4"
_QUIET = "opacity:.7"
_CUT = "overflow:hidden;text-overflow:ellipsis;white-space:nowrap"


def legend(scale: Scale) -> str:
    """What the colours mean."""
    if scale.low is None:
        items = "".join(
            f'<span style="margin-right:1em;white-space:nowrap"><span style="display:inline-block;'
            f'width:.8em;height:.8em;background:{colour}"></span> {escape(name)}</span>'
            for name, colour in scale.names.items()
        )
        return framed(items)
    middle, unit = (scale.low + scale.high) / 2, f" {scale.unit}" if scale.unit else ""
    sign = "+" if scale.signed else ""
    ends = [f"{value:{sign if value else ''}.3g}" for value in (scale.low, middle, scale.high)]
    if scale.signed:
        less, more = scale.signed
        ends = [f"{ends[0]}{unit}, {less}", ends[1], f"{ends[2]}{unit}, {more}"]
    else:
        ends = [f"{end}{unit}" for end in ends]
    bar = f"height:.9em;background:linear-gradient(to right,{','.join(scale.stops)})"
    texts = "".join(f"<span>{escape(end)}</span>" for end in ends)
    return framed(
        f'<div style="{bar}"></div>'
        f'<div style="display:flex;justify-content:space-between">{texts}</div>'
    )


def size_key(of: str, steps: Sequence[str]) -> str:
    """What sizes of dots mean, as `sizes.key` has it."""
    dots = "".join(
        f'<span style="margin-right:.9em;white-space:nowrap"><span style="display:inline-block;'
        f"width:{factor * KEY_EM:.2f}em;height:{factor * KEY_EM:.2f}em;border-radius:50%;"
        f'background:currentColor;vertical-align:middle"></span> {escape(text)}</span>'
        for factor, text in zip(sizes.FACTORS, steps, strict=True)
    )
    return framed(f'<div data-is="sizes">{escape(of)}:<br>{dots}</div>')


def run_name(name: str) -> str:
    """Whose plot stands below."""
    return f'<b data-is="side">{escape(name)}</b>'


def scan(points: Points | None, drawn: int, stop: str, ratios: Mapping[str, float]) -> str:
    """What the stop's beams say, all of them, however few are drawn; and how large residuals of all
    that was measured there are, over their sigmas."""
    return framed(_beams(points, drawn, stop) + _misfit(ratios))


def plotted(points: Points, rows: np.ndarray, up: str, axes: Mapping[str, Any]) -> str:
    """What a plot of the beams (n,) shows, how many of them are off its scale, and from where to
    where it goes along x."""
    values = points.columns[up][rows] * column(up).scale
    low, high = axes["y"]["range"]
    beyond = int(np.sum((values < low) | (values > high)))
    off = f"; {beyond:,} are beyond the scale" if beyond else ""
    off += ", which is wider without 'Keep scales'" if beyond > MANY * len(rows) else ""
    left, right = axes["x"]["range"]
    return framed(
        f'<span data-is="plotted" data-low="{left:.6g}" data-high="{right:.6g}">'
        f"{len(rows):,} beams{off}. Line: mean of the inliers.</span>"
    )


def lit(points: Points, kept: np.ndarray, chosen: np.ndarray | None, up: str) -> str:
    """How many beams are lit, of those that are looked at (N,), how large their residual is, and
    their mean of what the plot shows."""
    if chosen is None:
        return ""
    some = chosen & kept
    said = f"{some.sum():,} of {kept.sum():,} beams are lit"
    inliers, mean = some & points.inlier, ""
    if up != "residual_m" and inliers.any():
        shown = column(up)
        value = shown.scale * float(np.nanmean(points.columns[up][inliers].astype(float)))
        mean = (
            f"; mean {shown.title} {value:{'+' if shown.signed else ''}.4g} {shown.unit}".rstrip()
        )
    return framed(f'<b data-is="lit">{escape(said + _residual(points, inliers) + mean)}.</b>')


def _residual(points: Points, inliers: np.ndarray) -> str:
    """How large the residual of some inliers (N,) is."""
    if not inliers.any():
        return ", none of them an inlier of the fit"
    residual = 1e3 * points.columns["residual_m"][inliers].astype(float)
    rms = math.sqrt(np.mean(residual**2))
    return f"; residual of the inliers {rms:.2f} mm rms, {residual.mean():+.2f} mm mean"


def moved(run: Run) -> str:
    """What moved since the run that was its prior; nothing where there was none."""
    links = run.summary.get("links")
    told = f"Since the earlier run: {moved_sentence(links)}" if links else ""
    return framed(f'<p data-is="moved"><b>{escape(told)}</b></p>') if told else ""


def standing_out(run: Run) -> str:
    """What of the run does not fit; nothing where nothing stands out."""
    lines = "".join(f"<li>{escape(line)}</li>" for line in outstanding.standing_out(run.summary))
    title = '<b style="color:#b3261e">What does not fit</b>'
    return framed(f'{title}<ul data-is="misfits">{lines}</ul>') if lines else ""


def _beams(points: Points | None, drawn: int, stop: str) -> str:
    if points is None:
        return f"Stop {escape(stop)} has no scan in this fit."
    here = len(points.inlier)
    some = "" if here == points.measured else f", {here:,} of them looked at"
    return f"{points.measured:,} beams{some}, {drawn:,} drawn{_residual(points, points.inlier)}"


def _misfit(ratios: Mapping[str, float]) -> str:
    """What stands out is bold and red."""
    loud = "color:#b3261e;font-weight:600"
    cells = ", ".join(
        f'<span style="{loud if ratio > outstanding.STANDS_OUT else ""}">{escape(name)} '
        f"{outstanding.times(ratio)}</span>"
        for name, ratio in ratios.items()
    )
    return f'<div data-is="misfit">Residuals over their sigmas: {cells}</div>' if cells else ""


def point(points: Points, index: int, names: Mapping[str, Mapping[int, str]]) -> str:
    """All that is known of one beam: its residual, and every column.

    Args:
        points: the beams.
        index: of the beam.
        names: what the numbers of columns stand for.
    """

    def told(name: str) -> str:
        value, shown = points.columns[name][index], column(name)
        if name in names:
            return names[name].get(int(value), f"{shown.title} {int(value)}")
        value = float(value) * shown.scale
        digits = DIGITS.get(shown.unit, 4)
        text = f"{value:.{digits}f}" if shown.unit else f"{value:.6g}"
        return f"{text} {shown.unit}".strip()

    sigma = f"{1e3 * points.columns['sigma_m'][index]:.2f} mm"
    residual = f"{1e3 * points.columns['residual_m'][index]:+.2f} ± {sigma}"
    rows = {
        "residual": residual + ("" if points.inlier[index] else ", outlier"),
        "ring, column": f"{told('ring')}, {told('column')}",
    }
    rest = [n for n in choices(points) if n not in ("residual_m", "sigma_m", "ring", "column")]
    known = (n for n in rest if np.isfinite(points.columns[n][index]))
    rows |= {column(name).title: told(name) for name in known}
    cells = [
        f'<td style="{_QUIET};padding-right:.8em">{escape(name)}</td>'
        f'<td style="padding-right:1.2em">{escape(text)}</td>'
        for name, text in rows.items()
    ]
    pairs = "".join(f"<tr>{''.join(cells[i : i + 2])}</tr>" for i in range(0, len(cells), 2))
    return framed(f'<table data-is="point">{pairs}</table>')


def moves(found: Sequence[Move]) -> str:
    """How far every link stands from CAD, those that are hardly chance in bold."""
    lines = "".join(
        f'<div style="{"font-weight:600" if move.sure else _QUIET}">{escape(move.text)}</div>'
        for move in found
    )
    said = lines or "No link was estimated against CAD."
    return framed(f'<div data-is="moves">{said}</div>')


def findings(diagnosed: Findings | None) -> str:
    """The verdict in sentences, and the candidates in their order."""
    if diagnosed is None:
        return framed("This run has not been diagnosed.")
    above = {each["sentence"] for each in diagnosed.blunders}  # listed with their buttons
    sentences = "".join(
        f'<p style="margin:.3em 0">{escape(text)}</p>'
        for text in diagnosed.sentences
        if text not in above
    )
    verdict = escape(f"Verdict: {diagnosed.heading}")
    return framed(f'<b data-is="verdict">{verdict}</b>{sentences}{_candidates(diagnosed)}')


def formulas(diagnosed: Findings | None) -> str:
    """A picture for each formula: what was measured, the formula, and what is left."""
    return "".join(
        framed(
            f'<div data-is="formula"><b>{escape(chart.title)}</b>'
            f'<div style="background:#fff">{plots.svg(chart.figure(), chart.id)}</div>'
            f'<div style="{_QUIET}">{escape(chart.reading)}</div></div>'
        )
        for chart in (diagnosed.formulas if diagnosed else ())
    )


def expected(text: str) -> str:
    """What is known of a set of effects before it is fitted."""
    return framed(f'<div data-is="expected">{escape(text)}</div>')


def blunders(found: Sequence[Mapping[str, Any]]) -> str:
    """What is wrong in the recording, in the sentences of the diagnosis."""
    lines = "".join(f'<li style="margin:.3em 0">{escape(b["sentence"])}</li>' for b in found)
    return framed(f'<ul data-is="blunders" style="margin:0;padding-left:1.2em">{lines}</ul>')


def _candidates(diagnosed: Findings) -> str:
    if not diagnosed.candidates or (diagnosed.formulas and not diagnosed.worth_adding):
        return ""  # where a formula is the answer, what was tried before is in the menu
    head = "".join(
        f'<th style="text-align:{side};font-weight:600;padding-right:.6em">{text}</th>'
        for text, side in (("effect", "left"), ("mm", "right"), ("adjusted p", "left"))
    )
    head += '<th style="text-align:left;font-weight:600">held out</th>'
    rows = "".join(_candidate(each, diagnosed) for each in diagnosed.candidates[:SHOWN_CANDIDATES])
    return f'<table data-is="findings" style="width:100%"><tr>{head}</tr>{rows}</table>'


def _candidate(each: Mapping[str, Any], diagnosed: Findings) -> str:
    size = each["unabsorbed_rms_mm"]
    held = [each["held_out_rms_mm"][k] for k in ("before", "after")]
    held_out = f"{held[0]:.2f} → {held[1]:.2f}" if None not in held else ""
    p = "" if each["p_adjusted"] is None else small(each["p_adjusted"])
    worth = "" if each["add"] in diagnosed.worth_adding else _QUIET
    return (
        f'<tr style="{worth}"><td>{escape(each["add"]).replace("_", "_<wbr>")}</td>'
        f'<td style="text-align:right;padding-right:.6em">{"" if size is None else f"{size:.2f}"}'
        f'</td><td style="white-space:nowrap">{escape(p)}</td>'
        f'<td style="white-space:nowrap">{held_out}</td></tr>'
    )


def ladder(rungs: Sequence[Rung]) -> str:
    """Every rung's held-out error as a bar, and what is expected as a line through all of them."""
    errors = [_error(rung) for rung in rungs]
    floor = rungs[-1].run.summary["rms_mm"]["noise_floor"]
    most = max([*(mm for mm, _ in errors), floor]) * 1.02 or 1.0
    rows = "".join(
        _rung(rung, mm, 100 * mm / most, 100 * floor / most)
        for rung, (mm, _) in zip(rungs, errors, strict=True)
    )
    said = f"Error of {errors[-1][1]}; dashed: {floor:.2f} mm expected"
    said += f"; striped: {FORMULA}" if any(rung.empirical for rung in rungs) else ""
    warning = "".join(
        f'<div data-is="warning" style="color:#b3261e;font-weight:600">{escape(sentence)}</div>'
        for sentence in rungs[-1].run.warning
    )
    picture = f'<div data-is="ladder">{rows}</div><div style="{_QUIET}">{said}</div>'
    return framed(warning + picture)


def _error(rung: Rung) -> tuple[float, str]:
    rms = rung.run.summary["rms_mm"]
    if rms["held_out"] is None:
        return rms["fit"], "the fit, as no stop was held out"
    return rms["held_out"], "stops held out"


def _rung(rung: Rung, mm: float, width: float, floor: float) -> str:
    """One bar, `width` and `floor` in percent of the panel."""
    name = escape(rung.run.folder.name or str(rung.run.folder))
    step = rung.step if rung.below else f"{rung.step}: {rung.run.folder.name}"
    colour = STRIPED if rung.empirical else BAR
    line = f"position:absolute;top:0;bottom:0;left:{floor:.2f}%;border-left:2px dashed #00664a"
    return (
        f'<div style="display:flex;gap:.6em" title="{name}">'
        f'<span style="{_CUT};flex:1">{escape(step)}</span><b>{mm:.2f} mm</b></div>'
        f'<div style="position:relative"><div style="background:{colour};'
        f'height:.9em;width:{width:.2f}%" data-mm="{mm:.4f}"></div><div style="{line}"></div></div>'
    )


def note(text: str, bad: bool = False) -> str:
    """A sentence to the person at the page."""
    colour = (
        "#fdecea;border-left:4px solid #b3261e" if bad else "#eef4fa;border-left:4px solid #2171b5"
    )
    return (
        f'<div role="status" style="margin:0 1.2em .4em .75em;padding:.4em .6em;'
        f'background:{colour};font-size:12px;color:#222;overflow-wrap:anywhere">{escape(text)}</div>'
    )


def hint(text: str) -> str:
    """How something is used."""
    return framed(f'<div style="{_QUIET}">{escape(text)}</div>')


def new_run(rung: Rung) -> str:
    """Which run has just been made, and what stops held out make of it."""
    made = f"Made {rung.run.folder}, an ordinary run folder."
    below = rung.below.summary["rms_mm"]["held_out"] if rung.below else None
    here = rung.run.summary["rms_mm"]["held_out"]
    if below is None or here is None:
        return made
    return f"{made} Held-out error: {below:.2f} → {here:.2f} mm."


def framed(inner: str) -> str:
    """HTML as it stands in the panel."""
    return f'<div style="{_FRAME}">{inner}</div>'
