"""XML as files of other people hold it: elements and attributes, and nothing that acts; and what
every reader of a URDF asks of it.

A document may define entities that stand for a file of this machine, or for each other until they
fill its memory. No URDF, SRDF or E57 file needs these, so a document that defines one is refused;
an entity that stands for a few words is text.
"""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element
from xml.parsers import expat

import numpy as np

from chains import se3
from chains.errors import InputError
from chains.se3 import Array

LONGEST_ENTITY = 1000  # characters; what a person writes instead of writing it twice
DEEPEST_XML = 100  # elements within each other; a URDF has about 6, an E57 file about 15


def parse_xml(text: str | bytes, where: object, wanted: str) -> Element:
    """The root of an XML document.

    Args:
        text: the document.
        where: its file, for messages.
        wanted: what it should be, "a URDF file" say.

    Raises:
        InputError: it is no XML, defines an entity that is not plain words, or is nested deeper
            than any such file is.
    """
    try:
        _look_through(text, where)
        return ElementTree.fromstring(text)
    except (ElementTree.ParseError, expat.ExpatError) as error:
        raise InputError(f"{where} is not XML ({error}); {wanted} is wanted") from None
    except (ValueError, LookupError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{where} is not XML ({error}); {wanted} is wanted") from None


def _look_through(text: str | bytes, where: object) -> None:
    """Refuse what no tree should be made of, before one is."""
    parser, depths = expat.ParserCreate(), [0]

    def entity(name: str, parameter: bool, value: str | None, *_: object) -> None:
        if parameter or value is None or "&" in value or len(value) > LONGEST_ENTITY:
            raise InputError(
                f"{where} defines the entity {name}, which stands for more than a few words; "
                f"remove it, as no such file needs one"
            )

    def start(tag: str, _: dict[str, str]) -> None:
        depths.append(depths[-1] + 1)
        if depths[-1] > DEEPEST_XML:
            raise InputError(f"{where} has elements nested more than {DEEPEST_XML} deep")

    parser.EntityDeclHandler = entity
    parser.StartElementHandler = start
    parser.EndElementHandler = lambda tag: depths.pop()
    parser.Parse(text, True)


def read_robot(path: Path) -> Element:
    """Return the root of a URDF file; InputError, which names it, where it is none."""
    try:
        text = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); name a URDF file") from None
    robot = parse_xml(text, path, "a URDF file")
    if any("xacro" in element.tag for element in robot.iter()):
        raise InputError(f"{path}: still holds xacro; write it out with 'xacro FILE > arm.urdf'")
    if robot.tag != "robot":
        raise InputError(f"{path}: starts with <{robot.tag}>; a URDF file starts with <robot>")
    return robot


def numbers_of(owner: Element, tag: str, attribute: str, default: list[float]) -> Array:
    """Return the finite numbers of one attribute of a joint or link, as many as the default has."""
    element = owner.find(tag)
    text = None if element is None else element.get(attribute)
    if text is None:
        return np.array(default, float)
    try:
        values = np.array([float(word) for word in text.split()])
    except ValueError:
        values = np.array([np.nan])
    if values.shape != (len(default),) or not np.isfinite(values).all():
        count = "a number" if len(default) == 1 else f"{len(default)} numbers"
        raise InputError(
            f"{owner.tag} '{owner.get('name')}': {tag} {attribute} is '{text}'; it must be {count}"
        )
    return values


def origin_of(joint: Element) -> Array:
    """Return T_parent_child (4, 4) at the joint's zero."""
    xyz, rpy = (numbers_of(joint, "origin", part, [0, 0, 0]) for part in ("xyz", "rpy"))
    return se3.from_xyz_rpy(xyz, rpy)
