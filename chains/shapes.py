"""What an arm's links look like, and what they may hit: the meshes, boxes, cylinders and spheres of
a URDF (https://wiki.ros.org/urdf/XML/link).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal
from xml.etree.ElementTree import Element

import numpy as np

from chains.errors import InputError
from chains.se3 import Array
from chains.xml import numbers_of, origin_of, read_robot

SOLIDS = ("box", "cylinder", "sphere")


@dataclass(frozen=True)
class LinkShape:
    """A shape of a link: a mesh, or a solid that is 1 wide, deep and high about its origin.

    ``file`` is the mesh's as the URDF has it, empty for a solid. ``scale`` (3,) is by what its
    coordinates are multiplied, per axis, to be metres; ``T_link_shape`` (4, 4) where it stands.
    """

    link: str
    kind: Literal["mesh", "box", "cylinder", "sphere"]
    file: str
    T_link_shape: Array
    scale: Array


def read_shapes(urdf_path: str | Path, links: Sequence[str]) -> dict[str, list[list[LinkShape]]]:
    """Return the shapes of each of ``links`` that has any: all that is to be seen of it
    (``visual``) and all that is to be collided with (``collision``), those of these that it has.

    Raises InputError where the file cannot be read, or a number of a shape is none.
    """
    path = Path(urdf_path)
    found: dict[str, list[list[LinkShape]]] = {}
    try:
        for link in read_robot(path).findall("link"):
            name = link.get("name", "")
            either = [_shapes(name, link.findall(kind)) for kind in ("visual", "collision")]
            if name in links and any(either):
                found[name] = [shapes for shapes in either if shapes]
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    return found


def _shapes(link: str, parts: Sequence[Element]) -> list[LinkShape]:
    """Return the shapes among the ``visual`` or ``collision`` elements of a link."""
    found = []
    for part in parts:
        kind = next((k for k in ("mesh", *SOLIDS) if part.find(f"geometry/{k}") is not None), None)
        if kind is not None:
            mesh = part.find("geometry/mesh")
            found.append(
                LinkShape(
                    link=link,
                    kind=kind,
                    file="" if mesh is None else mesh.get("filename", ""),
                    T_link_shape=origin_of(part),
                    scale=_scale(part, kind),
                )
            )
    return found


def _scale(part: Element, kind: str) -> Array:
    where = f"geometry/{kind}"
    if kind == "mesh":
        return numbers_of(part, where, "scale", [1, 1, 1])
    if kind == "box":
        return numbers_of(part, where, "size", [0, 0, 0])
    wide = 2 * numbers_of(part, where, "radius", [0])[0]
    high = numbers_of(part, where, "length", [0])[0] if kind == "cylinder" else wide
    return np.array([wide, wide, high])
