"""What forbids to believe a run, whatever its model explains: one list for diagnosis and report."""

from __future__ import annotations

from calib.runs.run import Run

FAR_OFF = 3.0  # times its sigmas, or what is expected: residuals that something large is behind
OVER = "the held-out error is {:.1f} times as large as expected"


def misfit_sentence(kind: str, times: float) -> str:
    """How far the residuals of an instrument exceed their sigmas."""
    what = "errors of the reference" if kind == "reference" else f"residuals of the {kind}"
    return f"the {what} are {times:.1f} times larger than their sigmas allow"


def over_floor(run: Run) -> float:
    """The held-out error over the expected one; 0 where nothing was held out."""
    rms = run.summary["rms_mm"]
    return (rms.get("held_out") or 0.0) / rms["noise_floor"]


def forbids(run: Run) -> list[str]:
    """Why a run is not to be believed, a clause each; none where nothing speaks against it."""
    out = [] if run.converged else ["the fit has not converged"]
    if run.set_aside:
        out.append(f"{', '.join(run.set_aside)} contradict everything else, and were set aside")
    misfit = run.summary["misfit"].items()
    out += [misfit_sentence(kind, times) for kind, times in misfit if times > FAR_OFF]
    if (times := over_floor(run)) > FAR_OFF:
        out.append(OVER.format(times))
    return out
