"""What can be chosen of a world."""

from __future__ import annotations

import zlib
from dataclasses import dataclass

import numpy as np

LIDARS = ("hesai_pandarxt32", "hesai_pandarqt64", "ouster_os0_128_rev7")


@dataclass(frozen=True)
class World:
    """One recording: the defaults are a good one.

    Args:
        seed: of all that is drawn; each part has a stream of its own, so that worlds which differ
            in one knob share the rest.
        lidar: of `LIDARS`.
        locations: where the base stands.
        stops: at each location.
        sweeps: that are averaged at a stop; with 1 no scatter within the hold is known.
        beams: of a stop, about; columns are left out until so few are left.
        stop_scatter_m: standard deviation of a range zero that each stop has of its own.
        location_scatter_m: the same of each location.
        tracker_factor: how many times the tracker is worse than rig.yaml says.
        joint_factor: the same of the encoders.
        sphere_factor: the same of the targets' spheres.
        mount_shift_m, mount_turn_rad: standard deviations, an axis, of where the LiDAR sits on its
            mount and how it is turned there, anew at each stop.
        mesh_error_factor: how many times the mesh is worse than rig.yaml says.
        warp_m: how far the middle of one wall is bowed out of the mesh's plane.
        uneven_m: standard deviation of how far surfaces lie off flat, smoothly; no mesh has it.
        meshed: numbers of the rectangles that the mesh has; empty for all of them.
        shifted: of rectangles that stand elsewhere than the mesh has them, from a stop on: their
            numbers, that of the stop, and by how much, m along the normal.
        stands: whether the base stays where it is while it is at a location.
        kicked: numbers of stops from which on the base stands elsewhere, each with how far it went
            then, m, along each axis, and how far it was turned, rad, about each.
        clutter: share of the beams that hit boxes which are not in the mesh, about.
        turned: share of its range that each joint goes through, about its middle; 0 never turns.
        then: stops that follow: the number of a location, and what the encoders are to say there.
        hidden: effects with their sizes, of `effects.EFFECTS`.
    """

    seed: int = 0
    lidar: str = LIDARS[0]
    locations: int = 6
    stops: int = 5
    sweeps: int = 20
    beams: int = 2000
    stop_scatter_m: float = 0.0
    location_scatter_m: float = 0.0
    tracker_factor: float = 1.0
    joint_factor: float = 1.0
    sphere_factor: float = 1.0
    mount_shift_m: float = 0.0
    mount_turn_rad: float = 0.0
    mesh_error_factor: float = 1.0
    warp_m: float = 0.0
    uneven_m: float = 0.0
    meshed: tuple[int, ...] = ()
    shifted: tuple[tuple[int, ...], int, float] = ((), 0, 0.0)
    stands: bool = False
    kicked: tuple[tuple[int, float, float], ...] = ()
    clutter: float = 0.0
    turned: tuple[float, ...] = (1.0,) * 6
    then: tuple[tuple[int, tuple[float, ...]], ...] = ()
    hidden: tuple[tuple[str, float], ...] = ()

    def rng(self, part: str) -> np.random.Generator:
        """The stream of random numbers of one part of the world."""
        return np.random.default_rng([self.seed, zlib.crc32(part.encode())])
