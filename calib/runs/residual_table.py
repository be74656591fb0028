"""Every row's residual as a table per stop, as a run keeps them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from calib.diagnosis.formulas.seen import ColumnRanges
from calib.forward import Values
from calib.linear.parallel import over_stops
from calib.problem.model import Source, recording_names
from calib.residuals.beams import Association, Rows
from calib.residuals.scan import ScanStop
from calib.results.errors import Errors, row_errors
from calib.results.misfit import InstrumentRows
from calib.solve.estimate import Estimate
from calib.solve.fit import Progress
from sensors.documents import write_atomically
from sensors.recording import table_bytes, write_table

_FIRST = ("ring", "column", "range_m", "incidence_rad", "azimuth_rad", "elevation_rad", "intensity")
UNSEEN_FOLDER = "_held_out"  # folder of those stops as a fit without them predicts them
_PLACES = ("label", "surface", "region", "patch", "plane")


def table_path(folder: Path, scan: ScanStop, sources: Sequence[Source]) -> Path:
    """Where the table of a stop is: STOP.parquet; of several recordings RIG.STOP.parquet, with the
    recording's number in between where they are of one rig."""
    if len(sources) == 1:
        return folder / f"{scan.name}.parquet"
    return folder / f"{recording_of(scan, sources)}.{scan.name}.parquet"


def recording_of(scan: ScanStop, sources: Sequence[Source]) -> str:
    """The name of the recording that a scan is of; see `recording_names`."""
    pairs = zip(sources, recording_names(sources), strict=True)
    return next(name for source, name in pairs if source.recording is scan.recording)


def write_rows(folder: Path, rows: Mapping[str, InstrumentRows]) -> None:
    """Write the rows of instruments and priors, by kind, beside those of beams.

    Their files begin with an underscore, which readers of a folder of tables take as not of it.
    """
    for kind, some in rows.items():
        write_table(folder / f"_{kind}.parquet", some.table())


def write_residuals(
    folder: Path, estimate: Estimate, seen: ColumnRanges, progress: Progress
) -> dict[tuple[str, str], Errors]:
    """Write every beam's residual, stop by stop, and show `seen` what effects look at; sums of
    the residuals, by recording and stop."""
    folder.mkdir(exist_ok=True)
    found, scans, sources = {}, estimate.scans, estimate.problem.sources
    work = partial(_of_stop, estimate.values, seen.fresh())
    for i, stop in enumerate(over_stops(work, scans, estimate.associations)):
        progress("writing residuals", i, len(scans))
        table, looked_at, found[recording_of(scans[i], sources), scans[i].name] = stop
        seen.include(looked_at.ends)
        write_stop(folder, sources, scans[i], table)
    return found


def _of_stop(
    values: Values, seen: ColumnRanges, scan: ScanStop, association: Association
) -> tuple[bytes, ColumnRanges, Errors]:
    """The table of a stop, what `seen` has then seen, and sums."""
    rows, seen = scan.rows(values, association), seen.fresh()
    seen.look(rows.view.columns, rows.usable)
    return residual_bytes(rows), seen, row_errors(rows)


def write_stop(folder: Path, sources: Sequence[Source], scan: ScanStop, table: bytes) -> None:
    """Write a stop's table, as `residual_bytes` gives it."""
    with write_atomically(table_path(folder, scan, sources)) as temporary:
        temporary.write_bytes(table)


def residual_bytes(rows: Rows) -> bytes:
    """The table of a stop as its file holds it."""
    return table_bytes(residual_table(rows))


def residual_table(rows: Rows) -> dict[str, np.ndarray]:
    """The usable rows of a stop as columns (N,).

    What effects look at, every further column that the recording's points carry included; then
    ``residual_m``, ``sigma_m`` with the reference's error in it, and the robust ``weight``.
    """
    view = rows.view
    names = [n for n in (*_FIRST, *_PLACES) if n in view.columns]
    further = (n for n, column in view.columns.items() if not callable(column))
    # Of a scan of one point, columns of stops are as long as those of points; names are none.
    numbers = (n for n in further if n not in names and view[n].dtype.kind in "biuf")
    names += [n for n in numbers if np.shape(view[n]) == (view.rows,)]
    columns = {n: view[n] for n in names} | {
        "residual_m": rows.residual_m,
        "sigma_m": np.hypot(rows.sigma_m, rows.reference_sigma_m),
        "weight": rows.weight,
    }
    return {n: _compact(column[rows.usable]) for n, column in columns.items()}


def _compact(column: np.ndarray) -> np.ndarray:
    return column.astype(np.int32 if column.dtype.kind in "iu" else np.float32)


def beam_ends(columns: Mapping[str, np.ndarray], beam_origin_m: np.ndarray) -> np.ndarray:
    """Where beams end (N, 3) m, in the LiDAR's frame: origin + (predicted + residual) direction.

    Args:
        columns: of a table of residuals.
        beam_origin_m: (2,) of the LiDAR, as `sensors.lidar.beams` has it.
    """
    azimuth, elevation = (columns[n].astype(float) for n in ("azimuth_rad", "elevation_rad"))
    range_m = columns["range_m"].astype(float) + columns["residual_m"]
    radial, tangential = beam_origin_m
    c, s = np.cos(azimuth), np.sin(azimuth)
    flat = radial + range_m * np.cos(elevation)
    z = range_m * np.sin(elevation)
    return np.stack([flat * c - tangential * s, flat * s + tangential * c, z], axis=1)
