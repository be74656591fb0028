"""The page: one HTML file with all in it; charts inline, nothing to fetch."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from calib.diagnosis.search.confirmed import ALPHA_EFFECT
from calib.effects import CATALOGUE
from calib.report.calibration import calibration_tables
from calib.report.chart import Absent, Chart
from calib.report.charts.fit import error_mm
from calib.report.evidence import Evidence, folder_name
from calib.results.holdout import from_to
from calib.results.outstanding import shown
from calib.runs.run import Run
from calib.show.blunders import BLUNDER_HEADINGS, blunder_cells
from calib.show.headline import moved_sentence
from calib.show.misfit import and_angle, over_beams
from calib.show.tables import ERROR_LABELS, chance, effect_page, estimate_cell, mm
from calib.show.verdict import Verdict
from chains import escape

TOLD_CANDIDATES = 8  # candidates whose evidence is told
LISTED_DIRECTIONS = 12  # weak directions that are told
LISTED_QUIET = 3  # titles of charts without a finding that a section lists; more are one line


@dataclass(frozen=True)
class Drawn:
    """A chart as the page has it.

    Args:
        chart: what it says.
        svg: its picture.
        csv: the address of its numbers, as of `csv_link`; empty where it has none.
        places: where in the picture they are, as of `figure_places`.
    """

    chart: Chart
    svg: str
    csv: str
    places: str


@dataclass(frozen=True)
class Section:
    """A heading and its charts.

    Args:
        title: the heading.
        charts: in their order.
        brief: whether only charts that are an `answer` are open.
    """

    title: str
    charts: Sequence[Drawn]
    brief: bool

    @property
    def id(self) -> str:
        return self.title.lower().replace(" ", "-")

    @property
    def shown(self) -> list[Drawn]:
        """Charts that are open."""
        loud = (drawn for drawn in self.charts if not drawn.chart.quiet)
        return [drawn for drawn in loud if drawn.chart.answer or not self.brief]

    @property
    def listed(self) -> list[Drawn]:
        """Charts that a click on their title opens."""
        rest = [drawn for drawn in self.charts if drawn not in self.shown]
        return rest if len(self._quiet) <= LISTED_QUIET else [d for d in rest if not d.chart.quiet]

    @property
    def grouped(self) -> list[Drawn]:
        """Charts whose titles have to be opened first, as they are many and say nothing of note."""
        return self._quiet if len(self._quiet) > LISTED_QUIET else []

    @property
    def _quiet(self) -> list[Drawn]:
        return [drawn for drawn in self.charts if drawn.chart.quiet]

    def read_as(self, chart: Chart) -> str:
        """The id of the first chart on the page that is read as this one is; its own, maybe."""
        drawn = [*self.shown, *self.listed, *self.grouped]
        return next(d.chart.id for d in drawn if d.chart.reading == chart.reading)


def render(
    evidence: Evidence, verdict: Verdict, sections: Sequence[Section], absent: Sequence[Absent]
) -> str:
    """The page as HTML text; every text of the run is escaped.

    Args:
        evidence: the run.
        verdict: on it.
        sections: the charts.
        absent: figures that the run does not have.
    """
    import jinja2
    import markupsafe

    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )
    here = Path(__file__).parent
    css, script = ((here / f"page.{end}").read_text(encoding="utf-8") for end in ("css", "js"))
    page = environment.get_template("page.html.j2").render(
        css=markupsafe.Markup(css),
        script=markupsafe.Markup(script),
        policy=policy(css, script),
        run=evidence.run,
        name=folder_name(evidence.run.folder),
        verdict=verdict,
        numbers=_numbers(evidence),
        sections=sections,
        tables=calibration_tables(evidence),
        brief=verdict.light != "green",
        absent=absent,
        diagnosis=evidence.diagnosis,
        headings=BLUNDER_HEADINGS,
        blunders=[blunder_cells(b) for b in (evidence.diagnosis or {}).get("blunders", ())],
        candidates=_candidates(evidence),
        detectable=_detectable(evidence),
        weak=_weak(evidence),
        untold=_untold(evidence),
        moved=moved_sentence(links) if (links := evidence.run.summary.get("links")) else "",
        provenance=_provenance(evidence),
    )
    return escape.terminal(page)


def policy(css: str, script: str) -> str:
    """What a browser may do with the page: show it, and run its own script. It loads nothing.

    Args:
        css: the text of its only style element, which is let in by its hash; matplotlib's figures
            have style attributes besides.
        script: the text of its only script, which is let in by its hash as well.
    """
    rules = {
        "default-src": "'none'",
        "img-src": "data:",  # maps within figures
        "script-src": _hash(script),
        "style-src": "'unsafe-inline'",  # for browsers that do not know the next two
        "style-src-elem": _hash(css),
        "style-src-attr": "'unsafe-inline'",
        "base-uri": "'none'",
        "form-action": "'none'",
    }
    return "; ".join(f"{name} {value}" for name, value in rules.items())


def _hash(text: str) -> str:
    digest = base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
    return f"'sha256-{digest}'"


def _numbers(evidence: Evidence) -> list[tuple[str, str]]:
    """The few numbers that one looks for first: a value, and what it is."""
    summary, (kind, error) = evidence.run.summary, error_mm(evidence.rungs[-1])
    rms = summary["rms_mm"]
    told = {
        "held-out": "rms error of held-out stops",
        "fit": "rms error of the fit; none held out",
    }
    key, before = ("held_out", "held_out_") if kind == "held-out" else ("fit", "")
    value, _, share = over_beams(error, summary, before).partition(" over ")
    out = [
        (and_angle(value, summary, key), f"{told[kind]}, over {share}" if share else told[kind]),
        (
            and_angle(f"{rms['noise_floor']:.2f} mm", summary, "noise_floor"),
            ERROR_LABELS["noise_floor"],
        ),
        (f"{rms['nominal']:.1f} mm", "before, with everything as in CAD"),
        (f"{summary['stops']}", "stops"),
    ]
    if reached := summary.get("predicted_mm"):
        where = f"'{reached['body']}' anywhere in the joints' range, as predicted (95 %)"
        out.append((f"{reached['anywhere']:.2g} mm", where))
    if summary["points"]:
        out.append((f"{summary['points']:,}".replace(",", " "), "points fitted"))
    return out


def _candidates(evidence: Evidence) -> dict[str, list[dict[str, Any]]]:
    """Candidates that are confirmed, and others beyond chance, each with its evidence in words."""
    about = {effect.family: effect_page(effect)["what"] for effect in CATALOGUE}
    candidates = evidence.diagnosis["candidates"] if evidence.diagnosis else []
    own = {c["effect"]: c["document"] for c in candidates if isinstance(c.get("document"), Mapping)}
    about |= {name: str(document.get("what", "")) for name, document in own.items()}
    planned = _planned(evidence, "undistinguished").items()
    apart = {names[0]: [f"such stops are planned by '{command}'"] for names, command in planned}
    told = [
        {
            "name": c["add"],
            "what": about.get(c["effect"], ""),
            "confirmed": bool(c["step"]) and not c["dressed_up"],
            "told": "; ".join([*_told(c), *apart.get(c["add"], ())]),
        }
        for c in [c for c in candidates if c["step"] or c["p_adjusted"] < ALPHA_EFFECT][
            :TOLD_CANDIDATES
        ]
    ]
    confirmed = [c for c in told if c["confirmed"]]
    return {"confirmed": confirmed, "others": [c for c in told if c not in confirmed]}


def _told(candidate: dict[str, Any]) -> list[str]:
    out = [f"{chance(candidate['p_adjusted'])}, adjusted for multiple testing"]
    if candidate["unabsorbed_rms_mm"] is not None:
        out.append(
            f"would explain {mm(candidate['unabsorbed_rms_mm'])} mm rms that the model does not "
            f"absorb, of its {mm(candidate['rms_mm'])} mm in all"
        )
    if went := from_to(candidate):
        out.append(f"the held-out error goes from {went} with it")
        share = candidate.get("rejected_share") or {}  # which earlier versions did not write
        if share.get("before") is not None:
            ends = (f"{100 * share[key]:.1f}" for key in ("before", "after"))
            out.append(f"rejected beams go from {' to '.join(ends)} %")
    parameters = candidate["parameters"]
    if len(parameters["names"]) == 1:
        unit = parameters["unit"]
        cell = estimate_cell(parameters["estimate"][0], parameters["sigma"][0], unit)
        out.append(f"its size would be {cell} {shown(unit)[1]}".rstrip())
    if candidate["dressed_up"]:
        out.append("rejected: residual structure that no effect explains accounts for more")
    for rival in candidate["rivals"]:
        out.append(
            f"on these data not distinguishable from {rival['effect']}; {rival['separate']} would "
            "separate them"
        )
    return out


def _detectable(evidence: Evidence) -> list[tuple[str, str]]:
    """Effects that were tested and not confirmed, and the size from which each would have been."""
    out = []
    for c in sorted((evidence.diagnosis or {}).get("candidates", ()), key=lambda c: c["effect"]):
        size, units = c["smallest_detectable"], set(c["parameters"]["unit"].split(", "))
        if not c["step"] and size is not None and len(units) == 1:
            scale, unit = shown(*units)
            out.append((c["effect"], f"{scale * size:.2g} {unit}".rstrip()))
    return out


def _weak(evidence: Evidence) -> list[tuple[str, str, str, str]]:
    """What is weakly determined: names, how much they may be off, what would determine them, and
    the command that plans such stops."""
    planned = _planned(evidence, "weak_direction")
    directions = evidence.diagnosis["weak_directions"] if evidence.diagnosis else []
    return [
        (
            " and ".join(w["parameters"]),
            "" if w["sigma_mm"] is None else f"± {w['sigma_mm']:.2f} mm",
            w["needs"],
            planned.get(tuple(w["parameters"]), ""),
        )
        for w in directions[:LISTED_DIRECTIONS]
    ]


def _planned(evidence: Evidence, of: str) -> dict[tuple[str, ...], str]:
    """Names of what a diagnosis could not tell -> the command that plans stops for it."""
    found = (evidence.diagnosis or {}).get("remedies", ())
    return {tuple(r["names"]): r["plan"] for r in found if r["of"] == of and r["plan"]}


def _untold(evidence: Evidence) -> list[tuple[str, list[str]]]:
    """Why things were not estimated or tested, and what; those with one reason together."""
    reasons: dict[str, list[str]] = {}
    for entry in evidence.run.solution.not_estimated:
        tied, colon, why = entry["why"].partition(": ")
        name = f"{entry['name']}, {tied}" if colon else entry["name"]
        reasons.setdefault(why if colon else tied, []).append(name)
    planned = _planned(evidence, "untestable")
    for name, why in (evidence.diagnosis or {}).get("untestable", {}).items():
        command = planned.get((name,))
        told = f"{name}: '{command}' plans stops for it, if any can help" if command else name
        reasons.setdefault(f"not tested: {why}", []).append(told)
    return list(reasons.items())


def _beams(run: Run) -> list[tuple[str, str]]:
    if run.summary["residual"] != "range":
        return []
    return [("beams", f"{run.beams:,} of each scan at most" if run.beams else "all")]


def _provenance(evidence: Evidence) -> list[tuple[str, str]]:
    model = evidence.run.model
    out = [("run", str(evidence.run.folder))]
    out += [
        ("recording", f"{r['path']} ({r['rig']}), SHA-256 {r['sha256']}")
        for r in model["recordings"]
    ]
    out += [
        ("model", ", ".join(evidence.run.effects) or "no effects"),
        *_beams(evidence.run),
        ("left out", ", ".join(evidence.run.left_out) or "nothing"),
        ("set aside", ", ".join(evidence.run.set_aside) or "nothing"),
        ("held fixed", ", ".join(model["fixed"]) or "nothing but what CAD has exact"),
        ("held out", f"{model['hold_out']}, {model['folds']} fold(s)"),
        ("made with", ", ".join(f"{n} {v}" for n, v in model["versions"].items())),
    ]
    return out
