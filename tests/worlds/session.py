"""What is done in a world: stops one after another, and what the instruments read at them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from . import arm, effects, room
from .beams import JUMP_M, MIXED, NEAREST_M, STRADDLE_RAD, STRAY, Lidar, averaged
from .hardware import (
    BELOW_M,
    BODIES,
    SIGMA_JOINT_RAD,
    SIGMA_MARKER_M,
    SIGMA_SPHERE_M,
    SIGMA_TRACKER_M,
    SIGMA_TRACKER_RAD,
    Hardware,
)
from .knobs import World
from .poses import apply, inverse, moved, pose, quaternion, turn

SIGMA_ANGLE_RAD = 1e-4
SETTLES_M, SETTLES_RAD = 0.001, 0.001  # how far the base moves between stops of a location
OCCLUDED = 0.05  # of the mount's markers
GRAZING = 0.1  # cosine of incidence below which nothing comes back
ROD_M, TARGETS = 0.12, 5


@dataclass(frozen=True)
class Stops:
    """What is true at K stops.

    Args:
        location: (K,) its number.
        time_s, temperature_c, humidity: (K,).
        reported_rad: (K, 6) what the encoders say.
        T_faro_lidar: (K, 4, 4).
        T_opti_body: body -> (K, 4, 4).
        zero_m: (K,) the stops' own range zeros, those of their locations added.
    """

    location: np.ndarray
    time_s: np.ndarray
    temperature_c: np.ndarray
    humidity: np.ndarray
    reported_rad: np.ndarray
    T_faro_lidar: np.ndarray
    T_opti_body: dict[str, np.ndarray]
    zero_m: np.ndarray


def visited(world: World, rig: Hardware) -> Stops:
    """Where the rig stands and how the arm is held, at every stop."""
    rng, later = world.rng("stops"), world.rng("then")
    count, more = world.locations * world.stops, len(world.then)
    location = np.repeat(np.arange(world.locations), world.stops)
    location = np.append(location, [at for at, _ in world.then]).astype(int)

    def normal(*size: int) -> np.ndarray:
        """Of every stop; stops that follow change nothing of those before."""
        return np.concatenate(
            [r.standard_normal((n, *size)) for r, n in ((rng, count), (later, more))]
        )

    time_s = 120 + np.cumsum(50 + 5 * normal() + 300 * _arrives(location))
    hours = time_s / 3600
    temperature = 22 + 4 * (1 - np.exp(-hours / 0.4)) + 0.8 * np.sin(7 * hours + rng.uniform(0, 6))
    humidity = 0.45 + np.cumsum(0.015 * normal())
    share = np.array(world.turned) * rng.uniform(-1, 1, (count, 6))
    wanted = np.reshape([q for _, q in world.then], (more, 6))
    true_rad = np.concatenate([arm.HALF_RANGE_RAD * share, wanted + rig.zero_rad])
    # Zeros and effects are in what is true, the encoders' noise in what is read.
    angles = true_rad - rig.zero_rad
    true_rad = true_rad + effects.of_joints(world.hidden, angles)
    reported = angles + world.joint_factor * SIGMA_JOINT_RAD * normal(6)
    T_base_mount, T_base_lidar = rig.of_base(true_rad)
    T_faro_base = _bases(world, rng)[location]
    settle = normal(6) * ([SETTLES_M] * 3 + [SETTLES_RAD] * 3) * (not world.stands)
    for first, by_m, by_rad in world.kicked:
        settle[first:] += [by_m] * 3 + [by_rad] * 3
    T_faro_base = moved(T_faro_base, settle[:, :3], settle[:, 3:])
    T_opti_base = inverse(rig.T_faro_opti) @ T_faro_base
    scatter = world.rng("scatter")
    off = world.rng("mount").standard_normal((count + more, 2, 3))
    shift, turn = world.mount_shift_m * off[:, 0], world.mount_turn_rad * off[:, 1]
    T_base_lidar = moved(T_base_lidar, shift, turn)
    return Stops(
        location=location,
        time_s=time_s,
        temperature_c=temperature + 0.1 * normal(),
        humidity=humidity,
        reported_rad=reported,
        T_faro_lidar=T_faro_base @ T_base_lidar,
        T_opti_body={
            "base_markers": T_opti_base @ rig.frames["base_markers"],
            "mount_markers": T_opti_base @ T_base_mount @ rig.frames["mount_markers"],
        },
        zero_m=world.stop_scatter_m * scatter.standard_normal(count + more)
        + world.location_scatter_m * scatter.standard_normal(world.locations)[location],
    )


def _arrives(location: np.ndarray) -> np.ndarray:
    """(K,) whether a stop is the first at its location."""
    return np.diff(location, prepend=-1) != 0


def _bases(world: World, rng: np.random.Generator) -> np.ndarray:
    """T_faro_base (L, 4, 4), around the middle of the room, any way round, all but level."""
    xy = rng.uniform([-1.6, -1.2], [1.6, 1.2], (world.locations, 2))
    shift = np.column_stack([xy, np.full(world.locations, 0.12)])
    yaw = rng.uniform(-np.pi, np.pi, world.locations)
    level = pose(turn(np.tile([0.0, 0.0, 1.0], (world.locations, 1)), yaw), shift)
    return moved(level, np.zeros(3), 0.002 * rng.standard_normal((world.locations, 3)))


def tracked(world: World, stops: Stops) -> dict[str, np.ndarray]:
    """Body -> (K, 7) x y z qw qx qy qz as the tracker has it; NaN where it was not seen."""
    rng, factor, out = world.rng("tracker"), world.tracker_factor, {}
    for body in BODIES:
        T = stops.T_opti_body[body]
        noise = factor * rng.standard_normal((len(T), 6))
        T = moved(T, SIGMA_TRACKER_M * noise[:, :3], SIGMA_TRACKER_RAD * noise[:, 3:])
        out[body] = np.column_stack([T[:, :3, 3], quaternion(T[:, :3, :3])])
    out["mount_markers"][rng.random(len(T)) < OCCLUDED] = np.nan
    return out


def targets(world: World, rig: Hardware) -> np.ndarray:
    """(5, 9) m: sphere in faro, upper and lower marker in opti; rods hang along the room's z."""
    rng = world.rng("targets")
    bearing = np.arange(TARGETS) * 2 * np.pi / TARGETS + rng.uniform(0, 1, TARGETS)
    away = rng.uniform(1.5, 2.6, TARGETS)
    height = rng.uniform(0.7, 1.6, TARGETS)
    sphere = np.column_stack([away * np.cos(bearing), away * np.sin(bearing), height])
    up = np.array([0.0, 0.0, 1.0])
    T_opti_faro = inverse(rig.T_faro_opti)
    lower = apply(T_opti_faro, sphere + BELOW_M * up)
    upper = apply(T_opti_faro, sphere + (BELOW_M + ROD_M) * up)
    noise = rng.standard_normal((3, TARGETS, 3))
    seen = SIGMA_MARKER_M * world.tracker_factor
    found = sphere + SIGMA_SPHERE_M * world.sphere_factor * noise[0]
    return np.column_stack([found, upper + seen * noise[1], lower + seen * noise[2]])


def scan(
    world: World, lidar: Lidar, rig: Hardware, there: room.Quads, stops: Stops, k: int
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Columns of the scan of stop k, and what is true of its beams: range and incidence without
    any error, label, and the surface's normal in the LiDAR's frame, which faces it.

    Args:
        world, lidar, rig: what is scanned with.
        there: all that a beam can meet, clutter included.
        stops: all stops.
        k: the number of the stop.
    """
    rng = world.rng(f"scan {k}")
    named, ring, column = lidar.directions(world.beams)
    T = stops.T_faro_lidar[k]
    across = np.cross(named, rng.standard_normal((len(named), 3)))
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    angle = (
        SIGMA_ANGLE_RAD
        / np.sqrt(world.sweeps)
        * np.linalg.norm(rng.standard_normal((len(named), 2)), axis=1, keepdims=True)
    )
    start, turned = T[:3, 3], T[:3, :3].T
    towards = (named + angle * across) @ turned
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    range_m, which = there.hit(start, towards)
    edge = (named + STRADDLE_RAD * across) @ turned
    range_m = _mixed(rng, there, start, edge, (range_m, which))
    cosine = np.abs(np.sum(towards * there.normal[which], axis=1)).clip(1e-3, 1)
    white = np.array(list(room.LABELS.values()))[there.label[which]]
    height = 2 * ring / (len(rig.ring_m) - 1) - 1
    measured = range_m + rig.ring_m[ring] + stops.zero_m[k]
    measured += effects.of_range(
        world.hidden, cosine, height, stops.time_s[k], stops.temperature_c[k]
    )
    if world.uneven_m:
        met = start + np.where(which >= 0, range_m, 0.0)[:, None] * towards
        measured += world.uneven_m * room.bumps(world, met, which) / cosine
    back = (which >= 0) & (range_m > NEAREST_M) & (cosine > GRAZING)
    sigma_m = lidar.sigma(np.where(back, range_m, 1.0), white, cosine)
    mean_m, spread_m = averaged(lidar, rng, np.where(back, measured, 1.0), sigma_m, world.sweeps)
    brightness = white * cosine**0.4 * np.exp(0.05 * rng.standard_normal(len(white)))
    xyz = (mean_m[:, None] * named)[back].astype(np.float32)
    facing = there.normal[which] * -np.sign(np.sum(towards * there.normal[which], axis=1))[:, None]
    true = {
        "ring": ring,
        "column": column,
        "range_m": range_m,
        "incidence_rad": np.arccos(cosine),
        "label": there.label[which],
        **dict(zip(("normal_x", "normal_y", "normal_z"), (facing @ T[:3, :3]).T, strict=True)),
    }
    return {
        **dict(zip("xyz", xyz.T, strict=True)),
        "intensity": np.clip(brightness, 0, 1)[back].astype(np.float32),
        "ring": ring[back].astype(np.uint16),
        "column": column[back].astype(np.uint16),
        "count": np.full(int(back.sum()), world.sweeps, np.uint16),
        "range_std_m": spread_m[back].astype(np.float32),
    }, {name: each[back] for name, each in true.items()}


def _mixed(
    rng: np.random.Generator,
    there: room.Quads,
    start: np.ndarray,
    beside: np.ndarray,
    met: tuple[np.ndarray, np.ndarray],
) -> np.ndarray:
    """Ranges (N,) m of which a few lie between near and far, at edges and at what is thin.

    Args:
        rng: of which and where between.
        there: what can be met.
        start: (3,) m, of the beams.
        beside: (N, 3) directions of their edges, of any length.
        met: ranges (N,) m of their middles, and the rectangles (N,) met.
    """
    range_m, which = met
    other_m, other = there.hit(start, beside / np.linalg.norm(beside, axis=1, keepdims=True))
    at_edge = (which >= 0) & (other >= 0) & (which != other)
    step_m = np.where(at_edge, other_m, 0.0) - np.where(at_edge, range_m, 0.0)
    edges = np.flatnonzero(np.abs(step_m) > JUMP_M)
    chosen = rng.permutation(edges)[: round(MIXED * len(range_m))]
    out = range_m.copy()
    out[chosen] += rng.uniform(0.1, 0.9, len(chosen)) * step_m[chosen]
    return out * np.where(rng.random(len(out)) < STRAY, rng.uniform(0.3, 1.0, len(out)), 1.0)
