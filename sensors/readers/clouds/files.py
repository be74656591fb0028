"""Clouds in files, one for each stop: PCD, PLY, LAS, E57, NumPy, KITTI, nuScenes."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from chains.errors import InputError
from sensors.numbers import read_arrays
from sensors.readers.base import Columns, Contents, Options, Progress, Sweep, Sweeps
from sensors.readers.clouds.fields import Cloud
from sensors.readers.clouds.rings import find_format

Named = tuple[str, Cloud]


def read_pcd(files: Sequence[Path], options: Options, progress: Progress) -> Contents:
    """Read PCD files, a cloud each; rows of an organised cloud may be its rings."""
    return _found(files, _pcd, options, progress)


def read_ply(files: Sequence[Path], options: Options, progress: Progress) -> Contents:
    """Read PLY files, a cloud each."""
    return _found(files, _ply, options, progress)


def read_las(files: Sequence[Path], options: Options, progress: Progress) -> Contents:
    """Read LAS or LAZ files, a cloud each, in the LiDAR's own frame."""
    return _found(files, _las, options, progress)


def read_e57(files: Sequence[Path], options: Options, progress: Progress) -> Contents:
    """Read E57 files, a cloud for each of their scans, in the scanner's own frame."""
    return _found(files, _e57, options, progress)


def read_numpy(files: Sequence[Path], options: Options, progress: Progress) -> Contents:
    """Read .npy and .npz files, a cloud each.

    A structured array, or the arrays of an .npz, are fields by their names; a plain array (N, C)
    or (rows, columns, C) has x y z, then intensity, then ring.
    """
    return _found(files, _numpy, options, progress)


def read_kitti(files: Sequence[Path], options: Options, progress: Progress) -> Contents:
    """Read KITTI's .bin files: x y z intensity as float32, without rings."""
    return _found(files, lambda p: _floats(p, ("x", "y", "z", "intensity")), options, progress)


def read_nuscenes(files: Sequence[Path], options: Options, progress: Progress) -> Contents:
    """Read nuScenes' .pcd.bin files: x y z intensity ring as float32."""
    names = ("x", "y", "z", "intensity", "ring")
    return _found(files, lambda p: _floats(p, names), options, progress)


# ------------------------------------------------------------------------------------ all formats


def _found(
    files: Sequence[Path],
    clouds: Callable[[Path], Iterator[Named]],
    options: Options,
    progress: Progress,
) -> Contents:
    """Look at the first cloud, then hand out each as the one turn of its stop."""
    seen, layout = None, None
    sweeps: list[Sweeps] = []
    for done, path in enumerate(files):
        progress("looking at clouds", done, len(files))
        for number, (name, cloud) in enumerate(clouds(path)):
            if seen is None:
                seen = find_format(path.name, cloud, options)
                layout, first = seen.layout, set(cloud.fields)
            lacking = {*"xyz", *layout.fields.values()} - set(cloud.fields)
            if lacking:
                raise InputError(
                    f"{path} lacks the field {', '.join(sorted(lacking))}, which {files[0]} has;"
                    f" import clouds of one LiDAR together (here are {', '.join(sorted(first))})"
                )
            sweeps.append(_sweeps(name, path, number, clouds, layout.points))
    assert seen is not None  # a source has a file, and an empty file is an InputError
    progress("looking at clouds", len(files), len(files))
    count = f"{len(sweeps)} clouds without a clock, each a stop named after its file"
    return Contents(
        sweeps=tuple(sweeps),
        lidar=seen.lidar,
        understood=(*seen.understood, count),
        odd=seen.odd,
    )


def _sweeps(
    name: str,
    path: Path,
    number: int,
    clouds: Callable[[Path], Iterator[Named]],
    points: Callable[[Cloud], Columns],
) -> Sweeps:
    def read(wanted: NDArray[np.bool_]) -> Iterator[Sweep]:
        if wanted[0]:
            cloud = next(c for k, (_, c) in enumerate(clouds(path)) if k == number)
            yield Sweep(np.nan, points(cloud))

    return Sweeps(name, path.name, np.array([np.nan]), read)


# ------------------------------------------------------------------------------------ each format


def _pcd(path: Path) -> Iterator[Named]:
    from sensors.meshes import read_cloud

    fields = read_cloud(path)
    with open(path, "rb") as file:
        head = file.read(1 << 12)
    size = [re.search(rb"^%s\s+(\d+)" % key, head, re.MULTILINE) for key in (b"HEIGHT", b"WIDTH")]
    shape = (int(size[0][1]), int(size[1][1])) if all(size) else (1, len(fields["x"]))
    yield path.stem, Cloud(fields, shape)


def _ply(path: Path) -> Iterator[Named]:
    from sensors.meshes import read_cloud

    yield path.stem, Cloud(read_cloud(path))


def _las(path: Path) -> Iterator[Named]:
    from sensors.readers.clouds.las import read_las_points

    yield path.stem, Cloud(read_las_points(path))


def _e57(path: Path) -> Iterator[Named]:
    from sensors.readers.clouds.e57 import read_e57_scans

    for number, scan in enumerate(read_e57_scans(path)):
        yield f"{path.stem}_{number:03d}" if number else path.stem, Cloud(scan.columns)


def _numpy(path: Path) -> Iterator[Named]:
    data = read_arrays(path)
    if isinstance(data, np.ndarray):
        fields, shape = _array_fields(path, data)
    else:
        fields, shape = _archive_fields(path, data)
    yield path.stem, Cloud(fields, shape)


def _array_fields(path: Path, data: NDArray) -> tuple[Columns, tuple[int, int] | None]:
    shape = data.shape[:2] if data.ndim == 3 else None
    if data.dtype.names:
        shape = data.shape if data.ndim == 2 else None
        fields = {name: data[name].ravel() for name in data.dtype.names}
    elif data.ndim in (2, 3) and 3 <= data.shape[-1] <= 5 and data.dtype.kind in "fiu":
        values = data.reshape(-1, data.shape[-1])
        names = ("x", "y", "z", "intensity", "ring")
        fields = {name: values[:, k] for k, name in enumerate(names[: values.shape[1]])}
    else:
        raise InputError(
            f"{path} is an array {data.shape} of {data.dtype}; a cloud is (N, 3 to 5) or structured"
        )
    return _with_points(path, fields), shape


def _archive_fields(path: Path, arrays: Columns) -> tuple[Columns, tuple[int, int] | None]:
    if len(arrays) == 1:
        return _array_fields(path, next(iter(arrays.values())))
    for key in ("points", "xyz"):
        if key in arrays and arrays[key].ndim == 2 and arrays[key].shape[1] >= 3:
            points = arrays.pop(key)
            arrays |= {axis: points[:, k] for k, axis in enumerate("xyz")}
    size = len(arrays.get("x", ()))
    return _with_points(path, {k: v for k, v in arrays.items() if v.shape == (size,)}), None


def _with_points(path: Path, fields: Columns) -> Columns:
    if not {*"xyz"} <= fields.keys():
        raise InputError(f"{path} has no x, y and z; its fields are {', '.join(fields) or 'none'}")
    return fields


def _floats(path: Path, names: Sequence[str]) -> Iterator[Named]:
    try:
        data = np.fromfile(path, np.float32)
        size = path.stat().st_size
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}") from None
    if not size or size % (4 * len(names)):
        raise InputError(
            f"{path} has {size} bytes, which is no whole number of points of {4 * len(names)} bytes"
            f" ({', '.join(names)} as float32); get the whole file, or see what it is"
        )
    values = data.reshape(-1, len(names))
    stop = path.stem.removesuffix(".pcd")
    yield stop, Cloud({name: values[:, k] for k, name in enumerate(names)})
