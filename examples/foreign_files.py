"""Writes a recording as the files that people have: logs, a take, clouds, a mesh."""

import shutil
from pathlib import Path

import numpy as np

from calib.problem.model import Source
from chains import se3
from sensors.meshes import write_cloud
from sensors.ply import write_ply
from sensors.recording import read_table

HOLD_S, MOVE_S, LATER_S = 3.0, 2.0, 0.37  # Motive's clock starts that much later
Z_TO_Y_UP = se3.exp([-np.pi / 2, 0, 0, 0, 0, 0])


def logged(stops: np.ndarray, start_s: float, rate_hz: float) -> np.ndarray:
    """Time since the start, and columns that stay at each stop (K, C), then go to the next."""
    time_s = np.arange(start_s, len(stops) * (HOLD_S + MOVE_S) - MOVE_S, 1 / rate_hz)
    k, within = np.divmod(time_s, HOLD_S + MOVE_S)
    k, u = k.astype(int), np.clip((within - HOLD_S) / MOVE_S, 0, 1)[:, None]
    step = np.diff(stops, axis=0, append=stops[-1:])
    return np.column_stack([time_s - start_s, stops[k] + step[k] * u**2 * (3 - 2 * u)])


def write(path: Path, head: list[str], rows: np.ndarray) -> None:
    """A CSV file with some lines above its numbers."""
    lines = [",".join(row) for row in np.char.mod("%.7f", rows)]
    path.write_text("\n".join([*head, *lines, ""]))


def take(path: Path, parts: dict[str, np.ndarray]) -> None:
    """A take of Motive: poses (K, 4, 4) by stop of bodies, and of markers, which have a colon."""
    head, columns = [["", ""], ["", ""], ["", ""], ["Frame", "Time (Seconds)"]], []
    for name, Ts in parts.items():
        Ts, body = Z_TO_Y_UP @ Ts, ":" not in name
        quat = se3.to_quat_wxyz(Ts)
        quat[1:] *= np.cumprod(np.sign(np.sum(quat[1:] * quat[:-1], axis=1)))[:, None]  # short way
        log = logged(np.hstack([quat, 1000 * Ts[:, :3, 3]]), LATER_S, 100)
        log[:, 1:5] /= np.linalg.norm(log[:, 1:5], axis=1, keepdims=True)
        time_s, kept = log[:, :1], slice(1, None) if body else slice(5, None)
        columns.append(log[:, kept])
        axes = ["W", "X", "Y", "Z"] * body + ["X", "Y", "Z"]
        named = (["Rigid Body" if body else "Marker"], [name], [], [])
        for row, cell in zip(head, named, strict=True):
            row += cell * len(axes)
        head[2] += ["Rotation"] * (len(axes) - 3) + ["Position"] * 3
        head[3] += axes
    facts = "Format Version,1.23,Export Frame Rate,100,Rotation Type,Quaternion"
    rows = np.hstack([np.arange(len(time_s))[:, None], time_s, *columns])
    write(path, [f"{facts},Length Units,Millimeters", "", *map(",".join, head)], rows)


def write_files(folder: Path, files: Path) -> None:
    """Write what is in a recording's folder as foreign files into another."""
    (files / "clouds").mkdir(parents=True, exist_ok=True)
    source = Source.open(folder)
    rig, recording, targets = source.rig, source.recording, source.recording.targets
    for k, stop in enumerate(recording.stops):
        write_cloud(files / f"clouds/{k:02d}.ply", read_table(folder / f"scans/{stop}.parquet"))
    joints = logged(np.degrees(recording.joints), 0, 50)
    write(files / "joints.csv", [",".join(["time_s", *rig.joint_names])], joints)
    parts = {b: se3.from_xyz_quat(at[:, :3], at[:, 3:]) for b, at in recording.bodies.items()}
    for at_m, end in ((targets.upper_m, "upper"), (targets.lower_m, "lower")):
        for name, xyz in zip(targets.names, at_m, strict=True):
            parts[f"{name}:{end}"] = np.tile(
                se3.from_xyz_rpy(xyz, [0, 0, 0]), (len(recording.stops), 1, 1)
            )
    take(files / "take.csv", parts)
    spheres = [
        ",".join([n, *map(repr, c)])
        for n, c in zip(targets.names, targets.faro_m.tolist(), strict=True)
    ]
    (files / "spheres.csv").write_text("\n".join(["name,x [m],y [m],z [m]", *spheres, ""]))
    mesh = source.reference
    vertices = dict(zip("xyz", mesh.vertices_m.T, strict=True))
    faces = {
        "vertex_indices": mesh.triangles.astype(np.int32),
        "label": mesh.label.astype(np.uint16),
    }
    write_ply(files / "room.ply", {"vertex": vertices, "face": faces})
    for name in ("arm.urdf", "rig.yaml"):
        shutil.copyfile(folder / name, files / name)
