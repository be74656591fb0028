"""What a run's files must hold to be read: checked where they are opened, not where they are used.

A file may have been cut short, edited, or made by somebody else.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pydantic

from calib.problem.prior import JointPrior
from calib.results.solution import Solution
from chains.errors import InputError
from sensors import documents, numbers
from sensors.documents import Document, Format, Number, read_yaml, validate

FIT_AGAIN = "fit the run again"
RUN_FORMAT = Format(
    kind="run",
    newest=2,  # 1: without a number, steps, and the hash of a prior; ways are absolute
)


class _Part(Document):
    """Some keys of a document, which may have others."""

    model_config = pydantic.ConfigDict(extra="ignore", frozen=True, allow_inf_nan=False)


class _Kinds(_Part):
    nominal: Number | None
    fit: Number | None
    held_out: Number | None


class _Rms(_Kinds):
    noise_floor: Number | None


class _Wider(_Part):
    median: Number
    most: Number
    parameter: str


class _Summary(_Part):
    points: int
    stops: int
    residual: str
    rms_mm: _Rms
    mean_mm: _Kinds
    std_mm: _Kinds
    misfit: dict[str, Number | None]
    sigmas_widened_by: Number
    intervals_wider_by: _Wider | None = None
    iterations: int
    converged: bool


class _Recording(_Part):
    path: str
    rig: str
    sha256: str


class _Model(_Part):
    recordings: list[_Recording] = pydantic.Field(min_length=1)
    effects: list[str | dict]
    fixed: list[str]
    hold_out: str
    folds: int
    prior: str | None
    grown_from: str | None
    versions: dict[str, str]
    without: list[str] = []  # noqa: RUF012 - pydantic copies it
    beams: int | None = pydantic.Field(None, ge=1)


def read_model(path: Path) -> dict[str, Any]:
    """A run's model.yaml.

    Raises:
        InputError: it is no YAML, of a format that is not read, or lacks a key, or has something
            else there.
    """
    data, marks = read_yaml(path)
    known = data.get("versions") if isinstance(data, dict) else None
    RUN_FORMAT.check(data, path, str(known.get("rigcal", "")) if isinstance(known, dict) else "")
    return _checked(_Model, data, path, marks)


def read_summary(path: Path) -> dict[str, Any]:
    """A run's summary.json; raises as `read_model`."""
    return _checked(_Summary, read_json(path), path, {})


def read_json(path: Path) -> Any:
    """A JSON document.

    Raises:
        InputError: it is missing, or none.
    """
    try:
        return documents.read_json(path)
    except InputError as error:
        raise InputError(f"{error}; {FIT_AGAIN}") from None


def _checked(model: type[_Part], data: Any, path: Path, marks: dict) -> dict[str, Any]:
    try:
        validate(model, data, path, marks)
    except InputError as error:
        raise InputError(
            f"{error}; it was written by another version of rigcal, or edited: {FIT_AGAIN}"
        ) from None
    return data


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """The arrays of an .npz file, by name.

    Raises:
        InputError: it is missing, broken, or claims more than it holds.
    """
    try:
        stored = numbers.read_arrays(path)
        if isinstance(stored, dict):
            return stored
        why = f"{path} is one array, where arrays with names are wanted"
    except InputError as error:
        why = str(error)
    raise InputError(f"{why}; {FIT_AGAIN}")


def write_covariance(
    path: Path, solution: Solution, data: Sequence[str], prior: JointPrior | None
) -> None:
    """Put into a file how well all is known together, and what that rests on: `data`, and errors
    that other runs may share, unless the prior does not tell of its own."""
    arrays = {"covariance": solution.covariance, "graph": solution.graph}
    arrays |= {"names": np.array(solution.names), "rests_on": np.array(data, "S64")}
    told = prior is None or prior.common is not None
    np.savez(path, **arrays, **(solution.common.arrays if told else {}))
