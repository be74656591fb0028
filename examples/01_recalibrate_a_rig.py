"""A rig was calibrated on Monday. On Friday somebody bumped into its LiDAR. What has moved?

The second fit takes the first as its prior, sigmas and correlations included, and asks of every
link whether its change is larger than the two fits together allow. Links that have not moved keep
Monday's estimates, so that those that moved are determined far better than by either fit alone.

    python examples/01_recalibrate_a_rig.py [FOLDER]
"""

import shutil
import sys
import tempfile
from pathlib import Path

import numpy as np

import calib
from calib.simulation import load_spec
from chains import se3
from sensors.recording import read_table, write_table

BUMP = np.array([0, 0, 0.004, 0.003, 0, 0])  # 4 mrad about the LiDAR's z, 3 mm along its x


def keep(recording: Path, locations: tuple[str, ...]) -> None:
    """Leave only the stops at these locations."""
    head, *stops = (recording / "stops.csv").read_text().splitlines()
    kept = [stop for stop in stops if stop.split(",")[1] in locations]
    (recording / "stops.csv").write_text("\n".join([head, *kept, ""]))


def bump(recording: Path) -> None:
    """Move the LiDAR on its mount: it now sees every point from elsewhere."""
    for path in (recording / "scans").glob("*.parquet"):
        scan = read_table(path)
        points = se3.apply(se3.exp(-BUMP), np.stack([scan[axis] for axis in "xyz"], axis=1))
        write_table(path, scan | dict(zip("xyz", points.T.astype(np.float32), strict=True)))


out = Path(sys.argv[1] if len(sys.argv) > 1 else tempfile.mkdtemp(prefix="rigcal-"))
monday, friday = out / "monday", out / "friday"
calib.simulate(load_spec("tiny").model_copy(update={"locations": 8}), monday, seed=1)
shutil.copytree(monday, friday, dirs_exist_ok=True)
keep(monday, ("L00", "L01", "L02", "L03"))
keep(friday, ("L04", "L05", "L06", "L07"))
bump(friday)

calib.fit([monday], out / "monday-run", hold_out="none")
run = calib.fit([friday], out / "friday-run", hold_out="none", prior=out / "monday-run")

for link in run.summary["links"]:
    held = "may have moved instead" if link["freed"] else "has not moved"
    print(f"{link['name']:18}", "has moved" if link["moved"] else held)
    if link["moved"]:
        columns = (link[key] for key in ("parameters", "units", "change", "sigma"))
        for name, unit, change, sigma in zip(*columns, strict=True):
            print(f"    {name} {1e3 * change:+.2f} ± {1e3 * sigma:.2f} m{unit}")
