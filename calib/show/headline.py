"""What matters of a run, in a few lines: what moved, how large the error is, what to do next."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from calib.results.outstanding import shown
from calib.rig.suspect import listed
from calib.runs.run import Run
from calib.show.misfit import and_angle, over_beams
from calib.show.verdict import UNASKED, judge

ALL_MOVED = 4  # links, none of which stayed: a choice; a knock moves one or two
TOLD_AXES = 3.0  # sigmas of a change, from which the axis along which it went is named


class Words(NamedTuple):
    """How a change is told: of a length, of an angle, of an effect; that there is no other, that
    there is none at all, that nothing is known; what stands above links with and without; what is
    asked where everything changed; and what is hardly checked."""

    shifted: str
    turned: str
    changed: str
    no_other: str
    none: str
    silent: str
    title: str
    title_of_none: str
    all_of_them: str = ""
    hidden: str = ""


MOVED_WORDS = Words(
    shifted="moved",
    turned="turned",
    changed="changed by",
    no_other="nothing else moved",
    none="nothing moved significantly",
    silent="the new data do not determine {}",
    title="moved since the earlier run",
    title_of_none="not moved",
    all_of_them="nothing that the new data tell of stayed as it was: is it the same rig?",
    hidden="a move as large as CAD's sigma would not be seen in {}",
)
DIFFERS = Words(  # of one recording: nothing moved, two models tell it otherwise
    shifted="differs by",
    turned="differs by",
    changed="differs by",
    no_other="no other estimate differs significantly",
    none="no estimate differs significantly",
    silent="{} is not known",
    title="differs significantly",
    title_of_none="does not differ significantly",
)

FIRST_CHECKED = 3  # recordings that are to be checked where a fit did not converge: a choice


def moved_sentence(links: Sequence[Mapping[str, Any]], words: Words = MOVED_WORDS) -> str:
    """What moved since the run that was the prior, and that nothing else did.

    Args:
        links: as `summary.json` has them.
        words: in which it is told.
    """
    moved, still, silent = by_what_became(links)
    if moved:
        out = "; ".join(
            f"{link['name']} {' and '.join(_changes(link, words))}{_in_its_place(link)}"
            for link in moved
        )
        if still:
            out += f"; {words.no_other}"
        elif words.all_of_them and len(moved) >= ALL_MOVED:
            return f"{out}; {words.all_of_them}"
    else:
        out = words.none
    if silent:
        out += f"; {words.silent.format(', '.join(link['name'] for link in silent))}"
    if hidden := [link for link in still if link.get("unchecked")]:
        each = (f"{link['name']} ({listed(link['unchecked'])})" for link in hidden)
        out += f"; {words.hidden.format(', '.join(each))}"
    return f"{out}."


def by_what_became(links: Sequence[Mapping[str, Any]]) -> tuple[list[Mapping[str, Any]], ...]:
    """The links that moved, those that did not, and those of which the data say nothing; one that
    may have moved in place of another is none of these."""
    moved = [link for link in links if link["moved"]]
    instead = {name for link in moved for name in link.get("instead", ())}
    others = [link for link in links if not link["moved"] and link["name"] not in instead]
    told = [link for link in others if link["p_value"] is not None]
    return moved, told, [link for link in others if link["p_value"] is None]


def _in_its_place(link: Mapping[str, Any]) -> str:
    """Which others may have moved and not this one, if any."""
    others = link.get("instead", ())
    if not others:
        return ""
    return f" (or, in its place, {' or '.join(others)}: these data do not tell which)"


def _changes(link: Mapping[str, Any], words: Words) -> Iterator[str]:
    """By how much a link moved: of a frame along and about the axes that show it, of an effect its
    parameters that do, or, where several do, the rms of all."""
    names, change, sigma = link["parameters"], np.array(link["change"]), np.array(link["sigma"])
    of_frame = {"tx", "rx"} <= set(names)
    certain = np.abs(change) > TOLD_AXES * sigma
    if (best := link.get("shown_by")) in names:
        certain[names.index(best)] = True
    elif not certain.any():
        certain[np.argmax(np.abs(change) / sigma)] = True
    for unit in dict.fromkeys(link["units"][::-1]):
        mine = np.flatnonzero(certain & (np.array(link["units"]) == unit))
        scale, told = shown(unit)
        if not len(mine):
            continue
        if mean := link.get("of_mean"):
            by, sigma_by = (scale * each for each in mean)
            yield f"{words.changed} {by:+.2f} ± {sigma_by:.2f} {told} (all alike)"
            continue
        if not of_frame and len(mine) > 1:
            every = change[np.array(link["units"]) == unit]
            yield f"{words.changed} {scale * np.sqrt(np.mean(every**2)):.2f} {told} rms"
            continue
        cells = [f"{scale * change[i]:+.2f} ± {scale * sigma[i]:.2f} {told}" for i in mine]
        if not of_frame:
            if best == names[mine[0]] and link.get("alone"):
                by, sigma_by = (scale * each for each in link["alone"])
                cells = [f"{by:+.2f} ± {sigma_by:.2f} {told}"]
            yield f"{words.changed} {cells[0]} ({names[mine[0]]})"
            continue
        verb, way = (words.shifted, "in") if unit == "m" else (words.turned, "about")
        along = (f"{cell} {way} {names[i][1:]}" for cell, i in zip(cells, mine, strict=True))
        yield f"{verb} {', '.join(along)}"


def closing(run: Run) -> list[str]:
    """Of a run: its error beside what is expected and what it is worth; until it is diagnosed, the
    next command as well."""
    diagnosis = run.diagnosis()
    rms, verdict = run.summary["rms_mm"], judge(run, diagnosis)
    kind, before = ("held_out", "held_out_") if rms.get("held_out") is not None else ("fit", "")
    what = {"held_out": "held-out error", "fit": "error of the fit, none held out"}[kind]
    error = over_beams(rms[kind], run.summary, before).partition("; ")[0]
    error = and_angle(error, run.summary, kind)
    expected = and_angle(f"{rms['noise_floor']:.2f} mm", run.summary, "noise_floor")
    first = f"{what}: {error}; {expected} expected if the model is right"
    first_answer = []
    if run.beams and run.summary["residual"] == "range":
        whole = ["rigcal", "add", str(run.folder), "--every-beam", "-o", f"{run.folder}-all"]
        first_answer.append(
            f"of each scan {run.beams:,} beams at most were used: a first answer. All of them: "
            f"{shlex.join([*whole, *run.trusting])}"
        )
    if diagnosis:
        return [first, *first_answer, f"verdict: {verdict.meaning}. {verdict.sentence}"]
    told = "no contradiction to the model; not diagnosed yet"
    unchecked = () if run.converged else list(run.recordings)[:FIRST_CHECKED]
    if reasons := [each for each in verdict.reasons if not each.startswith(UNASKED)]:
        why, more = reasons[0], len(reasons) - 1
        others = f" (and {more} more reason{'s' * (more > 1)})" if more else ""
        told = f"{verdict.meaning}; {why}{others}"
    return [
        first,
        *first_answer,
        f"verdict so far: {told}",
        *(f"first: {shlex.join(['rigcal', 'check', str(folder)])}" for folder in unchecked),
        f"next: rigcal diagnose {shlex.quote(str(run.folder))}",
    ]
