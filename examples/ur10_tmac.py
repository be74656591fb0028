"""Imports the public UR10 data set of examples 06 and 09: an arm, a tracker, no LiDAR; and tells
what an arm that one series calibrated is worth in the other.

Its tables are separated by semicolons, have decimal commas, a row for every stop, millimetres and
Euler angles about the moved axes. The times of series D were ruined by a spreadsheet.
"""

from pathlib import Path

import numpy as np

import calib
from calib import problem as problems
from calib.intake import Choices, import_files
from calib.problem.model import Source
from calib.problem.prior import JointPrior
from calib.results.errors import ErrorSize, body_errors
from calib.solve.fit import solve
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


def elsewhere(run: calib.Run, folder: Path) -> ErrorSize:
    """How large errors are on other poses with the arm as a run found it, only base and tool being
    free."""
    problem = problems.build([Source.open(folder)], calib.Model.read(run.model))
    held = [v for n, v in problem.variables.items() if n in run.solution.shared.effects]
    means = {}
    for variable in held:
        effect = run.solution.shared.effects[variable.name]
        known = dict(zip(effect.names, effect.estimate, strict=True))
        means[variable.name] = np.array([known.get(dof, 0.0) for dof in variable.dofs])
    tight = 1e-16 * np.eye(sum(v.dim for v in held))
    solved = solve(problem, JointPrior(held, means, tight))
    return body_errors(problem.blocks, solved.values, None).size
