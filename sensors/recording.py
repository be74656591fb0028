"""The recording folder: what every instrument delivered, validated once, scans read lazily.

This is the pyarrow door: `read_table` and `write_table` serve whoever needs a Parquet file.
"""

import io
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import NDArray

from chains import remote
from chains.errors import InputError
from chains.sizes import check_claim, most
from sensors.documents import write_atomically
from sensors.holds import Columns, average_hold
from sensors.numbers import data_frame
from sensors.stops import POSE, Array, CsvTable, Targets, level_columns, read_targets

if TYPE_CHECKING:
    import pandas
    import pyarrow
    from pyarrow.parquet import ParquetFile

_PARTS = ("rig.yaml", "*.urdf", "stops.csv", "targets.csv", "scans/*.parquet", "reference/*")
_SCANS = "scans/"
_BATCH_ROWS = 1 << 20  # read at once: bounds the memory
_FARTHEST_M = 200.0  # median range, as of clouds that are imported: see `sensors.readers.clouds`
_LARGEST_SPREAD_M = 0.5  # median of a hold, a choice: of LiDARs 0.01 to 0.05 m, in mm 10 to 50
_KINDS = {"x": "f", "y": "f", "z": "f", "ring": "iu", "column": "iu"}


@dataclass(frozen=True)
class Scan:
    """What the LiDAR returned at one stop: N points in the LiDAR's own frame."""

    xyz_m: Array
    """(N, 3) m, as the driver gives them, or their mean over the hold."""
    ring: NDArray[np.int64]
    """(N,) laser, from 0."""
    column: NDArray[np.int64]
    """(N,) azimuth index."""
    intensity: Array
    """(N,) in the sensor's units; NaN = not recorded."""
    count: Array
    """(N,) returns averaged into the point."""
    range_std_m: Array
    """(N,) standard deviation of one return; NaN = unknown."""
    extra: dict[str, Array]
    """Every other numeric column, each (N,): per-point covariates."""

    def columns(self) -> Columns:
        """All columns by the names of the scan file, each (N,): x y z in m, ring, column, …"""
        return {
            **dict(zip("xyz", self.xyz_m.T, strict=True)),
            "ring": self.ring,
            "column": self.column,
            "intensity": self.intensity,
            "count": self.count,
            "range_std_m": self.range_std_m,
            **self.extra,
        }

    def to_arrow(self) -> "pyarrow.Table":
        """The points as a `pyarrow.Table`, a row each; columns as of `columns`."""
        import pyarrow

        return pyarrow.table({n: np.ascontiguousarray(c) for n, c in self.columns().items()})

    def to_pandas(self) -> "pandas.DataFrame":
        """The points as a `pandas.DataFrame`; InputError where pandas is not installed."""
        return data_frame(self.columns())

    def to_open3d(self) -> Any:
        """The points as an `open3d.t.geometry.PointCloud` with every column as an attribute.

        InputError where Open3D cannot be loaded.
        """
        from sensors.meshes import open3d_cloud

        try:
            return open3d_cloud(self.columns())
        except ImportError as error:
            raise InputError(f"to_open3d needs open3d: pip install open3d ({error})") from None


@dataclass(frozen=True)
class RecordedStops:
    """K stops of one rig; `RecordedStops.open` reads one."""

    folder: Path
    stops: list[str]
    """(K,) unique names, which name the scan files too."""
    location: NDArray[np.str_]
    time_s: Array
    """(K,) of the stops; NaN throughout where stops.csv has no such column."""
    joints: Array
    """(K, J) what the encoders reported, rad or m; NaN = no encoder says."""
    bodies: dict[str, Array]
    """Per tracked body (K, 7) x y z [m] qw qx qy qz; NaN = not seen; a point has only NaN for q."""
    base_guess: Array | None
    """(K, 7) rough pose of the base in the reference's frame."""
    covariates: dict[str, Array]
    """Every other numeric column of the stops, each (K,); NaN = not recorded."""
    targets: Targets | None
    has_scan: NDArray[np.bool_]
    """(K,) whether there is a scan file."""
    rings: int | None
    """How many rings the sensor has, None = not checked."""
    joint_names: tuple[str, ...] = ()
    """(J,) of the columns of `joints`."""
    levels: dict[str, Array] = field(default_factory=dict)
    """Per frame with an accelerometer (K, 3) unit vectors along what it felt; NaN = not read."""

    @classmethod
    def open(
        cls,
        folder: str | Path,
        joint_names: Sequence[str],
        bodies: Sequence[str],
        rings: int | None = None,
        levels: Sequence[str] = (),
        unread: Sequence[str] = (),
    ) -> Self:
        """Read and check the stops and targets of a recording, without reading any scan.

        Raises InputError, one sentence with file, row and column, for what is missing, has the
        wrong type, or cannot be: half a pose, a quaternion far from unit length (nearly unit ones
        are normalised), degrees for radians, millimetres for metres, a level that was not at rest.
        """
        folder = Path(folder)
        path = folder / "stops.csv"
        if not path.exists():
            raise InputError(f"{path} does not exist; a recording has a row for every stop there")
        table = CsvTable(path, key="stop", text=("location",))
        stops = table.names()
        return cls(
            folder=folder,
            stops=stops,
            location=table.locations(),
            time_s=table.times("time_s"),
            joints=table.joints(joint_names, unread),
            bodies={body: table.pose(body) for body in bodies},
            levels={frame: table.level(frame) for frame in levels},
            base_guess=table.pose("base_guess") if "base_guess.x" in table else None,
            covariates=table.rest(),
            targets=read_targets(folder / "targets.csv"),
            has_scan=_find_scans(folder / "scans", stops),
            rings=rings,
            joint_names=tuple(joint_names),
        )

    @property
    def timed(self) -> bool:
        """Whether anything says when the stops were made."""
        return bool(np.isfinite(self.time_s).all())

    def to_pandas(self) -> "pandas.DataFrame":
        """The stops as a `pandas.DataFrame` with the columns of stops.csv, in m, rad and s.

        InputError where pandas is not installed.
        """
        poses = self.bodies | ({} if self.base_guess is None else {"base_guess": self.base_guess})
        return data_frame(
            {
                "stop": np.array(self.stops),
                "location": self.location,
                **({"time_s": self.time_s} if self.timed else {}),
                **dict(zip(self.joint_names, self.joints.T, strict=True)),
                **{
                    f"{body}.{part}": pose[:, i]
                    for body, pose in poses.items()
                    for i, part in enumerate(POSE)
                    if i < 3 or not np.isnan(pose[:, 3:]).all()
                },
                **{
                    column: felt[:, i]
                    for frame, felt in self.levels.items()
                    for i, column in enumerate(level_columns(frame))
                },
                **self.covariates,
            }
        )

    def scan(self, stop: int) -> Scan:
        """Read the scan of one stop, by its index, as `read_scan` does."""
        return read_scan(self.folder / "scans" / f"{self.stops[stop]}.parquet", self.rings)

    def digest(self) -> str:
        """Return the SHA-256 (hex) of the names and contents of the recording's files."""
        return digest(self.folder)


def digests(folder: str | Path) -> remote.Digests:
    """Of the names and contents of a recording's files; and stop -> that of its scan."""
    whole, each = remote.digests(Path(folder), _PARTS)
    return remote.Digests(whole, {Path(n).stem: d for n, d in each.items() if n.startswith(_SCANS)})


def digest(folder: str | Path) -> str:
    """The SHA-256 (hex) of the names and contents of a recording's files."""
    return digests(folder).whole


def read_scan(path: str | Path, rings: int | None = None) -> Scan:
    """Read one scan; a raw hold is averaged per direction.

    Points that are not finite, or lie in the origin, are no returns and left out. Raises
    InputError for a file that is missing or empty, lacks a column or has one of the wrong type,
    and for rings (0 to `rings` - 1) or ranges that the sensor cannot have delivered.
    """
    with _open_parquet(path := Path(path)) as file:
        names = _check_types(path, file)
        if "scan" in names:
            columns = average_hold(lambda wanted: _batches(path, file, wanted), names)
        else:
            columns = _columns(path, file.read(names))
    return _check_scan(path, columns, rings)


def read_table(path: str | Path) -> dict[str, np.ndarray]:
    """Read all columns of a Parquet file; InputError where it is missing or is none."""
    with _open_parquet(Path(path)) as file:
        return _columns(Path(path), file.read())


def write_table(path: str | Path, columns: Mapping[str, np.ndarray]) -> None:
    """Write columns of equal length to a Parquet file (zstd), whole or not at all."""
    with write_atomically(path) as temporary:
        temporary.write_bytes(table_bytes(columns))


def table_bytes(columns: Mapping[str, np.ndarray]) -> bytes:
    """Columns of equal length as a Parquet file (zstd) holds them."""
    import pyarrow.parquet

    table = pyarrow.table({name: _arrow(values) for name, values in columns.items()})
    pyarrow.parquet.write_table(table, file := io.BytesIO(), compression="zstd")
    return file.getvalue()


def unpack_zstd(data: bytes, size: int) -> bytes:
    """Decompress zstd data whose plain size is known; ValueError where it is no such data."""
    import pyarrow

    if size > most(len(data)):
        raise ValueError(f"{len(data)} bytes claim to be {size}")
    try:
        return pyarrow.decompress(data, decompressed_size=size, codec="zstd", asbytes=True)
    except OSError as error:
        raise ValueError(str(error)) from None


@contextmanager
def _open_parquet(path: Path) -> Iterator["ParquetFile"]:
    """The file, while it is read: whatever is wrong in it is one sentence."""
    import pyarrow
    import pyarrow.parquet

    try:
        with pyarrow.parquet.ParquetFile(remote.fetched(path)) as file:
            rows, columns = file.metadata.num_rows, file.metadata.num_columns
            check_claim(path, 8 * rows * columns, f"{rows} rows of {columns} columns")
            yield file
    except FileNotFoundError:
        raise InputError(f"{path} does not exist") from None
    except (pyarrow.ArrowException, OSError, MemoryError, UnicodeDecodeError) as error:
        raise InputError(f"{path} is not a Parquet file: {str(error).splitlines()[0]}") from None


def _columns(path: Path, table: "pyarrow.Table | pyarrow.RecordBatch") -> Columns:
    """Turn a table or batch into numpy columns; an index must have a value in every row."""
    for name in ("ring", "column", "scan"):
        if name in table.schema.names and table[name].null_count:
            raise InputError(f"{path}: column {name} has empty cells; every return needs one")
    arrays = {name: _numpy(table[name]) for name in table.schema.names}
    return {n: _text(path, n, a) if a.dtype == object else a for n, a in arrays.items()}


def _text(path: Path, name: str, values: NDArray[Any]) -> NDArray[np.str_]:
    """Values as text, each of which takes as much room as the longest."""
    longest = max((len(str(value)) for value in values), default=0)
    check_claim(path, 4 * longest * len(values), f"{len(values)} texts as long as one of {name}")
    return values.astype(np.str_)


def _numpy(column: "pyarrow.ChunkedArray | pyarrow.Array") -> NDArray[Any]:
    """A column as an array; numbers without gaps not by pyarrow's way, which imports pandas where
    there is one."""
    chunks = getattr(column, "chunks", [column])
    if chunks and not column.null_count and _kind(column.type) in ("f", "i", "u"):
        return np.concatenate([np.from_dlpack(chunk) for chunk in chunks])
    return column.to_numpy(zero_copy_only=False)


def _arrow(values: NDArray[Any]) -> "pyarrow.Array":
    """An array as a column, the same way back; of text, too."""
    import pyarrow

    values = np.ascontiguousarray(values)
    if values.dtype.kind == "U":
        texts = [text.encode() for text in values.tolist()]
        ends = np.cumsum([0, *map(len, texts)], dtype=np.int32)
        buffers = pyarrow.py_buffer(ends), pyarrow.py_buffer(b"".join(texts))
        return pyarrow.StringArray.from_buffers(len(texts), *buffers)
    if values.dtype.kind not in "fiu":
        return pyarrow.array(values)
    kind = pyarrow.from_numpy_dtype(values.dtype)
    return pyarrow.Array.from_buffers(kind, len(values), [None, pyarrow.py_buffer(values)])


def _batches(path: Path, file: "ParquetFile", names: Sequence[str]) -> Iterator[Columns]:
    for batch in file.iter_batches(_BATCH_ROWS, columns=list(names)):
        yield _columns(path, batch)


def _find_scans(folder: Path, stops: Sequence[str]) -> NDArray[np.bool_]:
    """Say which stops have a scan; scans of which none belongs to a stop are a mistake."""
    names = {path.stem for path in remote.files(folder, "*.parquet")}
    if names and names.isdisjoint(stops):
        raise InputError(
            f"{folder} holds {min(names)}.parquet, but nothing named after a stop of stops.csv,"
            f" such as {stops[0]}.parquet; name scans after their stops"
        )
    return np.array([stop in names for stop in stops])


def _check_types(path: Path, file: "ParquetFile") -> list[str]:
    """Return the numeric columns, after checking that those every scan needs are among them. The
    index of a pandas frame is none of them: it numbers rows."""
    kinds = {field.name: _kind(field.type) for field in file.schema_arrow}
    for name, kind in _KINDS.items():
        if name not in kinds:
            raise InputError(f"{path}: column {name} is missing; a scan has {', '.join(_KINDS)}")
        if kinds[name] == "" or kinds[name] not in kind:
            stored = file.schema_arrow.field(name).type
            should = "float32, in metres" if kind == "f" else "uint16"
            raise InputError(f"{path}: column {name} is {stored}; it should be {should}")
    return [name for name, kind in kinds.items() if kind and not name.startswith("__index_level_")]


def _kind(arrow_type: "pyarrow.DataType") -> str:
    """Return numpy's kind of a numeric column ('f', 'i', 'u'), '' for others."""
    try:
        kind = np.dtype(arrow_type.to_pandas_dtype()).kind
    except (NotImplementedError, TypeError):
        return ""
    return kind if kind in "fiu" else ""


def _check_scan(path: Path, columns: Columns, rings: int | None) -> Scan:
    xyz = np.stack([columns.pop(axis) for axis in "xyz"], axis=-1).astype(np.float64)
    range_m = np.linalg.norm(xyz, axis=-1)
    seen = np.isfinite(range_m) & (range_m > 0)
    check_ranges(path, range_m[seen])
    ring, column = (columns.pop(name)[seen].astype(np.int64) for name in ("ring", "column"))
    wrong = ring[(ring < 0) | (ring >= (rings or np.inf))]
    if wrong.size:
        last = "" if rings is None else f" to {rings - 1}"
        raise InputError(f"{path}: ring {wrong[0]} is not in the sensor's 0{last}; count from 0")
    extra = {name: values[seen].astype(np.float64) for name, values in columns.items()}
    unknown = np.full(len(ring), np.nan)
    count = extra.pop("count", np.ones(len(ring)))
    if not (count >= 1).all():
        raise InputError(f"{path}: count is below 1; leave out directions without a return")
    intensity, spread = (extra.pop(name, unknown) for name in ("intensity", "range_std_m"))
    _check_spread(path, spread[np.isfinite(spread)])
    return Scan(
        xyz_m=xyz[seen],
        ring=ring,
        column=column,
        intensity=intensity,
        count=count,
        range_std_m=spread,
        extra=extra,
    )


def _check_spread(path: Path, spread_m: Array) -> None:
    if (spread_m < 0).any():
        raise InputError(f"{path}: range_std_m is negative; leave it empty where it is unknown")
    if spread_m.size and np.median(spread_m) > _LARGEST_SPREAD_M:
        raise InputError(
            f"{path}: half of range_std_m is above {np.median(spread_m):g} m, which looks like"
            " millimetres; it is in metres"
        )


def check_ranges(path: Path, range_m: Array) -> None:
    """Refuse ranges (N,) of returns that no LiDAR has, in metres; InputError."""
    if not range_m.size:
        raise InputError(f"{path} has no returns; remove the file if the stop was not scanned")
    if np.median(range_m) > _FARTHEST_M:
        far = f"half of the points are beyond {np.median(range_m):.0f} m"
        raise InputError(f"{path}: {far}, which looks like millimetres; x, y and z are in metres")
