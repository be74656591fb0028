"""Real files of other projects, rewritten as recordings: small readers that only the tests use.

Each function takes one folder of the shared data (whose SOURCE.txt names where it comes from) and
writes a recording folder. The conventions of each file were found by experiment; `test_real_data`
holds the experiments.
"""

import csv
import json
import sqlite3
import struct
from collections.abc import Mapping, Sequence
from contextlib import closing
from datetime import datetime
from itertools import zip_longest
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import yaml
from scipy.spatial.transform import Rotation

# (d, a, alpha) of the UR10 as its maker publishes them, m and rad; joint i turns about z before
# its row: T_i = Rz(q_i) Tz(d) Tx(a) Rx(alpha).
UR10_DH = (
    (0.1273, 0.0, np.pi / 2),
    (0.0, -0.612, 0.0),
    (0.0, -0.5723, 0.0),
    (0.163941, 0.0, np.pi / 2),
    (0.1157, 0.0, -np.pi / 2),
    (0.0922, 0.0, 0.0),
)
UR10_JOINTS = (
    "shoulder_pan_joint",
    "shoulder_lift_joint",
    "elbow_joint",
    "wrist_1_joint",
    "wrist_2_joint",
    "wrist_3_joint",
)
# kg, and centre of mass (x, z) in the link's frame, m: ros-industrial's ur_description, which has
# them from the maker; y and the wrists' centres are within 5 cm of 0 and left there.
UR10_LINKS = (
    (7.778, (0.0, 0.0)),
    (12.93, (-0.38757, 0.15061)),
    (3.87, (-0.1984, 0.06112)),
    (1.96, (0.0, 0.163941)),
    (1.96, (0.0, 0.1157)),
    (0.202, (0.0, 0.0922)),
)
UR10_FILES = {"A": "Series_A/measurements_grid.csv", "D": "Series_D/measurements_iso_cubes.csv"}

# model -> catalogue name, angle table, channels, blocks per packet, sweep's columns, shortest range
HESAI = {
    "qt64": ("hesai_pandarqt64", "PandarQT64", 64, 4, 600, 0.1),
    "xt32": ("hesai_pandarxt32", "PandarXT32", 32, 8, 2000, 0.05),
}

Origin = tuple[Sequence[float], Sequence[float]]  # xyz_m, rpy_rad of a URDF origin


def ur10(series: str, source: Path, out: Path, max_stops: int | None = None) -> Path:
    """UR10 under a laser tracker, series A or D of `arms/ur10_tmac`, as an arm without a LiDAR.

    The measurement is T_opti_mount_markers: mm and intrinsic X-Y-Z Euler angles in degrees. The
    planned TCP is FK @ inv(Trafo_TM_F_init), 109 mm in front of the flange; the measured frame is
    that TCP turned half a turn about z, and in series A its origin lies 16 mm nearer.
    """
    table = _decimal_comma_table(source / UR10_FILES[series])
    time_s = _seconds(table["Timestamp"])
    order = np.argsort(time_s, kind="stable")
    if max_stops is not None and max_stops < len(order):
        order = order[np.linspace(0, len(order) - 1, max_stops).astype(int)]
    position_mm, angles_deg = (
        np.stack([table[f"measurement_{axis}"] for axis in axes], axis=1)[order]
        for axes in (("x", "y", "z"), ("rx", "ry", "rz"))
    )
    quat = Rotation.from_euler("XYZ", angles_deg, degrees=True).as_quat(scalar_first=True)
    columns = {
        "stop": [f"pose_{row:05d}" for row in order],
        "location": [f"block_{12 * k // len(order):02d}" for k in range(len(order))],
        "time_s": time_s[order],
        "temperature_c": table["measurement_temperature"][order],
        **{joint: table[joint][order] for joint in UR10_JOINTS},
        **_pose_columns("mount_markers", np.hstack([position_mm / 1000, quat])),
    }
    out.mkdir(parents=True)
    _write_csv(out / "stops.csv", columns)
    _write_urdf(out / "arm.urdf", "ur10", *_ur10_origins(), UR10_LINKS)
    T_tool_flange = np.loadtxt(source / f"Series_{series}/Trafo_TM_F_init.txt")
    distance_m = float(np.linalg.norm(T_tool_flange[:3, 3])) / 1000
    mount = {
        "parent": "arm_end",
        "xyz_m": [0.0, 0.0, distance_m],
        "rpy_rad": [0.0, 0.0, -np.pi / 2],
        "sigma_m": 0.02,
        "sigma_rad": 0.02,
    }
    tracker = {"bodies": ["mount_markers"], "sigma_m": 0.00005, "sigma_rad": 0.0003}
    _write_yaml(out / "rig.yaml", _arm_rig(f"ur10-tmac-{series}", mount, tracker))
    return out


def rosi_positioner(source: Path, out: Path) -> Path:
    """Two-axis positioner under a camera, `arms/rosi_positioner_2axis`: the camera is the tracker.

    The measurement is T_camera_plate; the chain is that of the upstream example
    (`examples/kinematic_calibration.cpp`, two DH rows), and the plate sits 18 mm and 10 deg from
    the guessed mount.
    """
    poses = yaml.safe_load((source / "measurements.yaml").read_text())
    guess = yaml.safe_load((source / "pose_initial_guesses.yaml").read_text())
    stamps = sorted(poses)
    joints = np.array([poses[stamp]["target_joints"] for stamp in stamps])
    keys = ("x", "y", "z", "qw", "qx", "qy", "qz")
    plate = np.array([[poses[stamp]["pose"][key] for key in keys] for stamp in stamps])
    tilt_deg = np.degrees(joints[:, 0]).round().astype(int)
    columns = {
        "stop": [f"pose_{stamp}" for stamp in stamps],
        "location": [f"tilt_{tilt:+03d}_deg" for tilt in tilt_deg],
        "time_s": np.array([float(stamp) for stamp in stamps]) - float(stamps[0]),
        "joint_1": joints[:, 0],
        "joint_2": joints[:, 1],
        **_pose_columns("mount_markers", plate),
    }
    out.mkdir(parents=True)
    _write_csv(out / "stops.csv", columns)
    origins = [((0, 0, 0), (0, 0, 0)), ((0, 0, 0), (-np.pi / 2, 0, 0))]
    _write_urdf(
        out / "arm.urdf",
        "positioner",
        dict(zip(("joint_1", "joint_2"), origins, strict=True)),
        ((0, 0, -0.475), (0, 0, -np.pi / 2)),
    )
    target = guess["target_mount_to_target_guess"]
    quat = [target[key] for key in ("qw", "qx", "qy", "qz")]
    mount = {
        "parent": "arm_end",
        "xyz_m": [target[key] for key in ("x", "y", "z")],
        "rpy_rad": Rotation.from_quat(quat, scalar_first=True).as_euler("xyz").tolist(),
        "sigma_m": 0.05,
        "sigma_rad": 0.2,
    }
    tracker = {"bodies": ["mount_markers"], "sigma_m": 0.0002, "sigma_rad": 0.0005}
    _write_yaml(out / "rig.yaml", _arm_rig("positioner-2axis", mount, tracker))
    return out


def hesai(model: str, source: Path, out: Path) -> Path:
    """Four sweeps of a still Hesai sensor, `lidar/hesai_nebula`, from its raw packets.

    Every direction fires once and reports two returns in consecutive blocks, the nearer first;
    the later one is kept. Hesai counts azimuth clockwise from y, so column = columns/4 + azimuth.
    """
    name, table, channels, _, columns, shortest_m = HESAI[model]
    angles = np.loadtxt(source / f"calibration/{table}.csv", delimiter=",", skiprows=1)
    elevation, offset = np.radians(angles[:, 1:]).T
    sweeps = []
    for scan, (azimuth, range_m, intensity) in enumerate(hesai_returns(model, source)):
        kept = slice(1, None, 2)
        angle = azimuth[kept, None] + offset
        x, y = np.sin(angle) * np.cos(elevation), np.cos(angle) * np.cos(elevation)
        direction = np.stack([x, y, np.broadcast_to(np.sin(elevation), x.shape)], axis=-1)
        step = np.rint(azimuth[kept] * columns / (2 * np.pi)).astype(int)
        valid = range_m[kept] >= shortest_m
        sweeps.append(
            _points(
                (direction * range_m[kept, :, None])[valid],
                ring=np.broadcast_to(np.arange(channels), valid.shape)[valid],
                column=np.broadcast_to(((step + columns // 4) % columns)[:, None], valid.shape)[
                    valid
                ],
                intensity=intensity[kept][valid],
                scan=np.full(valid.sum(), scan),
            )
        )
    _write_still(out, f"still-{model}", {"model": name, "beam_origin_m": [0, 0]}, sweeps)
    return out


def hesai_returns(model: str, source: Path) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Per sweep of the ROS 2 bag: block azimuth (B,) rad, range (B, channels) m, intensity."""
    _, _, channels, blocks, _, _ = HESAI[model]
    bag = next((source / model).glob("*.db3"))
    with closing(sqlite3.connect(f"file:{bag}?mode=ro&immutable=1", uri=True)) as database:
        rows = database.execute("SELECT data FROM messages ORDER BY timestamp").fetchall()
    block = np.dtype(
        [
            ("azimuth", "<u2"),
            ("returns", [("range", "<u2"), ("intensity", "u1"), ("confidence", "u1")], channels),
        ]
    )
    sweeps = []
    for (message,) in rows:
        packets = _pandar_scan(message)
        body = packets[:, 12 : 12 + blocks * block.itemsize].copy().view(block).ravel()
        azimuth = np.radians(body["azimuth"] / 100)
        sweeps.append((azimuth, body["returns"]["range"] * 0.004, body["returns"]["intensity"]))
    return sweeps


def ouster(source: Path, out: Path, capture: str = "OS-0-128-U1_v2.3.0_1024x10") -> Path:
    """One sweep of an OS0-128, `lidar/ouster_sdk_tests`, from a PCAP of RNG15_RFL8_NIR8 packets.

    Axes as the driver's sensor frame (x forwards, against the cable), origin at the LiDAR's own
    centre: column c of N looks at pi - 2 pi c / N, less each ring's azimuth angle.
    """
    facts = json.loads((source / f"{capture}.json").read_text())
    shape = facts["data_format"]
    rings, columns = shape["pixels_per_column"], shape["columns_per_frame"]
    pixel = [("range", "<u2"), ("reflectivity", "u1"), ("near_infrared", "u1")]
    column = np.dtype(
        [("time", "<u8"), ("index", "<u2"), ("status", "<u2"), ("pixels", pixel, rings)]
    )
    size = shape["columns_per_packet"] * column.itemsize
    data = [p[32 : 32 + size] for p in _udp_payloads(source / f"{capture}.pcap", facts)]
    body = np.frombuffer(b"".join(data), column)
    elevation, aside = (
        np.radians(facts[f"beam_{angle}_angles"]) for angle in ("altitude", "azimuth")
    )
    encoder = (np.pi - 2 * np.pi * body["index"] / columns)[:, None]
    origin_m = facts["lidar_origin_to_beam_origin_mm"] / 1000
    range_m = (body["pixels"]["range"] & 0x7FFF) * 0.008
    along = range_m - origin_m
    flat = along * np.cos(elevation)
    xyz = np.stack(
        [
            flat * np.cos(encoder - aside) + origin_m * np.cos(encoder),
            flat * np.sin(encoder - aside) + origin_m * np.sin(encoder),
            along * np.sin(elevation),
        ],
        axis=-1,
    )
    valid = (range_m > origin_m) & (body["status"] & 1 == 1)[:, None]
    ring, index = np.broadcast_arrays(np.arange(rings), body["index"][:, None])
    sweep = _points(
        xyz[valid],
        ring=ring[valid],
        column=index[valid],
        intensity=body["pixels"]["reflectivity"][valid],
        scan=np.zeros(valid.sum(), int),
    )
    lidar = {"model": "ouster_os0_128_rev6", "beam_origin_m": [origin_m, 0]}
    _write_still(out, "still-os0-128-rev6", lidar, [sweep])
    return out


def _decimal_comma_table(path: Path) -> dict[str, np.ndarray]:
    names, *rows = path.read_text(encoding="utf-8-sig").replace(",", ".").splitlines()
    values = np.loadtxt(rows, delimiter=";", ndmin=2)
    return {name.strip(): values[:, k] for k, name in enumerate(names.split(";"))}


def _seconds(stamps: np.ndarray) -> np.ndarray:
    """Seconds since the first stamp (YYYYMMDDhhmmss), or the row number where they are ruined."""
    try:
        times = [datetime.strptime(f"{stamp:.0f}", "%Y%m%d%H%M%S") for stamp in stamps]
    except ValueError:
        return np.arange(len(stamps), dtype=float)
    return np.array([(time - times[0]).total_seconds() for time in times])


def _ur10_origins() -> tuple[dict[str, Origin], Origin]:
    """Each row's fixed part Tz(d) Tx(a) Rx(alpha) is the origin of the joint after it."""
    fixed = [((a, 0, d), (alpha, 0, 0)) for d, a, alpha in UR10_DH]
    return dict(zip(UR10_JOINTS, [((0, 0, 0), (0, 0, 0)), *fixed[:-1]], strict=True)), fixed[-1]


def _arm_rig(name: str, mount: dict, tracker: dict) -> dict:
    fixed = {"parent": "base", "xyz_m": [0, 0, 0], "rpy_rad": [0, 0, 0], "sigma_m": 0}
    return {
        "name": name,
        "arm": {"urdf": "arm.urdf", "base": "arm_base", "tip": "arm_end", "sigma_joint_rad": 0},
        "frames": {"arm_base": {**fixed, "sigma_rad": 0}, "mount_markers": mount},
        "base": {"moves": "never"},
        "tracker": {"frame": "opti", **tracker},
    }


def _write_urdf(
    path: Path,
    name: str,
    joints: Mapping[str, Origin],
    tip: Origin,
    masses: Sequence[tuple[float, tuple[float, float]]] = (),
) -> None:
    links = ["arm_base", *(f"link_{k + 1}" for k in range(len(joints))), "arm_end"]
    lines = [f'<robot name="{name}">', f'  <link name="{links[0]}"/>']
    for link, inertial in zip_longest(links[1:], masses):
        lines.append(f'  <link name="{link}"{"" if inertial else "/"}>')
        if inertial:
            mass_kg, (x, z) = inertial
            lines.append(f'    <inertial><origin xyz="{x} 0 {z}"/><mass value="{mass_kg}"/>')
            lines.append("    </inertial></link>")
    for k, (joint, (xyz, rpy)) in enumerate([*joints.items(), ("flange", tip)]):
        kind = "fixed" if joint == "flange" else "revolute"
        lines += [
            f'  <joint name="{joint}" type="{kind}">',
            f'    <parent link="{links[k]}"/><child link="{links[k + 1]}"/>',
            f'    <origin xyz="{" ".join(map(str, xyz))}" rpy="{" ".join(map(str, rpy))}"/>',
        ]
        if kind == "revolute":
            lines.append('    <axis xyz="0 0 1"/>')
            lines.append('    <limit lower="-6.2832" upper="6.2832" effort="0" velocity="0"/>')
        lines.append("  </joint>")
    path.write_text("\n".join([*lines, "</robot>"]) + "\n", encoding="utf-8")


def _pose_columns(body: str, poses: np.ndarray) -> dict[str, np.ndarray]:
    names = ("x", "y", "z", "qw", "qx", "qy", "qz")
    return {f"{body}.{name}": poses[:, k] for k, name in enumerate(names)}


def _points(xyz: np.ndarray, **columns: np.ndarray) -> dict[str, np.ndarray]:
    integer = {"ring", "column", "scan"}
    points = {axis: xyz[:, k].astype(np.float32) for k, axis in enumerate("xyz")}
    for name, values in columns.items():
        points[name] = values.astype(np.uint16 if name in integer else np.float32)
    return points


def _write_still(out: Path, name: str, lidar: dict, sweeps: list[dict[str, np.ndarray]]) -> None:
    """A rig that is only a LiDAR, with one stop of raw sweeps."""
    (out / "scans").mkdir(parents=True)
    hold = {key: np.concatenate([sweep[key] for sweep in sweeps]) for key in sweeps[0]}
    pq.write_table(pa.table(hold), out / "scans/still.parquet", compression="zstd")
    _write_csv(out / "stops.csv", {"stop": ["still"], "location": ["L0"], "time_s": [0.0]})
    _write_yaml(out / "rig.yaml", {"name": name, "lidar": {**lidar, "frame": "lidar"}})


def _pandar_scan(message: bytes) -> np.ndarray:
    """Packets (n, 1500) uint8 of a pandar_msgs/PandarScan: stamp, frame id, {stamp, bytes, size}[].

    CDR, little endian; numbers are aligned to 4 bytes counted from the end of its 4-byte header.
    """
    (length,) = struct.unpack_from("<I", message, 12)
    start = 16 + length + -length % 4
    (count,) = struct.unpack_from("<I", message, start)
    packets = np.frombuffer(message, np.uint8, count * 1512, start + 4)
    return packets.reshape(count, 1512)[:, 8:1508]


def _udp_payloads(path: Path, facts: dict) -> list[bytes]:
    """Payloads of the Ethernet frames sent to the LiDAR port, in order."""
    data, at, found = path.read_bytes(), 24, []
    while at < len(data):
        (length,) = struct.unpack_from("<I", data, at + 8)
        frame = data[at + 16 : at + 16 + length]
        at += 16 + length
        if struct.unpack_from(">H", frame, 36)[0] == facts["udp_port_lidar"]:
            found.append(frame[42:])
    return found


def _write_csv(path: Path, columns: Mapping[str, Sequence]) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        writer.writerows(zip(*columns.values(), strict=True))


def _write_yaml(path: Path, data: dict) -> None:
    path.write_text(yaml.safe_dump(data, sort_keys=False), encoding="utf-8")
