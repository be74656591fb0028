"""What an effect is drawn over: rows along which one thing changes and all else stands still."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from calib.effects import Effect, Site
from calib.effects.base import View
from calib.rig import Rig

# From where to where a covariate goes, by what its numbers are multiplied, and how it is written:
# a room, a day in it, and an arm's joint.
SPANS = {
    "range_m": (0.5, 12.0, 1.0, "range, m"),
    "incidence_rad": (0.0, 1.31, 180.0 / np.pi, "incidence, deg"),
    "intensity": (0.05, 3.0, 1.0, "intensity, of the median"),
    "elapsed_s": (0.0, 7200.0, 1.0 / 60.0, "time since the first stop, min"),
    "temperature_c": (10.0, 35.0, 1.0, "temperature, °C"),
    "azimuth_rad": (-np.pi, np.pi, 180.0 / np.pi, "azimuth, deg"),
    "elevation_rad": (-0.4, 0.4, 180.0 / np.pi, "elevation, deg"),
    "joints": (-np.pi, np.pi, 180.0 / np.pi, "angle of {}, deg"),
    "payload_kg": (0.0, 5.0, 1.0, "payload, kg"),
    "torques": (-40.0, 40.0, 1.0, "torque of every joint, N m"),
}
LOADS = {"payload_kg", "torques"}
# A place goes along x, the others of its coordinates standing at these.
TRACKED, ROOM_POINT = (-3.0, 3.0, (0.5, 1.0)), (0.0, 8.0, (2.0, 1.0))
CURVE_POINTS, STOPS, STOPS_PER_LOCATION, MAP_CELLS = 400, 12, 3, 60
JOINT = 1  # the second, which lifts the arm: what gravity does shows at it
REST = 0.3  # rad, of the other joints where a frame is looked at: no axis is aligned with another


@dataclass(frozen=True)
class Walk:
    """Rows, and where they are drawn.

    Args:
        view: of the rows.
        label: what lies along the axis, with its unit.
        x: (rows,) where they are.
        names: of the rows, where each stands for one thing.
    """

    view: View
    label: str
    x: np.ndarray
    names: tuple[str, ...] = ()


def walk_of(effect: Effect, rig: Rig) -> Walk | None:
    """The rows over which an effect is drawn; None where it depends on what no room has."""
    over = [name for name in effect.covariates if name != "time_s"]
    if "joints" in over and set(over) & {*LOADS, "temperature_c"}:  # of an arm that stands still
        over.remove("joints")
    if effect.by_chance or set(over) & {"ring", "label", "stop", "location", "surface", "target"}:
        return _things(effect, rig)
    if "time_s" in effect.covariates:
        return _stops(rig)
    if "elapsed_s" in over:
        return _along(rig, "elapsed_s")
    if effect.joint_kind == "prismatic":
        return _slid(effect, rig)
    if over == ["tracked"]:
        return _places(rig, "tracked", "x of a body or marker in the tracker's frame, m", TRACKED)
    if over == ["point_m"]:
        return _places(rig, "point_m", "x of a point in the reference's frame, m", ROOM_POINT)
    if not over and effect.site is Site.TARGET:
        return None
    name = over[0] if over else "range_m"
    return _along(rig, name) if len(over) < 2 and name in SPANS else None


def grid_of(effect: Effect, rig: Rig) -> tuple[View, list[str]] | None:
    """Cells over two covariates, the second going fastest, and their names; else None."""
    names = list(effect.covariates)
    if len(names) != 2 or not set(names) <= SPANS.keys() - {"joints", *LOADS}:
        return None
    edges = (np.linspace(*SPANS[name][:2], MAP_CELLS + 1) for name in names)
    middles = ((edge[1:] + edge[:-1]) / 2 for edge in edges)
    columns = dict(zip(names, map(np.ravel, np.meshgrid(*middles, indexing="ij")), strict=True))
    return _view(rig, MAP_CELLS * MAP_CELLS, columns), names


def _view(
    rig: Rig,
    rows: int,
    columns: Mapping[str, np.ndarray] = MappingProxyType({}),
    joints: np.ndarray | None = None,
) -> View:
    """Rows at which all stands still but these columns."""
    still = {name: np.full(rows, 0.5 * sum(span[:2])) for name, span in SPANS.items()}
    still = {name: column for name, column in still.items() if name not in LOADS}
    still["normal"] = np.tile([0.0, 0.0, 1.0], (rows, 1))
    if joints is None:
        joints = np.full((rows, len(rig.joint_names)), REST)
    bodies = rig.tracker.bodies if rig.tracker else ()
    seen = [rig.tree.transform(body, joints) for body in bodies]
    still["tracked"] = np.stack(seen, axis=1) if seen else np.zeros((rows, 0, 4, 4))
    return View(rig, rows, {**still, **columns}, joints)


def _along(rig: Rig, name: str) -> Walk:
    """Along one column, from end to end; of the joints along the second."""
    low, high, times, label = SPANS[name]
    column = np.linspace(low, high, CURVE_POINTS)
    if name == "torques":
        torques = np.tile(column[:, None], len(rig.joint_names))
        return Walk(_view(rig, CURVE_POINTS, {name: torques}), label, times * column)
    if name != "joints":
        return Walk(_view(rig, CURVE_POINTS, {name: column}), label, times * column)
    joints = np.zeros((CURVE_POINTS, len(rig.joint_names)))
    joint = min(JOINT, len(rig.joint_names) - 1)
    joints[:, joint] = column
    return Walk(_view(rig, CURVE_POINTS, joints=joints), label.format(rig.joint_names[joint]),
                times * column)  # fmt: skip


def _slid(effect: Effect, rig: Rig) -> Walk | None:
    """Along the first linear joint, as far as it goes; of what repeats, ten times."""
    linear = [i for i, kind in enumerate(rig.joint_kinds) if kind == "prismatic"]
    if not linear:
        return None
    joint = rig.joints[linear[0]]
    low, high = (end if np.isfinite(end) else usual for end, usual in
                 ((joint.lower, 0.0), (joint.upper, 1.0)))  # fmt: skip
    high = min(high, low + 10 * effect.shape) if effect.shape_name else high
    joints = np.zeros((CURVE_POINTS, len(rig.joint_names)))
    joints[:, linear[0]] = column = np.linspace(low, high, CURVE_POINTS)
    label = f"position of {joint.name}, mm"
    return Walk(_view(rig, CURVE_POINTS, joints=joints), label, 1e3 * column)


def _places(
    rig: Rig, name: str, label: str, span: tuple[float, float, tuple[float, float]]
) -> Walk:
    low, high, rest = span
    x = np.linspace(low, high, CURVE_POINTS)
    place_m = np.column_stack([x, np.tile(rest, (CURVE_POINTS, 1))])
    view = _view(rig, CURVE_POINTS)
    column = place_m
    if name == "tracked":
        column = np.array(view["tracked"])
        column[:, :, :3, 3] = place_m[:, None]
    return Walk(_view(rig, CURVE_POINTS, {name: column}), label, x)


def _stops(rig: Rig) -> Walk:
    """A few stops, one after the other."""
    joints = np.random.default_rng(0).uniform(-1.5, 1.5, (STOPS, len(rig.joint_names)))
    travel = np.diff(joints, axis=0, prepend=np.zeros((1, joints.shape[1])))
    columns = {"waited.s": np.linspace(0.5, 4.0, STOPS)}
    for k, joint in enumerate(rig.joint_names):
        columns[f"moved.{joint}"], columns[f"travel.{joint}"] = np.sign(travel[:, k]), travel[:, k]
    x = np.arange(1.0, STOPS + 1)
    return Walk(_view(rig, STOPS, columns, joints), "stop", x, tuple(f"{k:.0f}" for k in x))


def _things(effect: Effect, rig: Rig) -> Walk | None:
    """Every ring, material, stop, location, surface or target."""
    per = getattr(effect, "per", None) or effect.covariates[0]
    if per == "ring":
        count = rig.lidar.rings if rig.lidar else 0
        return Walk(_view(rig, count, {"ring": np.arange(count)}), "ring", np.arange(float(count)))
    if per == "label":
        labels = np.array(list(rig.labels))
        view = _view(rig, len(labels), {"label": labels})
        return Walk(view, "material", np.arange(float(len(labels))), tuple(rig.labels.values()))
    names = tuple(f"{k + 1}" for k in range(STOPS))
    if effect.by_chance:
        return Walk(_view(rig, STOPS, {per: np.array(names)}), per, np.arange(float(STOPS)), names)
    return None
