"""Parts of an arm as capsules: all points no further than a radius from a line (Ericson 2005,
Real-Time Collision Detection, ch. 4.5 and 5.1.9).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

SURFACE_POINTS = 4000  # of a shape: of one square metre they are 16 mm apart
MOST_OF_A_LINK = 4  # capsules: a choice; a link of two housings and a tube needs three
# Of the volume of one capsule, below which two of them take its place: a choice.
TIGHTER = 0.8
SPACING_M = 0.1  # of points along a capsule that are held against a room, at most


@dataclass(frozen=True)
class Capsules:
    """C capsules, each fixed to one or two frames of an arm.

    Args:
        frames: (C, 2) number of the frame in which either end of its line stands.
        ends_m: (C, 2, 3) there.
        radius_m: (C,).
        clear_m: (C,) how far from it anything else should stay.
    """

    frames: np.ndarray
    ends_m: np.ndarray
    radius_m: np.ndarray
    clear_m: np.ndarray

    @staticmethod
    def of(parts: Sequence[tuple[tuple[int, int], np.ndarray, float, float]]) -> Capsules:
        """From frames, ends, radius and clearance of each."""
        columns = list(zip(*parts, strict=True)) or [[], [], [], []]
        return Capsules(
            frames=np.array(columns[0], int).reshape(-1, 2),
            ends_m=np.array(columns[1], float).reshape(-1, 2, 3),
            radius_m=np.array(columns[2], float),
            clear_m=np.array(columns[3], float),
        )

    def placed(self, Ts: np.ndarray) -> np.ndarray:
        """Ends (n, C, 2, 3) of their lines, where frames stand at Ts (n, F, 4, 4)."""
        T = Ts[:, self.frames]
        return np.einsum("ncejk,cek->ncej", T[..., :3, :3], self.ends_m) + T[..., :3, 3]

    def points(self, ends_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Points (n, K, 3) along lines (n, C, 2, 3), and of which capsule (K,) each is."""
        long_m = np.linalg.norm(ends_m[:, :, 1] - ends_m[:, :, 0], axis=2).max(axis=0, initial=0.0)
        shares = [np.linspace(0, 1, int(np.ceil(each / SPACING_M)) + 1) for each in long_m]
        of = np.repeat(np.arange(len(long_m)), [len(share) for share in shares])
        share = np.concatenate([*shares, np.zeros(0)])[:, None]
        return ends_m[:, of, 0] * (1 - share) + ends_m[:, of, 1] * share, of


def segments_apart_m(a_m: np.ndarray, b_m: np.ndarray) -> np.ndarray:
    """Distance (...) between segments, by their ends (..., 2, 3): Ericson's closest points."""
    u, v, w = a_m[..., 1, :] - a_m[..., 0, :], b_m[..., 1, :] - b_m[..., 0, :], a_m[..., 0, :]
    w = w - b_m[..., 0, :]
    uu, vv, uv, uw, vw = (np.sum(x * y, -1) for x, y in ((u, u), (v, v), (u, v), (u, w), (v, w)))
    tiny = 1e-18  # m2: of a line that is a point
    across = uu * vv - uv * uv
    s = np.where(across > tiny * (uu + vv), (uv * vw - vv * uw) / np.maximum(across, tiny), 0.0)
    t = (uv * np.clip(s, 0, 1) + vw) / np.maximum(vv, tiny)
    t = np.clip(t, 0, 1)
    s = np.clip((uv * t - uw) / np.maximum(uu, tiny), 0, 1)
    return np.linalg.norm(w + s[..., None] * u - t[..., None] * v, axis=-1)


def about(vertices_m: np.ndarray, triangles: np.ndarray) -> list[tuple[np.ndarray, float]]:
    """Ends (2, 3) and radius of capsules about all of a shape: one, or several where they are
    tighter. Points drawn evenly over its surface stand for it."""
    corners = vertices_m[triangles]
    area = np.linalg.norm(np.cross(*np.moveaxis(corners[:, 1:] - corners[:, :1], 1, 0)), axis=1)
    rng = np.random.default_rng(0)
    chosen = rng.choice(len(area), SURFACE_POINTS, p=area / area.sum()) if area.sum() else []
    weight = rng.dirichlet(np.ones(3), len(chosen))
    inner = np.einsum("nk,nkj->nj", weight, corners[chosen]) if len(chosen) else np.zeros((0, 3))
    return _tightest(np.vstack([vertices_m[np.unique(triangles)], inner]), MOST_OF_A_LINK)


def _tightest(points: np.ndarray, most: int) -> list[tuple[np.ndarray, float]]:
    """Capsules about points (N, 3): halves along a main axis, where those are tighter."""
    one = _capsule(points)
    if most < 2 or len(points) < 8:
        return [one]
    middle = np.median(points, axis=0)
    axes = np.linalg.svd(np.cov((points - middle).T))[0]
    best = [one]
    for axis in axes.T:
        upper = (points - middle) @ axis > 0
        if upper.all() or not upper.any():
            continue
        halves = [points[upper], points[~upper]]
        if sum(_volume(*_capsule(half)) for half in halves) < _volume(*one):
            found = [c for half in halves for c in _tightest(half, most // 2)]
            best = min(best, found, key=lambda some: sum(_volume(*each) for each in some))
    return best if sum(_volume(*each) for each in best) < TIGHTER * _volume(*one) else [one]


def _capsule(points: np.ndarray) -> tuple[np.ndarray, float]:
    """Ends (2, 3) and radius of a capsule about points (N, 3), its line along that of their main
    axes which makes it smallest."""
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    axes = np.linalg.svd(np.cov((points - middle).T) + 1e-12 * np.eye(3))[0].T
    return min((_along(points, axis) for axis in axes), key=lambda each: _volume(*each))


def _along(points: np.ndarray, axis: np.ndarray) -> tuple[np.ndarray, float]:
    """The smallest such capsule, its line in the middle of what they span across this axis."""
    across = np.linalg.svd(axis[None])[2][1:]
    span = points @ across.T
    middle = (span.min(axis=0) + span.max(axis=0)) / 2 @ across
    along, away2 = points @ axis, np.sum((points @ across.T - middle @ across.T) ** 2, axis=1)
    radius = float(np.sqrt(away2.max()))
    cap = np.sqrt(np.maximum(radius**2 - away2, 0.0))  # how far beyond the line's end it may be
    low, high = float((along + cap).min()), float((along - cap).max())
    if low > high:
        low = high = (low + high) / 2
    return np.stack([middle + low * axis, middle + high * axis]), radius


def _volume(ends: np.ndarray, radius: float) -> float:
    long = float(np.linalg.norm(ends[1] - ends[0]))
    return np.pi * radius**2 * (long + 4 / 3 * radius)
