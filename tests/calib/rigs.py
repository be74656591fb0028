"""A small rig in a box-shaped room, its recording, and derivatives by differences.

Nothing here uses the code under test: chains are products of scipy's RigidTransform, ranges are
distances to the walls of a box, and values are moved as gtsam moves them.
"""

import csv
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import gtsam
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import yaml
from scipy.spatial.transform import RigidTransform, Rotation

ROOM_M = np.array([4.0, 3.0, 2.5])
WALL_STEPS = 5
RINGS, COLUMNS = 16, 25
BEAM_ORIGIN_M = (0.03, 0.01)
BELOW_M = 0.18
LEVEL_RAD = 0.001

# name: parent, xyz_m, rpy_rad, sigma_m, sigma_rad
FRAMES = {
    "base_markers": ("base", (0.12, -0.05, 0.32), (0.0, 0.1, 0.3), 0.0015, 0.003),
    "arm_base": ("base", (0.18, 0.0, 0.42), (0.0, 0.0, 0.2), 0.0015, (0.003, 0.003, 0.0)),
    "mount": ("arm_end", (0.01, 0.0, 0.02), (0.0, 0.2, 0.5), 0.0008, 0.002),
    "mount_markers": ("mount", (0.03, 0.02, 0.05), (0.3, 0.0, 0.0), 0.0008, 0.002),
    "lidar": ("mount", (0.0, 0.01, 0.085), (0.1, 0.0, -0.7), 0.001, 0.003),
}
# name: type, child, xyz_m, rpy_rad, axis
ARM = {
    "turn": ("revolute", "arm_1", (0.0, 0.0, 0.2), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
    "lift": ("revolute", "arm_2", (0.05, 0.0, 0.1), (0.1, 0.0, 0.2), (0.0, 1.0, 0.0)),
    "slide": ("prismatic", "arm_3", (0.3, 0.0, 0.0), (0.0, 0.2, 0.0), (1.0, 0.0, 0.0)),
    "tip": ("fixed", "arm_end", (0.0, 0.02, 0.08), (0.0, 0.0, 0.1), None),
}
JOINTS = ("turn", "lift", "slide")
STOPS = {  # stop: location, joints
    "s0": ("a", (-0.9, 0.3, 0.0)),
    "s1": ("a", (1.1, -0.5, 0.15)),
    "s2": ("b", (0.2, 0.6, 0.1)),
    "s3": ("b", (2.0, -0.2, 0.05)),
}


def pose(xyz_m: Sequence[float], rpy_rad: Sequence[float]) -> RigidTransform:
    """URDF's origin: fixed axes x, y, z."""
    return RigidTransform.from_components(xyz_m, Rotation.from_euler("xyz", rpy_rad))


BASES = {"a": pose((1.5, 1.2, 0.0), (0.01, 0.0, 0.4)), "b": pose((2.4, 1.7, 0.0), (0.0, 0.02, -1))}
T_OPTI_FARO = pose((-1.2, 0.7, 0.1), (0.02, -0.03, 0.8))


@dataclass
class Hardware:
    """What of the rig may differ from its drawing."""

    frames: dict[str, np.ndarray] = field(default_factory=dict)  # twist (6,) in the child's axes
    link_m: np.ndarray = field(default_factory=lambda: np.zeros(len(ARM)))
    joint: np.ndarray = field(default_factory=lambda: np.zeros(len(JOINTS)))
    ring_m: np.ndarray = field(default_factory=lambda: np.zeros(RINGS))


def drawn(rng: np.random.Generator) -> Hardware:
    """Hardware as far from its drawing as the priors allow."""
    twists = {
        name: rng.normal(size=6) * np.append(np.broadcast_to(rad, 3), np.broadcast_to(m, 3))
        for name, (_, _, _, m, rad) in FRAMES.items()
    }
    return Hardware(
        twists,
        rng.normal(0, 1e-3, len(ARM)),
        rng.normal(0, 2e-3, len(JOINTS)),
        rng.normal(0, 0.01, RINGS),
    )


def placed(frame: str, joints: Sequence[float], hardware: Hardware) -> RigidTransform:
    """T_base_frame, link after link up to the root.

    Joints and hardware may hold N cases along their first axis; so does what comes back then.
    """
    if frame == "base":
        return RigidTransform.identity()
    joints = np.asarray(joints)
    if frame in FRAMES:
        parent, xyz_m, rpy_rad, _, _ = FRAMES[frame]
        own = RigidTransform.from_exp_coords(hardware.frames.get(frame, np.zeros(6)))
        return placed(parent, joints, hardware) * pose(xyz_m, rpy_rad) * own
    i = next(i for i, (_, child, *_) in enumerate(ARM.values()) if child == frame)
    kind, _, xyz_m, rpy_rad, axis = list(ARM.values())[i]
    longer_m = np.divide(xyz_m, np.linalg.norm(xyz_m)) * hardware.link_m[..., i, None]
    origin = RigidTransform.from_translation(xyz_m + longer_m) * pose((0, 0, 0), rpy_rad)
    if axis:
        q = (joints + hardware.joint)[..., i, None]
        still = np.zeros_like(q * axis)
        turn, slide = (q * axis, still) if kind == "revolute" else (still, q * axis)
        origin = origin * RigidTransform.from_exp_coords(np.concatenate([turn, slide], axis=-1))
    parent = "arm_base" if i == 0 else list(ARM.values())[i - 1][1]
    return placed(parent, joints, hardware) * origin


def room(offset_m: Sequence[float] = (0, 0, 0)) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and triangles of the box, its corner at the offset: 300 triangles in 6 surfaces."""
    vertices, triangles = [], []
    s, t = (a.ravel() for a in np.meshgrid(*[np.linspace(0, 1, WALL_STEPS + 1)] * 2, indexing="ij"))
    i, j = (a.ravel() for a in np.meshgrid(*[np.arange(WALL_STEPS)] * 2, indexing="ij"))
    a = i * (WALL_STEPS + 1) + j
    b = a + WALL_STEPS + 1
    wall = np.concatenate([np.stack([a, b, b + 1], axis=1), np.stack([a, b + 1, a + 1], axis=1)])
    for axis in range(3):
        for side in (0.0, 1.0):
            corner = np.zeros((len(s), 3))
            corner[:, axis] = side
            corner[:, axis - 1], corner[:, axis - 2] = s, t
            triangles.append(wall + len(s) * len(vertices))
            vertices.append(corner * ROOM_M + np.array(offset_m))
    return np.concatenate(vertices), np.concatenate(triangles)


def fan() -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Origins, directions, rings and columns of the beams of one sweep, in the lidar's frame."""
    ring, column = (a.ravel() for a in np.meshgrid(np.arange(RINGS), np.arange(COLUMNS)))
    azimuth = np.pi - 2 * np.pi * (column + 0.3) / COLUMNS
    elevation = np.radians(np.linspace(-50, 50, RINGS))[ring]
    ahead = np.stack([np.cos(azimuth), np.sin(azimuth), 0 * azimuth], axis=1)
    left = np.stack([-np.sin(azimuth), np.cos(azimuth), 0 * azimuth], axis=1)
    up = np.array([0, 0, 1.0])
    direction = np.cos(elevation)[:, None] * ahead + np.sin(elevation)[:, None] * up
    return BEAM_ORIGIN_M[0] * ahead + BEAM_ORIGIN_M[1] * left, direction, ring, column


def to_walls(origin_m: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Distance (N,) along rays that start inside the box."""
    ends = np.where(direction > 0, ROOM_M, 0.0)
    return ((ends - origin_m) / direction).min(axis=1)


def swept(T_faro_lidar: RigidTransform, ring_m: np.ndarray, rng: np.random.Generator) -> dict:
    """The columns of one stop's averaged scan: 5 mm noise, 4 sweeps, one beam in 20 wild."""
    origin, direction, ring, column = fan()
    turned = T_faro_lidar.rotation.apply(direction)
    range_m = to_walls(T_faro_lidar.apply(origin), turned) + ring_m[ring]
    range_m += rng.normal(0, 0.005 / 2, len(ring))
    wild = rng.random(len(ring)) < 0.05
    range_m[wild] *= rng.uniform(0.4, 0.9, wild.sum())
    xyz = origin + range_m[:, None] * direction
    return dict(zip("xyz", xyz.T, strict=True)) | {
        "ring": ring.astype(np.uint16),
        "column": column.astype(np.uint16),
        "intensity": rng.uniform(0, 255, len(ring)),
        "count": np.full(len(ring), 4.0),
        "range_std_m": 0.005 * np.sqrt(rng.chisquare(3, len(ring)) / 3),
    }


def write(
    folder: Path, seed: int = 0, offset_m: Sequence[float] = (0, 0, 0), **changes: object
) -> Path:
    """A recording of four stops at two locations, with tracker, targets and mesh.

    Args:
        folder: where to.
        seed: of the hardware and the noise.
        offset_m: where the room's corner lies in the reference's frame.
        changes: top-level keys of rig.yaml to replace; None leaves one out. Without a tracker the
            base's guessed poses are all there is.
    """
    rng = np.random.default_rng(seed)
    hardware = drawn(rng)
    rig = {name: part for name, part in (drawing() | changes).items() if part is not None}
    (folder / "scans").mkdir(parents=True)
    (folder / "reference").mkdir()
    (folder / "rig.yaml").write_text(yaml.safe_dump(rig, sort_keys=False))
    (folder / "arm.urdf").write_text(_urdf())
    _write_mesh(folder / "reference/mesh.ply", *room(offset_m))
    stops = []
    for k, (stop, (location, joints)) in enumerate(STOPS.items()):
        true = np.array(joints) + rng.normal(0, 1e-4, len(JOINTS))
        T_faro_base = BASES[location]
        T_faro_lidar = T_faro_base * placed("lidar", true, hardware)
        scan = swept(T_faro_lidar, hardware.ring_m, rng)
        pq.write_table(pa.table(scan), folder / f"scans/{stop}.parquet")
        row = {"stop": stop, "location": location, "time_s": 60.0 * k, "temperature_c": 20.0 + k}
        row |= dict(zip(JOINTS, joints, strict=True))
        for body in ("base_markers", "mount_markers"):
            seen = T_OPTI_FARO * T_faro_base * placed(body, true, hardware)
            noise = rng.normal(size=6) * np.repeat([0.0003, 0.0002], 3)
            row |= _pose_cells(body, seen * RigidTransform.from_exp_coords(noise))
        rough = RigidTransform.from_exp_coords(rng.normal(0, 0.02, 6))
        moved = RigidTransform.from_translation(offset_m)
        row |= _pose_cells("base_guess", moved * T_faro_base * rough)
        for frame in rig.get("levels", {"frames": ()})["frames"]:
            own = np.random.default_rng([seed, k, *map(ord, frame)])
            row |= _felt_cells(frame, T_faro_base * placed(frame, true, hardware), own)
        stops.append(row)
    _write_csv(folder / "stops.csv", stops)
    _write_csv(folder / "targets.csv", _targets(np.array(offset_m), rng))
    return folder


def _targets(offset_m: np.ndarray, rng: np.random.Generator) -> list[dict]:
    down = T_OPTI_FARO.rotation.apply([0, 0, -1.0])
    rows = []
    for m, at in enumerate([(0.5, 0.5, 1.5), (3.5, 0.6, 1.2), (3.2, 2.5, 1.9), (0.6, 2.4, 1.0)]):
        lower = T_OPTI_FARO.apply(at) - BELOW_M * down
        named = {"faro": at + offset_m, "upper": lower - 0.3 * down, "lower": lower}
        row = {"target": f"t{m}"}
        for name, sigma in (("faro", 6e-4), ("upper", 2e-4), ("lower", 2e-4)):
            seen = named[name] + rng.normal(0, sigma, 3)
            row |= {f"{name}_{axis}": value for axis, value in zip("xyz", seen, strict=True)}
        rows.append(row)
    return rows


def drawing() -> dict:
    """What rig.yaml says."""
    keys = ("parent", "xyz_m", "rpy_rad", "sigma_m", "sigma_rad")
    frames = {name: dict(zip(keys, map(_plain, row), strict=True)) for name, row in FRAMES.items()}
    return {
        "name": "box",
        "lidar": {
            "model": "velodyne_vlp16",
            "frame": "lidar",
            "elevation_deg": [-50, 50],
            "columns": COLUMNS,
            "beam_origin_m": list(BEAM_ORIGIN_M),
            "sigma_range_m": 0.005,
        },
        "arm": {"urdf": "arm.urdf", "base": "arm_base", "tip": "arm_end", "sigma_joint_rad": 1e-4},
        "frames": frames,
        "base": {"moves": "location"},
        "tracker": {
            "frame": "opti",
            "bodies": ["base_markers", "mount_markers"],
            "sigma_m": 0.0002,
            "sigma_rad": 0.0003,
        },
        "target": {
            "sphere_below_lower_marker_m": BELOW_M,
            "sigma_sphere_m": 0.0006,
            "sigma_marker_m": 0.0002,
        },
        "reference": {"frame": "faro", "mesh": "reference/mesh.ply", "sigma_m": 0.0006},
    }


def _plain(value: object) -> object:
    return list(value) if isinstance(value, tuple) else value


def _urdf() -> str:
    lines = ['<robot name="arm"><link name="arm_base"/>']
    parent = "arm_base"
    for name, (kind, child, xyz_m, rpy_rad, axis) in ARM.items():
        lines.append(
            f'<link name="{child}"/><joint name="{name}" type="{kind}">'
            f'<parent link="{parent}"/><child link="{child}"/>'
            f'<origin xyz="{_words(xyz_m)}" rpy="{_words(rpy_rad)}"/>'
        )
        limit = '<limit lower="-3" upper="3" effort="1" velocity="1"/>'
        lines.append(f'<axis xyz="{_words(axis)}"/>{limit}</joint>' if axis else "</joint>")
        parent = child
    return "\n".join([*lines, "</robot>"])


def _words(values: Sequence[float]) -> str:
    return " ".join(map(repr, values))


def _pose_cells(body: str, T: RigidTransform) -> dict[str, float]:
    cells = [*T.translation, *T.rotation.as_quat(scalar_first=True)]
    names = ("x", "y", "z", "qw", "qx", "qy", "qz")
    return {f"{body}.{n}": float(v) for n, v in zip(names, cells, strict=True)}


def _felt_cells(frame: str, T: RigidTransform, rng: np.random.Generator) -> dict[str, float]:
    """What holds the frame up, in g, off by a milliradian."""
    tilt = Rotation.from_rotvec(rng.normal(0, LEVEL_RAD, 3))
    felt = tilt.apply(T.rotation.inv().apply([0.0, 0.0, 1.0]))
    return {f"{frame}.{axis}": float(a) for axis, a in zip(("ax", "ay", "az"), felt, strict=True)}


def _write_csv(path: Path, rows: Sequence[Mapping[str, object]]) -> None:
    with path.open("w", newline="") as file:
        table = csv.DictWriter(file, list(rows[0]))
        table.writeheader()
        table.writerows(rows)


def _write_mesh(path: Path, vertices: np.ndarray, triangles: np.ndarray) -> None:
    header = ["ply", "format ascii 1.0", f"element vertex {len(vertices)}"]
    header += [f"property double {axis}" for axis in "xyz"]
    header += [f"element face {len(triangles)}", "property list uchar int vertex_indices"]
    lines = [" ".join(map(repr, v)) for v in vertices.tolist()]
    lines += [" ".join(map(str, (3, *t))) for t in triangles.tolist()]
    path.write_text("\n".join([*header, "end_header", *lines, ""]))


# ------------------------------------------------------------------------------------- differences


def retract(kind: str, value: np.ndarray, step: np.ndarray) -> np.ndarray:
    """The value moved by a tangent, as gtsam moves a vector or a pose."""
    if kind == "pose":
        return value @ gtsam.Pose3.Expmap(step).matrix()
    return value + step


def whitening(v: object) -> np.ndarray:
    """(n, n) that whitens what was known of an unknown before any data; of one quantity of several
    members, their mean is as uncertain as each of them is about it."""
    known = np.diag(np.square(v.sigma))
    if v.of_members and v.dim > 1:
        known += np.outer(v.sigma, v.sigma)
    return np.sqrt(v.weight) * np.linalg.cholesky(np.linalg.inv(known)).T


def shaken(variables: Mapping[str, object], values: Mapping, size: float, seed: int = 1) -> dict:
    """Every value moved by a random tangent of so many rad and m per component."""
    rng = np.random.default_rng(seed)
    return {
        name: retract(v.kind, values[name], size * rng.uniform(-1, 1, v.dim))
        for name, v in variables.items()
    }


def differences(
    function: Callable[[Mapping], np.ndarray],
    values: Mapping,
    name: str,
    kind: str,
    step: float = 1e-5,
) -> np.ndarray:
    """Derivative (m, dim) of a function of the state by one variable's tangent, both sides."""
    dim = 6 if kind == "pose" else np.size(values[name])

    def at(moved: np.ndarray) -> np.ndarray:
        return function({**values, name: retract(kind, values[name], moved)}).ravel()

    return np.stack([(at(e) - at(-e)) / (2 * step) for e in step * np.eye(dim)], axis=1)


def assert_derivative(found: np.ndarray, expected: np.ndarray, what: str = "") -> None:
    """Equal to a millionth of each column, or a thousandth of that of the largest column."""
    assert found.shape == expected.shape, what
    size = np.abs(expected).max(axis=0, initial=1e-12)
    scale = np.maximum(size, 1e-3 * size.max(initial=1e-12))
    assert (np.abs(found - expected) / scale).max(initial=0.0) < 1e-6, what


def assert_block_derivatives(block: object, variables: Mapping, values: Mapping) -> None:
    """Every derivative of a block of rows, moved as the graph moves its variables.

    A variable that is not among those given is a vector.
    """
    _, found = block.evaluate(values, True)
    assert set(found) == set(block.variables)
    for name in block.variables:
        kind = variables[name].kind if name in variables else "vector"
        expected = differences(lambda v: block.evaluate(v, False)[0], values, name, kind)
        assert found[name].shape == (block.rows, expected.shape[1])
        assert_derivative(found[name], expected, name)
