"""The verdict: a light, and in words why it shows what it shows."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from calib.runs.belief import FAR_OFF, cautions, forbids
from calib.runs.run import Run
from calib.show.misfit import and_angle

UNASKED = "not diagnosed"
LIGHT_MEANS = {"green": "use it", "amber": "use it with care", "red": "do not use it yet"}


@dataclass(frozen=True)
class Verdict:
    """What a run is worth.

    Args:
        light: "green", "amber" or "red".
        sentence: the verdict.
        reasons: why the light is not green, or that nothing speaks against it.
    """

    light: str
    sentence: str
    reasons: tuple[str, ...]

    @property
    def meaning(self) -> str:
        """What the light asks of the reader."""
        return LIGHT_MEANS[self.light]


def judge(run: Run, diagnosis: Mapping[str, Any] | None) -> Verdict:
    """The verdict on a run.

    Red where an effect is known to be missing, or residuals are several times larger than their
    sigmas or than is expected; amber where that has not been looked at, or something is
    weak or unexplained; green where the model is adequate, stops that the fit never saw are as well
    predicted as noise allows, and nothing that the data left open is several times larger than
    that noise.
    """
    red, amber = list(_wrong(run, diagnosis)), list(_doubtful(run, diagnosis))
    light = "red" if red else "amber" if amber else "green"
    sentence = run.finding(diagnosis) if diagnosis else _undiagnosed(run)
    sentence = sentence if run.converged else run.warning[0]
    fine = "no effect is missing, and stops that it never saw are predicted as well as noise allows"
    return Verdict(light, sentence, tuple(red + amber) or (fine,))


def _undiagnosed(run: Run) -> str:
    rms = run.summary["rms_mm"]
    known = {kind: x for kind, x in rms.items() if x is not None}
    size = {kind: and_angle(f"{x:.2f} mm", run.summary, kind) for kind, x in known.items()}
    told = f"its residuals are {size['fit']}, and no stops were held out"
    if "held_out" in size:
        told = f"the held-out error is {size['held_out']}"
    return f"Not diagnosed yet: {told}; {size['noise_floor']} are expected."


def _wrong(run: Run, diagnosis: Mapping[str, Any] | None) -> Iterator[str]:
    if diagnosis and diagnosis["verdict"] == "missing_effect":
        yield "an effect is missing that is worth adding"
    elif diagnosis and diagnosis["verdict"] == "bad_data":
        yield "something in the recording is wrong, which has to be corrected or left out"
    yield from forbids(run)


def _doubtful(run: Run, diagnosis: Mapping[str, Any] | None) -> Iterator[str]:
    rms = run.summary["rms_mm"]
    if diagnosis is None:
        yield f"{UNASKED}; 'rigcal diagnose {run.folder}' looks for missing effects"
    elif diagnosis["too_few_stops"]:
        yield "the stops are too few to say whether anything is missing"
    elif diagnosis["verdict"] == "unexplained_structure":
        yield "there is something that no known effect explains"
    yield from cautions(run)
    for weak in (diagnosis or {}).get("weak_directions", ()):
        if (weak["sigma_mm"] or 0.0) > FAR_OFF * rms["noise_floor"]:
            names = " and ".join(weak["parameters"])
            yield f"{names} may still be off by {weak['sigma_mm']:.1f} mm (one sigma)"
