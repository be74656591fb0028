"""An arm as URDF or xacro; with it, where wanted, MoveIt's SRDF, its limits, or offsets.

What they mean is told in `chains.readers`; here they are files and options of an import.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from xml.etree import ElementTree

from chains.errors import InputError
from chains.readers import xacro
from chains.readers.urdf import apply_note, arm_ends, group_ends, joint_names, parse_robot
from sensors.documents import read_text, read_yaml
from sensors.readers.base import ArmDescription, Contents, Options, Progress

_MACROS = re.compile(r"<\s*xacro:|[$][{(]")  # an expanded file may still name the namespace


def read_urdf(files: Sequence[Path], options: Options, progress: Progress) -> Contents:
    """Read an arm: one URDF or xacro file, and what others say of the same arm.

    Raises:
        InputError: there is not one description, a link is not in it, or it has several arms.
    """
    progress("reading the arm", 0, 1)
    groups = [path for path in files if path.suffix == ".srdf"]
    notes = [path for path in files if path.suffix in (".yaml", ".yml")]
    described = [path for path in files if path not in (*groups, *notes)]
    if len(described) != 1:
        raise InputError(
            f"urdf takes one description of an arm, not {len(described)}: "
            f"{', '.join(map(str, described)) or 'name a .urdf or .xacro file'}"
        )
    text, odd = _text(described[0], options)
    robot = parse_robot(described[0], text)
    said = [apply_note(path, read_yaml(path)[0], robot) for path in notes]
    base, tip = None, None
    if groups:
        base, tip = group_ends(groups[0], read_text(groups[0]), options.tip)
    try:
        base, tip, more = arm_ends(described[0], robot, options.base or base, options.tip or tip)
    except InputError as error:
        raise InputError("; ".join([str(error), *odd])) from None
    names = joint_names(robot, base, tip)
    said.append(
        f"{described[0].name}: an arm of {len(names)} joints from {base} to {tip}: "
        f"{', '.join(names)}{more}"
    )
    if notes:
        text = ElementTree.tostring(robot, encoding="unicode")
    return Contents(arm=ArmDescription(text, base, tip), understood=tuple(said), odd=odd)


def with_ends(where: str, arm: ArmDescription, options: Options) -> ArmDescription:
    """The arm with its base and tip, found where its source does not say them.

    Raises:
        InputError: `where` is no URDF, a link is not in it, or it has several arms.
    """
    if arm.base and arm.tip:
        return arm
    robot = parse_robot(Path(where), arm.urdf)
    base, tip, _ = arm_ends(Path(where), robot, options.base or arm.base, options.tip or arm.tip)
    return ArmDescription(arm.urdf, base, tip)


def _text(path: Path, options: Options) -> tuple[str, tuple[str, ...]]:
    text = read_text(path)
    if not text.strip():
        raise InputError(f"{path} is empty; a URDF or xacro file is wanted")
    if path.suffix == ".xacro" or _MACROS.search(text):
        return xacro.write_out(path, options.packages)
    return text, ()
