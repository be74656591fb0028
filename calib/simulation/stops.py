"""Where the rig stood, and what every instrument but the LiDAR said there."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from calib.effects import Site, View
from calib.effects.elastic import masses
from calib.rig import Rig
from calib.rig.columns import stop_columns
from calib.simulation.room import FLOOR_CENTRE_M
from calib.simulation.spec import Spec
from calib.simulation.truth import Truth
from chains import se3
from chains.arm import gravity_torque
from chains.errors import InputError
from sensors.reference import Reference

# The LiDAR keeps clear of floor and furniture, the base of furniture.
LIDAR_CLEAR_M, ABOVE_FLOOR_M, BASE_FROM_FURNITURE_M = 0.6, 0.5, 0.45
SETTLE = np.repeat([0.0002, 0.0003], 3)  # rad, m: how the base shifts when the arm moves
GUESS = np.repeat([np.radians(1.0), 0.02], 3)  # rad, m: error of a guessed base pose
RATE = 0.25  # rad/s: sd of a joint's speed while the arm moves
PAYLOAD_KG, FRICTION = 2.5, 0.05  # as small arms carry; a share of the largest torque, assumed
POSES_TRIED = 200
GRAVITY_M_S2 = 9.81
UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class SimulatedStops:
    """Where the K stops are and what was written down there.

    Args:
        names, location: (K,) of the stops, and of the location of each.
        joints: (K, J) as reported, rad or m.
        Ts_faro_root: (K, 4, 4) true poses of the rig's root frame.
        columns: (K,) time and covariates, by name.
    """

    names: list[str]
    location: list[str]
    joints: np.ndarray
    Ts_faro_root: np.ndarray
    columns: dict[str, np.ndarray]

    def seen(self, rig: Rig) -> dict[str, np.ndarray]:
        """What effects may look at (K,), by name, as in a fit."""
        known = {"stop": np.array(self.names), "location": np.array(self.location)}
        own = stop_columns(rig, self.joints, self.columns["time_s"], self.columns)
        up = {"up": self.Ts_faro_root[:, 2, :3]} if rig.levels else {}
        return {**own, **up, **self.columns, **known}


def plan(rig: Rig, spec: Spec, mesh: Reference, rng: np.random.Generator) -> SimulatedStops:
    """Random stops within the joints' limits at which the LiDAR is clear of everything.

    Raises:
        InputError: no such stops were found.
    """
    S = spec.stops_per_location
    bases = _bases(rig, spec, mesh, rng)
    joints, roots = [], []
    for location in range(spec.locations):
        if spec.base_moves != "never" or location == 0:
            base = next(bases)
        reached, at = base
        take = slice(location * S, (location + 1) * S) if spec.base_moves == "never" else slice(S)
        joints.append(reached[take])
        roots.append(at[take])
    location = np.repeat(np.arange(spec.locations), S)
    Ts_faro_root = np.concatenate(roots)
    if spec.base_moves == "stop":
        Ts_faro_root = Ts_faro_root @ se3.exp(SETTLE * rng.standard_normal((len(location), 6)))
    columns = _columns(location, rng)
    if spec.poses == "moving":
        rates = RATE * rng.standard_normal((len(location), len(rig.joint_names)))
        columns |= {f"rate.{j}": r for j, r in zip(rig.joint_names, rates.T, strict=True)}
    return SimulatedStops(
        names=spec.names["stop"],
        location=spec.names["location"],
        joints=np.concatenate(joints),
        Ts_faro_root=Ts_faro_root,
        columns=columns,
    )


def _bases(
    rig: Rig, spec: Spec, mesh: Reference, rng: np.random.Generator
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Joints (n, J) and poses (n, 4, 4) of the root of one placing of the base after another."""
    n = spec.stops_per_location * (spec.locations if spec.base_moves == "never" else 1)
    tip = rig.lidar_frame or "mount"
    several = not spec.arm and spec.base_moves == "stop"
    tried = placed = 0
    while True:
        tried += 1
        if tried > POSES_TRIED:
            raise InputError(f"{n} stops clear of the furniture were not found; ask for fewer")
        joints = _joints(rig, spec, placed, 40 * n, rng)
        if spec.arm:
            T = _base(mesh, rng)
            roots = np.broadcast_to(T, (len(joints), 4, 4))
        else:
            held = _held(40 * n if several else 1, spec.level, rng)
            roots = np.broadcast_to(held, (len(joints), 4, 4))
        clear = _clear(mesh, roots @ rig.tree.place(tip, joints).Ts_root_frame)
        if len(clear) >= n:
            tried, placed = 0, placed + 1
            yield joints[clear[:n]], roots[clear[:n]]


def _joints(rig: Rig, spec: Spec, placed: int, count: int, rng: np.random.Generator) -> np.ndarray:
    """Joints (count, J) well within their limits, as the spec has them where the base stands after
    so many placings; `level` keeps the arm's tip upright."""
    limits = np.array([[joint.lower, joint.upper] for joint in rig.joints]).reshape(-1, 2)
    q = rng.uniform(*(0.85 * limits.T), (count, len(limits)))
    if spec.poses == "one_joint":
        q[:, np.arange(len(limits)) != placed % len(limits)] = 0.0
    if spec.level and len(limits):
        q[:, 3] = 0.0
        q[:, 4] = q[:, 1] - q[:, 2]
        q = q[(q[:, 4] > limits[4, 0]) & (q[:, 4] < limits[4, 1])]
    return q


def _base(mesh: Reference, rng: np.random.Generator) -> np.ndarray:
    """T_faro_base (4, 4) of a base on the floor, clear of furniture."""
    turn = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    around = np.stack([np.cos(turn), np.sin(turn), 0 * turn], axis=1)
    for _ in range(POSES_TRIED):
        xyz = FLOOR_CENTRE_M + rng.uniform((-2.3, -1.5, 0.0), (2.3, 1.5, 0.0))
        if mesh.cast(xyz + 0.3 * UP, around).range_m.min() > BASE_FROM_FURNITURE_M:
            tilt = 0.003 * rng.standard_normal(2)
            return se3.from_xyz_rpy(xyz, np.append(tilt, rng.uniform(-np.pi, np.pi)))
    raise InputError("no free place for the base was found in this room")


def _held(count: int, level: bool, rng: np.random.Generator) -> np.ndarray:
    """T_faro_mount (count, 4, 4) of a rig held anywhere, tilted up to 70 degrees."""
    xyz = FLOOR_CENTRE_M + rng.uniform([-2.8, -1.8, 0.6], [2.8, 1.8, 2.0], (count, 3))
    heading, towards = rng.uniform(-np.pi, np.pi, (2, count))
    tilt = (0.0 if level else 1.2) * rng.uniform(0, 1, count)
    still = np.zeros(count)
    twist = np.stack([tilt * np.cos(towards), tilt * np.sin(towards), *4 * [still]], axis=1)
    return se3.from_xyz_rpy(xyz, np.stack([still, still, heading], axis=1)) @ se3.exp(twist)


def _clear(mesh: Reference, Ts_faro_tip: np.ndarray) -> np.ndarray:
    """Indices of the poses that are inside the room and clear of all that is in it."""
    up = np.linspace(-0.95, 0.95, 42)
    turn = np.arange(42) * np.pi * (3 - np.sqrt(5))  # golden angle: evenly over the sphere
    rays = np.stack([np.cos(turn), np.sin(turn), up / np.sqrt(1 - up**2)], axis=1)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    origins = np.repeat(Ts_faro_tip[:, :3, 3], len(rays), axis=0)
    range_m = mesh.cast(origins, np.tile(rays, (len(Ts_faro_tip), 1))).range_m
    range_m = range_m.reshape(len(Ts_faro_tip), -1)
    high = Ts_faro_tip[:, 2, 3] - FLOOR_CENTRE_M[2] > ABOVE_FLOOR_M
    return np.flatnonzero(
        high & (range_m.min(axis=1) > LIDAR_CLEAR_M) & np.isfinite(range_m).all(axis=1)
    )


def _columns(location: np.ndarray, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Time and weather: a stop takes most of a minute, a new location some minutes."""
    count, places = len(location), location[-1] + 1
    between = 50.0 + 4.0 * rng.random(count) + 240.0 * (np.diff(location, prepend=0) > 0)
    warm, damp = rng.standard_normal((2, places))[:, location]
    return {
        "time_s": 70.0 + np.cumsum(between),
        "temperature_c": 23.0 + 1.2 * warm + 0.3 * rng.standard_normal(count),
        "humidity": 0.5 + 0.05 * damp + 0.01 * rng.standard_normal(count),
    }


def loads(stops: SimulatedStops, truth: Truth, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Columns (K,) of what loads the arm, where an effect of the hardware depends on it: a payload
    of up to `PAYLOAD_KG`, and the torques of its drives, off by `FRICTION` of the largest."""
    needed, rig = {c for effect, _ in truth.effects for c in effect.covariates}, truth.rig
    kg = PAYLOAD_KG * rng.integers(0, 3, len(stops.joints)) / 2
    found = {"payload_kg": kg} if "payload_kg" in needed else {}
    if "torques" in needed:
        view = View(rig, len(kg), found, stops.joints)
        torques = gravity_torque(rig.tree, masses(view), stops.joints)
        torques += FRICTION * np.abs(torques).max() * rng.choice([-1.0, 1.0], torques.shape)
        found |= {f"{j}.torque": t for j, t in zip(rig.joint_names, torques.T, strict=True)}
    return found


@dataclass(frozen=True)
class World:
    """The rig as it truly stood at every stop.

    Args:
        truth: the hardware.
        plan: the stops.
        joints: (K, J) true joints.
        twists: (K or 1, E, 6) by which the frame tree's edges truly differ from paper.
        moved: (K or 1, 6) by which the root truly stands elsewhere than where it is said to.
    """

    truth: Truth
    plan: SimulatedStops
    joints: np.ndarray
    twists: np.ndarray
    moved: np.ndarray

    @classmethod
    def of(
        cls, truth: Truth, stops: SimulatedStops, noise: float, rng: np.random.Generator
    ) -> World:
        """Bend the rig by its effects: ``true = nominal + effect``, encoders with their noise."""
        rig, view = (
            truth.rig,
            View(truth.rig, len(stops.joints), stops.seen(truth.rig), stops.joints),
        )
        shape = stops.joints.shape
        jitter = noise * rig.sigma_joint_rad * rng.standard_normal(shape)
        joints = stops.joints + jitter + truth.error(Site.JOINTS, view, shape[1:])
        twists = truth.error(Site.EDGE, view, (len(rig.tree.edges), 6))
        moved = truth.error(Site.ROOT, view, (6,))
        return cls(truth=truth, plan=stops, joints=joints, twists=twists, moved=moved)

    @cached_property
    def columns(self) -> dict[str, np.ndarray]:
        """What effects may look at (K, ...), by name, as in a fit; bodies where they truly are."""
        columns, tracker = self.plan.seen(self.truth.rig), self.truth.rig.tracker
        if tracker:
            bodies = [self.truth.T_opti_faro @ self.in_faro(body) for body in tracker.bodies]
            columns["tracked"] = np.stack(bodies, axis=1)
        return columns

    def in_faro(self, frame: str) -> np.ndarray:
        """True T_faro_frame (K, 4, 4)."""
        placed = self.truth.rig.tree.place(frame, self.joints, self.twists)
        return self.plan.Ts_faro_root @ se3.exp(self.moved) @ placed.Ts_root_frame

    def tracked(self, noise: float, rng: np.random.Generator) -> dict[str, np.ndarray]:
        """What the tracker said: body -> T_opti_body (K, 4, 4), with its effects and its noise."""
        tracker, count = self.truth.rig.tracker, len(self.joints)
        if tracker is None:
            return {}
        view = View(self.truth.rig, count, self.columns, self.plan.joints)
        added = self.truth.error(Site.TRACKER, view, (len(tracker.bodies), 6))
        seen = {}
        for b, body in enumerate(tracker.bodies):
            sigma = noise * np.repeat([tracker.sigma_rad, tracker.sigma_m], 3)
            jitter = se3.exp(sigma * rng.standard_normal((count, 6)))
            seen[body] = self.columns["tracked"][:, b] @ se3.exp(added[:, b]) @ jitter
        return seen

    def felt(self, noise: float, rng: np.random.Generator) -> dict[str, np.ndarray]:
        """What accelerometers felt at rest: frame -> (K, 3) m/s2; up is the FARO's z."""
        levels, count = self.truth.rig.levels, len(self.joints)
        out = {}
        for frame in levels.frames if levels else ():
            tilt = noise * levels.sigma_rad * rng.standard_normal((count, 3))
            up = self.in_faro(frame)[:, 2, :3]
            out[frame] = GRAVITY_M_S2 * np.matvec(se3.so3_exp(tilt), up)
        return out

    def guessed(self, moves: str, rng: np.random.Generator) -> np.ndarray:
        """Rough T_faro_root (K, 4, 4), off by about 2 cm and 1 degree wherever the base stood."""
        stop = np.arange(len(self.joints))
        _, location = np.unique(self.plan.location, return_inverse=True)
        group = {"stop": stop, "location": location, "never": 0 * stop}[moves]
        off = se3.exp(GUESS * rng.standard_normal((len(stop), 6)))
        return self.plan.Ts_faro_root @ off[group]


def hang_targets(
    truth: Truth, names: Sequence[str], noise: float, rng: np.random.Generator
) -> dict[str, np.ndarray]:
    """Targets (M,) as measured: `faro`, `upper` and `lower` (M, 3) m, spread through the room.

    The sphere hangs ``sphere_below_lower_marker_m`` below the lower marker along gravity, which is
    the FARO's -z; effects displace it from there. A bent volume of the tracker displaces markers.
    """
    spec, count = truth.rig.target, len(names)
    sets = FLOOR_CENTRE_M + rng.uniform((-2.8, -1.9, 0.5), (2.8, 1.9, 1.9), (200, count, 3))
    spread = np.linalg.svd(sets - sets.mean(axis=1, keepdims=True), compute_uv=False)[:, -1]
    sphere = sets[spread.argmax()]
    columns = {"point_m": sphere, "target": np.array(names)}
    view = View(truth.rig, count, columns, np.zeros((1, 0)))
    up = truth.T_opti_faro[:3, 2]
    nominal = se3.apply(truth.T_opti_faro, sphere) - truth.error(Site.TARGET, view, (3,))
    lower = nominal + spec.sphere_below_lower_marker_m * up
    scanner = replace(truth, effects=tuple(e for e in truth.effects if e[0].of_scanner))
    scanned = sphere - scanner.error(Site.REFERENCE, view, (3,))
    markers = np.stack([lower, lower + 0.12 * up], axis=1)
    volume = replace(truth, effects=tuple(e for e in truth.effects if e[0].of_volume))
    added = volume.error(Site.TRACKER, View.of_places(truth.rig, markers), (2, 6))[..., 3:]
    lower, upper = np.moveaxis(markers + added, 1, 0)
    measured = (
        ("faro", scanned, spec.sigma_sphere_m),
        ("upper", upper, spec.sigma_marker_m),
        ("lower", lower, spec.sigma_marker_m),
    )
    return {
        name: at + noise * sigma_m * rng.standard_normal(at.shape) for name, at, sigma_m in measured
    }
