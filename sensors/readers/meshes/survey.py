"""Clouds of a surveying scanner, FARO's or Leica's, made into the reference surface."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np

from chains.errors import InputError
from sensors.meshes import read_cloud
from sensors.readers.base import Array, Contents, Options, Progress, ScannedSurface
from sensors.readers.meshes.placing import WIDEST_ROOM_M, Placing, find_placing
from sensors.readers.meshes.pts import PointBlock, read_pts, read_ptx
from sensors.readers.meshes.reconstruction import Rebuilt, Thinner, rebuild

SURVEY_SUFFIXES = (".e57", ".pts", ".ptx", ".xyz", ".ply", ".pcd")
_COARSE_M = 0.03  # a choice: edges are rounded as far, a footprint of a LiDAR a few metres away


def read_survey(paths: Sequence[Path], options: Options, progress: Progress) -> Contents:
    """Read the scans of one room, registered to each other, and mesh them.

    Points are thinned, their normals face the scanner that saw them, the surface is Poisson's,
    trimmed where the scans are thin; intensity goes to the triangles.
    """
    clouds = _Clouds()
    for n, path in enumerate(paths):
        clouds.read(path, options, lambda what, n=n: progress(what, n, len(paths)))
    scan, points_m, columns = clouds.thinner.means()
    if np.ptp(points_m, axis=0).max() > WIDEST_ROOM_M and options.length_unit is None:
        raise InputError(
            f"{paths[0]}: its points are {np.ptp(points_m, axis=0).max():.0f} m apart; if they are"
            " metres, give --length-unit m"
        )
    facing, whence = clouds.facing(scan, points_m, columns[:, 1:])
    intensity = columns[:, 0] if np.isfinite(columns[:, 0]).all() else None
    try:
        built = rebuild(points_m, facing, intensity, progress)
    except InputError as error:
        raise InputError(f"{paths[0]}: {error}") from None
    lines, odd = _describe(built, clouds, len(points_m))
    return Contents(
        surface=ScannedSurface(built.vertices_m, built.triangles, intensity=built.intensity),
        understood=(*clouds.understood, *lines),
        odd=(*clouds.odd, *whence, *odd),
    )


class _Clouds:
    """All scans of all files, thinned; where each scanner stood."""

    def __init__(self) -> None:
        self.thinner = Thinner()
        self.origins: dict[int, Array] = {}
        self.understood: list[str] = []
        self.odd: list[str] = []
        self.scans = 0

    def read(self, path: Path, options: Options, tell: Callable[[str], None]) -> None:
        """Add the scans of one file, telling how many points there are so far."""
        placing: Placing | None = None
        before, last = self.thinner.count, -1
        for block in read_blocks(path):
            if not len(block.points):
                continue
            placing = placing or find_placing(path, block.points, options)
            scan = self.scans + block.scan
            if block.origin is not None:
                self.origins[scan] = placing.points(block.origin[None])[0]
            self._add(path, scan, block, placing)
            last = max(last, block.scan)
            tell(f"reading {path.name}, {self.thinner.count - before} points")
        if placing is None or self.thinner.count == before:
            raise InputError(f"{path} holds no points")
        known = sum(scan >= self.scans for scan in self.origins)
        self.scans += last + 1
        self.odd += placing.odd
        self.understood.append(
            f"{path.name}: {last + 1} scans, {known} with the scanner's place, "
            f"{self.thinner.count - before} points; {placing.understood}"
        )

    def _add(self, path: Path, scan: int, block: PointBlock, placing: Placing) -> None:
        columns = np.full((len(block.points), 4), np.nan)
        if block.intensity is not None:
            columns[:, 0] = block.intensity
        if block.normal is not None:
            columns[:, 1:] = placing.directions(block.normal)
        try:
            self.thinner.add(scan, placing.points(block.points), columns)
        except InputError as error:
            raise InputError(f"{path}: {error}") from None

    def facing(
        self, scan: np.ndarray, points_m: Array, normal: Array
    ) -> tuple[Array, tuple[str, ...]]:
        """Where the outside looks (N, 3) at each point, and what had to be assumed.

        Towards the scanner, else along the file's own normals; else the scanner is taken to have
        stood in the frame's origin, or in the middle where the origin lies outside the cloud.
        """
        low, high = points_m.min(axis=0), points_m.max(axis=0)
        inside = bool(((low < 0) & (high > 0)).all())
        guess = np.zeros(3) if inside else np.median(points_m, axis=0)
        facing, guessed = guess - points_m, np.ones(len(points_m), bool)
        has_normal = np.isfinite(normal).all(axis=1)
        facing[has_normal], guessed[has_normal] = normal[has_normal], False
        for number, origin_m in self.origins.items():
            of = scan == number
            facing[of], guessed[of] = origin_m - points_m[of], False
        if not guessed.any():
            return facing, ()
        where = "the origin of its frame" if inside else "the middle of its points"
        return facing, (
            f"{100 * guessed.mean():.0f} % of the points do not say where their scanner stood;"
            f" {where} is taken, so surfaces that cannot be seen from there may come out wrong;"
            " E57 and PTX hold the scanner's pose",
        )


def read_blocks(path: Path) -> Iterator[PointBlock]:
    """The points of a cloud in the units and axes of its file, block by block.

    Raises InputError for a file that is missing, broken or of no kind known here.
    """
    suffix = path.suffix.lower()
    if suffix not in SURVEY_SUFFIXES:
        raise InputError(
            f"{path}: a cloud is read from {', '.join(SURVEY_SUFFIXES)}, not {suffix!r}"
        )
    if suffix in (".pts", ".xyz"):
        yield from read_pts(path)
    elif suffix == ".ptx":
        yield from read_ptx(path)
    elif suffix == ".e57":
        yield from _read_e57(path)
    else:
        columns = read_cloud(path)
        normals = [columns.get(name) for name in ("nx", "ny", "nz")]
        yield PointBlock(
            0,
            np.stack([columns[axis] for axis in "xyz"], axis=1),
            next((v for n, v in columns.items() if "intensity" in n.lower()), None),
            None if any(n is None for n in normals) else np.stack(normals, axis=1),
        )


def _read_e57(path: Path) -> Iterator[PointBlock]:
    from sensors.readers.clouds.e57 import read_e57_scans

    for number, scan in enumerate(read_e57_scans(path)):
        # Points in rows and columns are as one scanner saw them: from the origin of their frame.
        origin = scan.pose[:3, 3] if scan.posed or "row" in scan.columns else None
        yield PointBlock(number, scan.xyz_in_file(), scan.columns.get("intensity"), origin=origin)


def _describe(built: Rebuilt, clouds: _Clouds, thinned: int) -> tuple[list[str], list[str]]:
    """How good the surface is, and what looks odd about it."""
    off_mm = 1000 * built.distance_m
    rms = float(np.sqrt(np.mean(off_mm**2)))
    lines = [
        f"thinned to {thinned} points, {1000 * built.spacing_m:.1f} mm apart "
        f"(voxels of {1000 * clouds.thinner.voxel_m:.0f} mm); meshed by Poisson's equation in "
        f"cells of {1000 * built.cell_m:.1f} mm: {len(built.triangles)} triangles",
        f"trimmed where the scan is thin: {100 * built.trimmed:.0f} % of what it had closed",
        f"cloud to mesh: {np.median(off_mm):.2f} mm in the median, {rms:.2f} mm rms, 99 % within "
        f"{np.quantile(off_mm, 0.99):.1f} mm",
    ]
    odd = []
    if built.cell_m > _COARSE_M:
        odd.append(
            f"the surface has cells of {1000 * built.cell_m:.0f} mm, which round edges as far; "
            "cut the cloud to the room, or scan it denser"
        )
    return lines, odd
