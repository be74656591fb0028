"""Fit, diagnose, add, until nothing worth adding is left: ``rigcal explain``."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from calib.calibrate import calibrate, grow
from calib.diagnosis import Diagnosis, diagnose
from calib.effects import load_effects
from calib.fit import Progress
from calib.model import Model
from calib.run import Run
from chains.errors import InputError
from sensors.documents import write_json

EXPLANATION = "explanation.json"
MOST_RUNGS = 8


@dataclass(frozen=True)
class Explanation:
    """A ladder of runs, and why it ends where it does.

    Args:
        runs: from the first fit to the last, each grown from the one before.
        steps: per run what was added or dropped, and its held-out error.
        refused: effects that were found and did not lower the held-out error.
        diagnosis: of the last run.
    """

    runs: Sequence[Run]
    steps: Sequence[dict[str, Any]]
    refused: Sequence[str]
    diagnosis: Diagnosis

    def document(self) -> dict[str, Any]:
        """As written to explanation.json."""
        return {
            "verdict": self.diagnosis.verdict,
            "sentences": list(self.diagnosis.sentences),
            "ladder": list(self.steps),
            "refused": list(self.refused),
        }


def explain(
    recordings: Sequence[Path | str],
    out: Path | str,
    model: Model = Model(),  # noqa: B008 - frozen
    progress: Progress = lambda what, done, total: None,
) -> Explanation:
    """Grow a model until it is adequate, or what is left has no name; every rung is kept.

    What is found is added only if the held-out error falls, and dropped again if later steps leave
    it without effect. Rungs that an interrupted call has finished are taken up again.

    Args:
        recordings: folders.
        out: folder of the runs ``00``, ``01``, …, made if it is not there.
        model: what is estimated at first.
        progress: as of `fit.solve`.

    Raises:
        InputError: what is wrong with the input, or `out` is something else.
    """
    out = Path(out)
    _refuse_other(out)
    out.mkdir(parents=True, exist_ok=True)
    climb = _Climb([Path(r) for r in recordings], out, progress)
    climb.first(model)
    while True:
        found = diagnose(climb.run, progress, refits=False)
        before = len(climb.runs)
        for name in found.worth_adding:
            climb.add(name)
        climb.drop_idle()
        if len(climb.runs) == before or len(climb.runs) > MOST_RUNGS:
            break
    result = Explanation(climb.runs, climb.steps, climb.refused, found)
    write_json(out / EXPLANATION, result.document())
    return result


def _refuse_other(out: Path) -> None:
    """A folder that holds anything but a ladder is not ours to write into."""
    if not out.exists():
        return
    if not out.is_dir():
        raise InputError(f"{out} is a file; give a folder for the runs")
    others = [p.name for p in out.iterdir() if not (p.name.isdigit() or p.name == EXPLANATION)]
    others = [name for name in others if not name.startswith(".")]
    if others:
        raise InputError(f"{out} holds {others[0]}, so it is no ladder of runs; give another -o")


class _Climb:
    """The ladder while it is climbed."""

    def __init__(self, recordings: list[Path], out: Path, progress: Progress) -> None:
        self.recordings, self.out, self.progress = recordings, out, progress
        self.runs: list[Run] = []
        self.steps: list[dict[str, Any]] = []
        self.refused: list[str] = []

    @property
    def run(self) -> Run:
        return self.runs[-1]

    def first(self, model: Model) -> None:
        """The fit to start from."""
        folder = self._next()
        run = self._finished(folder, model, None)
        if run is None:
            run = calibrate(self.recordings, folder, model, progress=self.progress)
        self._keep(run, [], [])

    def add(self, name: str) -> None:
        """A rung more, if it lowers the held-out error."""
        effect = load_effects((name,))
        if name in self.refused or any(e.family == effect[0].family for e in self._model.effects):
            return
        self._try(self._model.plus(effect), [name], [])

    def drop_idle(self) -> None:
        """Without an effect that was added and that later rungs left with nothing to do."""
        for name in [n for step in self.steps[:-1] for n in step["added"]]:
            if name in self.run.effects and len(self.steps) > 2:
                rest = tuple(e for e in self._model.effects if e.name != name)
                self._try(Model(rest, self._model.fixed), [], [name])

    @property
    def _model(self) -> Model:
        return Model.read(self.run.model)

    def _try(self, model: Model, added: list[str], dropped: list[str]) -> None:
        folder = self._next()
        run = self._finished(folder, model, self.run)
        if run is None:
            run = grow(self.run, model, folder, self.progress)
        if _held_out(run) < _held_out(self.run):
            self._keep(run, added, dropped)
        else:
            shutil.rmtree(folder)
            self.refused += added

    def _keep(self, run: Run, added: list[str], dropped: list[str]) -> None:
        self.runs.append(run)
        rms = run.summary["rms_mm"]
        self.steps.append(
            {
                "run": str(run.folder),
                "added": added,
                "dropped": dropped,
                "held_out_rms_mm": rms["held_out"],
                "fit_rms_mm": rms["fit"],
                "noise_floor_mm": rms["noise_floor"],
            }
        )

    def _next(self) -> Path:
        return self.out / f"{len(self.runs):02d}"

    def _finished(self, folder: Path, model: Model, below: Run | None) -> Run | None:
        """The rung that an earlier call made here, if it is the same one."""
        try:
            run = Run.open(folder)
        except InputError:
            return None
        grown_from = str(below.folder.resolve()) if below else None
        same = (
            run.model["grown_from"] == grown_from
            and Model.read(run.model).names == model.names
            and [p.resolve() for p in run.recordings] == [p.resolve() for p in self.recordings]
        )
        return run if same else None


def _held_out(run: Run) -> float:
    found = run.summary["rms_mm"]["held_out"]
    return run.summary["rms_mm"]["fit"] if found is None else found
