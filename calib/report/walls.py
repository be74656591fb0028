"""Residuals where the beams end: on the floor, the ceiling and the walls of a room, each laid flat.

A cell's mean holds noise beside what repeats there. Stops are taken by turns into two halves; the
mean over cells of the product of the two halves' means is the variance of what both saw.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from sensors.reference import Reference

# A cell's size, and how many beams end in it: larger where they are few.
WALL_CELL_M, BEAMS_A_CELL = 0.2, 10
DEPTH_M = 0.4  # of what stands before a wall, and is drawn on it: shelves, pipes, doors
FEWEST_IN_CELL = 5  # beams of a cell that is drawn
BOX = 0.005, 0.995  # quantiles of where beams end: what is seen through a door is not the room
LEVEL_NORMAL = 0.9  # of a triangle's normal, how much is level: it is of a wall


@dataclass(frozen=True)
class Face:
    """One side of the room.

    Args:
        name: "floor", "ceiling" or "wall at x = 0".
        axes: names of the two directions along it, right and up.
        cell_m: size of its cells.
        mean_m: (H, W) mean residual of its cells, from the room's corner; NaN where fewer than
            `FEWEST_IN_CELL` beams ended.
        halves_m: (2, H, W) the same of each half of the stops.
    """

    name: str
    axes: tuple[str, str]
    cell_m: float
    mean_m: np.ndarray
    halves_m: np.ndarray


@dataclass(frozen=True)
class Ends:
    """Where the beams of one stop end, in the axes of the mesh.

    Args:
        at_m: (N, 3).
        residual_m, weight: (N,).
    """

    at_m: np.ndarray
    residual_m: np.ndarray
    weight: np.ndarray


@dataclass(frozen=True)
class Box:
    """The room as a box: turned by `yaw_rad` about z from the axes of its mesh.

    Args:
        yaw_rad: of its walls.
        low_m, high_m: (3,) its corners, in its own axes.
        cell_m: size of the cells of its sides.
    """

    yaw_rad: float
    low_m: np.ndarray
    high_m: np.ndarray
    cell_m: float

    @classmethod
    def of(cls, yaw_rad: float, ends: Sequence[Ends], beams: int) -> Box:
        """The box that holds nearly all ends of some stops' beams; all stops have so many."""
        at_m = _turned(np.concatenate([each.at_m for each in ends]), yaw_rad)
        low_m, high_m = np.quantile(at_m, BOX, axis=0)
        x, y, z = high_m - low_m
        cell_m = np.sqrt(2 * (x * y + y * z + z * x) * BEAMS_A_CELL / max(beams, 1))
        return cls(yaw_rad, low_m, high_m, max(WALL_CELL_M, round(float(cell_m), 1)))


def yaw_of(mesh: Reference) -> float:
    """By how much the walls of a mesh are turned about z from its axes, rad; within pi / 4."""
    x, y = mesh.planes[:-1, :2].T
    turns = 4.0 * np.arctan2(y, x)  # all four walls of a room as one
    walls = mesh.area_m2 * (np.hypot(x, y) > LEVEL_NORMAL)
    return float(np.angle(np.sum(walls * np.exp(1j * turns)))) / 4.0


def faces(box: Box, stops: Iterable[Ends]) -> list[Face]:
    """The six sides of a room, and the mean residual on each."""
    size_m = box.high_m - box.low_m
    shape = np.maximum(np.ceil(size_m / box.cell_m - 1e-6).astype(int), 1)
    sides = [(k, end) for end in (0, 1) for k in range(3)]
    sums = {side: np.zeros((2, 3, *_other(shape, side[0]))) for side in sides}
    for number, stop in enumerate(stops):
        at_m = _turned(stop.at_m, box.yaw_rad) - box.low_m
        cell = np.clip((at_m / box.cell_m).astype(int), 0, shape - 1)
        off_m = np.stack([np.abs(at_m), np.abs(at_m - size_m)])  # (2, N, 3)
        nearest = off_m.transpose(1, 0, 2).reshape(len(at_m), 6).argmin(axis=1)
        for side in sides:
            k, end = side
            mine = (nearest == 3 * end + k) & (off_m[end, :, k] < DEPTH_M) & (stop.weight > 0)
            into, weight = sums[side][number % 2], stop.weight[mine]
            u, v = (cell[mine, i] for i in _along(k))
            flat, wr = v * into.shape[2] + u, weight * stop.residual_m[mine]
            every = [np.bincount(flat, values, into[0].size) for values in (None, weight, wr)]
            into += np.reshape(every, into.shape)
    return [
        Face(
            name=_name(k, end, size_m),
            axes=tuple("xyz"[i] for i in _along(k)),
            cell_m=box.cell_m,
            **_means(sums[k, end]),
        )
        for k, end in sides
    ]


def repeats_m(found: Sequence[Face]) -> float:
    """The rms of what both halves of the stops saw; 0 where they have nothing in common."""
    products = np.concatenate([np.prod(face.halves_m, axis=0).ravel() for face in found])
    seen = products[np.isfinite(products)]
    return float(np.sqrt(max(seen.mean(), 0.0))) if len(seen) else 0.0


def _means(sums: np.ndarray) -> dict[str, np.ndarray]:
    """Of sums (2, 3, H, W) the mean over both halves, and those of each; as `Face` has them."""
    every = np.concatenate([sums.sum(axis=0)[None], sums])
    count, weight, total = every.swapaxes(0, 1)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.where(count >= FEWEST_IN_CELL, total / weight, np.nan)
    return {"mean_m": mean[0], "halves_m": mean[1:]}


def _turned(at_m: np.ndarray, yaw_rad: float) -> np.ndarray:
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    return at_m @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _along(k: int) -> tuple[int, int]:
    """The two axes of a side whose normal is axis k."""
    return ((1, 2), (0, 2), (0, 1))[k]


def _other(shape: np.ndarray, k: int) -> tuple[int, int]:
    """(H, W) of such a side."""
    right, up = _along(k)
    return int(shape[up]), int(shape[right])


def _name(k: int, end: int, size_m: np.ndarray) -> str:
    if k == 2:
        return ("floor", "ceiling")[end]
    return f"wall at {'xy'[k]} = {end * size_m[k]:.1f} m"
