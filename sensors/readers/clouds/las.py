"""LAS and LAZ files. This is the laspy door."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from chains.errors import InputError
from chains.sizes import check_claim, check_stored
from sensors.readers.base import Columns


def _check_header(path: Path, header: Any) -> None:
    """Refuse a header that claims more points than the file can hold."""
    claimed = header.point_count * header.point_format.size
    what = f"{header.point_count} points of {header.point_format.size} bytes"
    if header.are_points_compressed:
        check_claim(path, claimed, what)
    else:
        check_stored(path, header.offset_to_point_data + claimed, what)


def read_las_points(path: str | Path) -> Columns:
    """Read the points of a LAS or LAZ file: x y z in its own unit, and every other dimension.

    Raises InputError where the file is missing, empty, cut short or none, and where laspy, or
    lazrs for LAZ, is not installed.
    """
    try:
        import laspy
    except ImportError:
        raise InputError("reading LAS needs laspy: pip install 'rigcal[las]'") from None
    path = Path(path)
    try:
        if not path.stat().st_size:
            raise InputError(f"{path} is empty (0 bytes); a LAS file was wanted")
        with laspy.open(path) as file:
            _check_header(path, file.header)
            las = file.read()
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}") from None
    except InputError:
        raise
    except Exception as error:  # laspy, lazrs and numpy each have their own for a broken file
        raise InputError(f"{path} is no whole LAS file: {error}") from None
    if len(las.points) != las.header.point_count:
        raise InputError(
            f"{path} should hold {las.header.point_count} points and holds {len(las.points)}; get"
            " the whole file"
        )
    names = [n for n in las.point_format.dimension_names if n not in ("X", "Y", "Z")]
    columns = {axis: np.asarray(las[axis]) for axis in "xyz"}
    return columns | {n: v for n in names if np.ndim(v := np.asarray(las[n])) == 1 and v.any()}
