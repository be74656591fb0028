"""Every source read by its reader, and all that they hold as one."""

from __future__ import annotations

import tempfile
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from chains.arm import read_arm
from chains.errors import InputError
from chains.frames import Edge
from sensors.documents import nearest, read_text, read_yaml
from sensors.lidar import catalog
from sensors.readers import READERS
from sensors.readers.arms.urdf import with_ends
from sensors.readers.base import (
    ArmDescription,
    Columns,
    Contents,
    Options,
    Progress,
    ScannedSurface,
    Spheres,
    Sweeps,
    Track,
)  # fmt: skip

ARMS = ("urdf", "dh")  # read before all others, which look for the arm's joints
USUAL_LOSS = 0.01  # of a LiDAR's packets, from which it is told: a choice
TOLD_BY_FILE = ("bag", "hesai", "mesh", "ouster")  # which read --metadata
PACKED = (".zip", ".gz", ".tgz", ".bz2", ".xz", ".7z", ".zst", ".tar")
ROOMS = ("mesh", "spheres", "survey")  # what stood around; nothing of the rig

Given = tuple[str, Sequence[Path]]
"""A kind, and its files."""


@dataclass(frozen=True)
class Gathered:
    """What all sources hold; the fields are those of `Contents`, `edges` the arm's, to all of its
    tips."""

    tracks: list[Track]
    sweeps: list[Sweeps]
    stops: Columns | None
    lidar: Mapping[str, Any] | None
    arm: ArmDescription | None
    edges: list[Edge]
    surface: ScannedSurface | None
    spheres: Spheres | None
    understood: list[str]
    odd: list[str]
    passive: Collection[str] = ()

    @property
    def joints(self) -> list[str]:
        """Names of the arm's moving joints that something reads, in order."""
        return list(_read_joints(self.edges, self.passive))

    @property
    def read_chain(self) -> list[Edge]:
        """The arm's chain to its first tip, where its joints tell how that moves: where all of them
        are read."""
        return [] if self.passive or self.arm is None else chain(replace(self.arm, others=()))


def sources(words: Sequence[str]) -> list[Given]:
    """Cut the words of a command line into sources: a kind, and its files.

    Raises:
        InputError: the first word is no kind, a kind has no files, or a file does not exist.
    """
    if not words or words[0] not in READERS:
        fault = f"'{words[0]}' is no kind of file" if words else "no kind of file is given"
        raise InputError(f"{fault}{nearest(words[0] if words else '', READERS)}")
    given: list[tuple[str, list[Path]]] = []
    for word in words:
        if word in READERS and not (given and Path(word).is_file()):
            given.append((word, []))
            continue
        path = Path(word)
        if not path.exists():
            raise InputError(f"{word} is neither a file nor a kind{nearest(word, READERS)}")
        given[-1][1].append(path)
    for kind, files in given:
        if not files:
            raise InputError(f"{kind}: no file is named after it; it reads {READERS[kind].reads}")
        for path in files:
            if path.is_file() and path.stat().st_size == 0:
                raise InputError(f"{path} is empty (0 bytes); was its transfer cut short?")
            if path.suffix.lower() in PACKED:
                raise InputError(f"{path} is packed; unpack it, and name the files in it")
    return given


def gather(
    given: Sequence[Given], options: Options, rig: Path | None, progress: Progress
) -> Gathered:
    """Read all sources, arms first, and put together what they hold.

    Raises:
        InputError: as readers do; two sources describe the same thing.
    """
    if all(kind in ROOMS for kind, _ in given):
        raise InputError(
            f"{' and '.join(dict.fromkeys(kind for kind, _ in given))} alone makes no recording; "
            "add what the LiDAR, the arm or a tracker measured, as a bag, clouds or a table"
        )
    if options.metadata and not any(kind in TOLD_BY_FILE for kind, _ in given):
        raise InputError(
            f"--metadata {options.metadata}: it is for {', '.join(TOLD_BY_FILE)}, and no such "
            "source is given"
        )
    if rig:
        options = _told_by_rig(rig, options)
    arms = [Contents(arm=_arm_beside(rig))] if rig else []
    arms += [_read(kind, files, options, progress) for kind, files in given if kind in ARMS]
    arm = _only([f.arm for f in arms if f.arm], "describe an arm", [k for k, _ in given])
    others = _tips_of(rig)[1:] if rig else ()
    arm = arm and replace(arm, others=others)
    edges = chain(arm)
    passive = section(rig, "arm").get("passive") or () if rig else ()
    options = replace(options, joints=_read_joints(edges, passive))
    rest = [_read(kind, files, options, progress) for kind, files in given if kind not in ARMS]
    if arm is None:
        arm = _only([f.arm for f in rest if f.arm], "describe an arm", [k for k, _ in given])
        arm = with_ends("the description of the arm", arm, options) if arm else None
        arm = arm and replace(arm, others=others)
        edges = chain(arm)
    contents = [*arms, *rest]
    sweeps = [s for f in contents for s in f.sweeps]
    names = [kind for kind, _ in given]
    return Gathered(
        tracks=[_renamed(t, options.bodies) for f in contents for t in f.tracks],
        sweeps=sweeps,
        stops=_one_table([f.stops for f in contents if f.stops is not None], options.bodies),
        lidar=_one_lidar([f.lidar for f in contents if f.lidar is not None]),
        arm=arm,
        edges=edges,
        surface=_only([f.surface for f in contents if f.surface], "hold a surface", names),
        spheres=_only([f.spheres for f in contents if f.spheres], "hold spheres", names),
        understood=[line for f in contents for line in f.understood],
        odd=[*(line for f in contents for line in f.odd), *_lossy(sweeps)],
        passive=passive,
    )


def _lossy(sweeps: Sequence[Sweeps]) -> Iterator[str]:
    """What is said of LiDARs of which packets are missing."""
    for each in (each for each in sweeps if each.lost > USUAL_LOSS):
        yield (
            f"{each.name}: {100 * each.lost:.2g} % of its packets are missing: the network, or the "
            "program that captured them, lost them"
        )


def _read(kind: str, files: Sequence[Path], options: Options, progress: Progress) -> Contents:
    return READERS[kind].read(files, options, progress)


def _read_joints(edges: Sequence[Edge], passive: Collection[str]) -> dict[str, str]:
    """Name -> kind of the moving joints of a chain that something reads, in order."""
    joints = (j for edge in edges if (j := edge.joint) is not None and j.leads)
    return {joint.name: joint.kind for joint in joints if joint.name not in passive}


def chain(arm: ArmDescription | None) -> list[Edge]:
    """The edges of an arm from its base to its tips; none of no arm."""
    if arm is None:
        return []
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "arm.urdf"
        path.write_text(arm.urdf, encoding="utf-8")
        try:
            return read_arm(path, arm.base, arm.tip, *arm.others)
        except InputError as error:
            raise InputError(str(error).replace(str(path), "the arm")) from None


def section(rig: Path, name: str) -> dict[str, Any]:
    """A section of a rig.yaml; empty where there is none that could be one."""
    data, _ = read_yaml(rig)
    part = data.get(name) if isinstance(data, dict) else None
    return part if isinstance(part, dict) else {}


def _arm_of(rig: Path) -> dict[str, str]:
    """Where the arm's URDF is and between which links it moves, or nothing."""
    arm, tips = section(rig, "arm"), _tips_of(rig)
    if not {"urdf", "base"} <= arm.keys() or not tips:
        return {}
    return {"urdf": str(arm["urdf"]), "base": str(arm["base"]), "tip": tips[0]}


def _tips_of(rig: Path) -> tuple[str, ...]:
    """The links that the arm ends at."""
    tip = section(rig, "arm").get("tip") or ()
    return tuple(map(str, tip)) if isinstance(tip, list) else (str(tip),) if tip else ()


def refuse_parts(gathered: Gathered, rig: Path | None) -> None:
    """Refuse sources of which no recording can be made.

    Raises:
        InputError: nothing was measured, or there is nothing that it could calibrate.
    """
    if not gathered.tracks and not gathered.sweeps and gathered.stops is None:
        what = "an arm" if gathered.arm else "nothing"
        raise InputError(
            f"the sources hold {what}, and no logs, no table of stops and no LiDAR data; add what "
            "was measured, as a bag, clouds or a table"
        )
    names = [t.name for t in gathered.tracks if t.kind in ("pose", "point")]
    names += [n.rpartition(".")[0] for n in gathered.stops or () if n.endswith(".x")]
    if gathered.surface and not names:
        raise InputError(
            "nothing says where the rig stood in the scanned room; add what a tracker saw, or a "
            "table of stops with base_guess.x to base_guess.qz, or leave the room out"
        )
    if rig is None and gathered.arm is None and not gathered.sweeps:
        raise InputError(
            "no arm or LiDAR is there to be calibrated by "
            f"{', '.join(dict.fromkeys(names)) or 'what was logged'}; add the source of one, as "
            "`urdf FILE` or `dh FILE` for an arm"
        )


def _told_by_rig(rig: Path, options: Options) -> Options:
    """The options with what rig.yaml says: the arm's links, and the LiDAR's model."""
    arm = _arm_of(rig)
    model = section(rig, "lidar").get("model")
    return replace(
        options,
        base=options.base or arm.get("base"),
        tip=options.tip or arm.get("tip"),
        lidar=options.lidar or (model if model in catalog() else None),
    )


def _arm_beside(rig: Path) -> ArmDescription | None:
    """The arm that a rig.yaml names, where its URDF lies beside it."""
    arm = _arm_of(rig)
    path = rig.parent / arm["urdf"] if arm else None
    if path is None or not path.is_file():
        return None
    return ArmDescription(read_text(path), arm["base"], arm["tip"])


def _only(those: Sequence[Any], what: str, kinds: Sequence[str]) -> Any:
    """The last of what should be one: a source given outdoes what lies beside rig.yaml."""
    if len(those) > 2 or (len(those) == 2 and what != "describe an arm"):
        raise InputError(f"{len(those)} of the sources ({', '.join(kinds)}) {what}; give one")
    return those[-1] if those else None


def _one_table(tables: Sequence[Columns], bodies: Mapping[str, str]) -> Columns | None:
    """The columns of all tables of stops, joined by the names of the stops."""
    if not tables:
        return None
    renamed = [
        {_column(name, bodies): values for name, values in table.items()} for table in tables
    ]
    first = renamed[0]
    for other in renamed[1:]:
        if "stop" not in first or "stop" not in other:
            raise InputError(
                "two sources hold a row for every stop; they need a column `stop` to be joined by"
            )
        rows = {name: k for k, name in enumerate(other["stop"])}
        if missing := [name for name in first["stop"] if name not in rows]:
            raise InputError(f"stop {missing[0]} is in one table of stops, and not in the other")
        order = [rows[name] for name in first["stop"]]
        first = {name: values[order] for name, values in other.items()} | first
    return first


def _column(name: str, bodies: Mapping[str, str]) -> str:
    body, dot, part = name.rpartition(".")
    return f"{bodies.get(body, body)}{dot}{part}"


def _renamed(track: Track, bodies: Mapping[str, str]) -> Track:
    if track.kind not in ("pose", "point"):
        return track
    return replace(track, name=bodies.get(track.name, track.name))


def _one_lidar(lidars: Sequence[Mapping[str, Any]]) -> Mapping[str, Any] | None:
    """What sources say of the LiDAR; two that name different models are two LiDARs."""
    models = list(dict.fromkeys(one["model"] for one in lidars if one.get("model")))
    if len(models) > 1:
        raise InputError(
            f"the sources are of several LiDARs, {', '.join(models)}; a recording has one"
        )
    merged: dict[str, Any] = {}
    for one in lidars:
        merged |= {key: value for key, value in one.items() if value is not None}
    return merged or None


def once_each(tracks: Sequence[Track]) -> None:
    """Refuse a body, or the joints, that two logs follow.

    Raises:
        InputError: which of the two is meant is not known.
    """
    seen: dict[str, Track] = {}
    for track in (t for t in tracks if t.kind in ("joints", "pose", "point")):
        key = "joints" if track.kind == "joints" else track.name
        if key in seen:
            raise InputError(
                f"two logs follow {key}, on the clocks {seen[key].clock} and {track.clock}; give "
                "one of them, or name topics with --topic"
            )
        seen[key] = track


def joint_track(tracks: Sequence[Track], joints: Sequence[str]) -> list[Track]:
    """The tracks, those with all of the arm's joints as joints, in the arm's order; what else they
    and logs of other joints tell, a gripper's opening say, as covariates.

    Raises:
        InputError: no log has them all.
    """
    if not joints:
        return list(tracks)
    out, met, have = [], False, []
    for track in tracks:
        have += track.names if track.kind in ("joints", "covariate") else []
        if track.kind in ("joints", "covariate") and set(joints) <= set(track.names):
            order = [track.names.index(name) for name in joints]
            out.append(
                replace(track, kind="joints", names=tuple(joints), values=track.values[:, order])
            )
            met = True
        if track.kind in ("joints", "covariate"):
            rest = [k for k, name in enumerate(track.names) if name not in joints]
            if rest:
                names = tuple(track.names[k] for k in rest)
                values = track.values[:, rest]
                out.append(replace(track, kind="covariate", names=names, values=values))
        else:
            out.append(track)
    if not met:
        missing = next((name for name in joints if name not in have), joints[0])
        raise InputError(
            f"no source has values of the arm's joint {missing}"
            f"{nearest(missing, have) if have else ''}; say --column {missing}=THEIRS"
        )
    return out


def finite_times(sweeps: Sequence[Sweeps]) -> bool:
    """Whether all turns of the LiDAR have a time."""
    return all(np.isfinite(one.time_s).all() for one in sweeps)
