"""Every ring of a spinning LiDAR has its own range zero. Find them all and correct a scan.

`measured = true + a_ring`, so a correction takes a_ring off along the beam. The fit finds the
offsets of all rings together with where the LiDAR sits: a tilt of its frame would otherwise look
like a slope of the offsets over the rings.

    python examples/02_per_ring_corrections.py [FOLDER]
"""

import json
import sys
import tempfile
from pathlib import Path

import numpy as np

import calib
from calib.rig import Rig, load_rig
from calib.simulation import load_spec
from sensors.lidar import Beams, beams
from sensors.recording import read_scan
from sensors.reference import Reference


def range_errors(
    rig: Rig, beam: Beams, range_m: np.ndarray, T_faro_lidar: np.ndarray
) -> np.ndarray:
    """Range (N,) minus the distance to the mesh, NaN where a beam misses it."""
    mesh = Reference.read(rig.reference.mesh, rig.reference.faces, rig.reference.labels)
    R, t = T_faro_lidar[:3, :3], T_faro_lidar[:3, 3]
    hits = mesh.cast(beam.origin_m @ R.T + t, beam.direction @ R.T)
    return np.where(hits.triangle >= 0, range_m - hits.range_m, np.nan)


out = Path(sys.argv[1] if len(sys.argv) > 1 else tempfile.mkdtemp(prefix="rigcal-"))
spec = load_spec("tiny").model_copy(update={"lidar": "ouster_os0_128_rev6"})
calib.simulate(spec, out / "recording", seed=3)
run = calib.fit([out / "recording"], out / "run", hold_out="none")

truth = json.loads((out / "recording.truth.json").read_text())
offsets = run.solution.shared.effects["ring_range_offset"]
true_m = truth["effects"]["ring_range_offset"]
print("ring  offset mm      truth mm")
for ring in range(0, 128, 16):
    estimate = f"{1e3 * offsets.estimate[ring]:+6.2f} ± {1e3 * offsets.sigma[ring]:.2f}"
    print(f"{ring:4}  {estimate}  {1e3 * true_m[ring]:+6.2f}")

rig = load_rig(out / "recording")
stop, pose = next(iter(truth["stops"].items()))
scan = read_scan(out / "recording" / "scans" / f"{stop}.parquet", rig.lidar.rings)
beam = beams(scan.xyz_m, rig.lidar.beam_origin_m)
corrected_m = beam.range_m - offsets.estimate[scan.ring]
for name, range_m in (("as delivered", beam.range_m), ("corrected", corrected_m)):
    errors = range_errors(rig, beam, range_m, np.array(pose["T_faro_lidar"]))
    print(f"median range error {name}: {1e3 * np.nanmedian(np.abs(errors)):.2f} mm")
