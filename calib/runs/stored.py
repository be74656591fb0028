"""What a run's files must hold to be read: checked where they are opened, not where they are used.

A file may have been cut short, edited, or made by somebody else.
"""

from __future__ import annotations

import json
import math
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pydantic

from chains.errors import InputError
from sensors.documents import Document, Number, read_text, read_yaml, validate

AGAIN = "fit the run again"
_DEFLATE_MOST = 1032  # bytes that one byte of DEFLATE can stand for (zlib's technical details)


class _Part(Document):
    """Some keys of a document, which may have others."""

    model_config = pydantic.ConfigDict(extra="ignore", frozen=True, allow_inf_nan=False)


class _Kinds(_Part):
    nominal: Number | None
    fit: Number | None
    held_out: Number | None


class _Rms(_Kinds):
    noise_floor: Number | None


class _Summary(_Part):
    points: int
    stops: int
    residual: str
    rms_mm: _Rms
    mean_mm: _Kinds
    std_mm: _Kinds
    misfit: dict[str, Number | None]
    sigmas_widened_by: Number
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


def read_model(path: Path) -> dict[str, Any]:
    """A run's model.yaml.

    Raises:
        InputError: it is no YAML, or lacks a key, or has something else there.
    """
    data, marks = read_yaml(path)
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
        return json.loads(read_text(path))
    except (ValueError, RecursionError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path} is no JSON text ({error}); {AGAIN}") from None


def _checked(model: type[_Part], data: Any, path: Path, marks: dict) -> dict[str, Any]:
    try:
        validate(model, data, path, marks)
    except InputError as error:
        raise InputError(
            f"{error}; it was written by another version of rigcal, or edited: {AGAIN}"
        ) from None
    return data


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """The arrays of an .npz file, by name.

    What its headers claim is held against the file before memory is taken for it.

    Raises:
        InputError: it is missing, broken, or claims more than it holds.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            for member in archive.infolist():
                _check_size(archive, member)
        with np.load(path, allow_pickle=False) as stored:
            return {name: stored[name] for name in stored.files}
    except FileNotFoundError:
        raise InputError(f"{path} is missing; {AGAIN}") from None
    except (
        *(OSError, ValueError, EOFError, KeyError, RuntimeError, NotImplementedError),
        *(MemoryError, OverflowError, zipfile.BadZipFile, zlib.error),
    ) as error:
        why = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(f"{path} cannot be read ({why}); {AGAIN}") from None


def _check_size(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> None:
    """Raise ValueError where an array's header, its size in the archive and the bytes that are
    there do not agree."""
    with archive.open(member) as file:
        version = np.lib.format.read_magic(file)
        if version not in ((1, 0), (2, 0)):
            raise ValueError(f"{member.filename} is of format {version}")
        header = getattr(np.lib.format, f"read_array_header_{version[0]}_0")
        shape, _, dtype = header(file)
        claimed = file.tell() + math.prod(shape) * dtype.itemsize
    if claimed != member.file_size:
        raise ValueError(f"{member.filename} claims {claimed} bytes, and has {member.file_size}")
    if member.file_size > _DEFLATE_MOST * (member.compress_size + 1):
        raise ValueError(f"{member.filename} claims {member.file_size} bytes, and cannot have them")
