"""A LiDAR in the hand, or on a cart: no arm, and one body by which a tracker follows it."""

import json

import numpy as np
import pandas as pd

from chains import se3
from tests.worlds import World, write
from tests.worlds.beams import model
from tests.worlds.hardware import SIGMA_TRACKER_M, SIGMA_TRACKER_RAD, built
from tests.worlds.session import visited

HAND = World(seed=5, locations=8, stops=1, beams=600)
XYZ, QUAT = ("x", "y", "z"), ("qw", "qx", "qy", "qz")
POSE = (*XYZ, *QUAT)
FRAMES = {
    "markers": ((0.1, -0.05, 0.12), (0.0, 0.0, 0.3)),
    "lidar": ((0.02, 0.03, 0.25), (0, 0, -0.7)),
}


def handheld(folder, world=HAND, guess=None, targets=True, tracked=True):
    """A recording of a world's room from where its LiDAR was.

    Args:
        folder: does not exist yet.
        world: of `tests.worlds`; its arm is what the hand does.
        guess: sigmas, m and rad, of a base_guess; without it there is none.
        targets: whether spheres tie the tracker to the mesh.
        tracked: whether there is a tracker.

    Returns:
        T_faro_base (K, 4, 4).
    """
    write(world, folder)
    rig, rng = built(world, model(world.lidar)), np.random.default_rng(world.seed)
    at = {name: se3.from_xyz_rpy(*placed) for name, placed in FRAMES.items()}
    off = se3.exp(rng.standard_normal(6) * np.repeat([0.004, 0.0015], 3))
    T_faro_base = visited(world, rig).T_faro_lidar @ se3.inverse(at["lidar"] @ off)
    table = pd.read_csv(folder / "stops.csv")[["stop", "location", "time_s"]]
    paper = json.loads((folder / "rig.yaml").read_text())
    del paper["arm"]
    paper["base"] = {"moves": "stop"}
    paper["frames"] = {
        name: {"parent": "base", "xyz_m": list(xyz), "rpy_rad": list(rpy)}
        | (
            {"sigma_m": 0.0015, "sigma_rad": 0.004}
            if name == "lidar"
            else {"sigma_m": 0.0, "sigma_rad": 0.0}
        )
        for name, (xyz, rpy) in FRAMES.items()
    }
    if tracked:
        noise = rng.standard_normal((len(table), 6))
        noise *= np.repeat([SIGMA_TRACKER_RAD, SIGMA_TRACKER_M], 3)
        T = se3.inverse(rig.T_faro_opti) @ T_faro_base @ at["markers"] @ se3.exp(noise)
        paper["tracker"]["bodies"] = ["markers"]
        _put(table, "markers", T)
    else:
        del paper["tracker"], paper["frames"]["markers"]
    if guess is not None:
        near = rng.standard_normal((len(table), 6)) * np.repeat([guess[1], guess[0]], 3)
        _put(table, "base_guess", T_faro_base @ se3.exp(near))
    if not (targets and tracked):
        del paper["target"]
        (folder / "targets.csv").unlink()
    table.to_csv(folder / "stops.csv", index=False)
    (folder / "rig.yaml").write_text(json.dumps(paper))
    return T_faro_base


def _put(table, name, T):
    columns = [f"{name}.{part}" for part in POSE]
    table[columns] = np.concatenate([T[:, :3, 3], se3.to_quat_wxyz(T)], axis=1)


def rewritten(folder, change, name="markers"):
    """The columns of a body's poses (K, 7) become what `change` makes of them."""
    table = pd.read_csv(folder / "stops.csv")
    columns = [f"{name}.{part}" for part in POSE]
    table[columns] = change(table[columns].to_numpy())
    table.to_csv(folder / "stops.csv", index=False)
