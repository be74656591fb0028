"""The scanned room as the `reference/` of a recording: a mesh, its labels and intensities."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from sensors.ply import write_ply
from sensors.readers.base import ScannedSurface
from sensors.recording import write_table


def write_surface(surface: ScannedSurface, folder: str | Path) -> None:
    """Write `reference/` into a recording's folder: mesh.ply, faces.parquet, labels.yaml.

    Label and intensity are columns of faces.parquet where the surface has them; labels without a
    name are called label_<n>. Without either, the mesh is all there is.
    """
    reference = Path(folder) / "reference"
    reference.mkdir(parents=True, exist_ok=True)
    xyz = dict(zip("xyz", np.asarray(surface.vertices_m, np.float64).T, strict=True))
    corners = {"vertex_indices": np.asarray(surface.triangles, np.int32)}
    write_ply(reference / "mesh.ply", {"vertex": xyz, "face": corners})
    faces = {}
    if surface.label is not None:
        faces["label"] = surface.label.astype(np.uint16)
        names = {int(n): surface.names.get(int(n), f"label_{n}") for n in np.unique(surface.label)}
        (reference / "labels.yaml").write_text(
            "".join(f"{number}: {name}\n" for number, name in names.items()), encoding="utf-8"
        )
    if surface.intensity is not None:
        faces["intensity"] = surface.intensity.astype(np.float32)
    if faces:
        write_table(reference / "faces.parquet", faces)
