"""Where a model does not fit, and of how many beams its error speaks, as people read it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

from calib.residuals.groups import CAD
from calib.results.outstanding import groups, moves, times, together_told
from calib.runs.belief import TOLERATED_OF_CAD, misfit_sentence

# Times that a held-out error is smaller than expected, from which it is told. In 23 recordings of
# an independent simulator it was 1.15 at most; with the joints' sigma 50 times too large, 4.
FAR_LESS = 2.0

if TYPE_CHECKING:
    from calib.runs.run import Run


def over_beams(rms_mm: float, summary: Mapping[str, Any], before: str = "") -> str:
    """An error with the share of beams that it speaks of, and the error of them all.

    Args:
        rms_mm: the error.
        summary: of the run.
        before: "held_out_" of stops held out.
    """
    share, every = (summary.get(f"{before}{k}") for k in ("rejected_share", "rms_all_mm"))
    if share is None or every is None or summary["residual"] != "range":
        return f"{rms_mm:.2f} mm"
    return f"{rms_mm:.2f} mm over {100 * (1 - share):.1f} % of the beams; {every:.2f} mm over all"


def and_angle(told: str, summary: Mapping[str, Any], kind: str) -> str:
    """An error in words, and that of orientations where a tracker sees some.

    Args:
        told: the error.
        summary: of the run.
        kind: "fit", "held_out" or "noise_floor".
    """
    mrad = summary.get("rms_mrad", {}).get(kind)
    return told if mrad is None else f"{told} and {mrad:.2f} mrad"


def beams_told(summary: Mapping[str, Any]) -> list[str]:
    """Of a run with beams: its errors, of how many beams they speak, and those of all."""
    if summary["residual"] != "range" or summary.get("rejected_share") is None:
        return []
    kinds = (("fit", "", "after the fit"), ("held_out", "held_out_", "of stops held out"))
    rms = summary["rms_mm"]
    return [
        f"{what}: {over_beams(rms[kind], summary, before)}"
        for kind, before, what in kinds
        if rms.get(kind) is not None
    ]


def furthest(worst: str, ratio: float, limit: str, loud: int) -> str:
    """What is furthest off, over which limit, and how many others stand out with it."""
    more = f"; {loud - 1} more stand{'s' * (loud == 2)} out" if loud > 1 else ""
    return f"{worst} is {times(ratio)} times further off than {limit}{more}"


def worst_of(run: Run) -> tuple[str, str]:
    """The worst group and the furthest move of a run; empty where there are none."""
    group = next((f"{name} {times(x)}" for name, x in groups(run.summary).items()), "")
    move = next((f"{name} {times(m['move_sigmas'])}" for name, m in moves(run.summary).items()), "")
    return group, move


def misfit_warnings(summary: Mapping[str, Any]) -> Iterator[str]:
    """That residuals are larger than they may be, or err together, and what was done about it."""
    if (factor := summary.get("cad_widened_by", 1.0)) > TOLERATED_OF_CAD:
        yield (
            f"{misfit_sentence(CAD, factor)}: a value of CAD is wrong, or a sigma in rig.yaml too "
            f"small; of every sigma above, the part that is due to CAD is widened by that"
        )
    if (factor := summary.get("sigmas_widened_by", 1.0)) > 1.0:
        instruments = {kind: x for kind, x in summary["misfit"].items() if kind != CAD}
        kind = max(instruments, key=instruments.get)
        what = "errors of the reference" if kind == "reference" else f"residuals of {kind}"
        yield (
            f"the {what} are {factor:.1f} times larger than their sigmas allow: something is "
            f"missing from the model, or a sigma in rig.yaml too small; {_widened(summary)}"
        )
    held_out, expected = (summary["rms_mm"].get(key) for key in ("held_out", "noise_floor"))
    if held_out and expected and expected > FAR_LESS * held_out:
        lidar = ", or that of the LiDAR's model" if summary["residual"] == "range" else ""
        yield (
            f"the held-out error is {times(expected / held_out)} times smaller than expected: a "
            f"sigma in rig.yaml is too large (tracker, joints, targets or reference){lidar}, and "
            "so are those above that rest on it"
        )
    for told in together_told(summary):
        yield f"{told}; 'rigcal diagnose' looks for the cause"


def _widened(summary: Mapping[str, Any]) -> str:
    """What is wider where residuals exceed their sigmas."""
    moved = any(link["moved"] for link in summary.get("links", ()))
    doubt = ", and what moved may have moved because of it" if moved else ""
    return f"of every sigma above, the part that these data tell is widened by that{doubt}"
