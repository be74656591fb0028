"""Calibrate, export to YAML, and use the file without rigcal: PyYAML and numpy are enough.

From the tracked markers to the LiDAR there are two links, `mount -> mount_markers` and
`mount -> lidar`. Neither can be told alone, as the mount itself is never seen; that is why their
sigmas are half a millimetre. What a user needs is the two together, and that is told far better.

    python examples/03_export_yaml_extrinsics.py [FOLDER]
"""

import json
import sys
import tempfile
from pathlib import Path

import numpy as np
import yaml

from calib.calibrate import calibrate
from calib.export import export
from calib.rig import load_rig
from calib.simulate import simulate


def markers_to_lidar(T_parent_child: dict[str, np.ndarray]) -> np.ndarray:
    """T_mount_markers_lidar (4, 4)."""
    return np.linalg.inv(T_parent_child["mount_markers"]) @ T_parent_child["lidar"]


def off(T: np.ndarray, T_true: np.ndarray) -> str:
    """How far a transform is from the true one."""
    turn = np.linalg.norm(T[:3, :3] @ T_true[:3, :3].T - np.eye(3)) / np.sqrt(2)
    return f"{1e3 * np.linalg.norm(T - T_true, axis=0)[3]:.2f} mm, {1e3 * turn:.2f} mrad off"


out = Path(sys.argv[1] if len(sys.argv) > 1 else tempfile.mkdtemp(prefix="rigcal-"))
simulate("tiny", out / "recording", seed=1)
run = calibrate([out / "recording"], out / "run", hold_out="none")
(file,) = export(run, out / "export", ["yaml"])

extrinsics = yaml.safe_load(file.read_text())
print(f"{file.name}, fitted to {extrinsics['provenance']['recordings'][0]['rig']}")
for name, frame in extrinsics["frames"].items():
    xyz_m = ", ".join(f"{v:.4f}" for v in frame["xyz_m"])
    print(f"  {frame['parent']} -> {name}: {xyz_m} m, sigma {1e3 * max(frame['sigma_m']):.2f} mm")

found = {n: np.array(f["T_parent_child"]) for n, f in extrinsics["frames"].items()}
cad = {edge.name: edge.T_parent_child for edge in load_rig(out / "recording").tree.edges}
truth = json.loads((out / "recording.truth.json").read_text())["frames"]
true = markers_to_lidar({name: np.array(T) for name, T in truth.items()})
print("mount_markers -> lidar")
for name, frames in (("CAD", cad), ("fit", found)):
    print(f"  {name}: {off(markers_to_lidar(frames), true)}")
