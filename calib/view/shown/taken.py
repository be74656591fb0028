"""Files that are taken away from a page: what its plot shows, and what a run has found."""

from __future__ import annotations

import csv
import io
import zipfile
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from calib.exporters import export
from calib.runs.run import Run
from calib.view.scene import Points
from calib.view.shown.colours import column
from calib.view.shown.columns import STOP
from chains import escape

BEAM = (STOP, "ring", "column")  # what says which beam a row is
LONG_AGO = (1980, 1, 1, 0, 0, 0)  # of files in an archive: the same run gives the same bytes


def beams_csv(points: Points, rows: np.ndarray, names: Sequence[str], lit: np.ndarray) -> bytes:
    """Some columns of some beams (n,), as the plot shows them: with their units, and for each beam
    1 or 0 for an inlier, and for one that is lit (N,)."""
    wanted = [n for n in dict.fromkeys((*BEAM, *names)) if n in points.columns]
    table = [points.columns[n][rows].astype(float) * column(n).scale for n in wanted]
    table += [points.inlier[rows].astype(float), lit[rows].astype(float)]
    heading, body = io.StringIO(), io.StringIO()
    texts = [*(column(n).heading for n in wanted), "inlier", "lit"]
    csv.writer(heading, lineterminator="\n").writerow(map(escape.csv_cell, texts))
    np.savetxt(body, np.stack(table, axis=1), "%.7g", delimiter=",")
    return (heading.getvalue() + body.getvalue().replace("nan", "")).encode()


def extrinsics_zip(run: Run) -> bytes:
    """What ``rigcal export`` writes of a run, in all formats, as one archive.

    Raises:
        InputError: the run has not converged.
    """
    packed = io.BytesIO()
    with TemporaryDirectory() as scratch, zipfile.ZipFile(packed, "w") as archive:
        for file in sorted(export(run, Path(scratch) / "extrinsics").files):
            entry = zipfile.ZipInfo(f"extrinsics/{file.name}", LONG_AGO)
            archive.writestr(entry, file.read_bytes(), zipfile.ZIP_DEFLATED)
    return packed.getvalue()
