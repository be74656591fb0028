"""A URDF written back: other origins, more fixed frames, and every other byte as it was.

The file is edited as text at the places where an XML parser says its tags begin, because any
library that reads and writes XML loses comments, spacing or the order of attributes.
"""

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from xml.parsers import expat

import numpy as np

from chains import se3
from chains.errors import InputError
from chains.escape import xml_attribute, xml_comment
from chains.frames import Edge
from chains.se3 import Array

_TAG = re.compile(rb"""<[^\s/>]+(?:[^>"']|"[^"]*"|'[^']*')*>""")
_ATTRIBUTE = re.compile(rb"""\s([^\s=]+)\s*=\s*("[^"]*"|'[^']*')""")
_UNCHANGED = 1e-15  # m, and of a rotation's entries: a few roundings of double precision
_Edit = tuple[int, int, bytes]  # start and end in the text, and what comes there


@dataclass
class _Joint:
    """Where the tags of a joint, its origin and its mimic begin, in bytes, and what hangs from
    what."""

    start: int
    origin: int | None = None
    mimic: int | None = None
    parent: str = ""
    child: str = ""


class _Robot:
    """The tags of a URDF that matter here, by where they begin."""

    def __init__(self, text: bytes, where: str | Path) -> None:
        self.start = self.end = 0
        self.links: list[str] = []
        self.joints: dict[str, _Joint] = {}
        self._open: list[str] = []
        self._joint: _Joint | None = None
        self._parser = expat.ParserCreate()
        self._parser.StartElementHandler = self._begin
        self._parser.EndElementHandler = self._finish
        try:
            self._parser.Parse(text, True)
        except expat.ExpatError as error:
            raise InputError(f"{where}: is not XML ({error}); a URDF file is wanted") from None

    def _begin(self, tag: str, attributes: dict[str, str]) -> None:
        self._open.append(tag)
        at, name = self._parser.CurrentByteIndex, attributes.get("name", "")
        match self._open:
            case ["robot"]:
                self.start = at
            case ["robot", "link"]:
                self.links.append(name)
            case ["robot", "joint"]:
                self._joint = self.joints[name] = _Joint(at)
            case ["robot", "joint", "origin"] if self._joint.origin is None:
                self._joint.origin = at
            case ["robot", "joint", "mimic"] if self._joint.mimic is None:
                self._joint.mimic = at
            case ["robot", "joint", "parent" | "child" as role]:
                setattr(self._joint, role, attributes.get("link", ""))

    def _finish(self, tag: str) -> None:
        if self._open == ["robot"]:
            self.end = self._parser.CurrentByteIndex
        self._open.pop()


def empty_robot(name: str, link: str) -> bytes:
    """Return a URDF of one link, to add frames to."""
    lines = ('<?xml version="1.0"?>', f"<robot name={xml_attribute(name)}>", "</robot>", "")
    text = "\n".join([*lines[:2], f"  <link name={xml_attribute(link)}/>", *lines[2:]])
    return text.encode("ascii", "xmlcharrefreplace")


def with_origins(text: bytes, origins: Mapping[str, Array], where: str | Path) -> bytes:
    """Return a URDF with other origins at some joints; only their xyz and rpy differ.

    Numbers are written in full, and only where they change; an origin that is not there is put
    in. The text keeps its encoding.

    Args:
        text: the file.
        origins: joint -> T_parent_child (4, 4) at its zero, m.
        where: the file's name, for messages.

    Raises:
        InputError: the text is no XML, or is UTF-16, or has no such joint.
    """
    _refuse_wide(text, where)
    joints = _Robot(text, where).joints
    edits = []
    for name, T in origins.items():
        if name not in joints:
            raise InputError(f"{where}: there is no joint '{name}'; it has {', '.join(joints)}")
        joint = joints[name]
        if joint.origin is None:
            end = _TAG.match(text, joint.start).end()
            edits.append((end, end, b"<origin" + _attributes(T) + b"/>"))
        else:
            edits += _pose_edits(_TAG.match(text, joint.origin)[0], joint.origin, T)
    return _spliced(text, edits)


def with_mimics(
    text: bytes, mimics: Mapping[str, tuple[str, float, float]], where: str | Path
) -> bytes:
    """Return a URDF in which some joints that mimic others do so otherwise.

    Args:
        text: the file.
        mimics: joint -> the joint that it follows, its multiplier and its offset, rad or m.
        where: the file's name, for messages.

    Raises:
        InputError: as `with_origins`, or such a joint mimics none.
    """
    _refuse_wide(text, where)
    joints, edits = _Robot(text, where).joints, []
    for name, (other, multiplier, offset) in mimics.items():
        start = joints[name].mimic if name in joints else None
        if start is None:
            raise InputError(f"{where}: there is no joint '{name}' that mimics another")
        new = {
            b"joint": _in_any_quotes(other),
            b"multiplier": _words([multiplier]),
            b"offset": _words([offset]),
        }
        edits += _attribute_edits(_TAG.match(text, start)[0], start, new)
    return _spliced(text, edits)


def with_comment(text: bytes, lines: Iterable[str], where: str | Path) -> bytes:
    """Return a URDF with a comment before its robot; raises InputError as `with_origins`."""
    _refuse_wide(text, where)
    start = _Robot(text, where).start
    inside = "\n  ".join(map(xml_comment, lines)).encode("ascii")
    return text[:start] + b"<!--\n  " + inside + b"\n-->\n" + text[start:]


def with_frames(
    text: bytes, frames: Iterable[Edge], where: str | Path
) -> tuple[bytes, tuple[str, ...]]:
    """Return a URDF with fixed links added before its end, and the names of those not added.

    A frame hangs from a link that is there, or holds the link that all others hang from. One that
    would break the tree, as its child hangs from elsewhere already, is left away, with all that
    hangs from it alone. Raises InputError as `with_origins`.
    """
    _refuse_wide(text, where)
    robot = _Robot(text, where)
    held = {joint.child for joint in robot.joints.values()}
    links, waiting, lines = set(robot.links), list(frames), []
    while True:
        roots = links - held
        fit = [
            e
            for e in waiting
            if (e.parent in links and e.child not in links)
            or (e.child in roots and len(roots) == 1 and e.parent not in links)
        ]
        if not fit:
            break
        edge = fit[0]
        waiting.remove(edge)
        lines += [
            f"<link name={xml_attribute(n)}/>" for n in (edge.parent, edge.child) if n not in links
        ]
        lines.append(_fixed(edge, {*robot.joints}))
        links |= {edge.parent, edge.child}
        held.add(edge.child)
    added = "".join(f"  {line}\n" for line in lines).encode("ascii", "xmlcharrefreplace")
    return text[: robot.end] + added + text[robot.end :], tuple(e.name for e in waiting)


def _fixed(edge: Edge, taken: set[str]) -> str:
    name = f"{edge.parent}_to_{edge.child}"
    while name in taken:
        name += "_"
    name, parent, child = map(xml_attribute, (name, edge.parent, edge.child))
    return (
        f'<joint name={name} type="fixed"><parent link={parent}/><child link={child}/>'
        f"<origin{_attributes(edge.T_parent_child).decode()}/></joint>"
    )


def _attributes(T: Array) -> bytes:
    return b' xyz="%s" rpy="%s"' % (_words(T[:3, 3]), _words(se3.to_rpy(T)))


def _in_any_quotes(name: str) -> bytes:
    """A name as it may stand between quotes of either kind."""
    text = xml_attribute(name)[1:-1].replace('"', "&quot;").replace("'", "&apos;")
    return text.encode("ascii", "xmlcharrefreplace")


def _words(values: Array) -> bytes:
    return " ".join(repr(v + 0.0) for v in np.asarray(values).tolist()).encode()


def _pose_edits(tag: bytes, start: int, T: Array) -> list[_Edit]:
    """What gives an origin's tag the xyz and rpy of T, each only where it is another."""
    at = {found[1]: found for found in _ATTRIBUTE.finditer(tag)}
    xyz, rpy = (
        np.array(at[key][2][1:-1].split(), float) if key in at else np.zeros(3)
        for key in (b"xyz", b"rpy")
    )
    off = np.abs(se3.from_xyz_rpy(xyz, rpy) - T)
    new = {}
    if off[:3, 3].max() > _UNCHANGED:
        new[b"xyz"] = _words(T[:3, 3])
    if off[:3, :3].max() > _UNCHANGED:
        new[b"rpy"] = _words(se3.to_rpy(T))
    return _attribute_edits(tag, start, new)


def _attribute_edits(tag: bytes, start: int, new: Mapping[bytes, bytes]) -> list[_Edit]:
    """What gives attributes of a tag other values; those that it lacks come last."""
    at = {found[1]: found for found in _ATTRIBUTE.finditer(tag)}
    bare = len(re.match(rb"<[^\s/>]+", tag)[0])
    end = start + max((found.end() for found in at.values()), default=bare)
    edits = []
    for key, words in new.items():
        if key in at:
            edits.append((start + at[key].start(2) + 1, start + at[key].end(2) - 1, words))
        else:
            edits.append((end, end, b' %s="%s"' % (key, words)))
    return edits


def _spliced(text: bytes, edits: Iterable[_Edit]) -> bytes:
    for start, end, new in sorted(edits, reverse=True):
        text = text[:start] + new + text[end:]
    return text


def _refuse_wide(text: bytes, where: str | Path) -> None:
    if text.startswith((b"\xff\xfe", b"\xfe\xff")):
        raise InputError(f"{where}: is UTF-16; save it as UTF-8")
