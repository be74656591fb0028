"""Two arms on a torso that turns and rises, under a tracker; placed by scipy.

The world shares no line with the fit's kinematics.
"""

from dataclasses import dataclass

import numpy as np
import pandas as pd
import yaml
from scipy.spatial.transform import RigidTransform, Rotation

from .rigs import pose

TRACKER_M, TRACKER_RAD = 5e-5, 2e-4
HANDS = ("left_hand", "right_hand")
# joint: kind, parent, child, xyz_m, rpy_rad, axis, half of its range (rad or m)
TORSO = {
    "waist": ("revolute", "foot", "hip", (0, 0, 0.4), (0, 0, 0), (0, 0, 1), 1.5),
    "lift": ("prismatic", "hip", "chest", (0.05, 0, 0.3), (0, 0, 0), (0, 0, 1), 0.2),
}
ARM = (
    ("1", (0.0, 0.2, 0.25), (-0.9, 0, 0), (0, 0, 1)),
    ("2", (0, 0, 0.12), (np.pi / 2, 0, 0), (0, 0, 1)),
    ("3", (0, 0.31, 0.02), (0, 0, 0), (0, 0, 1)),
    ("4", (0, 0, 0), (-np.pi / 2, 0, 0), (0, 0, 1)),
    ("5", (0, 0, 0.27), (np.pi / 2, 0, 0), (0, 0, 1)),
    ("6", (0, 0.01, 0), (-np.pi / 2, 0, 0), (0, 0, 1)),
)


def _edges():
    edges = {name: row for name, row in TORSO.items()}
    for side, mirror in (("left", 1.0), ("right", -1.0)):
        parent = "chest"
        for number, xyz_m, rpy_rad, axis in ARM:
            xyz_m = (xyz_m[0], mirror * xyz_m[1], xyz_m[2]) if number == "1" else xyz_m
            rpy_rad = tuple(mirror * r for r in rpy_rad) if number == "1" else rpy_rad
            child = f"{side}_link_{number}"
            row = ("revolute", parent, child, xyz_m, rpy_rad, axis, 2.2)
            edges[f"{side}_{number}"], parent = row, child
        wrist = ("fixed", parent, f"{side}_hand", (0, 0, 0.08), (0, 0, 0), None, 0.0)
        edges[f"{side}_wrist"] = wrist
    return edges


EDGES = _edges()
JOINTS = [name for name, (kind, *_) in EDGES.items() if kind != "fixed"]


@dataclass(frozen=True)
class TwoArms:
    """The hardware: what is added to each origin's length [m], to each joint [rad or m], and each
    tool's twist (6,) after its drawn place."""

    lengths: dict[str, float]
    zeros: dict[str, float]
    tools: dict[str, np.ndarray]
    T_world_foot: RigidTransform

    def seen(self, hand: str, reported: np.ndarray) -> RigidTransform:
        """T_world_tool (K,) without noise."""
        T = RigidTransform.identity(len(reported))
        for name, (kind, _, _, xyz_m, rpy_rad, axis, _) in reversed(_way(hand)):
            motion = RigidTransform.identity(len(reported))
            if axis:
                q = (reported[:, JOINTS.index(name)] + self.zeros[name])[:, None] * axis
                parts = (q, 0 * q) if kind == "revolute" else (0 * q, q)
                motion = RigidTransform.from_exp_coords(np.concatenate(parts, axis=1))
            length_m = np.linalg.norm(xyz_m)
            longer = np.array(xyz_m) * (1 + self.lengths[name] / length_m if length_m else 1.0)
            T = pose(longer, rpy_rad) * motion * T
        tool = pose((0.02, 0.03, 0.05), (0, 0, 0)) * RigidTransform.from_exp_coords(
            self.tools[hand]
        )
        return self.T_world_foot * T * tool


def _way(link):
    """The edges from the foot to a link."""
    way = []
    while link != "foot":
        name, row = next((n, r) for n, r in EDGES.items() if r[2] == link)
        way, link = [(name, row), *way], row[1]
    return way


def drawn(rng: np.random.Generator) -> TwoArms:
    """Hardware as far off as is usual."""
    foot = RigidTransform.from_components([0.5, 1.0, 0.1], Rotation.from_rotvec([0.01, 0.02, 0.7]))
    size = np.repeat([0.01, 0.003], 3)
    return TwoArms(
        lengths={n: 1e-3 * rng.normal() * bool(np.any(row[3])) for n, row in EDGES.items()},
        zeros={name: 2e-3 * rng.normal() for name in JOINTS},
        tools={hand: size * rng.normal(size=6) for hand in HANDS},
        T_world_foot=foot,
    )


def write(folder, arms: TwoArms, poses: int, rng: np.random.Generator, **arm: object) -> None:
    """A recording of some poses anywhere, at which both hands are seen."""
    folder.mkdir()
    tools = {
        f"{hand}_tool": {"parent": hand, "xyz_m": [0.02, 0.03, 0.05], "sigma_m": 0.003}
        | {"sigma_rad": 0.01}
        for hand in HANDS
    }
    foot = {"parent": "base", "xyz_m": [0, 0, 0], "sigma_m": 0, "sigma_rad": 0}
    rig = {
        "name": "torso",
        "arm": {"urdf": "arm.urdf", "base": "foot", "tip": list(HANDS)} | arm,
        "frames": {"foot": foot, **tools},
        "base": {"moves": "never"},
        "tracker": {"bodies": list(tools), "sigma_m": TRACKER_M, "sigma_rad": TRACKER_RAD},
    }
    (folder / "rig.yaml").write_text(yaml.safe_dump(rig))
    (folder / "arm.urdf").write_text(urdf())
    half = np.array([EDGES[name][-1] for name in JOINTS])
    joints = rng.uniform(-half, half, (poses, len(half)))
    table = {"stop": [f"p{k:03d}" for k in range(poses)], "location": "a"}
    table |= dict(zip(JOINTS, joints.T, strict=True))
    for hand in HANDS:
        off = rng.normal(size=(poses, 6)) * np.repeat([TRACKER_RAD, TRACKER_M], 3)
        T = arms.seen(hand, joints) * RigidTransform.from_exp_coords(off)
        xyzw = T.rotation.as_quat()
        table |= {f"{hand}_tool.{c}": x for c, x in zip("xyz", T.translation.T, strict=True)}
        quat = zip("wxyz", (3, 0, 1, 2), strict=True)
        table |= {f"{hand}_tool.q{c}": xyzw[:, i] for c, i in quat}
    pd.DataFrame(table).to_csv(folder / "stops.csv", index=False)


def urdf() -> str:
    """As its maker draws it: each link 2 kg."""
    lines = ['<robot name="torso"><link name="foot"/>']
    for name, (kind, parent, child, xyz_m, rpy_rad, axis, half) in EDGES.items():
        words = (" ".join(map(repr, map(float, each))) for each in (xyz_m, rpy_rad))
        xyz, rpy = words
        moves = ""
        if axis:
            along = " ".join(map(str, axis))
            moves = f'<axis xyz="{along}"/><limit lower="{-half}" upper="{half}" effort="1" '
            moves += 'velocity="1"/>'
        lines.append(
            f'<link name="{child}"><inertial><mass value="{1.5 + 0.1 * len(lines)}"/></inertial>'
            f'</link><joint name="{name}" type="{kind}"><parent link="{parent}"/>'
            f'<child link="{child}"/><origin xyz="{xyz}" rpy="{rpy}"/>{moves}</joint>'
        )
    return "\n".join([*lines, "</robot>"])
