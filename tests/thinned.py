"""Less of a recording that was made at its full size."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np

from sensors.recording import read_table, write_table


def thinned(recording: Path, folder: Path, stops: int, columns: int) -> None:
    """Copy a recording, of so many stops and columns every first."""
    shutil.copytree(recording, folder)
    head, *rows = (folder / "stops.csv").read_text().splitlines()
    (folder / "stops.csv").write_text("\n".join([head, *rows[::stops], ""]))
    for path in (folder / "scans").iterdir():
        table = read_table(path)
        kept = np.isin(table["column"], np.unique(table["column"])[::columns])
        write_table(path, {name: values[kept] for name, values in table.items()})
