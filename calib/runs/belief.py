"""What forbids to believe a run, whatever its model explains, and what asks for care: one list of
each for fit, diagnosis and report."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence

import numpy as np

from calib.blunders.judged import limit_of
from calib.diagnosis.verdict import HELD_OUT_BY_CHANCE
from calib.residuals.groups import CAD
from calib.residuals.levels import Level
from calib.results.errors import over_expected
from calib.results.outstanding import standing_out, together_told
from calib.results.rings import harmful
from calib.results.sigmas import TOLERATED
from calib.runs.run import DIAGNOSIS, Run

# Times its sigmas, or what is expected: residuals that something large is behind. A choice: sigmas
# of data sheets are wrong by a factor of two at times, and then widened.
FAR_OFF = 3.0
# Of frames few moves from CAD are checked by anything: beyond this chance puts 6 of them in one rig
# of a hundred, and 17, as of an arm with two bodies, in one of 10,000.
TOLERATED_OF_CAD = 1.7
LEAST_OF_A_RIG = 2  # links: a choice; of rigs with fewer a body that was knocked is most of it
OVER = "the held-out error is {:.1f} times as large as expected"


def misfit_sentence(kind: str, times: float) -> str:
    """How far the residuals of an instrument exceed their sigmas."""
    if kind == CAD:
        return f"frames are {times:.1f} times further from CAD than its sigmas allow"
    what = "errors of the reference" if kind == "reference" else f"residuals of the {kind}"
    said = f"the {what} are {times:.1f} times larger than their sigmas allow"
    askew = " (is it askew on the frame that it is named after? Give it a frame of its own)"
    return said + (askew if kind == Level.kind else "")


def _misfit(run: Run, kind: str, times: float) -> str:
    """The same of a run; of CAD, with the frame that is furthest from it."""
    said, found = misfit_sentence(kind, times), run.summary.get("misfit_by", {}).get("prior", {})
    frames = {name: move for name, move in found.items() if "." not in name}
    if kind != CAD or not frames:
        return said
    worst = max(frames, key=lambda name: frames[name]["move_sigmas"])
    return f"{said}, {worst} by {frames[worst]['move_sigmas']:.1f} of them"


def _rings(run: Run, bad: bool) -> list[str]:
    """How rings are numbered otherwise than their LiDAR's model has it."""
    found = run.summary.get("rings", ())
    told = (each["sentence"] for each in found if harmful(each["what"]) == bad)
    return list(dict.fromkeys(told))  # of several recordings the same


def cautions(run: Run) -> list[str]:
    """What is to be looked at before a run is used, and does not forbid belief; a clause each."""
    misfit = run.summary["misfit"].items()
    least = {kind: TOLERATED_OF_CAD if kind == CAD else TOLERATED for kind, _ in misfit}
    out = [_misfit(run, kind, x) for kind, x in misfit if least[kind] < x <= FAR_OFF]
    if run.summary["rms_mm"].get("held_out") is None:
        out.append("no stops were held out, so its predictions were not checked")
    if HELD_OUT_BY_CHANCE < (times := over_expected(run.summary)) <= FAR_OFF:
        out.append(OVER.format(times))
    out += run.summary.get("odd", ())  # which runs of earlier versions lack
    told = [*together_told(run.summary), *standing_out(run.summary)]
    return [*out, *_rings(run, bad=False), *told, *_another_rig(run), *_not_asked(run)]


def _another_rig(run: Run) -> list[str]:
    """That most of what an earlier run knew is otherwise now, as of another rig."""
    links = [link for link in run.summary.get("links") or () if link["p_value"] is not None]
    moved = [link["name"] for link in links if link["moved"]]
    if len(moved) <= max(len(links) / 2, LEAST_OF_A_RIG):
        return []
    what = f"{len(moved)} of {len(links)} links moved since the earlier run"
    return [f"{what}: was that a run of this rig?"]


def _not_asked(run: Run) -> list[str]:
    """That something moved since a run which nobody asked what its model lacks: that may be it."""
    moved = any(link["moved"] for link in run.summary.get("links") or ())
    there = run.prior is not None and run.prior.is_dir()
    if not (moved and there) or (run.prior / DIAGNOSIS).is_file():
        return []
    return [
        "the earlier run was not diagnosed, and what its model lacks may seem to have moved; "
        f"'{shlex.join(['rigcal', 'diagnose', str(run.prior)])}' looks for that"
    ]


def forbids(run: Run) -> list[str]:
    """Why a run is not to be believed, a clause each; none where nothing speaks against it."""
    out = [] if run.converged else ["the fit has not converged"]
    if run.set_aside:
        out.append(f"{run.listed_aside} contradict everything else, and were set aside")
    misfit = run.summary["misfit"].items()
    out += [_misfit(run, kind, times) for kind, times in misfit if times > FAR_OFF]
    if (times := over_expected(run.summary)) > FAR_OFF:
        out.append(OVER.format(times))
    return [*out, *_rings(run, bad=True)]


def limits(redundancies: Mapping[str, Sequence[float]]) -> dict[str, float]:
    """How many times larger than their sigmas chance makes the residuals of one of all groups at
    most, by kind, as it is for a diagnosis.

    Args:
        redundancies: kind -> that of each of its groups.
    """
    looks, out = sum(map(len, redundancies.values())), {}
    for kind, some in redundancies.items():
        if some:
            own = max(1.0, float(np.median(some)))
            out[kind] = float(np.sqrt(limit_of(own, sum(some) - own, len(some), looks)[1]))
    return out
