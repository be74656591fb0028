"""What a run was fitted to, as it was then: its model and its recordings."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from calib.diagnosis.stand import Stand
from calib.effects import Effect, NotTrustedError, own_effects, read
from calib.problem import Problem, build
from calib.problem.model import Model, Source
from calib.problem.spread import names_of
from calib.problem.without import leave_out
from calib.recalibration.links import moved_since_cad
from calib.rig import load_rig
from calib.runs.run import DIAGNOSIS, MODEL, SOLUTION, STATE, Run, versions
from calib.runs.stored import FIT_AGAIN
from calib.solve.estimate import DOFS, SD, Start
from calib.solve.fit import Progress, resume
from chains import remote
from chains.errors import InputError
from sensors.recording import digest
from sensors.reference import Reference

OPENED = 4  # recordings that stay open in a process: to grow and diagnose runs of them again
_opened: dict[tuple[Path, str, int | None], Source] = {}


def model_of(run: Run) -> Model:
    """The model that a run was fitted with.

    Raises:
        NotTrustedError: it has an effect of a Python file that the user did not say may run.
    """
    return Model.read(run.model, run.folder / MODEL, run.trust)


def identity(run: Run) -> dict[str, Any]:
    """All of a run that what is made of it depends on, its recordings included, as JSON holds it:
    digests of its files, the files that may run, and what computes."""
    files = [run.folder / name for name in (MODEL, STATE, SOLUTION)]
    return {
        "files": [hashlib.sha256(path.read_bytes()).hexdigest() for path in files],
        "set_aside": sorted(run.set_aside),
        "trust": sorted(run.trust),
        "versions": versions(),
    }


def effects_of_prior(folder: Path | str | None) -> Sequence[Effect]:
    """The effects of an earlier run that another is fitted from, for its usual model; none where
    there is no such run.

    Raises:
        InputError: one is of a Python file, which does not run unasked.
    """
    if folder is None:
        return ()
    found, why = effects_that_may_run(Run.open(folder))
    if why:
        raise InputError(f"--prior {folder}: {why}; or choose what is estimated with --effects")
    return found


def effects_that_may_run(run: Run) -> tuple[list[Effect], str]:
    """Effects of a run's model but those of Python files that the user did not say may run, and
    the sentence that says which these are; empty where there is none."""
    found, why = [], ""
    for document in run.model["effects"]:
        try:
            found.append(read(document, run.folder / MODEL, run.trust))
        except NotTrustedError as error:
            why = str(error)
    return found, why


def proposed(run: Run, names: Sequence[str]) -> list[Effect]:
    """Effects of these names that no catalogue has: as the run's diagnosis describes them, or else
    as the files do that its recordings' ``rig.yaml`` names.

    Args:
        run: the run.
        names: effects, with or without a shape; those that are known nowhere are left out.

    Raises:
        NotTrustedError: one is of a Python file that the user did not say may run.
        InputError: the diagnosis, or a file, holds no such effect as it should.
    """
    described = _described(run)
    found = [read(described[n], run.folder / DIAGNOSIS, run.trust) for n in names if n in described]
    if set(names) <= described.keys():
        return found
    there = (folder for folder in map(remote.here, run.recordings) if folder.is_dir())
    rest = own_effects(map(load_rig, there))
    return [*found, *(e for e in rest if e.name in names and e.name not in described)]


def _described(run: Run) -> dict[str, Any]:
    """Name -> how the run's diagnosis describes an effect that no catalogue has."""
    document, found = run.diagnosis(), {}
    try:
        for each in reversed(document["candidates"] if document else []):  # best first: it stays
            if isinstance(each.get("document"), Mapping):
                found |= dict.fromkeys((str(each["effect"]), str(each["add"])), each["document"])
        formulas = (each.get("formula") for each in (document["unexplained"] if document else []))
        return found | {str(each["name"]): each for each in formulas if each}
    except (KeyError, TypeError, AttributeError):
        raise InputError(
            f"{run.folder / DIAGNOSIS} is no diagnosis of this version; diagnose the run again"
        ) from None


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
    """Where a run's fit stood, for another fit of its recordings. What beams met is known where the
    same beams are used.

    Raises:
        InputError: the run is of an earlier version.
    """
    folders = [source.recording.folder for source in sources]
    met = {}
    for name, part in run.met().items() if sources[0].beams == run.beams else ():
        number, _, stop = name.partition("/")
        known = number.isdecimal() and stop.isdecimal() and int(number) < len(sources)
        mesh = sources[int(number)].reference if known else None
        if mesh is None or not _are_of(mesh, part):
            raise InputError(f"{run.folder / STATE}: {name} is no list of triangles; {FIT_AGAIN}")
        met[folders[int(number)], int(stop)] = part
    return Start(run.state(), met, frozenset(run.set_aside))


def state_of(run: Run, problem: Problem) -> dict[str, np.ndarray]:
    """Where a run's fit stood, all of the problem's unknowns.

    Raises:
        InputError: the state has not all of them, or one of another shape.
    """
    state = run.state()
    for name, unknown in problem.variables.items():
        found, dofs = state.get(name), state.get(f"{name}{DOFS}")
        whole = found is not None and found.dtype.kind == "f" and np.isfinite(found).all()
        if whole and dofs is None:
            whole = found.shape == problem.initial[name].shape
        elif whole:
            whole = found.shape == dofs.shape and set(unknown.dofs) <= set(dofs.tolist())
        if not whole:
            raise InputError(f"{run.folder / STATE}: its state lacks '{name}'; {FIT_AGAIN}")
    drawn = (t for terms in problem.terms for t in terms if t.effect.by_chance)
    for key in (key for term in drawn for key in names_of(problem, term)):
        if f"{key}{SD}" not in state:
            raise InputError(f"{run.folder / STATE}: its state lacks '{key}'; {FIT_AGAIN}")
    return state


def problem_of(
    run: Run, sources: Sequence[Source], meetings: Mapping[int, object] | None = None
) -> Problem:
    """A run's model on its recordings, without what its fit set aside.

    Args:
        run: the run.
        sources: its recordings.
        meetings: as of `calib.problem.build`.
    """
    return build(sources, model_of(run), meetings=meetings).setting_aside(run.set_aside)


def _are_of(mesh: Reference, part: np.ndarray) -> bool:
    """Whether these can be the triangles (N,) of a mesh that beams met, -1 for none."""
    whole = part.ndim == 1 and part.dtype.kind == "i"
    return whole and bool(((part >= -1) & (part < len(mesh.triangles))).all())


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
    path = remote.here(recording["path"])
    as_it_was(recording, path, run)
    key = path, recording["sha256"], run.beams
    known = _opened.get(key)
    source = known or Source.open(path).of_beams(run.beams)
    if known is None and len(_opened) == OPENED:
        _opened.clear()
    _opened[key] = source
    return source


def stand_of(run: Run, progress: Progress, candidates: str | Sequence[str] = ()) -> Stand:
    """Where a run stands: its model, its recordings, and the state in which its fit was left.

    Args:
        run: the run.
        progress: as of `fit.solve`.
        candidates: as of `diagnose`.

    Raises:
        InputError: its recordings are not what they were, or a file of effects is wrong.
    """
    sources, model = reopened(run), replace(model_of(run), moved=moved_since_cad(run.summary))
    own = own_effects([source.rig for source in sources], candidates)
    problem, converged = build(sources, model, progress=progress), run.summary["converged"]
    state_of(run, problem)  # or it would look from elsewhere, unseen
    estimate = resume(problem, start_of(run, sources), progress, converged)
    return Stand(sources, model, problem, estimate, own=own)
