"""Simulated recordings, and the rays and chains that they are checked against.

Nothing here uses the code under test: chains are products of scipy's RigidTransform, and beams are
taken from the points as the driver gives them.
"""

import json
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from calib.problem.model import Source
from calib.simulation import Spec, simulate

QUICK = {"locations": 2, "stops_per_location": 2, "column_step": 128}
EXACT = Spec(**QUICK, noise=0, build_error=0, mesh_error_m=0, mixed_pixel_share=0, occluded_share=0)
BELOW_M = 0.18


def made(folder: Path, spec: str | Spec, seed: int = 3, **hide: float) -> tuple[Source, dict]:
    """A simulated recording, opened, and its truth."""
    simulate(spec, folder, seed, hide)
    return Source.open(folder), json.loads(Path(f"{folder}.truth.json").read_text())


def changed(spec: Spec, **fields: object) -> Spec:
    return Spec(**{**spec.model_dump(), **fields})


def pose(T: object) -> RigidTransform:
    return RigidTransform.from_matrix(np.array(T))


def seen(source: Source, body: str, stop: int) -> RigidTransform:
    x, y, z, *quat = source.recording.bodies[body][stop]
    return RigidTransform.from_components([x, y, z], Rotation.from_quat(quat, scalar_first=True))


def nominal(source: Source, frame: str, joints: np.ndarray) -> RigidTransform:
    """T_root_frame, edge after edge."""
    T, tree = RigidTransform.identity(), source.rig.tree
    reported = dict(zip(source.rig.joint_names, joints, strict=True))
    for edge in (tree.edges[i] for i in tree.path(frame)):
        T = T * pose(edge.T_parent_child)
        if edge.joint:
            turn = Rotation.from_rotvec(reported[edge.joint.name] * edge.joint.axis)
            T = T * RigidTransform.from_rotation(turn)
    return T


def rays(
    source: Source, stop: int, T_faro_lidar: object
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Origins and directions in the FARO's frame, and ranges, of a stop's points."""
    xyz = source.recording.scan(stop).xyz_m
    ahead, left = source.rig.lidar.beam_origin_m
    assert left == 0
    flat = xyz * [1, 1, 0]
    origin = ahead * flat / np.linalg.norm(flat, axis=1, keepdims=True)
    range_m = np.linalg.norm(xyz - origin, axis=1)
    T = pose(T_faro_lidar)
    return T.apply(origin), T.rotation.apply((xyz - origin) / range_m[:, None]), range_m


def first_hit(origin: np.ndarray, direction: np.ndarray, corners: np.ndarray) -> float:
    """Distance to the nearest of the triangles (F, 3, 3) along one ray (Moeller and Trumbore)."""
    e1, e2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    p = np.cross(direction, e2)
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = 1 / np.einsum("fi,fi->f", e1, p)
        s = origin - corners[:, 0]
        u = np.einsum("fi,fi->f", s, p) * inverse
        q = np.cross(s, e1)
        v = q @ direction * inverse
        t = np.einsum("fi,fi->f", e2, q) * inverse
    inside = (u >= -1e-9) & (v >= -1e-9) & (u + v <= 1 + 1e-9) & (t > 1e-6)
    return t[inside].min(initial=np.inf)


def off_mesh(source: Source, truth: dict, stop: int) -> tuple[np.ndarray, object]:
    """Measured less true range of each point, and what it hit."""
    name = source.recording.stops[stop]
    origin, direction, range_m = rays(source, stop, truth["stops"][name]["T_faro_lidar"])
    hits = source.reference.cast(origin, direction)
    return range_m - hits.range_m, hits
