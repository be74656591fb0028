"""Planned stops in the room: the arm as it would stand there, drawn thin, with its number."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from calib.runs.run import Run
from calib.view.scene import Scene
from chains import se3
from chains.errors import InputError
from sensors.documents import read_json

PLANNED_PATH = "/planned"  # under which they stand in the scene
GHOST_COLOUR = (0, 114, 178)
GHOST_M = 0.02  # its lines are as thick: thinner than the arm that was measured


@dataclass(frozen=True)
class Ghost:
    """A planned stop.

    Args:
        number: as the plan has it, from 1.
        lines_m: (n, 2, 3) from frame to frame of the rig, reference frame.
        tip_m: (3,) where the last of them ends.
    """

    number: int
    lines_m: np.ndarray
    tip_m: np.ndarray


def plan_beside(run: Run) -> Path:
    """Where a plan for a run is looked for: ``rigcal plan RUN -o RUN-plan`` writes it there."""
    return run.folder.with_name(f"{run.folder.name}-plan") / "plan.json"


def ghosts(scene: Scene, recording: int) -> list[Ghost]:
    """The planned stops of the plan beside a run, as CAD has the rig; none where there is no plan,
    or for others than the first of its recordings, for which stops are planned.

    Raises:
        InputError: the plan is of another rig, or no plan.
    """
    path = plan_beside(scene.run)
    if recording or not path.is_file():
        return []
    document, tree = read_json(path), scene.sources[recording].rig.tree
    try:
        stops, places = document["stops"], document["places"]
        joints = np.array([[stop[name] for name in tree.joint_names] for stop in stops], float)
        roots = [places[stop["location"]] for stop in stops]
        Ts = se3.from_xyz_quat(
            np.array([root["xyz_m"] for root in roots], float),
            np.array([root["quat_wxyz"] for root in roots], float),
        )
    except (KeyError, TypeError, ValueError):
        raise InputError(
            f"{path} is no plan for this rig; write it again with 'rigcal plan {scene.run.folder} "
            f"-o {path.parent}'"
        ) from None
    at = {f: (Ts @ tree.place(f, joints).Ts_root_frame)[:, :3, 3] for f in tree.frames}
    ends = np.stack([np.stack([at[e.parent], at[e.child]], axis=1) for e in tree.edges], axis=1)
    tip = scene.sources[recording].rig.lidar_frame or tree.edges[-1].child
    return [Ghost(k + 1, ends[k], at[tip][k]) for k in range(len(stops))]


def draw(gui_scene: Any, path: str, some: list[Ghost], middle_m: np.ndarray, shown: bool) -> None:
    """Draw planned stops.

    Args:
        gui_scene: viser's.
        path: under which they stand.
        some: they.
        middle_m: (3,) about which all is drawn.
        shown: whether they are seen at first.
    """
    gui_scene.remove_by_name(path)
    gui_scene.add_frame(path, show_axes=False, visible=shown)
    for ghost in some:
        gui_scene.add_line_segments(
            f"{path}/{ghost.number}", ghost.lines_m - middle_m, GHOST_COLOUR, thickness=GHOST_M
        )
        gui_scene.add_label(
            f"{path}/{ghost.number}/name", str(ghost.number), position=ghost.tip_m - middle_m
        )
