"""Imports the public UR10 data set of example 06 as recordings: an arm, a tracker, no LiDAR.

Its tables are separated by semicolons, have decimal commas, a row for every stop, millimetres and
Euler angles about the moved axes. The times of series D were ruined by a spreadsheet.
"""

from pathlib import Path

from calib.intake import Choices, import_files
from sensors.readers.base import Options

HERE = Path(__file__).parent
SERIES = {"A": "Series_A/measurements_grid.csv", "D": "Series_D/measurements_iso_cubes.csv"}
COLUMNS = {
    "time_s": "Timestamp",
    "temperature_c": "measurement_temperature",
    "mount_markers.*": "measurement_*[mm]",
}


def recording(data: Path, series: str, folder: Path, most: int | None = None) -> Path:
    """Import a series; of more poses than `most` some, evenly spread."""
    given = [("table", [data / SERIES[series]]), ("dh", [HERE / "ur10.yaml"])]
    choices = Choices(HERE / "ur10_rig.yaml", blocks=12, most_stops=most)
    return import_files(given, folder, Options(columns=COLUMNS, euler="XYZ"), choices).folder
