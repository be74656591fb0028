"""The shapes of an arm's links: what its URDF has, the meshes where they lie in the recording."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path, PurePosixPath

import numpy as np

from calib.rig.description import Rig
from chains import se3
from chains.errors import InputError, shortened
from chains.shapes import LinkShape, read_shapes
from sensors.readers.meshes.mesh_files import read_mesh_file

PACKAGE = "package://"
CORNERS = 24  # of a circle: a solid that is drawn with them is nowhere 1 % smaller


@dataclass(frozen=True)
class Shape:
    """The shape of a link: vertices (V, 3) in the link's frame, m, and triangles (F, 3)."""

    link: str
    vertices_m: np.ndarray
    triangles: np.ndarray


def arm_shapes(rig: Rig, hit: bool = False) -> tuple[list[Shape], list[str]]:
    """The shapes of an arm's links, and of each link whose shapes are not there, why.

    Args:
        rig: the rig.
        hit: whether what is to be collided with is wanted where there is both, not what is to be
            seen.

    Raises:
        InputError: the URDF holds a shape that cannot be read.
    """
    if rig.arm_urdf is None:
        return [], []
    edges = [edge for edge in rig.tree.edges if edge.name in rig.arm_edges]
    shapes: list[Shape] = []
    lacking: list[str] = []
    either_of = read_shapes(rig.arm_urdf, [edges[0].parent, *(edge.child for edge in edges)])
    for link, either in either_of.items():
        try:
            shapes += _first_that_is_there(rig, either[::-1] if hit else either)
        except InputError as error:
            lacking.append(f"{link} ({error})")
    return shapes, lacking


def _first_that_is_there(rig: Rig, either: Sequence[Sequence[LinkShape]]) -> list[Shape]:
    """The first of several sets of shapes, each of which is of the whole link.

    Raises:
        InputError: none of them can be read whole; of the first, why.
    """
    whys = []
    for shapes in either:
        try:
            return [_shape(rig, shape) for shape in shapes]
        except InputError as error:
            whys.append(str(error))
    raise InputError(whys[0])


def _shape(rig: Rig, shape: LinkShape) -> Shape:
    if shape.kind == "mesh":
        read = read_mesh_file(_file(rig, shape.file))
        vertices, triangles = np.asarray(read.vertices, float), read.triangles
    else:
        vertices, triangles = _solid(shape.kind)
    vertices_m = se3.apply(shape.T_link_shape, vertices * shape.scale)
    # A scale that mirrors turns the faces inside out.
    triangles = triangles if np.prod(shape.scale) > 0 else triangles[:, ::-1]
    return Shape(shape.link, vertices_m, triangles)


@cache
def _solid(kind: str) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) and triangles (F, 3), turned outwards, of a solid 1 wide, deep and high."""
    from scipy.spatial import ConvexHull  # late: it loads much, and few arms need it

    turn = np.linspace(0, 2 * np.pi, CORNERS, endpoint=False)
    circle = np.column_stack([np.cos(turn), np.sin(turn)])
    if kind == "box":
        corners = np.array(np.meshgrid(*[(-0.5, 0.5)] * 3)).reshape(3, -1).T
    elif kind == "cylinder":
        corners = np.vstack([np.column_stack([circle / 2, 0 * turn + z]) for z in (-0.5, 0.5)])
    else:
        up = np.linspace(-np.pi / 2, np.pi / 2, CORNERS // 2 + 1)[1:-1]
        rings = [np.column_stack([np.cos(u) * circle, 0 * turn + np.sin(u)]) for u in up]
        corners = np.vstack([*rings, [[0, 0, -1], [0, 0, 1]]]) / 2
    hull = ConvexHull(corners)
    a, b, c = np.moveaxis(corners[hull.simplices], 1, 0)
    inwards = np.einsum("fi,fi->f", np.cross(b - a, c - a), hull.equations[:, :3]) < 0
    return corners, np.where(inwards[:, None], hull.simplices[:, ::-1], hull.simplices)


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
