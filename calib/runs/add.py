"""The model of a run and more effects: ``rigcal add``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from calib.runs.calibrate import grow, grown_model
from calib.runs.run import Run
from calib.solve.fit import Progress
from chains.errors import InputError


def add(
    run: Run,
    effects: str | Sequence[str],
    out: Path | str,
    progress: Progress = lambda what, done, total: None,
    without: Sequence[str] = (),
    every_beam: bool = False,
) -> Run:
    """Fit a run's model and more effects to the same recordings, from where that run stood.

    Args:
        run: the run to grow from; see `calib.runs.calibrate.grow`.
        effects: names in the catalogue, or files of effects; one, several with commas, or a list.
        out: the run folder to make; an earlier run there is replaced, anything else is refused.
        progress: called with what is being done, and how far it is.
        without: what more is left out of the recordings, as ``--without`` names it.
        every_beam: True to use all beams of each scan, where the run used some.

    Raises:
        InputError: an effect is unknown or in the model already, or the run's recordings are not
            what they were; or every beam is asked for, which the run used, and nothing else.
    """
    if every_beam and run.beams is None and not effects and not without:
        raise InputError(f"{run.folder} used all beams already; give an EFFECT to add")
    model = grown_model(run, effects).leaving_out(without)
    return grow(run, replace(model, beams=None) if every_beam else model, out, progress)
