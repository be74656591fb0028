"""Meshes of the scanned room: PLY, OBJ, STL, GLB, with labels by number, colour or material."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from chains.errors import InputError
from sensors.readers.base import Array, Contents, Options, Progress, ScannedSurface
from sensors.readers.meshes.labels import (
    Labels,
    Palette,
    labels_of_colours,
    labels_of_numbers,
    read_palette,
)
from sensors.readers.meshes.mesh_files import Mesh, read_mesh_file
from sensors.readers.meshes.placing import find_placing
from sensors.surfaces import triangle_planes

_LABELS = (
    "label", "labels", "class", "class_id", "classification", "semantic", "category",
    "category_id", "segment", "segment_id", "object_id", "material_index",
)  # fmt: skip
_INTENSITIES = ("intensity", "reflectance", "reflectivity", "remission")
_PALETTES = (".yaml", ".yml", ".csv")


def read_meshes(paths: Sequence[Path], options: Options, progress: Progress) -> Contents:
    """Read one mesh, or several that make up one room, as the reference surface.

    Labels are the first of: a number per face, a number per vertex, colours of the texture, the
    faces or the vertices if they keep to a few, materials. `--metadata` may name them: a YAML or
    CSV of numbers or colours and names. Of several files without labels, each is one.
    """
    given = options.metadata is not None and options.metadata.suffix.lower() in _PALETTES
    palette = read_palette(options.metadata) if given else Palette()
    parts, lines, odd = [], [], []
    for n, path in enumerate(paths):
        progress("reading meshes", n, len(paths))
        surface, said, strange = _read_one(path, options, palette, alone=len(paths) == 1)
        parts.append(surface)
        lines += said
        odd += strange
    return Contents(surface=_together(parts), understood=tuple(lines), odd=tuple(odd))


def _read_one(
    path: Path, options: Options, palette: Palette, alone: bool
) -> tuple[ScannedSurface, list[str], list[str]]:
    mesh = read_mesh_file(path)
    gltf = path.suffix.lower() in (".glb", ".gltf")
    used = mesh.vertices[np.unique(mesh.triangles)]
    because = "as glTF has it" if gltf else ""
    placing = find_placing(path, used, options, "y" if gltf else "z", because)
    labels, source = _find_labels(path, mesh, palette)
    odd = [*mesh.odd, *placing.odd]
    if labels is None and not alone:
        labels = Labels(np.zeros(len(mesh.triangles), np.uint16), {0: path.stem})
        source = "file"
    elif labels is None:
        odd.append(f"{path.name} {source}; its triangles have no labels")
    if labels is not None:
        odd += [f"{path.name}: {sentence}" for sentence in labels.odd]
    vertices_m = placing.points(mesh.vertices)
    intensity = _intensity(mesh)
    surface = ScannedSurface(
        vertices_m=vertices_m,
        triangles=mesh.triangles,
        label=None if labels is None else labels.label,
        intensity=intensity,
        names={} if labels is None else labels.names,
    )
    return surface, _describe(path, surface, placing.understood, source), odd


def _find_labels(path: Path, mesh: Mesh, palette: Palette) -> tuple[Labels | None, str]:
    """Labels and where they come from; without any, why there are none."""
    for columns, where in ((mesh.face, "face"), (mesh.vertex, "vertex")):
        name = _named(columns, _LABELS)
        if name is not None:
            numbers = columns[name]
            numbers = numbers[:, None] if where == "face" else numbers[mesh.triangles]
            try:
                return labels_of_numbers(numbers, palette), f"{name} per {where}"
            except InputError as error:
                raise InputError(f"{path}: property {name}: {error}") from None
    why = "has neither labels, colours nor materials"
    if mesh.colours is not None:
        labels = labels_of_colours(mesh.colours, palette)
        if labels is not None and (palette.colours or len(labels.names) > 1):
            return labels, "colour"
        why = "has the colours of a photograph" if labels is None else "has one colour"
    if len(mesh.materials) > 1 and mesh.material is not None:
        names = dict(enumerate(mesh.materials))
        return Labels(mesh.material.astype(np.uint16), names), "material"
    return None, why


def _intensity(mesh: Mesh) -> Array | None:
    """Intensity (F,) of each triangle: its own, or its vertices' mean."""
    for columns, at in ((mesh.face, slice(None)), (mesh.vertex, mesh.triangles)):
        name = _named(columns, _INTENSITIES)
        if name is not None:
            values = columns[name][at].astype(np.float64)
            return values.reshape(len(mesh.triangles), -1).mean(axis=1)
    return None


def _named(columns: Mapping[str, np.ndarray], names: Sequence[str]) -> str | None:
    """The first column of one of those names, however spelled: CloudCompare's scalar_Label too."""
    plain = {name.lower().removeprefix("scalar_").replace(" ", "_"): name for name in columns}
    return next((plain[name] for name in names if name in plain), None)


def _together(parts: Sequence[ScannedSurface]) -> ScannedSurface:
    """One surface of several; labels of one name are one label."""
    if len(parts) == 1:
        return parts[0]
    names = list(dict.fromkeys(name for part in parts for name in part.names.values()))
    labels, first = [], np.cumsum([0, *(len(part.vertices_m) for part in parts)])
    for part in parts:
        number = np.zeros(1 << 16, np.uint16)
        for old, name in part.names.items():
            number[old] = names.index(name)
        labels.append(number[part.label])
    none = [np.full(len(part.triangles), np.nan) for part in parts]
    bright = [n if p.intensity is None else p.intensity for p, n in zip(parts, none, strict=True)]
    return ScannedSurface(
        vertices_m=np.concatenate([part.vertices_m for part in parts]),
        triangles=np.concatenate([p.triangles + n for p, n in zip(parts, first, strict=False)]),
        label=np.concatenate(labels),
        intensity=None if all(part.intensity is None for part in parts) else np.concatenate(bright),
        names=dict(enumerate(names)),
    )


def _describe(path: Path, surface: ScannedSurface, placing: str, source: str) -> list[str]:
    corners_m = surface.vertices_m[surface.triangles]
    size = np.ptp(corners_m.reshape(-1, 3), axis=0)
    area_m2 = triangle_planes(corners_m)[1]
    lines = [
        f"{path.name}: {len(surface.triangles)} triangles, {area_m2.sum():.1f} m², "
        f"{size[0]:.2f} x {size[1]:.2f} x {size[2]:.2f} m; {placing}"
    ]
    if surface.label is not None:
        share = np.bincount(surface.label, area_m2) / max(area_m2.sum(), 1e-12)
        most = sorted(surface.names, key=lambda n: -share[n])
        listed = ", ".join(f"{surface.names[n]} {100 * share[n]:.1f} %" for n in most[:8])
        more = f" and {len(most) - 8} more" if len(most) > 8 else ""
        lines.append(f"{path.name}: {len(most)} labels by {source}: {listed}{more} of the area")
    if surface.intensity is not None:
        low, high = np.nanpercentile(surface.intensity, [1, 99])
        lines.append(f"{path.name}: intensity {low:.3g} to {high:.3g}")
    return lines
