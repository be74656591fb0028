"""An arm that goes from hold to hold under a tracker, logged by files that the tests write.

Nothing here uses the code under test: the arm's chain is a product of scipy's transforms.
"""

from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

# a, alpha, d of standard rows; m and rad.
DH = ((0.0, np.pi / 2, 0.3), (-0.4, 0.0, 0.0), (-0.3, 0.4, 0.1), (0.1, -np.pi / 2, 0.2))
JOINTS = tuple(f"j{k + 1}" for k in range(len(DH)))
T_TIP_CUP = RigidTransform.from_components([0.05, -0.1, 0.2], Rotation.from_rotvec([0.4, 1, -2]))
T_WORLD_BASE = RigidTransform.from_components([2, -1, 0.5], Rotation.from_rotvec([0.1, 0.2, 2.5]))
T_BASE_FOOT = RigidTransform.from_components([0.2, 0.3, -0.1], Rotation.from_rotvec([0, 0.3, 0.1]))


def tip(joints: np.ndarray) -> RigidTransform:
    """T_base_tip of joints (K, 4)."""
    chain = RigidTransform.identity(len(joints))
    for (a, alpha, d), q in zip(DH, joints.T, strict=True):
        turn = Rotation.from_euler("z", q[:, None])
        chain = chain * RigidTransform.from_components(np.tile([0, 0, d], (len(q), 1)), turn)
        chain = chain * RigidTransform.from_components([a, 0, 0], Rotation.from_euler("x", alpha))
    return chain


def plan(holds: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Joints (K, 4) of holds and their spans (K, 2) s; moves take 1.5 to 3 s, holds 2 to 4 s."""
    rng = np.random.default_rng(seed)
    lengths = rng.uniform(2, 4, holds), rng.uniform(1.5, 3, holds)
    starts = np.concatenate([[0], np.cumsum(lengths[0] + lengths[1])[:-1]])
    return rng.uniform(-1.2, 1.2, (holds, 4)), np.stack([starts, starts + lengths[0]], axis=1)


def logged(held: np.ndarray, spans: np.ndarray, time_s: np.ndarray) -> np.ndarray:
    """Values (N, C) at times: constant in each hold, and smooth from each to the next."""
    k = np.clip(np.searchsorted(spans[:, 0], time_s, side="right") - 1, 0, len(held) - 1)
    after = np.minimum(k + 1, len(held) - 1)
    end, start = spans[k, 1], spans[after, 0]
    u = np.clip((time_s - end) / np.maximum(start - end, 1e-9), 0, 1)
    return held[k] + (held[after] - held[k]) * (u**2 * (3 - 2 * u))[:, None]


def tum(path: Path, time_s: np.ndarray, pose: RigidTransform, noise: float = 0.0) -> Path:
    """A trajectory of TUM, with noise in m and rad."""
    rng = np.random.default_rng(7)
    jitter = RigidTransform.from_exp_coords(noise * rng.normal(size=(len(time_s), 6)))
    pose = pose * jitter
    rows = np.column_stack([time_s, pose.translation, pose.rotation.as_quat()])
    np.savetxt(path, rows, fmt="%.9f")
    return path


def joint_log(path: Path, time_s: np.ndarray, joints: np.ndarray) -> Path:
    """A table of joints with our names."""
    rows = np.column_stack([time_s, joints])
    np.savetxt(path, rows, "%.9f", ",", header=",".join(["time_s", *JOINTS]), comments="")
    return path


def dh(path: Path) -> Path:
    """The arm's table."""
    rows = ", ".join(
        f"{{name: {name}, a: {a}, alpha: {alpha!r}, d: {d}}}"
        for name, (a, alpha, d) in zip(JOINTS, DH, strict=True)
    )
    path.write_text(f"{{convention: standard, joints: [{rows}]}}")
    return path
