"""What a run was fitted to, as it was then: its model and its recordings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from calib.problem import Problem, build
from calib.problem.model import Model, Source
from calib.problem.without import leave_out
from calib.runs.run import MODEL, Run
from calib.solve.estimate import Start
from chains.errors import InputError
from sensors.recording import digest

OPENED = 4  # recordings that stay open in a process: to grow and diagnose runs of them again
_opened: dict[tuple[Path, str], Source] = {}


def model_of(run: Run) -> Model:
    """The model that a run was fitted with."""
    return Model.read(run.model, run.folder / MODEL)


def reopened(run: Run, without: Sequence[str] | None = None) -> list[Source]:
    """A run's recordings, as they were when the run was fitted to them.

    Args:
        run: the run.
        without: what is left out of them; what the run left out where None.

    Raises:
        InputError: one is gone, or has changed; or one does not have what is to be left out.
    """
    found = [_reopened(recording, run) for recording in run.model["recordings"]]
    return leave_out(found, run.model.get("without", ()) if without is None else without)


def start_of(run: Run, sources: Sequence[Source]) -> Start:
    """Where a run's fit stood, for another fit of its recordings.

    Raises:
        InputError: the run is of an earlier version.
    """
    folders = [source.recording.folder for source in sources]
    met = {}
    for name, part in run.met().items():
        number, stop = map(int, name.split("/"))
        met[folders[number], stop] = part
    return Start(run.state(), met, _aside(run, sources))


def problem_of(
    run: Run, sources: Sequence[Source], meetings: Mapping[int, object] | None = None
) -> Problem:
    """A run's model on its recordings, without the scans that its fit set aside.

    Args:
        run: the run.
        sources: its recordings.
        meetings: as of `calib.problem.build`.
    """
    return build(sources, model_of(run), meetings=meetings).setting_aside(_aside(run, sources))


def _aside(run: Run, sources: Sequence[Source]) -> frozenset[tuple[Path, int]]:
    """Recording and number of the stops whose scans the fit set aside."""
    aside = (map(int, name.split("/")) for name in run.summary.get("set_aside", {}).values())
    return frozenset((sources[number].recording.folder, stop) for number, stop in aside)


def stored_met(start: Start, sources: Sequence[Source]) -> dict[str, np.ndarray]:
    """What beams met, as a run keeps it: of recordings with a mesh."""
    number = {s.recording.folder: i for i, s in enumerate(sources) if s.reference is not None}
    known = ((folder, stop, part) for (folder, stop), part in start.met.items())
    return {f"{number[folder]}/{stop}": part for folder, stop, part in known if folder in number}


def as_it_was(recording: Mapping[str, str], path: Path, run: Run) -> None:
    """Raise InputError where a recording of a run is not at this path, or has changed since."""
    if not path.is_dir():
        raise InputError(
            f"{path}, which {run.folder} was fitted to, is no longer there; put it back, or fit it "
            f"where it is now with 'rigcal fit'"
        )
    if digest(path) != recording["sha256"]:
        raise InputError(
            f"{path} has changed since {run.folder} was fitted to it; fit it anew with 'rigcal fit'"
        )


def _reopened(recording: Mapping[str, str], run: Run) -> Source:
    path = Path(recording["path"])
    as_it_was(recording, path, run)
    known = _opened.get((path, recording["sha256"]))
    source = known or Source.open(path)
    if known is None and len(_opened) == OPENED:
        _opened.clear()
    _opened[path, recording["sha256"]] = source
    return source
