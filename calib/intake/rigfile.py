"""rig.yaml: the one that a user has, matched with what was found, or a first one from data."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from calib.intake.gather import Gathered, section
from calib.intake.roles import Mounted, Roles, find_roles
from calib.rig.document import RECORDING_FORMAT
from chains import escape, se3
from chains.errors import InputError
from sensors.documents import nearest, write_atomically
from sensors.lidar import catalog
from sensors.readers.base import Columns
from sensors.stops import POSE

# Sigmas of a mounting that is worked out from the recording: a choice, so wide that they decide
# nothing.
GUESS_M, GUESS_RAD = 0.1, 0.3
_PLAIN = re.compile(r"[A-Za-z_][\w./-]*( [\w./-]+)*|\d+")
_TRACKER = "sigma_m: 0.0002, sigma_rad: 0.0003"


def bodies_of(columns: Columns) -> list[str]:
    """Tracked bodies and points of a table of stops."""
    names = (name.rpartition(".")[0] for name in columns if name.endswith(".x"))
    return [name for name in dict.fromkeys(names) if name != "base_guess"]


def matched(rig: Path, columns: Columns) -> tuple[Columns, list[str], list[str]]:
    """The stops with bodies named as in a rig.yaml, what was understood, and what looked odd.

    Raises:
        InputError: a body of the rig was not tracked; the flag is --body NAME=FRAME.
    """
    wanted = [str(body) for body in section(rig, "tracker").get("bodies") or ()]
    seen = bodies_of(columns)
    missing = [body for body in wanted if body not in seen]
    spare = [body for body in seen if body not in wanted]
    if len(missing) == 1 and len(spare) == 1:
        columns = _renamed(columns, spare[0], missing[0])
        return columns, [f"bodies: {spare[0]} is {missing[0]}, the only one left on both sides"], []
    if missing:
        raise InputError(
            f"{rig}: body {missing[0]} was not tracked; seen were {', '.join(seen) or 'none'}, and "
            f"frames of the rig are {', '.join(wanted)}: say --body NAME=FRAME"
        )
    odd = [f"{name} was tracked and is no body of {rig.name}; it is left out" for name in spare]
    return _without(columns, spare), [], odd


def _without(columns: Columns, bodies: Sequence[str]) -> Columns:
    """The columns without the poses of some bodies."""
    poses = {f"{body}.{part}" for body in bodies for part in POSE}
    return {name: values for name, values in columns.items() if name not in poses}


def _renamed(columns: Columns, old: str, new: str) -> Columns:
    return {
        f"{new}.{name[len(old) + 1 :]}" if name.rpartition(".")[0] == old else name: values
        for name, values in columns.items()
    }


def first_rig(
    folder: Path, name: str, gathered: Gathered, columns: Columns, model: str | None
) -> tuple[Columns, list[str], list[str]]:
    """Write a first rig.yaml from the data; frames that CAD knows better are marked as guesses.

    Args:
        folder: the recording's, which holds the arm and the reference already.
        name: of the rig.
        gathered: what all sources hold.
        columns: the stops.
        model: of the LiDAR, where a flag names it.

    Returns:
        The stops without bodies that hang on nothing, what was understood, and what looked odd.

    Raises:
        InputError: a LiDAR's model is not known, or the data do not tell where a body hangs.
    """
    roles = _roles(gathered, columns)
    lines = [
        "# Written by rigcal import. A guess was found in the data: write there what CAD says.",
        f"format: {RECORDING_FORMAT.newest}",
        f"name: {name}",
    ]
    lidar = _lidar(gathered, model) if gathered.sweeps else None
    if lidar:
        lines.append(f"lidar: {_flow(lidar)}")
    if gathered.arm:
        arm = {"urdf": "arm.urdf", "base": gathered.arm.base, "tip": gathered.arm.tip}
        lines.append(f"arm: {_flow(arm | {'sigma_joint_rad': 0})}")
    frames = [line for mounted in roles.mounted for line in _frame(mounted)]
    odd = list(roles.odd)
    if lidar and (parent := _carrier(gathered, roles, columns)):
        at = "as if it were there: its mounting is not known"
        frames += _frame(Mounted("lidar", parent, np.eye(4), at))
        odd.append(f"frame lidar is written as if it coincided with {parent}; write CAD there")
    bodies = [m.body for m in roles.mounted] or (bodies_of(columns) if frames else [])
    lines += ["frames:", *frames] if frames else []
    lines.append(f"base: {{moves: {'stop' if roles.base_moves or not gathered.arm else 'never'}}}")
    if bodies:
        lines.append(
            f"tracker: {{frame: opti, bodies: [{', '.join(map(_word, bodies))}], {_TRACKER}}}"
        )
    if gathered.surface:
        names = {"mesh": "mesh.ply", "faces": "faces.parquet", "labels": "labels.yaml"}
        files = {
            k: f"reference/{f}" for k, f in names.items() if (folder / "reference" / f).exists()
        }
        lines.append(f"reference: {_flow({'frame': 'faro'} | files | {'sigma_m': 0.001})}")
    with write_atomically(folder / "rig.yaml") as path:
        path.write_text("\n".join([*lines, ""]), encoding="utf-8")
    spare = [body for body in bodies_of(columns) if body not in bodies]
    kept = _without(columns, spare)
    said = [f"rig: {m.body} hangs on {m.parent}, {m.why}" for m in roles.mounted]
    return kept, said, odd


def _roles(gathered: Gathered, columns: Columns) -> Roles:
    """Where tracked bodies hang."""
    if gathered.edges and gathered.arm:
        return find_roles(
            columns, gathered.edges, gathered.joints, gathered.arm.base, gathered.arm.tip
        )
    return Roles([], True, [])


def _carrier(gathered: Gathered, roles: Roles, columns: Columns) -> str | None:
    """What carries the LiDAR: the body on the arm's tip, the tip, or the one body there is."""
    if gathered.arm:
        return gathered.arm.tip
    bodies = bodies_of(columns)
    if len(bodies) > 1:
        raise InputError(
            f"which of {', '.join(bodies)} carries the LiDAR is not known; give --rig with frames"
        )
    return bodies[0] if bodies else None


def _lidar(gathered: Gathered, model: str | None) -> dict[str, Any]:
    facts = dict(gathered.lidar or {})
    name = model or facts.get("model")
    if name is None or (name not in catalog() and not str(name).endswith((".yaml", ".yml"))):
        said = "is not known" if name is None else f"'{name}' is not in the catalogue"
        raise InputError(
            f"the model of the LiDAR {said}; say --lidar{nearest(name or '', catalog())}"
        )
    return {"model": name, "frame": "lidar"} | {k: v for k, v in facts.items() if k != "model"}


def _frame(mounted: Mounted) -> list[str]:
    T = mounted.T_parent_body
    at = {"parent": mounted.parent, "xyz_m": _round(T[:3, 3]), "rpy_rad": _round(se3.to_rpy(T))}
    sigma = {"sigma_m": GUESS_M, "sigma_rad": 0.0 if mounted.point else GUESS_RAD}
    return [
        f"  # guess: {escape.line(mounted.why)}",
        f"  {_word(mounted.body)}: {_flow(at | sigma)}",
    ]


def _round(values: Sequence[float]) -> list[float]:
    return [round(float(value), 5) for value in values]


def _flow(data: Mapping[str, Any]) -> str:
    """A mapping on one line of YAML."""
    return "{" + ", ".join(f"{key}: {_scalar(value)}" for key, value in data.items()) + "}"


def _scalar(value: Any) -> str:
    if isinstance(value, list | tuple | np.ndarray):
        return "[" + ", ".join(_scalar(v) for v in value) + "]"
    return repr(float(value)) if isinstance(value, float | np.floating) else _word(str(value))


def _word(name: str) -> str:
    """A name as YAML takes it: in quotes where it is more than a plain word."""
    if _PLAIN.fullmatch(name) and name.lower() not in ("true", "false", "null"):
        return name
    return escape.json(json.dumps(name, ensure_ascii=False))
