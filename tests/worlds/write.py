"""A world as a recording's folder, and its truth beside it."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from . import arm, room
from .beams import model
from .hardware import BODIES, SIGMA_MESH_M, Hardware, built, on_paper
from .knobs import World
from .session import Stops, scan, targets, tracked, visited

POSE = ("x", "y", "z", "qw", "qx", "qy", "qz")
TARGET = [f"{part}_{axis}" for part in ("faro", "upper", "lower") for axis in "xyz"]


def write(world: World, folder: Path, beams: Path | None = None) -> dict[str, Any]:
    """Write a recording, and FOLDER.truth.json beside it.

    Args:
        world: what is recorded.
        folder: does not exist yet.
        beams: a folder that exists; it gets STOP.parquet of what is true of every beam.

    Returns:
        The truth.
    """
    lidar = model(world.lidar)
    rig = built(world, lidar)
    stops = visited(world, rig)
    there = room.furnished(world.rng("room"))
    (folder / "scans").mkdir(parents=True)
    (folder / "reference").mkdir()
    # YAML holds JSON.
    (folder / "rig.yaml").write_text(json.dumps(on_paper(world), indent=1) + "\n")
    (folder / "arm.urdf").write_text(arm.urdf())
    _stops_table(world, stops).to_csv(folder / "stops.csv", index=False)
    rods = pd.DataFrame(targets(world, rig), columns=TARGET)
    rods.insert(0, "target", [f"T{i + 1}" for i in range(len(rods))])
    rods.to_csv(folder / "targets.csv", index=False)
    sigma_m = SIGMA_MESH_M * world.mesh_error_factor
    mesh = room.scanned(there, world.rng("mesh"), sigma_m, world.warp_m, world.meshed)
    _write_reference(mesh, folder / "reference")
    share = _scans(world, rig, stops, there, (folder / "scans", beams))
    truth = _truth(world, rig, stops) | {"clutter_share": share}
    Path(f"{folder}.truth.json").write_text(json.dumps(truth, indent=1) + "\n")
    return truth


def names(stops: Stops) -> list[str]:
    """Stops, as `L00P03`."""
    within = [int(np.sum(stops.location[:k] == x)) for k, x in enumerate(stops.location)]
    return [f"L{x:02d}P{p:02d}" for x, p in zip(stops.location, within, strict=True)]


def _scans(
    world: World,
    rig: Hardware,
    stops: Stops,
    there: room.Quads,
    folders: tuple[Path, Path | None],
) -> float:
    """Write every scan, and what is true of its beams; the share of beams that met clutter."""
    lidar, met, named = model(world.lidar), [], names(stops)
    beams = lidar.directions(world.beams)[0]
    for location in range(world.locations):
        at = np.flatnonzero(stops.location == location)
        T = stops.T_faro_lidar[at]
        towards = beams @ np.swapaxes(T[:, :3, :3], 1, 2)
        rng = world.rng(f"clutter {location}")
        more = room.cluttered(there, rng, world.clutter, T[:, :3, 3], towards)
        everything = there.and_(more)
        some, first, by_m = world.shifted
        for k in at:
            now = everything.shifted(some, by_m) if k >= first else everything
            tables = scan(world, lidar, rig, now, stops, k)
            for table, folder in zip(tables, folders, strict=True):
                if folder is not None:
                    pd.DataFrame(table).to_parquet(folder / f"{named[k]}.parquet", index=False)
        hits = [everything.hit(*each)[1] for each in zip(T[:, :3, 3], towards, strict=True)]
        met.append(np.mean(np.array(hits) >= len(there.corner)))
    return float(np.mean(met))


def _stops_table(world: World, stops: Stops) -> pd.DataFrame:
    table = pd.DataFrame(
        {
            "stop": names(stops),
            "location": [f"L{x:02d}" for x in stops.location],
            "time_s": stops.time_s,
            "temperature_c": stops.temperature_c,
            "humidity": stops.humidity,
        }
    )
    table[list(arm.JOINTS)] = stops.reported_rad
    read = tracked(world, stops)
    for body in BODIES:
        table[[f"{body}.{part}" for part in POSE]] = read[body]
    return table


def _write_reference(mesh: room.Mesh, folder: Path) -> None:
    head = (
        "ply\nformat binary_little_endian 1.0\n"
        f"element vertex {len(mesh.vertices)}\n"
        "property double x\nproperty double y\nproperty double z\n"
        f"element face {len(mesh.faces)}\n"
        "property list uchar uint vertex_indices\nend_header\n"
    )
    faces = np.zeros(len(mesh.faces), [("n", "u1"), ("corners", "<u4", 3)])
    faces["n"], faces["corners"] = 3, mesh.faces
    body = mesh.vertices.astype("<f8").tobytes() + faces.tobytes()
    (folder / "mesh.ply").write_bytes(head.encode() + body)
    white = np.array(list(room.LABELS.values()), np.float32)[mesh.label]
    table = pd.DataFrame({"label": mesh.label.astype(np.uint16), "intensity": white})
    table.to_parquet(folder / "faces.parquet", index=False)
    lines = [f"{i}: {name}\n" for i, name in enumerate(room.LABELS)]
    (folder / "labels.yaml").write_text("".join(lines))


def _truth(world: World, rig: Hardware, stops: Stops) -> dict[str, Any]:
    return {
        "world": asdict(world),
        "effects": [name for name, _ in world.hidden],
        "params": dict(world.hidden),
        "dlen": rig.extra_m.tolist(),
        "joint_offset": rig.zero_rad.tolist(),
        "ring_range_offset": rig.ring_m.tolist(),
        "stop_zero_m": stops.zero_m.tolist(),
        "T_faro_opti": rig.T_faro_opti.tolist(),
        "frames": {name: T.tolist() for name, T in rig.frames.items()},
    }
