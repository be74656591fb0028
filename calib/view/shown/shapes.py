"""The shapes of an arm's links: the meshes that its URDF names, where they lie in the recording."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np

from calib.rig import Rig
from calib.view.scene import MOST_TRIANGLES
from chains import se3
from chains.arm import LinkMesh, read_meshes
from chains.errors import InputError, shortened
from sensors.readers.meshes.mesh_files import read_mesh_file

PACKAGE = "package://"


@dataclass(frozen=True)
class Shape:
    """The mesh of a link: vertices (V, 3) in the link's frame, m, and triangles (F, 3)."""

    link: str
    vertices_m: np.ndarray
    triangles: np.ndarray


def arm_shapes(rig: Rig) -> tuple[list[Shape], str]:
    """The shapes of an arm's links, and which links are therefore drawn as lines, in a sentence.

    The sentence is empty where every link that has a mesh has a shape, or none has a mesh.
    """
    if rig.arm_urdf is None:
        return [], ""
    edges = [edge for edge in rig.tree.edges if edge.name in rig.arm_edges]
    shapes: list[Shape] = []
    lacking: list[str] = []
    try:
        either_of = read_meshes(rig.arm_urdf, [edges[0].parent, *(edge.child for edge in edges)])
    except InputError as error:
        return [], f"The arm is drawn as lines: {error}."
    for link, either in either_of.items():
        try:
            shapes += _first_that_is_there(rig, either)
        except InputError as error:
            lacking.append(f"{link} ({error})")
    triangles = sum(len(shape.triangles) for shape in shapes)
    if triangles > MOST_TRIANGLES:
        return [], (
            f"The arm is drawn as lines: its meshes have {triangles:,} triangles, more than the "
            f"{MOST_TRIANGLES:,} that are drawn."
        )
    if not lacking:
        return shapes, ""
    rest = f", and so are {len(lacking) - 1} more links" if len(lacking) > 1 else ""
    return shapes, f"Drawn as lines: {lacking[0]}{rest}."


def _first_that_is_there(rig: Rig, either: Sequence[Sequence[LinkMesh]]) -> list[Shape]:
    """The shapes of the first of several sets of meshes, each of which shows a link.

    Raises:
        InputError: none of them can be read whole; of the first, why.
    """
    whys = []
    for meshes in either:
        try:
            return [_shape(rig, mesh) for mesh in meshes]
        except InputError as error:
            whys.append(str(error))
    raise InputError(whys[0])


def _shape(rig: Rig, mesh: LinkMesh) -> Shape:
    read = read_mesh_file(_file(rig, mesh.file))
    vertices_m = se3.apply(mesh.T_link_mesh, np.asarray(read.vertices, float) * mesh.scale)
    # A scale that mirrors turns the faces inside out.
    triangles = read.triangles if np.prod(mesh.scale) > 0 else read.triangles[:, ::-1]
    return Shape(mesh.link, vertices_m, triangles)


def _file(rig: Rig, name: str) -> Path:
    """Where a URDF's mesh lies in the recording: of a package, in a folder of its name or without
    that; else beside the URDF. A name that leads out of the recording is not followed.

    Raises:
        InputError: it does not lie there.
    """
    inside = name.removeprefix(PACKAGE)
    places = [PurePosixPath(inside)]
    if name.startswith(PACKAGE):
        places.append(PurePosixPath(*places[0].parts[1:]))
    folder = rig.folder.resolve()
    beside = folder if name.startswith(PACKAGE) else rig.arm_urdf.resolve().parent
    for place in places:
        path = (beside / place).resolve()
        if path.is_relative_to(folder) and path.is_file():
            return path
    raise InputError(f"the recording has no {shortened(str(places[-1]))}")
