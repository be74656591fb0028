"""A room to scan: what stands in it, of what it is made, and how well its mesh was measured."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from chains import se3
from sensors.reference import Reference

SIZE_M = np.array([8.0, 6.0, 3.0])  # a choice: a laboratory
# The FARO's frame: level, its origin at the scanner's head; the room's middle lies elsewhere.
FLOOR_CENTRE_M = np.array([0.6, -0.4, -1.2])
X, Y, Z = np.eye(3)
CELL_M = 0.22  # of the mesh, a choice: finer than errors of walls, and no even part of a wall
CORRELATION_M = 1.0  # over which walls are uneven alike: a choice

Triple = tuple[float, float, float]

# name: (FARO intensity, reflectivity at the LiDAR's wavelength); low goes with low
MATERIALS: dict[str, tuple[float, float]] = {
    "floor": (0.38, 0.30),
    "ceiling": (0.80, 0.75),
    "wall_paint": (0.82, 0.80),
    "wallpaper": (0.66, 0.60),
    "wood_panel": (0.52, 0.50),
    "metal_cabinet": (0.45, 0.40),
    "whiteboard": (0.74, 0.70),
    "curtain": (0.35, 0.33),
    "foam": (0.30, 0.22),
    "cardboard": (0.50, 0.48),
    "plastic_black": (0.08, 0.06),
    "plastic_white": (0.78, 0.74),
    "plastic_red": (0.42, 0.62),
    "plastic_blue": (0.25, 0.35),
    "paper": (0.86, 0.85),
    "sticker": (0.60, 0.55),
}
LABEL_NAMES = dict(enumerate(MATERIALS))


@dataclass(frozen=True)
class Panel:
    """One smooth surface: a parallelogram, its grid of vertices, its label.

    Args:
        corner_m: (3,) of the parallelogram, in the room: origin on the floor's centre, z up.
        along_m, up_m: (3,) its two edges; the normal is their cross product.
        material: its name.
        wave_m: amplitude of a ripple across `along_m`, as of a curtain.
    """

    corner_m: np.ndarray
    along_m: np.ndarray
    up_m: np.ndarray
    material: str
    wave_m: float = 0.0

    @property
    def normal(self) -> np.ndarray:
        """Unit normal (3,)."""
        normal = np.cross(self.along_m, self.up_m)
        return normal / np.linalg.norm(normal)

    def grid(self) -> tuple[np.ndarray, np.ndarray]:
        """Vertices (V, 3), m, and triangles (F, 3) of the panel alone."""
        width_m, height_m = np.linalg.norm(self.along_m), np.linalg.norm(self.up_m)
        n = int(np.ceil(width_m / (CELL_M / 4 if self.wave_m else CELL_M)))
        m = int(np.ceil(height_m / CELL_M))
        a, b = np.meshgrid(np.linspace(0, 1, n + 1), np.linspace(0, 1, m + 1), indexing="ij")
        ripple_m = self.wave_m * np.sin(2 * np.pi * a.ravel() * width_m / 0.4)
        vertices = (
            self.corner_m
            + a.reshape(-1, 1) * self.along_m
            + b.reshape(-1, 1) * self.up_m
            + ripple_m[:, None] * self.normal
        )
        first = (np.arange(n)[:, None] * (m + 1) + np.arange(m)).ravel()
        quad = np.stack([first, first + m + 1, first + m + 2, first + 1], axis=1)
        return vertices, np.concatenate([quad[:, [0, 1, 2]], quad[:, [0, 2, 3]]])


@dataclass(frozen=True)
class Room:
    """The room as it is and as it was measured, both in the FARO's frame.

    Args:
        true: the surfaces that beams meet.
        measured: the reference mesh; its vertices are those of `true`, displaced along the normal.
        reflectivity: (F,) of each triangle at the LiDAR's wavelength.
    """

    true: Reference
    measured: Reference
    reflectivity: np.ndarray


def build(kind: str, mesh_error_m: float, rng: np.random.Generator) -> Room:
    """A room of 8 x 6 x 3 m, and its mesh with an error smooth over each surface.

    Along the normal, half of the error's variance is common to a surface and half varies over about
    a metre, so its standard deviation is `mesh_error_m` in all.

    Args:
        kind: `lab` is furnished, `box` bare.
        mesh_error_m: standard deviation of the mesh along the surfaces' normals.
        rng: furniture, intensities and mesh errors.
    """
    panels = [*_shell(), *(_furniture(rng) if kind == "lab" else ())]
    vertices, errors, triangles, material = [], [], [], []
    count = 0
    for panel in panels:
        grid, faces = panel.grid()
        smooth = np.hypot(0.5, 0.5) * (rng.standard_normal() + _field(grid, rng))
        vertices.append(grid + FLOOR_CENTRE_M)
        errors.append(mesh_error_m * smooth[:, None] * panel.normal)
        triangles.append(faces + count)
        material += [panel.material] * len(faces)
        count += len(grid)
    faro, reflectivity = np.array([MATERIALS[name] for name in material]).T
    label = np.array([list(MATERIALS).index(name) for name in material])
    faro = faro * np.exp(0.04 * rng.standard_normal(len(faro)))
    true_m, faces = np.concatenate(vertices), np.concatenate(triangles)
    meshes = [
        Reference(at_m, faces, label, faro, LABEL_NAMES)
        for at_m in (true_m, true_m + np.concatenate(errors))
    ]
    return Room(meshes[0], meshes[1], reflectivity)


def _field(points_m: np.ndarray, rng: np.random.Generator, waves: int = 24) -> np.ndarray:
    """A Gaussian field of unit variance at points (N, 3), correlation exp(-d^2 / (2 l^2))."""
    wave_vectors = rng.standard_normal((3, waves)) / CORRELATION_M
    phases = rng.uniform(0, 2 * np.pi, waves)
    return np.sqrt(2 / waves) * np.cos(points_m @ wave_vectors + phases).sum(axis=1)


def _shell() -> list[Panel]:
    """Floor, ceiling and four walls, their normals pointing inwards."""
    x, y, z = SIZE_M[0] * X, SIZE_M[1] * Y, SIZE_M[2] * Z
    corner = -(x + y) / 2
    wide, half = 2 * x / 8 * 3, y / 2
    return [
        Panel(corner, x, y, "floor"),
        Panel(corner + z, y, x, "ceiling"),
        Panel(corner, z, x - wide, "wall_paint"),
        Panel(corner + x - wide, z, wide, "wood_panel"),
        Panel(corner + y, x, z, "wall_paint"),
        Panel(corner, y, z, "wallpaper"),
        Panel(corner + x, z, half, "wood_panel"),
        Panel(corner + x + half, z, half, "wall_paint"),
    ]


def _box(
    centre_m: Triple, size_m: Triple, material: str, rpy_rad: Triple = (0, 0, 0)
) -> list[Panel]:
    """The six sides of a box whose middle stands at `centre_m`, turned by `rpy_rad`."""
    T = se3.from_xyz_rpy(centre_m, rpy_rad)
    x, y, z = np.array(size_m)[:, None] * T[:3, :3].T
    low, high = T[:3, 3] - (x + y + z) / 2, T[:3, 3] + (x + y + z) / 2
    sides = [(low, y, x), (low, z, y), (low, x, z), (high, -x, -y), (high, -y, -z), (high, -z, -x)]
    return [Panel(corner, along, up, material) for corner, along, up in sides]


def _standing(x: float, y: float, size_m: Triple, material: str, yaw: float = 0.0) -> list[Panel]:
    """A box on the floor."""
    return _box((x, y, size_m[2] / 2 + 0.002), size_m, material, (0, 0, yaw))


def _table(x: float, y: float, yaw: float) -> list[Panel]:
    top = _box((x, y, 0.74), (1.4, 0.7, 0.04), "wood_panel", (0, 0, yaw))
    corners = [(a, b, 0) for a in (0.64, -0.64) for b in (0.3, -0.3)]
    feet = se3.apply(se3.from_xyz_rpy((x, y, 0), (0, 0, yaw)), np.array(corners))
    legs = [_standing(*foot[:2], (0.06, 0.06, 0.71), "metal_cabinet", yaw) for foot in feet]
    return [panel for part in (top, *legs) for panel in part]


def _shelf(x: float, y: float) -> list[Panel]:
    boards = [_box((x, y, z), (0.35, 1.2, 0.03), "wood_panel") for z in (0.25, 0.75, 1.25, 1.75)]
    sides = [_box((x, y + s, 0.9), (0.35, 0.03, 1.8), "wood_panel") for s in (-0.62, 0.62)]
    return [panel for part in (*boards, *sides) for panel in part]


def _furniture(rng: np.random.Generator) -> list[Panel]:
    """Cabinets, tables, a shelf, a curtain, sheets on the walls, boxes, and boards that lean."""
    parts = [
        _standing(-3.7, 1.2, (0.45, 0.9, 1.9), "metal_cabinet"),
        _standing(-3.7, 0.25, (0.45, 0.9, 1.9), "metal_cabinet"),
        _standing(2.6, 2.7, (1.0, 0.45, 1.1), "metal_cabinet"),
        _table(-1.6, 2.5, 0.05),
        _table(3.4, -1.9, 1.45),
        _shelf(3.78, 0.9),
        _box((-1.9, 2.5, 0.885), (0.3, 0.25, 0.25), "plastic_white", (0, 0, 0.4)),
        _box((-1.2, 2.55, 0.865), (0.25, 0.2, 0.21), "plastic_black", (0, 0, -0.3)),
        _box((3.4, -1.6, 0.91), (0.4, 0.3, 0.3), "cardboard", (0, 0, 0.7)),
        _box((2.6, 2.7, 1.23), (0.4, 0.3, 0.25), "plastic_blue", (0, 0, 0.2)),
        _standing(-3.4, -2.4, (0.6, 0.6, 0.6), "cardboard", 0.5),
        _standing(3.55, 2.5, (0.4, 0.4, 0.8), "plastic_red", 0.3),
        _box((0.4, 2.985, 1.5), (1.8, 0.02, 1.1), "whiteboard"),
        _box((-3.985, -1.4, 1.6), (0.02, 0.8, 1.1), "paper"),
        _box((-2.7, -2.985, 1.5), (0.7, 0.02, 0.5), "sticker"),
        _box((3.985, 1.9, 1.5), (0.02, 0.5, 0.7), "sticker"),
        [
            Panel(
                corner_m=np.array([0.2, -2.85, 0.05]),
                along_m=2.4 * X,
                up_m=2.6 * Z,
                material="curtain",
                wave_m=0.03,
            )
        ],
    ]
    leaning = ["foam", "whiteboard", "plastic_white", "cardboard", "plastic_red", "wood_panel"]
    places = [(-3.0, 2.0), (-3.1, -0.9), (-1.4, -2.4), (2.9, -0.7), (1.6, 2.3), (3.0, 1.7)]
    for material, (x, y) in zip(leaning, places, strict=True):
        towards_middle = np.arctan2(-y, -x) + np.pi / 2 + rng.uniform(-0.5, 0.5)
        tilt = rng.uniform(0.15, 0.5)
        centre = (x, y, 0.72)
        parts.append(_box(centre, (0.9, 0.03, 1.3), material, (tilt, 0, towards_middle)))
    parts.append(_box((0.9, -0.2, 2.6), (1.2, 0.5, 0.06), "plastic_white", (0.3, 0.2, 0.6)))
    return [panel for part in parts for panel in part]


def write_ply(path: Path, mesh: Reference) -> None:
    """Write a mesh as binary PLY with vertices in double precision, m."""
    faces = np.empty(len(mesh.triangles), dtype=[("n", "u1"), ("v", "<u4", (3,))])
    faces["n"], faces["v"] = 3, mesh.triangles
    axes = "".join(f"property double {axis}\n" for axis in "xyz")
    header = (
        "ply\nformat binary_little_endian 1.0\n"
        f"element vertex {len(mesh.vertices_m)}\n{axes}"
        f"element face {len(faces)}\nproperty list uchar uint vertex_indices\nend_header\n"
    )
    path.write_bytes(header.encode() + mesh.vertices_m.astype("<f8").tobytes() + faces.tobytes())
