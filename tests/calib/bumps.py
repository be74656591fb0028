"""A rig whose LiDAR somebody bumped into: recordings before and after, and runs of them."""

import shutil
from pathlib import Path

import numpy as np

from calib.runs.add import add
from calib.runs.calibrate import calibrate
from calib.runs.run import Run
from calib.simulation import load_spec, simulate
from chains import se3

from ..mishaps import Scene
from ..mishaps.scene import XYZ

BUMP = np.array([0, 0, 0.004, 0.003, 0, 0])  # rad, m


def keep(recording: Path, locations: tuple[str, ...]) -> None:
    """Leave only the stops at these locations."""
    with Scene(recording, np.random.default_rng()).sheet("stops.csv") as stops:
        stops.keep([i for i, at in enumerate(stops.columns["location"]) if at in locations])


def bump(recording: Path, by: np.ndarray = BUMP) -> None:
    """Move the LiDAR on its mount: it sees every point from elsewhere."""

    def moved(scan: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        points = se3.apply(se3.exp(-by), np.stack([scan[axis] for axis in XYZ], axis=1))
        return scan | dict(zip(XYZ, points.T, strict=True))

    Scene(recording, np.random.default_rng()).each_scan(moved)


def bumped(out: Path) -> None:
    """Runs a, before; b, after; from_a, after from a; grown, a with one effect more."""
    spec = load_spec("tiny").model_copy(update={"locations": 6, "column_step": 200})
    simulate(spec, out / "before", seed=1)
    shutil.copytree(out / "before", out / "after")
    keep(out / "before", ("L00", "L01", "L02"))
    keep(out / "after", ("L03", "L04", "L05"))
    bump(out / "after")
    calibrate([out / "before"], out / "a", hold_out="none")
    calibrate([out / "after"], out / "b", hold_out="none")
    calibrate([out / "after"], out / "from_a", hold_out="none", prior=out / "a")
    add(Run.open(out / "a"), ["range_scale"], out / "grown")
