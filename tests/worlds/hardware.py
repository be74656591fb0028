"""The rig as it is on paper, and as it is."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from . import arm
from .beams import Lidar
from .knobs import World
from .poses import moved, pose, rpy, turn

# Frame -> parent, xyz m, rpy rad, sigma m, sigma rad.
FRAMES = {
    "base_markers": ("base", (0.10, -0.06, 0.35), (0.0, 0.0, 0.4), 0.0015, 0.003),
    "arm_base": ("base", (0.20, 0.0, 0.40), (0.0, 0.0, 0.0), 0.0015, 0.003),
    "mount": ("arm_end", (0.0, 0.0, 0.02), (0.0, 0.0, 0.6), 0.0008, 0.002),
    "mount_markers": ("mount", (0.04, 0.02, 0.05), (0.0, 0.0, 0.0), 0.0008, 0.002),
    "lidar": ("mount", (0.0, 0.01, 0.09), (0.0, 0.0, -0.8), 0.001, 0.003),
}
BODIES = ("base_markers", "mount_markers")
SIGMA_LENGTH_M, SIGMA_ZERO_RAD = 0.003, 0.003
SIGMA_JOINT_RAD = 0.0001
SIGMA_TRACKER_M, SIGMA_TRACKER_RAD = 0.0002, 0.0003
SIGMA_SPHERE_M, SIGMA_MARKER_M = 0.0006, 0.0002
SIGMA_MESH_M = 0.0006
BELOW_M = 0.18  # a sphere's centre, of the lower marker


@dataclass(frozen=True)
class Hardware:
    """What the rig is truly like.

    Args:
        frames: name -> T_parent_child.
        extra_m: (7,) of the lengths of the arm's origins.
        zero_rad: (6,) true minus reported joints.
        ring_m: (R,) range zeros.
        T_faro_opti: of the room's two worlds.
    """

    frames: Mapping[str, np.ndarray]
    extra_m: np.ndarray
    zero_rad: np.ndarray
    ring_m: np.ndarray
    T_faro_opti: np.ndarray

    def of_base(self, angles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """T_base_mount and T_base_lidar (K, 4, 4) at true angles (K, 6) rad."""
        tip = arm.along(angles, arm.lengthened(self.extra_m))[:, -1]
        T_base_mount = self.frames["arm_base"] @ tip @ self.frames["mount"]
        return T_base_mount, T_base_mount @ self.frames["lidar"]


def built(world: World, lidar: Lidar) -> Hardware:
    """A rig whose parts are off what paper says by about as much as it says."""
    rng = world.rng("hardware")
    frames = {}
    for name, (_, xyz, angles, sigma_m, sigma_rad) in FRAMES.items():
        shift, vector = rng.standard_normal((2, 3))
        frames[name] = moved(pose(rpy(*angles), xyz), sigma_m * shift, sigma_rad * vector)
    has_length = np.linalg.norm(arm.ORIGINS, axis=1) > 0
    extra_m = SIGMA_LENGTH_M * rng.standard_normal(7) * has_length
    zero_rad = SIGMA_ZERO_RAD * rng.standard_normal(6)
    rings = np.arange(len(lidar.elevation_rad))
    wave = np.sin(2 * np.pi * rings / rng.uniform(3, 12) + rng.uniform(0, 6))
    pattern = 0.8 * rng.standard_normal(len(rings)) + 0.85 * wave
    shift = np.array([*rng.uniform(-0.7, 0.7, 2), rng.uniform(-0.1, 0.1)])
    tilt = moved(pose(turn((0.0, 0.0, 1.0), rng.uniform(-3, 3)), shift), np.zeros(3), np.zeros(3))
    return Hardware(
        frames=frames,
        extra_m=extra_m,
        zero_rad=zero_rad,
        ring_m=lidar.ring_mean_m + lidar.ring_sigma_m * pattern,
        T_faro_opti=moved(tilt, np.zeros(3), 0.001 * rng.standard_normal(3)),
    )


def on_paper(world: World) -> dict[str, Any]:
    """rig.yaml."""
    frames = {
        name: {
            "parent": parent,
            "xyz_m": list(xyz),
            "rpy_rad": list(angles),
            "sigma_m": sigma_m,
            "sigma_rad": sigma_rad,
        }
        for name, (parent, xyz, angles, sigma_m, sigma_rad) in FRAMES.items()
    }
    return {
        "name": "worlds",
        "lidar": {"model": world.lidar, "frame": "lidar", "beam_origin_m": [0.0, 0.0]},
        "arm": {
            "urdf": "arm.urdf",
            "base": "arm_base",
            "tip": "arm_end",
            "sigma_joint_rad": SIGMA_JOINT_RAD,
        },
        "frames": frames,
        "base": {"moves": "location" if world.stands else "stop"},
        "tracker": {
            "frame": "opti",
            "bodies": list(BODIES),
            "sigma_m": SIGMA_TRACKER_M,
            "sigma_rad": SIGMA_TRACKER_RAD,
        },
        "target": {
            "sphere_below_lower_marker_m": BELOW_M,
            "sigma_sphere_m": SIGMA_SPHERE_M,
            "sigma_marker_m": SIGMA_MARKER_M,
        },
        "reference": {
            "frame": "faro",
            "mesh": "reference/mesh.ply",
            "faces": "reference/faces.parquet",
            "labels": "reference/labels.yaml",
            "sigma_m": SIGMA_MESH_M,
        },
    }
