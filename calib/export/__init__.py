"""A run for others to use. A new format is a function and a line in `FORMATS`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from calib.export.yaml_extrinsics import read_extrinsics, write_extrinsics
from calib.run import Run
from chains.errors import InputError

__all__ = ["FORMATS", "export", "read_extrinsics"]

FORMATS: dict[str, Callable[[Run, Path], list[Path]]] = {"yaml": write_extrinsics}


def export(run: Run, out: Path | str, formats: Sequence[str] = ()) -> list[Path]:
    """Write a run in the formats named, all of them if none is.

    Args:
        run: what to write.
        out: the folder to write to; made if need be, files of the same name are replaced.
        formats: names in `FORMATS`.

    Returns:
        The files written.

    Raises:
        InputError: an unknown format, or `out` is a file.
    """
    out = Path(out)
    for name in formats:
        if name not in FORMATS:
            raise InputError(f"--format {name}: that is none; there are {', '.join(FORMATS)}")
    if out.exists() and not out.is_dir():
        raise InputError(f"{out} is a file; give a folder to export to")
    chosen = dict.fromkeys(formats or FORMATS)
    return [file for name in chosen for file in FORMATS[name](run, out)]
