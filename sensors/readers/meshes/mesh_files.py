"""Mesh files as scanners and modelling programs write them. This is the trimesh door.

PLY keeps every property of its vertices and faces. OBJ, STL, GLB and OFF are trimesh's, which
reads text in double precision, where Open3D rounds it to float32.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from chains.errors import InputError
from sensors.ply import Columns, fans, read_ply

MESH_SUFFIXES = (".ply", ".obj", ".stl", ".glb", ".gltf", ".off")
# Where a triangle's texture is looked at: its middle, and half-way from there to each corner.
_SAMPLES = (np.eye(4, 3, -1) + 1 / 3) / np.array([[1], [2], [2], [2]])


@dataclass(frozen=True)
class Mesh:
    """A mesh as its file has it: the file's units and axes.

    Args:
        vertices: (V, 3), the file's own precision.
        triangles: (F, 3); polygons are cut into fans.
        vertex: other columns (V,) of the vertices, by name.
        face: columns (F,) of the triangles.
        colours: (F, S, 3) uint8, at S places of each triangle; None = the file has none.
        material: (F,) index into `materials`.
        materials: their names.
        odd: what looked odd, a sentence each.
    """

    vertices: np.ndarray
    triangles: np.ndarray
    vertex: Columns = field(default_factory=dict)
    face: Columns = field(default_factory=dict)
    colours: np.ndarray | None = None
    material: np.ndarray | None = None
    materials: tuple[str, ...] = ()
    odd: tuple[str, ...] = ()


def read_mesh_file(path: Path) -> Mesh:
    """Read a PLY, OBJ, STL, GLB or OFF file.

    Raises InputError for a file that is missing, empty or broken, has no triangles, or has a
    triangle whose vertex does not exist or is not finite.
    """
    suffix = path.suffix.lower()
    if suffix not in MESH_SUFFIXES:
        cloud = "; a scanner's cloud is a `survey`" if suffix in (".e57", ".pts", ".ptx") else ""
        known = ", ".join(MESH_SUFFIXES)
        raise InputError(f"{path}: a mesh is read from {known}, not {suffix!r}{cloud}")
    if not path.is_file():
        raise InputError(f"{path} does not exist; name a mesh")
    if path.stat().st_size == 0:
        raise InputError(f"{path} is empty (0 bytes); a mesh was wanted")
    mesh = _read_ply(path) if suffix == ".ply" else _read_other(path)
    if not len(mesh.triangles):
        what = f"{len(mesh.vertices)} points and no triangles"
        raise InputError(f"{path} has {what}; a cloud is read as kind `survey`")
    if mesh.triangles.min() < 0 or mesh.triangles.max() >= len(mesh.vertices):
        last = len(mesh.vertices) - 1
        raise InputError(f"{path}: a triangle has a vertex that is none of 0 to {last}")
    if mesh.vertices.shape[1:] != (3,):
        raise InputError(f"{path} has vertices of {mesh.vertices.shape[1:]} numbers, not of 3")
    if not np.isfinite(mesh.vertices[mesh.triangles]).all():
        raise InputError(f"{path}: a triangle has a corner that is not finite; repair the mesh")
    return mesh


def _read_ply(path: Path) -> Mesh:
    elements = read_ply(path)
    vertex, face = dict(elements.get("vertex", {})), dict(elements.get("face", {}))
    if not {"x", "y", "z"} <= vertex.keys():
        raise InputError(f"{path} has no vertices with x, y and z; a mesh was wanted")
    vertices = np.stack([vertex.pop(axis) for axis in "xyz"], axis=1)
    corners = next((face.pop(n) for n in ("vertex_indices", "vertex_index") if n in face), None)
    if corners is None:
        return Mesh(vertices, np.zeros((0, 3), np.int64))
    triangles, polygon = fans(corners)
    face = {name: values[polygon] for name, values in face.items() if values.ndim == 1}
    colours = _rgb(face)
    if colours is not None:
        colours = colours[:, None]
    elif (of_vertices := _rgb(vertex)) is not None:
        colours = of_vertices[triangles]
    return Mesh(vertices=vertices, triangles=triangles, vertex=vertex, face=face, colours=colours)


def _rgb(columns: Columns) -> np.ndarray | None:
    """Colours (N, 3) uint8 of columns red, green and blue, which may count to 1, 255 or 65535."""
    if not {"red", "green", "blue"} <= columns.keys():
        return None
    colours = np.stack([columns.pop(name) for name in ("red", "green", "blue")], axis=1)
    if colours.dtype.kind == "f":
        colours = colours * (255.0 if colours.max(initial=0) <= 1 else 1.0)
    elif colours.dtype == np.uint16:
        colours = colours >> 8
    return np.clip(np.rint(colours), 0, 255).astype(np.uint8)


# ---------------------------------------------------------------------------------------- trimesh


def _read_other(path: Path) -> Mesh:
    try:
        import trimesh
    except ImportError:
        raise InputError(
            f"{path}: {path.suffix} files need trimesh: pip install 'rigcal[mesh]'"
        ) from None
    try:
        scene = trimesh.load_scene(str(path), process=False)
        parts = [part for part in scene.dump() if isinstance(part, trimesh.Trimesh)]
    except Exception as error:  # whatever stumbles over a broken file
        raise InputError(f"{path} cannot be read as {path.suffix}: {error}") from None
    parts = [part for part in parts if len(part.faces)]
    if not parts:
        return Mesh(np.zeros((0, 3)), np.zeros((0, 3), np.int64))
    first = np.cumsum([0, *(len(part.vertices) for part in parts[:-1])])
    triangles = [np.asarray(part.faces) + n for part, n in zip(parts, first, strict=True)]
    names = [_material_name(part) for part in parts]
    materials = tuple(dict.fromkeys(names))
    material = np.repeat([materials.index(name) for name in names], [len(t) for t in triangles])
    images, odd = zip(*(_image(part) for part in parts), strict=True)
    return Mesh(
        np.concatenate([np.asarray(part.vertices) for part in parts]),
        np.concatenate(triangles),
        colours=_colours(parts, images),
        material=material,
        materials=materials,
        odd=tuple(dict.fromkeys(sentence for part in odd for sentence in part)),
    )


def _material_name(part: Any) -> str:
    material = getattr(part.visual, "material", None)
    return str(getattr(material, "name", None) or part.metadata.get("name") or "surface")


def _image(part: Any) -> tuple[np.ndarray | None, tuple[str, ...]]:
    """The texture (H, W, 3) of a part, and what is wrong with it."""
    material = getattr(part.visual, "material", None)
    image = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
    wanted = getattr(material, "kwargs", {}).get("map_kd")
    if image is None:
        missing = f"its texture {wanted} is not beside it, so its colours are not known"
        return None, (missing,) if wanted else ()
    return np.asarray(image.convert("RGB")), ()


def _colours(parts: Sequence[Any], images: Sequence[np.ndarray | None]) -> np.ndarray | None:
    """Colours (F, S, 3) of all parts; None where no part has any but its material's."""
    painted = [_colours_of(part, image) for part, image in zip(parts, images, strict=True)]
    if all(colours is None for colours in painted):
        return None
    count = len(_SAMPLES)
    filled = []
    for part, colours in zip(parts, painted, strict=True):
        if colours is None:
            plain = getattr(getattr(part.visual, "material", None), "main_color", (102, 102, 102))
            colours = np.tile(np.asarray(plain[:3], np.uint8), (len(part.faces), 1, 1))
        filled.append(np.resize(colours.swapaxes(0, 1), (count, *colours[:, 0].shape)))
    return np.concatenate(filled, axis=1).swapaxes(0, 1)


def _colours_of(part: Any, image: np.ndarray | None) -> np.ndarray | None:
    """Colours (F, S, 3) of one part's texture, faces or vertices."""
    kind, faces = part.visual.kind, np.asarray(part.faces)
    uv = getattr(part.visual, "uv", None)
    if image is not None and uv is not None and len(uv) == len(part.vertices):
        places = np.einsum("sc,fck->fsk", _SAMPLES, np.asarray(uv)[faces])
        column = np.floor(places[..., 0] % 1 * image.shape[1]).astype(int)
        row = np.floor(-places[..., 1] % 1 * image.shape[0]).astype(int)
        return image[row.clip(0, len(image) - 1), column.clip(0, image.shape[1] - 1)]
    if kind == "face":
        return np.asarray(part.visual.face_colors)[:, None, :3]
    if kind == "vertex":
        return np.asarray(part.visual.vertex_colors)[faces][:, :, :3]
    return None
