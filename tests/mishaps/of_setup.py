"""Mishaps of what holds for a whole recording: CAD, URDF, targets, the mesh."""

from __future__ import annotations

import re
from itertools import islice

import numpy as np
from scipy.spatial.transform import Rotation

from .kinds import Done, done, mishap
from .scene import PARTS, Scene

INCH_M = 0.0254


# ------------------------------------------------------------------------------------------ CAD


def _frames(scene: Scene, *wanted: str) -> list[str]:
    """Frames that have a prior to be wrong by; those of the hand first asked for."""
    known = {n: f for n, f in scene.rig["frames"].items() if np.any(f.get("sigma_m", 0))}
    return [n for n in wanted if n in known] or list(known)


def _tied(scene: Scene, frame: str) -> set[str]:
    """What turns or moves with a frame at every stop, so that only their sum is seen."""
    parents = {name: f["parent"] for name, f in scene.rig["frames"].items()}
    arm = scene.rig.get("arm") or {}
    hand = {n for n in parents if _root(n, parents) == arm.get("tip")}
    mine = hand if frame in hand else set(parents) - hand
    joints = scene.joints[-1:] if frame in hand else scene.joints[:1]
    ends = {"tip", "joint_tip", *joints} if frame in hand else set(joints)
    effects = {f"arm_{kind}.{end}" for kind in ("link_length", "joint_offset") for end in ends}
    return {f"cad:{name}" for name in (mine | effects if scene.joints else mine)}


def _root(frame: str, parents: dict[str, str]) -> str:
    while frame in parents:
        frame = parents[frame]
    return frame


def _cad(scene: Scene, frame: str, key: str, change: object) -> Done:
    with scene.description() as rig:
        rig["frames"][frame][key] = np.asarray(change, float).tolist()
    return done({f"cad:{frame}"}, _tied(scene, frame))


def _off(scene: Scene, times: float, frame: str, kind: str) -> Done:
    key = "xyz_m" if kind == "m" else "rpy_rad"
    old = np.array(scene.rig["frames"][frame][key], float)
    move = times * scene.size(f"cad:{frame}", f"frame {kind}") * scene.way()
    if kind == "m":
        return _cad(scene, frame, key, old + move)
    turned = Rotation.from_euler("xyz", old) * Rotation.from_rotvec(move)
    return _cad(scene, frame, key, turned.as_euler("xyz"))


@mishap(sized=True)
def CAD_of_the_sensor_shifted(scene: Scene, times: float) -> Done:
    return _off(scene, times, _frames(scene, "lidar", "tool", "laser_tracker")[0], "m")


@mishap(sized=True)
def CAD_of_the_sensor_turned(scene: Scene, times: float) -> Done:
    return _off(scene, times, _frames(scene, "lidar", "tool")[0], "rad")


@mishap("tracker", sized=True)
def CAD_of_a_body_shifted(scene: Scene, times: float) -> Done:
    return _off(scene, times, _frames(scene, scene.bodies[-1])[0], "m")


@mishap("tracker", "poses", sized=True)
def CAD_of_a_body_turned(scene: Scene, times: float) -> Done:
    return _off(scene, times, _frames(scene, scene.bodies[-1])[0], "rad")


@mishap("arm", sized=True)
def CAD_of_the_arms_base_shifted(scene: Scene, times: float) -> Done:
    return _off(scene, times, _frames(scene, "arm_base")[0], "m")


@mishap()
def CAD_of_the_sensor_of_wrong_sign(scene: Scene, times: float) -> Done:
    frame = _frames(scene, "lidar", "tool")[0]
    return _cad(scene, frame, "xyz_m", -np.array(scene.rig["frames"][frame]["xyz_m"]))


@mishap("tracker")
def CAD_of_a_body_of_wrong_sign(scene: Scene, times: float) -> Done:
    frame = _frames(scene, scene.bodies[-1])[0]
    return _cad(scene, frame, "xyz_m", -np.array(scene.rig["frames"][frame]["xyz_m"]))


@mishap()
def CAD_axes_exchanged(scene: Scene, times: float) -> Done:
    """x y z of the sensor as z x y."""
    frame = _frames(scene, "lidar", "tool")[0]
    return _cad(scene, frame, "xyz_m", np.roll(scene.rig["frames"][frame]["xyz_m"], 1))


@mishap("lidar")
def CAD_turned_the_wrong_way(scene: Scene, times: float) -> Done:
    frame = _frames(scene, "lidar")[0]
    return _cad(scene, frame, "rpy_rad", -np.array(scene.rig["frames"][frame]["rpy_rad"]))


@mishap("lidar")
def CAD_angles_in_degrees(scene: Scene, times: float) -> Done:
    frame = _frames(scene, "lidar")[0]
    return _cad(scene, frame, "rpy_rad", np.degrees(scene.rig["frames"][frame]["rpy_rad"]))


@mishap()
def CAD_in_inches(scene: Scene, times: float) -> Done:
    frame = _frames(scene, "lidar", "tool")[0]
    return _cad(scene, frame, "xyz_m", np.array(scene.rig["frames"][frame]["xyz_m"]) / INCH_M)


# ----------------------------------------------------------------------------------------- URDF


def _length(scene: Scene) -> tuple[str, int, np.ndarray, str]:
    """A link whose length shows: its joint, the axis, its origin, and how the URDF writes it."""
    text = (scene.folder / scene.urdf).read_text(encoding="utf-8")
    for joint in scene.joints[1:]:
        block = re.search(rf'<joint name="{joint}".*?</joint>', text, re.S)[0]
        written = re.search(r'<origin[^>]*xyz="([^"]+)"', block)
        origin = np.array(written[1].split(), float) if written else np.zeros(3)
        if np.any(origin):
            return joint, int(np.argmax(np.abs(origin))), origin, block
    raise AssertionError("no link has a length")


def _write_length(scene: Scene, joint: str, block: str, origin: np.ndarray) -> None:
    words = " ".join(repr(float(x)) for x in origin)
    changed = re.sub(r'(<origin[^>]*xyz=")[^"]+', lambda m: m[1] + words, block, count=1)
    scene.rewrite(scene.urdf, block, changed)


@mishap("arm", sized=True)
def a_link_of_the_URDF_too_long(scene: Scene, times: float) -> Done:
    joint, axis, origin, block = _length(scene)
    name = f"arm_link_length.{joint}"
    longer = times * scene.size(f"cad:{name}", "length m")
    sign = np.sign(origin[axis])
    origin[axis] += sign * longer
    _write_length(scene, joint, block, origin)
    return done({f"cad:{name}"}, {"cad:arm_*"}, {("arm_link_length", joint): -longer})


@mishap("arm")
def a_link_of_the_URDF_of_wrong_sign(scene: Scene, times: float) -> Done:
    joint, axis, origin, block = _length(scene)
    length = abs(origin[axis])
    origin[axis] *= -1
    _write_length(scene, joint, block, origin)
    shift = {("arm_link_length", joint): -2 * length}
    return done({f"cad:arm_link_length.{joint}"}, {"cad:arm_*"}, shift)


@mishap("arm")
def an_axis_of_the_URDF_of_wrong_sign(scene: Scene, times: float) -> Done:
    joint = str(scene.rng.choice(scene.joints[1:-1]))
    text = (scene.folder / scene.urdf).read_text(encoding="utf-8")
    block = re.search(rf'<joint name="{joint}".*?</joint>', text, re.S)[0]
    axis = np.array(re.search(r'<axis xyz="([^"]+)"', block)[1].split(), float)
    words = " ".join(f"{-x:g}" for x in axis)
    scene.rewrite(scene.urdf, block, re.sub(r'(<axis xyz=")[^"]+', rf"\g<1>{words}", block))
    return done({f"*:{joint}", "*:joints"}, {"*:*"})


@mishap("arm")
def an_origin_of_the_URDF_turned(scene: Scene, times: float) -> Done:
    """One of the quarter turns between axes has the wrong sign."""
    text = (scene.folder / scene.urdf).read_text(encoding="utf-8")
    quarter = re.search(r'rpy="(-?1\.57\d*)', text)[1]
    scene.rewrite(scene.urdf, f'rpy="{quarter}', f'rpy="{-float(quarter)!r}')
    return done({"cad:*"}, {"*:*"})


# -------------------------------------------------------------------------------------- targets


def _target(scene: Scene, times: float, part: str, columns: tuple[str, ...]) -> Done:
    with scene.sheet("targets.csv") as sheet:
        k = int(scene.rng.integers(len(sheet)))
        target = sheet.columns["target"][k]
        token = f"{target}:{part}"
        move = times * scene.size(token, "target m") * scene.way()
        for column in columns:
            names = [f"{column}_{axis}" for axis in "xyz"]
            values = sheet.numbers(*names)
            values[k] += move
            sheet.put(values, *names)
    return done({token}, {f"{target}:{p}" for p in PARTS})


@mishap("targets", sized=True)
def a_sphere_misplaced(scene: Scene, times: float) -> Done:
    return _target(scene, times, "sphere", ("faro",))


@mishap("targets", sized=True)
def a_lower_marker_misplaced(scene: Scene, times: float) -> Done:
    return _target(scene, times, "lower", ("lower",))


@mishap("targets", sized=True)
def an_upper_marker_misplaced(scene: Scene, times: float) -> Done:
    return _target(scene, times, "upper", ("upper",))


@mishap("targets", sized=True)
def a_rod_moved_between_the_instruments(scene: Scene, times: float) -> Done:
    return _target(scene, times, "rod", ("upper", "lower"))


@mishap("targets")
def two_targets_exchanged(scene: Scene, times: float) -> Done:
    with scene.sheet("targets.csv") as sheet:
        rows = scene.rng.choice(len(sheet), 2, replace=False)
        names = [f"faro_{axis}" for axis in "xyz"]
        values = sheet.numbers(*names)
        values[rows] = values[rows[::-1]]
        sheet.put(values, *names)
        targets = [sheet.columns["target"][k] for k in rows]
    return done({f"{t}:{p}" for t in targets for p in PARTS}, {"*:sphere", "*:rod"})


@mishap("targets")
def upper_and_lower_markers_exchanged(scene: Scene, times: float) -> Done:
    with scene.sheet("targets.csv") as sheet:
        for axis in "xyz":
            one, other = f"upper_{axis}", f"lower_{axis}"
            sheet.columns[one], sheet.columns[other] = sheet.columns[other], sheet.columns[one]
    return done()


@mishap("targets", sized=True)
def rods_longer_than_stated(scene: Scene, times: float) -> Done:
    with scene.description() as rig:
        rig["target"]["sphere_below_lower_marker_m"] += 0.003 * times
    return done({"*:sphere", "*:rod", "*:lower", "target_sphere_offset"}, {"cad:*"})


@mishap("targets")
def one_target_in_millimetres(scene: Scene, times: float) -> Done:
    with scene.sheet("targets.csv") as sheet:
        k = int(scene.rng.integers(len(sheet)))
        for axis in "xyz":
            values = sheet.numbers(f"faro_{axis}")
            values[k] *= 1000
            sheet.put(values, f"faro_{axis}")
        target = sheet.columns["target"][k]
    return done({f"{target}:sphere"}, {f"{target}:{p}" for p in PARTS})


# ----------------------------------------------------------------------------------------- mesh


@mishap("mesh", "targets", sized=True)
def mesh_scaled(scene: Scene, times: float) -> Done:
    """0.1 %, 0.3 %, 1 %, the spheres with it: the laser scanner's scale is off."""
    factor = 1 + 1e-3 * times
    scene.remesh(lambda at, triangles: factor * at)
    with scene.sheet("targets.csv") as sheet:
        for axis in "xyz":
            sheet.put(factor * sheet.numbers(f"faro_{axis}"), f"faro_{axis}")
    return done({"mesh:scale", "faro_scale", "mesh:*"}, {"range_scale"})


@mishap("mesh")
def mesh_in_inches(scene: Scene, times: float) -> Done:
    scene.remesh(lambda at, triangles: at / INCH_M)
    return done({"mesh:scale", "faro_scale"}, {"mesh:*"})


@mishap("mesh")
def mesh_mirrored(scene: Scene, times: float) -> Done:
    scene.remesh(lambda at, triangles: at * [1, -1, 1])
    return done()


@mishap("mesh", "targets", sized=True)
def mesh_shifted_against_the_spheres(scene: Scene, times: float) -> Done:
    """The scanner was set up again between the room and the spheres."""
    move = times * scene.size("T1:sphere", "target m") * scene.way()
    scene.remesh(lambda at, triangles: at + move)
    # Spheres that hang lower and rods that lean, all alike, are a shift of all spheres.
    alike = {"target_sphere_offset", "target_rod_tilt"}
    return done({"mesh_shift", "mesh:*", "*:sphere", "*:rod"}, alike, unsure={"faro"})


def _planes(at: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of each triangle its normal (F, 3), and the number of the plane that it is of, by area."""
    corners = at[triangles]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(cross, axis=1)
    normal = cross / np.maximum(area, 1e-12)[:, None]
    offset = np.einsum("fi,fi->f", normal, corners[:, 0])
    key = np.round(np.column_stack([normal * 20, offset * 10])).astype(int)
    _, plane = np.unique(key, axis=0, return_inverse=True)
    order = np.argsort(-np.bincount(plane.ravel(), weights=area))
    return normal, np.argsort(order)[plane.ravel()]


def _seen(at: np.ndarray, triangles: np.ndarray, which: np.ndarray) -> bool:
    """Whether the largest of some triangles (F,) is the first that a ray to it from the middle of
    the room meets (Moeller and Trumbore 1997)."""
    corners = at[triangles]
    edge_1, edge_2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = np.linalg.norm(np.cross(edge_1, edge_2), axis=1)
    middle = np.percentile(at, [2, 98], axis=0).mean(axis=0)
    ray = corners[np.argmax(np.where(which, area, -1))].mean(axis=0) - middle
    p, from_corner = np.cross(ray, edge_2), middle - corners[:, 0]
    det = np.einsum("fi,fi->f", edge_1, p)
    q = np.cross(from_corner, edge_1)
    with np.errstate(divide="ignore", invalid="ignore"):
        u, v = np.einsum("fi,fi->f", from_corner, p) / det, q @ ray / det
        part = np.einsum("fi,fi->f", edge_2, q) / det  # of the way to that triangle
        before = (u >= 0) & (v >= 0) & (u + v <= 1) & (part > 0) & (part < 1 - 1e-6)
    return not np.any(before & ~which)


@mishap("mesh", sized=True)
def one_surface_moved(scene: Scene, times: float) -> Done:
    """A wall's panel stands off since the room was scanned: the second largest of the planes that
    are seen from the middle of the room."""

    def moved(at: np.ndarray, triangles: np.ndarray) -> np.ndarray:
        normal, plane = _planes(at, triangles)
        seen = (n for n in range(plane.max() + 1) if _seen(at, triangles, plane == n))
        which = plane == list(islice(seen, 2))[1]
        size = times * scene.size("mesh:surface", "surface m")
        at[np.unique(triangles[which])] += size * normal[which].mean(axis=0)
        return at

    scene.remesh(moved)
    return done({"mesh:*"}, {"moved_surface", "label_range_offset"})


@mishap("mesh", sized=True)
def furniture_moved(scene: Scene, times: float) -> Done:
    """All between 0.3 and 1.2 m above the floor in one corner of the room stands elsewhere."""

    def moved(at: np.ndarray, triangles: np.ndarray) -> np.ndarray:
        low, high = np.percentile(at, [2, 98], axis=0)
        height = at[:, 2] - low[2]
        inside = np.all((at[:, :2] > low[:2] + 0.2) & (at[:, :2] < high[:2] - 0.2), axis=1)
        corner = np.all(at[:, :2] < (low + high)[:2] / 2, axis=1)
        which = inside & corner & (height > 0.3) & (height < 1.2)
        at[which] += times * scene.size("mesh:surface", "surface m") * np.array([0.8, 0.6, 0])
        return at

    scene.remesh(moved)
    return done({"mesh:*"}, {"moved_surface", "label_range_offset"})


@mishap("mesh", harmless=True)
def mesh_seen_from_behind(scene: Scene, times: float) -> Done:
    """Every triangle wound the other way."""
    head, at, triangles, tail = scene.vertices()
    rows = np.empty((len(triangles), 13), "u1")
    rows[:, 0] = 3
    rows[:, 1:] = np.ascontiguousarray(triangles[:, ::-1]).view("u1").reshape(-1, 12)
    tail = rows.tobytes() + tail[rows.size :]
    (scene.folder / "reference/mesh.ply").write_bytes(head + at.astype("<f8").tobytes() + tail)
    return done()
