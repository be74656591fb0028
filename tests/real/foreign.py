"""Real files of other projects, rewritten as recordings: small readers that only the tests use.

Each function takes one folder of the shared data (whose SOURCE.txt names where it comes from) and
writes a recording folder. The conventions of each file were found by experiment; `test_real_data`
holds the experiments.
"""

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from calib.intake import Choices, import_files
from sensors.readers.bags.bag import read_bag
from sensors.readers.base import Contents, Options
from sensors.readers.packets.ouster import read_ouster
from sensors.recording import write_table

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
UR10_FILES = {"A": "Series_A/measurements_grid.csv", "D": "Series_D/measurements_iso_cubes.csv"}
UR10_COLUMNS = {
    "time_s": "Timestamp",
    "temperature_c": "measurement_temperature",
    "mount_markers.*": "measurement_*[mm]",
}
POSITIONER_DH = """\
{convention: standard, joints: [{a: 0, alpha_deg: -90, d: 0},
                                {a: 0, alpha: 0, d_mm: -475, theta_deg: -90}]}
"""
POSITIONER_RIG = """\
name: positioner-2axis
arm: {{urdf: arm.urdf, base: arm_base, tip: arm_end, sigma_joint_rad: 0}}
frames:
  arm_base: {{parent: base, xyz_m: [0, 0, 0], rpy_rad: [0, 0, 0], sigma_m: 0, sigma_rad: 0}}
  mount_markers: {{parent: arm_end, xyz_m: {xyz}, rpy_rad: {rpy}, sigma_m: 0.05, sigma_rad: 0.2}}
base: {{moves: never}}
tracker: {{frame: opti, bodies: [mount_markers], sigma_m: 0.0002, sigma_rad: 0.0005}}
"""

# model -> angle table
HESAI = {
    "40p": "Pandar40P",
    "64": "Pandar64",
    "qt64": "PandarQT64",
    "qt128": "PandarQT128",
    "xt16": "PandarXT16",
    "xt32": "PandarXT32",
    "xt32m": "PandarXT32M",
}


def ur10(series: str, source: Path, out: Path, max_stops: int | None = None) -> Path:
    """UR10 under a laser tracker, series A or D of `arms/ur10_tmac`, as an arm without a LiDAR.

    The measurement is T_opti_mount_markers: mm and intrinsic X-Y-Z Euler angles in degrees. The
    planned TCP is FK @ inv(Trafo_TM_F_init), 109 mm in front of the flange; the measured frame is
    that TCP turned half a turn about z, and in series A its origin lies 16 mm nearer.
    """
    given = [("table", [source / UR10_FILES[series]]), ("dh", [EXAMPLES / "ur10.yaml"])]
    choices = Choices(EXAMPLES / "ur10_rig.yaml", blocks=12, most_stops=max_stops)
    return import_files(given, out, Options(columns=UR10_COLUMNS, euler="XYZ"), choices).folder


def rosi_positioner(source: Path, out: Path) -> Path:
    """Two-axis positioner under a camera, `arms/rosi_positioner_2axis`: the camera is the tracker.

    The measurement is T_camera_plate; the chain is that of the upstream example
    (`examples/kinematic_calibration.cpp`, two DH rows), and the plate sits 18 mm and 10 deg from
    the guessed mount.
    """
    guess = yaml.safe_load((source / "pose_initial_guesses.yaml").read_text())
    target = guess["target_mount_to_target_guess"]
    quat = Rotation.from_quat([target[key] for key in ("qw", "qx", "qy", "qz")], scalar_first=True)
    xyz, rpy = [target[key] for key in ("x", "y", "z")], quat.as_euler("xyz").tolist()
    dh, rig = out.with_name(f"{out.name}-dh.yaml"), out.with_name(f"{out.name}-rig.yaml")
    dh.write_text(POSITIONER_DH)
    rig.write_text(POSITIONER_RIG.format(xyz=xyz, rpy=rpy))
    given = [("industrial_calibration", [source / "measurements.yaml"]), ("dh", [dh])]
    options = Options(bodies={"target": "mount_markers"})
    return import_files(given, out, options, Choices(rig, blocks=13)).folder


def hesai(model: str, source: Path, out: Path) -> Path:
    """The turns of a still Hesai sensor, `lidar/hesai_nebula`, from its raw packets."""
    angles = source / f"calibration/{HESAI[model]}.csv"
    return still(read_bag([source / model], Options(metadata=angles), quiet), f"still-{model}", out)


def ouster(source: Path, out: Path, capture: str = "OS-0-128-U1_v2.3.0_1024x10") -> Path:
    """One sweep of an OS0-128, `lidar/ouster_sdk_tests`, from its raw packets."""
    found = read_ouster([source / f"{capture}.pcap"], Options(), quiet)
    return still(found, "still-os0-128-rev6", out)


def still(found: Contents, name: str, out: Path) -> Path:
    """A rig that is only a LiDAR, with one stop: every turn that a reader found."""
    (sweeps,) = found.sweeps
    turns = [turn.points for turn in sweeps.read(np.ones(len(sweeps.time_s), bool))]
    for number, points in enumerate(turns):
        points["scan"] = np.full(len(points["x"]), number, np.uint16)
    hold = {key: np.concatenate([points[key] for points in turns]) for key in turns[0]}
    (out / "scans").mkdir(parents=True)
    write_table(out / "scans/still.parquet", hold)
    _write_csv(out / "stops.csv", {"stop": ["still"], "location": ["L0"], "time_s": [0.0]})
    _write_yaml(out / "rig.yaml", {"name": name, "lidar": {**found.lidar, "frame": "lidar"}})
    return out


def quiet(what: str, done: int, total: int) -> None:
    """No progress."""


def _write_csv(path: Path, columns: Mapping[str, Sequence]) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        writer.writerows(zip(*columns.values(), strict=True))


def _write_yaml(path: Path, data: dict) -> None:
    path.write_text(yaml.safe_dump(data, sort_keys=False), encoding="utf-8")
