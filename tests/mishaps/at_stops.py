"""Mishaps of one stop or of some: bodies, joints and scans."""

from __future__ import annotations

import shutil

import numpy as np
from scipy.spatial.transform import Rotation

from sensors.recording import read_table, write_table

from .kinds import Done, done, mishap
from .scene import QUAT, XYZ, Scene

NO = np.zeros(3)


# --------------------------------------------------------------------------------------- bodies


def _body(scene: Scene, times: float, which: int, kind: str) -> Done:
    body = scene.bodies[which]
    stop = scene.stop(body)
    token = f"{stop}:{body}"
    move = times * scene.size(token, f"body {kind}") * scene.way()
    rows = [scene.names.index(stop)]
    scene.move(body, rows, *((move, NO) if kind == "m" else (NO, move)))
    return done({token}, scene.group(token))


@mishap("tracker", "base", sized=True)
def base_body_shifted_at_one_stop(scene: Scene, times: float) -> Done:
    return _body(scene, times, 0, "m")


@mishap("tracker", "base", "poses", sized=True)
def base_body_turned_at_one_stop(scene: Scene, times: float) -> Done:
    return _body(scene, times, 0, "rad")


@mishap("tracker", sized=True)
def mount_body_shifted_at_one_stop(scene: Scene, times: float) -> Done:
    return _body(scene, times, -1, "m")


@mishap("tracker", "poses", sized=True)
def mount_body_turned_at_one_stop(scene: Scene, times: float) -> Done:
    return _body(scene, times, -1, "rad")


def _taped(scene: Scene, times: float, which: int) -> Done:
    """From a stop on, a body sits elsewhere on what it is bolted to."""
    body = scene.bodies[which]
    first = int(scene.rng.integers(len(scene.names) // 3, 2 * len(scene.names) // 3))
    later = range(first, len(scene.names))
    rows = [k for k in later if scene.seen(body)[k]]
    way = times * scene.size(f"{scene.names[first]}:{body}", "body m") * scene.way()
    quat = scene.stops.numbers(*(f"{body}.{q}" for q in QUAT))[rows]
    scene.move(body, rows, Rotation.from_quat(quat, scalar_first=True).apply(way), NO)
    # With no arm, or no LiDAR, whatever moves a body moves it against all that is seen.
    alike = set() if scene.joints and "lidar" in scene.rig else {"mount_slip"}
    right = {f"*:{body}", f"cad:{body}", "body_slip" if which else "base_slip"}
    right |= {"body_slip"} if len(scene.bodies) == 1 else set()
    return done(right, {"*:joints", "*:scan"} | alike, unsure={body})


@mishap("tracker", "base", "poses", sized=True)
def base_body_taped_anew_from_a_stop_on(scene: Scene, times: float) -> Done:
    return _taped(scene, times, 0)


@mishap("tracker", "poses", sized=True)
def mount_body_taped_anew_from_a_stop_on(scene: Scene, times: float) -> Done:
    return _taped(scene, times, -1)


@mishap("tracker")
def one_wild_coordinate(scene: Scene, times: float) -> Done:
    body = str(scene.rng.choice(scene.bodies))
    stop = scene.stop(body)
    scene.move(body, [scene.names.index(stop)], np.array([0.5, 0, 0]), NO)
    return done({f"{stop}:{body}"}, scene.group(f"{stop}:{body}"))


def _rows(scene: Scene, stops: list[str], body: str, values: list[float]) -> Done:
    columns = [f"{body}.{p}" for p in (*XYZ, *QUAT) if f"{body}.{p}" in scene.stops.columns]
    with scene.sheet("stops.csv") as sheet:
        numbers = sheet.numbers(*columns)
        numbers[[scene.names.index(stop) for stop in stops]] = values[: len(columns)]
        sheet.put(numbers, *columns)
    tokens = {f"{stop}:{body}" for stop in stops}
    return done(tokens, set().union(*map(scene.group, tokens)))


@mishap("tracker", sized=True)
def rows_of_zeros_where_nothing_was_seen(scene: Scene, times: float) -> Done:
    return _rows(scene, scene.some(times), scene.bodies[-1], [0, 0, 0, 1, 0, 0, 0])


@mishap("tracker", sized=True)
def the_last_seen_pose_held_on(scene: Scene, times: float) -> Done:
    """A tracker's stream that went stale: one pose for several stops."""
    body = scene.bodies[-1]
    stop = scene.stop(body)
    columns = [f"{body}.{p}" for p in (*XYZ, *QUAT) if f"{body}.{p}" in scene.stops.columns]
    held = scene.stops.numbers(*columns)[scene.names.index(stop)].tolist()
    return _rows(scene, [n for n in scene.some(times) if n != stop] or [stop], body, held)


@mishap("tracker", "base", "poses")
def bodies_swapped_at_one_stop(scene: Scene, times: float) -> Done:
    base, mount = scene.bodies[0], scene.bodies[-1]
    stop = scene.stop(base, mount)
    _swap(scene, base, mount, [scene.names.index(stop)])
    return done({f"{stop}:{base}", f"{stop}:{mount}"}, {f"{stop}:joints"})


@mishap("tracker", "base", "poses")
def bodies_swapped(scene: Scene, times: float) -> Done:
    _swap(scene, scene.bodies[0], scene.bodies[-1], list(range(len(scene.names))))
    return done()


def _swap(scene: Scene, one: str, other: str, rows: list[int]) -> None:
    with scene.sheet("stops.csv") as sheet:
        for part in (*XYZ, *QUAT):
            values = sheet.numbers(f"{one}.{part}", f"{other}.{part}")
            values[rows] = values[rows][:, ::-1]
            sheet.put(values, f"{one}.{part}", f"{other}.{part}")


@mishap("tracker", "poses")
def quaternions_with_the_scalar_last(scene: Scene, times: float) -> Done:
    with scene.sheet("stops.csv") as sheet:
        for body in scene.bodies:
            columns = [f"{body}.{q}" for q in QUAT]
            sheet.put(np.roll(sheet.numbers(*columns), -1, axis=1), *columns)
    return done()


@mishap("tracker", "poses", harmless=True)
def quaternions_of_either_sign(scene: Scene, times: float) -> Done:
    with scene.sheet("stops.csv") as sheet:
        for body in scene.bodies:
            columns = [f"{body}.{q}" for q in QUAT]
            sign = scene.rng.choice([-1, 1], (len(sheet), 1))
            sheet.put(sign * sheet.numbers(*columns), *columns)
    return done()


@mishap("tracker", "poses")
def poses_the_other_way_round(scene: Scene, times: float) -> Done:
    """T_body_opti where T_opti_body belongs."""
    with scene.sheet("stops.csv") as sheet:
        for body in scene.bodies:
            at, quat = ([f"{body}.{p}" for p in parts] for parts in (XYZ, QUAT))
            seen = scene.seen(body)
            xyz, q = sheet.numbers(*at), sheet.numbers(*quat)
            R = Rotation.from_quat(q[seen], scalar_first=True).inv()
            xyz[seen], q[seen] = -R.apply(xyz[seen]), R.as_quat(scalar_first=True)
            sheet.put(xyz, *at)
            sheet.put(q, *quat)
    return done()


@mishap("tracker", sized=True)
def tracker_rounds_its_positions(scene: Scene, times: float) -> Done:
    with scene.sheet("stops.csv") as sheet:
        for body in scene.bodies:
            columns = [f"{body}.{p}" for p in XYZ]
            step = 1e-4 * times
            sheet.put(np.round(sheet.numbers(*columns) / step) * step, *columns)
    return done()


# --------------------------------------------------------------------------------------- joints


def _joint(scene: Scene, stop: str, joint: str) -> Done:
    group = scene.group(f"{stop}:joints") | {f"{stop}:joint_*"}
    return done({f"{stop}:{joint}", f"{stop}:joints"}, group)


def _middle(scene: Scene) -> str:
    """A joint whose reading shows: the first may turn with the room, the last with the tool."""
    return str(scene.rng.choice(scene.joints[1:-1]))


@mishap("arm", sized=True)
def one_joint_misread_at_one_stop(scene: Scene, times: float) -> Done:
    joint, stop = _middle(scene), scene.stop(*scene.bodies)
    token = f"{stop}:{joint}"
    with scene.sheet("stops.csv") as sheet:
        values = sheet.numbers(joint)
        values[scene.names.index(stop)] += times * scene.size(token, "joint rad")
        sheet.put(values, joint)
    return _joint(scene, stop, joint)


@mishap("arm")
def joints_of_one_stop_from_another(scene: Scene, times: float) -> Done:
    stop = scene.stop(*scene.bodies)
    k = scene.names.index(stop)
    with scene.sheet("stops.csv") as sheet:
        values = sheet.numbers(*scene.joints)
        values[k] = values[k - 1]
        sheet.put(values, *scene.joints)
    return _joint(scene, stop, "joints")


@mishap("arm")
def joints_read_one_stop_late(scene: Scene, times: float) -> Done:
    with scene.sheet("stops.csv") as sheet:
        sheet.put(np.roll(sheet.numbers(*scene.joints), 1, axis=0), *scene.joints)
    return done({"*:joint*"}, {"*"})


@mishap("arm", sized=True)
def one_encoder_stuck_for_some_stops(scene: Scene, times: float) -> Done:
    joint, count = _middle(scene), max(2, int(times))
    first = int(scene.rng.integers(0, max(1, len(scene.names) - count)))
    with scene.sheet("stops.csv") as sheet:
        values = sheet.numbers(joint)
        values[first : first + count] = values[first]
        sheet.put(values, joint)
    stops = scene.names[first + 1 : first + count]
    right = {f"{s}:{j}" for s in stops for j in (joint, "joints")}
    return done(right, set().union(*(scene.group(f"{s}:joints") for s in stops)) | {"*:joint*"})


@mishap("arm")
def one_encoder_stuck_all_the_time(scene: Scene, times: float) -> Done:
    joint = _middle(scene)
    with scene.sheet("stops.csv") as sheet:
        sheet.put(np.full((len(sheet), 1), sheet.numbers(joint)[0, 0]), joint)
    return done({f"*:{joint}", "*:joints"}, {"*"})


@mishap("arm")
def one_joint_in_degrees(scene: Scene, times: float) -> Done:
    return _scaled(scene, _middle(scene), 180 / np.pi)


@mishap("arm")
def one_joint_counts_the_other_way(scene: Scene, times: float) -> Done:
    return _scaled(scene, _middle(scene), -1.0)


@mishap("arm", sized=True)
def one_joint_scaled(scene: Scene, times: float) -> Done:
    """A gear ratio a little off: 0.1 %, 0.3 %, 1 %."""
    return _scaled(scene, _middle(scene), 1 + 1e-3 * times)


def _scaled(scene: Scene, joint: str, factor: float) -> Done:
    with scene.sheet("stops.csv") as sheet:
        sheet.put(factor * sheet.numbers(joint), joint)
    return done({f"*:{joint}", "*:joints", "arm_joint_scale"}, {"*:*"})


@mishap("arm")
def columns_of_two_joints_exchanged(scene: Scene, times: float) -> Done:
    one, other = scene.rng.choice(scene.joints[1:-1], 2, replace=False)
    with scene.sheet("stops.csv") as sheet:
        sheet.columns[one], sheet.columns[other] = sheet.columns[other], sheet.columns[one]
    return done({"*:joint*"}, {"*:*"})


@mishap("arm")
def a_joint_zeroed_a_quarter_turn_away(scene: Scene, times: float) -> Done:
    joint = _middle(scene)
    with scene.sheet("stops.csv") as sheet:
        sheet.put(sheet.numbers(joint) + np.pi / 2, joint)
    shift = {("arm_joint_offset", joint): -np.pi / 2}
    return done({f"cad:arm_joint_offset.{joint}"}, {"*:joint*"}, shift)


# ---------------------------------------------------------------------------------------- scans


def _scan(scene: Scene, times: float, kind: str) -> Done:
    stop = scene.stop(*scene.bodies)
    token = f"{stop}:scan"
    move = times * scene.size(token, f"scan {kind}") * scene.way()

    def knocked(columns: dict[str, np.ndarray]) -> None:
        xyz = np.stack([columns[c] for c in XYZ], axis=1).astype(float)
        xyz = xyz + move if kind == "m" else Rotation.from_rotvec(move).apply(xyz)
        columns.update(zip(XYZ, xyz.T, strict=True))

    scene.each_scan(knocked, stop)
    return done({token}, scene.group(token))


@mishap("lidar", sized=True)
def sensor_shifted_at_one_stop(scene: Scene, times: float) -> Done:
    return _scan(scene, times, "m")


@mishap("lidar", sized=True)
def sensor_turned_at_one_stop(scene: Scene, times: float) -> Done:
    return _scan(scene, times, "rad")


@mishap("lidar", "tracker", "base", sized=True)
def base_moved_between_tracker_and_scan(scene: Scene, times: float) -> Done:
    """All bodies are where they were, and the scan is not."""
    stop = scene.stop(*scene.bodies)
    token = f"{stop}:scan"
    move = times * scene.size(token, "scan m") * scene.way()
    for body in scene.bodies:
        scene.move(body, [scene.names.index(stop)], move, NO)
    return done({token}, scene.group(token))


def _with_scan(scene: Scene) -> list[str]:
    return [name for name in scene.names if scene.scan_path(name).is_file()]


@mishap("lidar")
def two_scans_exchanged(scene: Scene, times: float) -> Done:
    one, other = map(str, scene.rng.choice(_with_scan(scene), 2, replace=False))
    scans = [scene.scan_path(name).read_bytes() for name in (other, one)]
    for name, data in zip((one, other), scans, strict=True):
        scene.scan_path(name).write_bytes(data)
    return done({f"{one}:scan", f"{other}:scan"}, {f"{one}:*", f"{other}:*"})


@mishap("lidar")
def scans_one_stop_late(scene: Scene, times: float) -> Done:
    names = _with_scan(scene)
    scans = [scene.scan_path(name).read_bytes() for name in names]
    for name, data in zip(names, [scans[-1], *scans[:-1]], strict=True):
        scene.scan_path(name).write_bytes(data)
    return done()


@mishap("lidar")
def one_scan_is_a_copy_of_another(scene: Scene, times: float) -> Done:
    one, other = map(str, scene.rng.choice(_with_scan(scene), 2, replace=False))
    shutil.copy(scene.scan_path(one), scene.scan_path(other))
    return done({f"{other}:scan"}, {f"{one}:scan", *scene.group(f"{other}:scan")})


@mishap("lidar")
def sweeps_of_two_stops_in_one_scan(scene: Scene, times: float) -> Done:
    one, other = map(str, scene.rng.choice(_with_scan(scene), 2, replace=False))
    mine, strange = (read_table(scene.scan_path(name)) for name in (one, other))
    half = len(strange["x"]) // 2
    both = {c: np.concatenate([mine[c], strange[c][:half]]) for c in mine}
    write_table(scene.scan_path(one), both)
    return done({f"{one}:scan"}, scene.group(f"{one}:scan"))


@mishap(harmless=True)
def one_stop_written_twice(scene: Scene, times: float) -> Done:
    """The same stop under another name."""
    k = int(scene.rng.integers(len(scene.names)))
    name, twin = scene.names[k], f"{scene.names[k]}again"
    with scene.sheet("stops.csv") as sheet:
        sheet.keep([*range(len(sheet)), k])
        sheet.columns["stop"][-1] = twin
    if scene.scan_path(name).is_file():
        shutil.copy(scene.scan_path(name), scene.scan_path(twin))
    return done({f"{name}:scan", f"{twin}:scan"}, {f"{name}:*", f"{twin}:*"})


@mishap("lidar", sized=True)
def half_of_a_scan_from_after_a_knock(scene: Scene, times: float) -> Done:
    """The sensor was knocked while it swept: half of the columns are elsewhere."""
    stop = scene.stop(*scene.bodies)
    token = f"{stop}:scan"
    move = 2 * times * scene.size(token, "scan m") * scene.way()

    def knocked(columns: dict[str, np.ndarray]) -> None:
        later = columns["column"] > np.median(columns["column"])
        for axis, shift in zip(XYZ, move, strict=True):
            columns[axis] = columns[axis] + shift * later

    scene.each_scan(knocked, stop)
    return done({token}, scene.group(token))
