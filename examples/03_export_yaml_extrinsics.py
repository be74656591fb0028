"""Calibrate, export, and use the files without rigcal: YAML with PyYAML, URDF with yourdfpy.

Neither `mount -> mount_markers` nor `mount -> lidar` is identifiable alone, as the mount itself is
not observed: their sigmas are half a millimetre. Their combination is determined far better, and so
is all from the base's markers to the LiDAR: `rig.urdf`, the arm's with other origins, and the
frames.

    python examples/03_export_yaml_extrinsics.py [FOLDER]
"""

import csv
import json
import sys
import tempfile
from pathlib import Path

import numpy as np
import yaml

import calib
from calib.rig import load_rig


def off(T: np.ndarray, T_true: np.ndarray) -> str:
    """How far a transform is from the true one."""
    turn = np.linalg.norm(T[:3, :3] @ T_true[:3, :3].T - np.eye(3)) / np.sqrt(2)
    return f"{1e3 * np.linalg.norm(T - T_true, axis=0)[3]:.2f} mm, {1e3 * turn:.2f} mrad off"


out = Path(sys.argv[1] if len(sys.argv) > 1 else tempfile.mkdtemp(prefix="rigcal-"))
calib.simulate("tiny", out / "recording", seed=1)
run = calib.fit([out / "recording"], out / "run", hold_out="none")
file, _, urdf = calib.export(run, out / "export", ["yaml", "urdf"]).files

extrinsics = yaml.safe_load(file.read_text())
print(f"{file.name}, fitted to {extrinsics['provenance']['recordings'][0]['rig']}")
for name, frame in extrinsics["frames"].items():
    xyz_m = ", ".join(f"{v:.4f}" for v in frame["xyz_m"])
    print(f"  {frame['parent']} -> {name}: {xyz_m} m, sigma {1e3 * max(frame['sigma_m']):.2f} mm")

fitted = {n: np.array(f["T_parent_child"]) for n, f in extrinsics["frames"].items()}
cad = {edge.name: edge.T_parent_child for edge in load_rig(out / "recording").tree.edges}
truth = json.loads((out / "recording.truth.json").read_text())
true = {name: np.array(T) for name, T in truth["frames"].items()}
T_true, *others = (np.linalg.inv(T["mount_markers"]) @ T["lidar"] for T in (true, cad, fitted))
print("mount_markers -> lidar")
for name, T in zip(("CAD", "fit"), others, strict=True):
    print(f"  {name}: {off(T, T_true)}")

try:
    from yourdfpy import URDF
except ImportError:
    print("rig.urdf not read: yourdfpy is not installed")
    sys.exit()
robot, worst_m = URDF.load(urdf, load_meshes=False), 0.0
for stop in csv.DictReader((out / "recording/stops.csv").open()):
    robot.update_cfg({joint: float(stop[joint]) for joint in robot.actuated_joint_names})
    T_faro_root, T_faro_lidar = map(np.array, truth["stops"][stop["stop"]].values())
    T_true = np.linalg.inv(T_faro_root @ true["base_markers"]) @ T_faro_lidar
    T = robot.get_transform("lidar", "base_markers")
    worst_m = max(worst_m, np.linalg.norm((T - T_true)[:3, 3]))
print(f"base_markers -> lidar through {urdf.name}: {1e3 * worst_m:.2f} mm off at the worst stop")
