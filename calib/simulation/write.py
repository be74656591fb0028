"""A simulated recording's files, and its truth."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from calib.simulation.room import LABEL_NAMES, write_ply
from calib.simulation.spec import Spec
from calib.simulation.stops import World, hang_targets
from calib.simulation.truth import Truth
from chains import se3
from sensors.documents import write_json
from sensors.recording import write_table
from sensors.reference import Reference
from sensors.stops import POSE, level_columns, write_columns


def write_reference(folder: Path, mesh: Reference) -> None:
    """Write the mesh as measured, with label and FARO intensity per triangle."""
    folder.mkdir()
    write_ply(folder / "mesh.ply", mesh)
    faces = {"label": mesh.label.astype(np.uint16), "intensity": mesh.intensity.astype(np.float32)}
    write_table(folder / "faces.parquet", faces)
    labels = "".join(f"{number}: {name}\n" for number, name in LABEL_NAMES.items())
    (folder / "labels.yaml").write_text(labels, encoding="utf-8")


def write_stops(path: Path, world: World, spec: Spec, rng: np.random.Generator) -> None:
    """Write stops.csv: time and covariates, joints, tracked bodies or the guessed base."""
    stops, rig = world.plan, world.truth.rig
    columns: dict[str, Iterable] = {
        "stop": stops.names,
        "location": stops.location,
        **stops.columns,
        **dict(zip(rig.joint_names, stops.joints.T, strict=True)),
    }
    columns = {name: column for name, column in columns.items() if name not in rig.passive}
    hidden = rng.random(len(stops.names)) < spec.occluded_share
    for body, Ts_opti_body in world.tracked(spec.noise, rng).items():
        pose = _pose(Ts_opti_body)
        if body in rig.beyond_arm:
            pose[hidden] = np.nan
        parts = POSE[:3] if spec.tracker == "points" else POSE
        columns |= {f"{body}.{part}": pose[:, i] for i, part in enumerate(parts)}
    for frame, felt in world.felt(spec.noise, rng).items():
        columns |= dict(zip(level_columns(frame), felt.T, strict=True))
    if not spec.tracker:
        pose = _pose(world.guessed(spec.base_moves, rng))
        columns |= {f"base_guess.{part}": pose[:, i] for i, part in enumerate(POSE)}
    write_columns(path, columns)


def write_targets(path: Path, truth: Truth, spec: Spec, rng: np.random.Generator) -> None:
    """Write targets.csv: spheres and markers as measured."""
    measured = hang_targets(truth, spec.names["target"], spec.noise, rng)
    columns: dict[str, Iterable] = {"target": spec.names["target"]}
    for name, at in measured.items():
        columns |= {f"{name}_{axis}": at[:, i] for i, axis in enumerate("xyz")}
    write_columns(path, columns)


def write_truth(path: Path, world: World, spec: Spec, seed: int) -> None:
    """Write what a fit should find: frames, effects, and where every stop truly was."""
    truth, stops = world.truth, world.plan
    frames = {"root": stops.Ts_faro_root}
    if truth.rig.lidar_frame:
        frames["lidar"] = world.in_faro(truth.rig.lidar_frame)
    document = {
        "spec": spec.model_dump(),
        "seed": seed,
        "hidden": dict(truth.hidden),
        "T_faro_opti": se3.inverse(truth.T_opti_faro),
        "frames": truth.frames,
        "effects": {e.name: theta for e, theta in truth.effects if e.name not in truth.frames},
        "stops": {
            name: {f"T_faro_{frame}": Ts[k] for frame, Ts in frames.items()}
            for k, name in enumerate(stops.names)
        },
    }
    write_json(path, document)


def _pose(T: np.ndarray) -> np.ndarray:
    """x y z qw qx qy qz (K, 7) of poses (K, 4, 4)."""
    return np.concatenate([T[:, :3, 3], se3.to_quat_wxyz(T)], axis=1)
