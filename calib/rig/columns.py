"""What follows from a recording's stops and is a column of them: what effects may look at."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from calib.rig.description import Rig
from chains import se3
from chains.align import align_points
from chains.arm import UPRIGHT
from chains.errors import InputError
from sensors.recording import RecordedStops

PAYLOAD = "payload_kg"
TEMPERATURE = "temperature_c"


def stop_columns(
    rig: Rig, joints: np.ndarray, time_s: np.ndarray, recorded: Mapping[str, np.ndarray]
) -> dict[str, np.ndarray]:
    """What follows from when and how the arm came to each of K stops, (K,) each.

    Each joint by its name as reported, rad or m; ``torques`` (K, J), N m or N, where any column
    ``<joint>.torque`` was recorded; ``payload_kg`` of the first tip where ``<tip>.payload_kg`` of
    any was; and, where the times are known: ``time_s``; ``elapsed_s`` since the first stop;
    ``waited.s`` since the stop before; ``travel.<joint>``, how far a joint went since then, rad or
    m; ``moved.<joint>``, which way: -1, 0 or 1. Of the first stop these three are 0: nothing is
    known of it.

    Args:
        rig: whose joints they are.
        joints: (K, J) reported.
        time_s: (K,) of the stops; NaN where nothing says when they were made.
        recorded: the recording's own columns.

    Raises:
        InputError: the payload of the first tip is there twice.
    """
    columns = dict(zip(rig.joint_names, joints.T, strict=True))
    torques = {name: f"{name}.torque" for name in rig.joint_names}
    if any(name in recorded for name in torques.values()):
        unknown = np.full(len(joints), np.nan)
        columns["torques"] = np.stack([recorded.get(c, unknown) for c in torques.values()], axis=1)
    columns |= _payload(rig, len(joints), recorded)
    if not np.isfinite(time_s).all():
        return columns
    order = np.argsort(time_s, kind="stable")
    travel, wait_s = np.zeros(np.shape(joints)), np.zeros(len(joints))
    travel[order[1:]] = np.diff(joints[order], axis=0)
    wait_s[order[1:]] = np.diff(time_s[order])
    elapsed_s = time_s - time_s.min(initial=np.inf)
    columns |= {"time_s": time_s, "elapsed_s": elapsed_s, "waited.s": wait_s}
    for name, went in zip(rig.joint_names, travel.T, strict=True):
        columns |= {f"travel.{name}": went, f"moved.{name}": np.sign(went)}
    return columns


def _payload(rig: Rig, count: int, recorded: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """``payload_kg`` (K,) of the first tip, none where only others carry any."""
    own = [f"{tip}.{PAYLOAD}" for tip in rig.tips]
    if not any(name in recorded for name in own):
        return {}
    if PAYLOAD in recorded and own[0] in recorded:
        raise InputError(
            f"{PAYLOAD} and {own[0]} both say what {rig.tips[0]} carries; keep one of the columns"
        )
    return {PAYLOAD: recorded.get(own[0], np.zeros(count))}


def load_columns(rig: Rig) -> dict[str, str]:
    """The column that says what each tip carries: of the first that without a name."""
    return {tip: f"{tip}.{PAYLOAD}" for tip in rig.tips} | {tip: PAYLOAD for tip in rig.tips[:1]}


def recorded_columns(columns: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """A recording's own columns (K,) as effects look at them: ``temperature_c`` that was read at
    some stops only is at the others as it is at these on average."""
    known = np.isfinite(celsius := columns.get(TEMPERATURE, np.zeros(0)))
    if known.all() or not known.any():
        return dict(columns)
    return {**columns, TEMPERATURE: np.where(known, celsius, celsius[known].mean())}


def up_in_root(rig: Rig, recording: RecordedStops) -> np.ndarray:
    """Unit vectors (K, 3) that point up in the root's frame, as levels say there on average, the
    chain as on paper; where none was read, as at all other stops. Without levels, as follows from
    where up is known to be in the tracker's frame."""
    said = [
        np.matvec(rig.tree.transform(frame, recording.joints)[:, :3, :3], felt)
        for frame, felt in recording.levels.items()
    ]
    if not said and rig.levels.up and rig.tracker:
        said = [direction_in_root(rig, recording, rig.levels.up)]
    up = np.nansum([np.full((len(recording.stops), 3), np.nan), *said], axis=0)
    elsewhere = up.sum(axis=0) if up.any() else UPRIGHT
    up = np.where(up.any(axis=1, keepdims=True), up, elsewhere)
    return up / np.linalg.norm(up, axis=1, keepdims=True)


def direction_in_root(rig: Rig, recording: RecordedStops, direction: Sequence[float]) -> np.ndarray:
    """As `direction_in_root_at`, on median for as long as the rig stands still."""
    there = direction_in_root_at(rig, recording, direction)
    places = recording.location if rig.moves == "location" else np.zeros(len(there), int)
    for place in np.unique(places) if rig.moves != "stop" else ():
        some = there[places == place]
        if np.isfinite(some).any():
            there[places == place] = np.nanmedian(some, axis=0)
    return there / np.linalg.norm(there, axis=1, keepdims=True)


def direction_in_root_at(
    rig: Rig, recording: RecordedStops, direction: Sequence[float]
) -> np.ndarray:
    """Unit vectors (K, 3) in the root's frame that point where a direction (3,) does in the
    tracker's, the rig lying at each stop as the body with the fewest joints before it says; NaN
    where that is not seen."""
    tracked, bodies = tracked_poses(rig, recording), rig.tracker.bodies
    read = [b for b in bodies if set(rig.passive).isdisjoint(rig.joints_to(b))]
    read = [b for b in read if np.isfinite(tracked[:, bodies.index(b), 0, 0]).any()]
    if not read:
        return np.full((len(tracked), 3), np.nan)
    body = min(read, key=lambda b: len(rig.joints_to(b)))
    R_world_body = tracked[:, bodies.index(body), :3, :3]
    R_root_body = rig.tree.transform(body, recording.joints)[:, :3, :3]
    there = np.matvec(R_root_body @ R_world_body.mT, np.array(direction, float))
    return there / np.linalg.norm(there, axis=1, keepdims=True)


def tracked_poses(rig: Rig, recording: RecordedStops) -> np.ndarray:
    """T_world_body (K, B, 4, 4) of the tracked bodies as measured, NaN where not known.

    Bodies seen as points are turned as CAD says, the rig lying as three or more points say.
    """
    seen = np.stack([recording.bodies[body] for body in rig.tracker.bodies], axis=1)
    T = se3.from_xyz_quat(seen[..., :3], seen[..., 3:])
    nominal = [rig.tree.place(b, recording.joints).Ts_root_frame for b in rig.tracker.bodies]
    nominal = np.stack(nominal, axis=1)
    points = np.isfinite(seen[..., 0]) & ~np.isfinite(seen[..., 3:]).all(axis=-1)
    for k in np.flatnonzero(points.any(axis=1)):
        at = np.flatnonzero(points[k])
        try:
            T_world_root, _ = align_points(seen[k, at, :3], nominal[k, at, :3, 3])
        except InputError:
            continue
        T[k, at, :3, :3] = T_world_root[:3, :3] @ nominal[k, at, :3, :3]
    return T
