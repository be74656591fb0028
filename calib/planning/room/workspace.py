"""How errors of a calibration move what an arm carries, over all that it can reach."""

from __future__ import annotations

import numpy as np

from calib.planning.information import Information
from calib.planning.scene import PlanningScene
from calib.planning.stops import Poses
from calib.results.reach import at_joints, body_beyond, placed
from chains.errors import InputError


def moved_anywhere(scene: PlanningScene, known: Information, poses: Poses) -> np.ndarray:
    """Mean (S, S) over poses of ``J^T J``, m2: J is how the components that are known move the
    position of the LiDAR, or else of the last tracked body beyond the joints.

    That position is told from a tracked body before the joints, or else from the tracker where
    the base stands still, or else from the arm's root.

    Args:
        scene: the fit.
        known: its S components, in units of what was known before.
        poses: all over the workspace.

    Raises:
        InputError: the arm carries neither.
    """
    problem, rig = scene.stand.estimate.problem, scene.source.rig
    beyond = body_beyond(problem)
    carried = rig.lidar_frame if scene.scanned else beyond and beyond.body
    if carried is None:
        raise InputError(
            f"{rig.folder}: the arm carries no LiDAR that scans, and no tracked body, whose place "
            "could be predicted"
        )
    names = {name for name, _ in known.keys}
    at_stop = np.zeros(len(poses.joints), int) if scene.source.recording.stops else None
    stops = at_joints(problem, at_stop, poses.joints, beyond.root if beyond else "")
    base = beyond.base if beyond else None
    if base is None and not (beyond and beyond.root in names):
        base = rig.tree.root
    seen = placed(stops, carried, base, scene.values)
    at, out = {key: i for i, key in enumerate(known.keys)}, np.zeros((len(known.keys),) * 2)
    mine = [name for name in seen.d if name in names]
    columns = np.array([at[key] for n in mine for key in problem.variables[n].keys], int)
    J = seen.by(mine)[:, 3:] * known.unit[columns]
    out[np.ix_(columns, columns)] = np.einsum("nip,niq->pq", J, J) / len(J)
    return out
