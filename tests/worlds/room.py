"""A furnished room of flat rectangles: what a ray meets, and the mesh that was scanned of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .knobs import World
from .poses import turn

SIZE_M = np.array([8.0, 7.0, 2.9])
LABELS = {
    "floor": 0.25,
    "ceiling": 0.70,
    "wall_paint": 0.75,
    "wallpaper": 0.60,
    "wood_panel": 0.45,
    "metal_cabinet": 0.50,
    "whiteboard": 0.85,
    "cardboard": 0.40,
    "plastic_black": 0.06,
    "foam": 0.12,
}
FURNITURE = ("wood_panel", "metal_cabinet", "cardboard", "plastic_black", "foam")
CELL_M = 0.2  # of the mesh
WAVES, SHORTEST_M, LONGEST_M = 12, 0.5, 4.0  # of the mesh's error on a surface
TRIES = 200  # to place a box of clutter
WARPED = 2  # the surface whose error a warp adds to: a wall


@dataclass(frozen=True)
class Quads:
    """Q rectangles corner + a u + b v with 0 <= a, b <= 1; u, v across each other, m.

    Args:
        corner, u, v: (Q, 3).
        label: (Q,) index into `LABELS`.
    """

    corner: np.ndarray
    u: np.ndarray
    v: np.ndarray
    label: np.ndarray

    @property
    def normal(self) -> np.ndarray:
        """(Q, 3) unit."""
        n = np.cross(self.u, self.v)
        return n / np.linalg.norm(n, axis=1, keepdims=True)

    def and_(self, other: Quads) -> Quads:
        """Both."""
        mine, theirs = vars(self).items(), vars(other)
        return Quads(**{name: np.concatenate([each, theirs[name]]) for name, each in mine})

    def shifted(self, some: tuple[int, ...], by_m: float) -> Quads:
        """Some of them along their normals."""
        corner = self.corner.copy()
        corner[list(some)] += by_m * self.normal[list(some)]
        return Quads(corner, self.u, self.v, self.label)

    def hit(self, start: np.ndarray, towards: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """How far (N,) m rays go until they meet a rectangle, and which (N,); inf and -1 if none.

        Args:
            start: (3,) or (N, 3) m.
            towards: (N, 3) unit.
        """
        n = self.normal
        slope = towards @ n.T
        offset = np.sum(self.corner * n, axis=1) - np.atleast_2d(start) @ n.T
        with np.errstate(divide="ignore", invalid="ignore"):
            reach = offset / slope
            for edge in (self.u, self.v):
                unit = edge / np.sum(edge**2, axis=1)[:, None]
                at_start = np.atleast_2d(start) @ unit.T - np.sum(self.corner * unit, axis=1)
                share = at_start + reach * (towards @ unit.T)
                reach = np.where((share >= 0) & (share <= 1), reach, np.inf)
        reach = np.where(reach > 1e-6, reach, np.inf)
        which = np.argmin(reach, axis=1)
        nearest = reach[np.arange(len(reach)), which]
        return nearest, np.where(np.isfinite(nearest), which, -1)


def box(centre: np.ndarray, size: np.ndarray, yaw: float, label: str) -> Quads:
    """The six sides of a box, edges (3,) m long, turned by yaw rad; normals point out."""
    axes = turn(np.array([0.0, 0.0, 1.0]), yaw) * size
    corner, u, v = [], [], []
    for i in range(3):
        n, a, b = axes[:, i], axes[:, (i + 1) % 3], axes[:, (i + 2) % 3]
        corner += [centre + (n - a - b) / 2, centre + (-n - a - b) / 2]
        u, v = [*u, a, b], [*v, b, a]
    return Quads(*map(np.array, (corner, u, v)), np.full(6, list(LABELS).index(label)))


def furnished(rng: np.random.Generator) -> Quads:
    """Floor, ceiling, four walls, and furniture along the walls; z is up from the floor."""
    room = box(np.array([0, 0, SIZE_M[2] / 2]), SIZE_M, 0.0, "wall_paint")
    # Sides come as +x, -x, +y, -y, +z, -z; here as floor, ceiling, walls, and seen from inside.
    order = [5, 4, 0, 1, 2, 3]
    room = Quads(room.corner[order], room.v[order], room.u[order], room.label[order])
    room.label[:] = [list(LABELS).index(x) for x in ("floor", "ceiling", *(["wall_paint"] * 4))]
    room.label[3] = list(LABELS).index("wallpaper")
    for k in range(14):
        room = room.and_(_piece(rng, k))
    return room.and_(_board(rng))


def _piece(rng: np.random.Generator, k: int) -> Quads:
    """A cupboard, crate or shelf near wall k % 4."""
    size = rng.uniform([0.35, 0.3, 0.3], [1.2, 0.6, 1.9])
    raised = 0.0 if rng.random() < 0.7 else rng.uniform(0.8, SIZE_M[2] - size[2] - 0.1)
    side, across = k % 4, rng.uniform(-0.85, 0.85)
    long = side < 2  # the wall is one of constant x
    half = SIZE_M[:2] / 2
    away = (half[0] if long else half[1]) - size[1] / 2 - rng.uniform(0.05, 0.25)
    sign = 1 if side % 2 else -1
    at = across * ((half[1] if long else half[0]) - 0.7)
    xy = [sign * away, at] if long else [at, sign * away]
    yaw = (np.pi / 2 if long else 0.0) + rng.normal(0, 0.06)
    label = FURNITURE[rng.integers(len(FURNITURE))]
    return box(np.array([*xy, raised + 0.005 + size[2] / 2]), size, yaw, label)


def _board(rng: np.random.Generator) -> Quads:
    """A whiteboard that leans against a wall: the one thing that is neither upright nor level."""
    lean, width, height = rng.uniform(0.2, 0.4), 1.4, 1.2
    foot = np.array([rng.uniform(-2, 1), -SIZE_M[1] / 2 + 0.75, 0.1])
    up = height * np.array([0.0, -np.sin(lean), np.cos(lean)])
    along = np.array([width, 0.0, 0.0])
    label = np.array([list(LABELS).index("whiteboard")])
    return Quads(foot[None], along[None], up[None], label)


@dataclass(frozen=True)
class Mesh:
    """V corners (V, 3) m and F triangles (F, 3) of them, each of a rectangle's label (F,)."""

    vertices: np.ndarray
    faces: np.ndarray
    label: np.ndarray


def scanned(
    quads: Quads,
    rng: np.random.Generator,
    sigma_m: float,
    warp_m: float,
    meshed: tuple[int, ...] = (),
) -> Mesh:
    """The mesh of rectangles, off along their normals by errors that are smooth over each.

    Args:
        quads: what is there.
        rng: of the errors.
        sigma_m: their standard deviation.
        warp_m: how far the middle of the wall `WARPED` is off besides.
        meshed: numbers of the rectangles that it has; empty for all.
    """
    vertices, faces, labels, first = [], [], [], 0
    for q, normal in enumerate(quads.normal):
        u, v = quads.u[q], quads.v[q]
        counts = [max(1, round(np.linalg.norm(edge) / CELL_M)) for edge in (u, v)]
        a, b = np.meshgrid(*(np.linspace(0, 1, n + 1) for n in counts), indexing="ij")
        points = quads.corner[q] + a.reshape(-1, 1) * u + b.reshape(-1, 1) * v
        error = sigma_m * _waves(points, rng)
        if q == WARPED:
            error += warp_m * np.sin(np.pi * a.ravel()) * np.sin(np.pi * b.ravel())
        if meshed and q not in meshed:
            continue
        number = np.arange(a.size).reshape(a.shape) + first
        w, x, y, z = (number[i, j].ravel() for i, j in _corners())
        vertices.append(points + error[:, None] * normal)
        faces.append(np.concatenate([np.stack([w, x, y], 1), np.stack([w, y, z], 1)]))
        labels.append(np.full(2 * len(w), quads.label[q]))
        first += a.size
    return Mesh(*map(np.concatenate, (vertices, faces, labels)))


def _corners() -> list[tuple[slice, slice]]:
    low, high = slice(None, -1), slice(1, None)
    return [(low, low), (high, low), (high, high), (low, high)]


def _waves(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A random smooth function at points (N, 3) m, of variance 1: waves of many lengths."""
    length_m = np.exp(rng.uniform(np.log(SHORTEST_M), np.log(LONGEST_M), WAVES))
    towards = rng.standard_normal((WAVES, 3))
    towards *= (2 * np.pi / length_m / np.linalg.norm(towards, axis=1))[:, None]
    size = rng.standard_normal(WAVES)
    return np.cos(points @ towards.T + rng.uniform(0, 2 * np.pi, WAVES)) @ size * np.sqrt(2 / WAVES)


def bumps(world: World, points: np.ndarray, which: np.ndarray) -> np.ndarray:
    """How far (N,) the rectangles (N,) lie behind flat at points (N, 3) m, of variance 1; 0 for -1.
    It is the same at every stop."""
    out = np.zeros(len(points))
    for q in np.unique(which[which >= 0]).tolist():
        mine = which == q
        out[mine] = _waves(points[mine], world.rng(f"bumps {q}"))
    return out


def cluttered(
    quads: Quads,
    rng: np.random.Generator,
    share: float,
    starts: np.ndarray,
    towards: np.ndarray,
) -> Quads:
    """Boxes that stand before rays until these meet them in a share of all cases, about.

    Args:
        quads: what is there without them.
        rng: of their places.
        share: of the rays.
        starts: (K, 3) m, of as many bundles.
        towards: (K, N, 3) unit.

    Returns:
        The boxes alone; none where the share is 0.
    """
    out = Quads(*(np.zeros((0, 3)) for _ in range(3)), np.zeros(0, int))
    free = [quads.hit(*each)[0] for each in zip(starts, towards, strict=True)]
    met = np.zeros((len(starts), towards.shape[1]), bool)
    most, middle = SIZE_M[:2] / 2 - 0.5, starts[:, :2].mean(axis=0)
    for _ in range(TRIES):
        if met.mean() >= share:
            break
        size = rng.uniform([0.15, 0.15, 0.4], [0.35, 0.35, 1.7])
        bearing, away = rng.uniform(0, 2 * np.pi), rng.uniform(0.6, 1.8)
        xy = middle + away * np.array([np.cos(bearing), np.sin(bearing)])
        near = np.linalg.norm(starts[:, :2] - xy, axis=1).min() < 0.45
        if not near and np.all(np.abs(xy) < most):
            yaw = rng.uniform(0, np.pi)
            more = box(np.array([*xy, size[2] / 2]), size, yaw, "cardboard")
            bundles = zip(starts, towards, strict=True)
            met |= [more.hit(*each)[0] < far for each, far in zip(bundles, free, strict=True)]
            out = out.and_(more)
    return out
