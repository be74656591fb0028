"""Whether a run follows from its recordings: ``rigcal reproduce``."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from calib import outputs
from calib.problem.model import Model
from calib.results.solution import Part
from calib.runs.calibrate import calibrate, grow
from calib.runs.reopen import as_it_was, model_of
from calib.runs.run import (
    COVARIANCE,
    MODEL,
    RESIDUALS,
    SOLUTION,
    STATE,
    SUMMARY,
    Run,
    solution_digest,
    versions,
)
from calib.solve.fit import Progress
from chains import remote, se3
from chains.errors import InputError
from sensors.documents import read_yaml
from sensors.recording import read_table

TOOK = "seconds"  # of summary.json: the one entry of a run that two fits of the same do not share
_DOF = ("rx", "ry", "rz", "tx", "ty", "tz")


@dataclass(frozen=True)
class Difference:
    """What differs between a file of a run and the same file made again.

    Args:
        file: its name in the run's folder.
        entries: how many of its entries differ; all of a file that only one of the two has.
        of: how many there are.
        most: the entry that differs most, as a share of its size.
        was, now: what stands there; of an array where it differs most.
    """

    file: str
    entries: int
    of: int
    most: str = ""
    was: Any = None
    now: Any = None


@dataclass(frozen=True)
class Reproduction:
    """A run beside the same made again.

    Args:
        run: its folder.
        files: how many files were compared.
        differences: of those that are not the same.
        furthest: the parameter whose estimate moved most, and by how many of its sigmas; None
            where nothing is estimated.
        versions: what another version of made the run -> that, and the one here.
    """

    run: Path
    files: int
    differences: Sequence[Difference]
    furthest: tuple[str, float] | None
    versions: Mapping[str, tuple[str, str]]

    @property
    def identical(self) -> bool:
        """Whether every file holds the same."""
        return not self.differences

    def document(self) -> dict[str, Any]:
        """As ``rigcal reproduce --json`` gives it."""
        return {
            "run": str(self.run),
            "identical": self.identical,
            "files": self.files,
            "differences": [asdict(each) for each in self.differences],
            "furthest": self.furthest and dict(zip(("name", "sigmas"), self.furthest, strict=True)),
            "versions": {n: {"run": was, "here": now} for n, (was, now) in self.versions.items()},
        }


def reproduce(
    run: Run,
    recordings: outputs.Paths = (),
    progress: Progress = lambda what, done, total: None,
) -> Reproduction:
    """Fit a run again, and every run that it grew from, and compare.

    Args:
        run: the run; nothing is written into it.
        recordings: where its recordings are now, in its order; where they were if none is given.
        progress: called with what is being done, and how far it is.

    Raises:
        InputError: a recording or the prior is gone or has changed, or the run does not say by
            which steps it was made; or an effect of it is in a Python file that may not run.
    """
    stored, moved = run.model["recordings"], outputs.each(recordings)
    if moved and len(moved) != len(stored):
        count = f"{len(moved)} recordings are given, and {run.folder} was fitted to"
        raise InputError(f"{count} {len(stored)}; give each of them, in the order of {MODEL}")
    paths = moved or [remote.here(path) for path in run.recordings]
    for each, path in zip(stored, paths, strict=True):
        if not path.is_dir():
            raise InputError(
                f"{path}, which {run.folder} was fitted to, is not there; say with --recording "
                "PATH where it is now"
            )
        as_it_was(each, path, run)
    models, prior = _models(run), _prior(run)
    choices = run.model["hold_out"], run.model["folds"], prior
    with tempfile.TemporaryDirectory(prefix="rigcal-") as folder:
        again = calibrate(paths, Path(folder, "0"), models[0], *choices, progress)
        for i, model in enumerate(models[1:], 1):
            again = grow(again, model, Path(folder, str(i)), progress)
        return compared(run, again)


def compared(run: Run, again: Run) -> Reproduction:
    """What differs between a run and the same made again."""
    pairs = [
        (r.folder, p) for r in (run, again) for p in r.folder.glob(f"{RESIDUALS}/**/*.parquet")
    ]
    tables = {path.relative_to(folder).as_posix() for folder, path in pairs}
    files = [SOLUTION, COVARIANCE, STATE, SUMMARY, *sorted(tables)]
    differences = [_difference(name, run.folder, again.folder) for name in files]
    was, here = run.model.get("versions", {}), versions()
    other = {name: (was.get(name, "not known"), now) for name, now in here.items()}
    return Reproduction(
        run=run.folder,
        files=len(files),
        differences=[each for each in differences if each is not None],
        furthest=max(_moves(run, again), key=lambda move: move[1], default=None),
        versions={name: pair for name, pair in other.items() if pair[0] != pair[1]},
    )


def _models(run: Run) -> list[Model]:
    """The run's model after those of the runs that it grew from, the first fit's first."""
    steps = run.model.get("steps", None if run.grown_from else [])
    if steps is None:
        raise InputError(
            f"{run.folder} grew from a run, and it or one below it was written by a version of "
            "rigcal that did not note by which steps; fit and add anew"
        )
    return [*(Model.read(step, run.folder / MODEL, run.trust) for step in steps), model_of(run)]


def _prior(run: Run) -> Path | None:
    """The run's prior, as it was."""
    prior = run.prior
    if prior is not None:
        digest, stored = solution_digest(Run.open(prior).folder), run.model.get("prior_sha256")
        if digest != stored:
            raise InputError(f"{prior}, the prior of {run.folder}, has changed since")
    return prior


def _difference(name: str, run: Path, again: Path) -> Difference | None:
    paths = run / name, again / name
    if not all(path.is_file() for path in paths):
        there = next(path for path in paths if path.is_file())
        which = "is only in the run" if there == paths[0] else "is missing from the run"
        count = len(_entries(there))
        return Difference(name, count, count, most=f"the file {which}")
    was, now = map(_entries, paths)
    names = list(dict.fromkeys([*was, *now]))
    apart = {n: a for n in names if (a := _apart(was.get(n), now.get(n)))[0] > 0}
    if not apart:
        return None
    most = max(apart, key=lambda n: apart[n][0])
    return Difference(
        file=name, entries=len(apart), of=len(names), most=most, was=apart[most][1],
        now=apart[most][2],
    )  # fmt: skip


def _entries(path: Path) -> dict[str, Any]:
    """What a file of a run holds, by name, lists of numbers as arrays."""
    if path.suffix == ".npz":
        with np.load(path) as stored:
            return {name: stored[name] for name in stored.files}
    if path.suffix == ".parquet":
        return dict(read_table(path))
    if path.suffix == ".json":
        data = json.loads(path.read_text(encoding="utf-8"))
        return dict(_leaves({key: value for key, value in data.items() if key != TOOK}))
    return dict(_leaves(read_yaml(path)[0]))


def _leaves(data: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    if isinstance(data, Mapping) and data:
        for key, value in data.items():
            yield from _leaves(value, f"{name}.{key}" if name else str(key))
    elif isinstance(data, list) and not all(isinstance(x, int | float) for x in data):
        for i, value in enumerate(data):
            yield from _leaves(value, f"{name}[{i}]")
    else:
        yield name, np.array(data) if isinstance(data, list) else data


def _apart(was: Any, now: Any) -> tuple[float, Any, Any]:
    """How far two entries are apart as a share of the larger, and what they are there; infinitely
    where they are no two numbers, or not as many."""
    a, b = np.asarray(was), np.asarray(now)
    if a.shape != b.shape or any(x.dtype.kind not in "iufb" for x in (a, b)):
        same = a.shape == b.shape and bool(np.all(a == b))
        return (0.0, None, None) if same else (np.inf, *map(_told, (was, now)))
    a, b = a.astype(float).ravel(), b.astype(float).ravel()
    same = (a == b) | (np.isnan(a) & np.isnan(b))
    if same.all():
        return 0.0, None, None
    a, b = np.where(same, 1.0, a), np.where(same, 1.0, b)
    apart = np.nan_to_num(np.abs(a - b) / np.fmax(np.abs(a), np.abs(b)), nan=np.inf)
    at = int(apart.argmax())
    return float(apart[at]), float(a[at]), float(b[at])


def _told(entry: Any) -> Any:
    return f"{entry.dtype} {entry.shape}" if isinstance(entry, np.ndarray) else entry


def _moves(run: Run, again: Run) -> Iterator[tuple[str, float]]:
    """By how many sigmas of the run each of its estimates is apart from the same made again."""
    pairs = [("", run.solution.shared, again.solution.shared)]
    others = again.solution.recordings
    pairs += [(f"{n}/", part, others.get(n, Part())) for n, part in run.solution.recordings.items()]
    for prefix, part, other in pairs:
        for name in (n for n in part.frames if n in other.frames):
            frame, T_now = part.frames[name], other.frames[name].T_parent_child
            R_t, t = frame.T_parent_child[:3, :3].T, frame.T_parent_child[:3, 3]
            # Of a pose that is the same both are 0 exactly, which no product of inverses is.
            apart = np.r_[se3.so3_log(R_t @ T_now[:3, :3]), R_t @ (T_now[:3, 3] - t)]
            yield from _sigmas(prefix + name, _DOF, apart, np.r_[frame.sigma_rad, frame.sigma_m])
        for name in (n for n in part.effects if n in other.effects):
            was, now = part.effects[name], other.effects[name]
            if was.names == now.names:
                apart = now.estimate - was.estimate
                yield from _sigmas(prefix + name, was.names, apart, was.sigma)


def _sigmas(
    variable: str, names: Sequence[str], apart: np.ndarray, sigma: np.ndarray
) -> Iterator[tuple[str, float]]:
    for name, by, width in zip(names, np.abs(apart), sigma, strict=True):
        if width > 0:
            yield f"{variable}.{name}", float(by / width)
