"""Centres of calibration spheres: as the scanner's program lists them, or fitted to clouds."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from chains.align import fit_sphere
from chains.errors import InputError
from sensors.meshes import surface_normals
from sensors.readers.base import Array, Contents, Options, Progress, Spheres
from sensors.readers.meshes.placing import find_placing
from sensors.readers.meshes.survey import SURVEY_SUFFIXES as CLOUDS
from sensors.readers.meshes.survey import read_blocks
from sensors.readers.tables.sheets import LENGTHS, Sheet, is_number, open_sheet, split_unit

_LARGEST_RMS_M = 0.005  # a choice: scanners have 1 to 3 mm of noise, what is no sphere has more
_LEAST_SHARE = 0.6  # of a cloud that is said to be one: a choice, rod and background being the rest
_FEWEST_POINTS = 50  # with 2 mm of noise the centre of a cap is then 0.9 mm off, rms (300 draws)
_SEEN_CAP = 0.25  # of the half that faces the scanner, what must be there to be a sphere
_AXIS = re.compile(r"(?:.*[ _.])?([xyz])(?:[ _-]?(?:coord.*|pos.*|value))?$", re.IGNORECASE)


def read_spheres(paths: Sequence[Path], options: Options, progress: Progress) -> Contents:
    """Read the centres of spheres, in the scanner's frame.

    A table (CSV, TXT) has a row for each: a name and x y z; of one with a column of types, rows
    that say sphere are taken. A cloud is one sphere, whose radius is fitted; where
    `sphere_radius_m` is given, spheres of that radius are found in clouds of anything.
    """
    names: list[str] = []
    centres, lines, odd = [], [], []
    for n, path in enumerate(paths):
        progress("reading spheres", n, len(paths))
        cloud = path.suffix.lower() in CLOUDS
        fitted, said, strange = (_of_cloud if cloud else _of_table)(path, options)
        names += fitted.names
        centres.append(fitted.centre_m)
        lines += said
        odd += strange
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise InputError(f"{paths[-1]}: a sphere {twice} is there twice; rename one")
    spheres = Spheres(tuple(names), np.concatenate(centres))
    return Contents(spheres=spheres, understood=tuple(lines), odd=tuple(odd))


# ----------------------------------------------------------------------------------------- tables


def _of_table(path: Path, options: Options) -> tuple[Spheres, list[str], list[str]]:
    sheet, head = open_sheet(path)
    skip, header = _header(sheet, head)
    columns, unit = _axes(path, sheet, head, skip, header)
    named = [c for c in range(columns[0]) if not _numeric(sheet, head, skip, c)]
    xyz, odd = sheet.numbers(columns, skip)
    texts = {c: sheet.text(c, skip)[: len(xyz)] for c in named}
    rows = np.isfinite(xyz).all(axis=1)
    kinds = next((c for c, cells in texts.items() if _are_kinds(cells)), None)
    if kinds is not None:
        rows &= np.array(["sphere" in cell.lower() for cell in texts[kinds]])
    labels = next((cells for c, cells in texts.items() if c != kinds), None)
    if not rows.any():
        raise InputError(f"{path} has no row with a sphere's x, y and z")
    if options.length_unit is None and unit is not None:
        metres, placed = LENGTHS[unit], f"{unit} by its header"
        points_m = find_placing(path, xyz[rows] * metres, options).points(xyz[rows] * metres)
    else:
        placing = find_placing(path, xyz[rows], options)
        points_m, placed = placing.points(xyz[rows]), placing.understood
    kept = np.flatnonzero(rows).tolist()
    names = tuple(labels[k] if labels else f"{path.stem}_{k + 1}" for k in kept)
    left = f", {len(rows) - len(kept)} other rows left out" if len(kept) < len(rows) else ""
    return (
        Spheres(names, points_m),
        [f"{path.name}: {len(names)} spheres ({', '.join(names)}){left}; {placed}"],
        list(odd),
    )


def _header(sheet: Sheet, head: Sequence[str]) -> tuple[int, list[str]]:
    """How many lines stand above the rows, and the cells of the last that is no row."""
    skip, header = 0, []
    for number, line in enumerate(head, 1):
        cells = sheet.cells(line.lstrip("#% "))
        numbers = sum(is_number(cell, sheet.decimal_comma) for cell in cells)
        if numbers >= 3:
            return skip, header
        if numbers and header:
            raise InputError(f"{sheet.path}:{number}: a number is wanted for each of x, y and z")
        if any(cells):
            header = cells
        skip = number
    raise InputError(
        f"{sheet.path} has no row with three numbers; a sphere's x, y and z are wanted"
    )


def _axes(
    path: Path, sheet: Sheet, head: Sequence[str], skip: int, header: Sequence[str]
) -> tuple[list[int], str | None]:
    """The columns of x, y and z and their unit: by the header, else the first three of numbers."""
    parts = [split_unit(cell) for cell in header]
    columns = {}
    for column, (name, unit) in enumerate(parts):
        axis = _AXIS.match(name)
        if axis:
            columns.setdefault(axis[1].lower(), (column, unit))
    if columns.keys() == set("xyz"):
        units = {unit for _, unit in columns.values()}
        return [columns[axis][0] for axis in "xyz"], units.pop() if len(units) == 1 else None
    count = len(sheet.cells(head[skip]))
    if len(header) == count:
        raise InputError(f"{path} has the columns {', '.join(header)}; x, y and z are wanted")
    numeric = [c for c in range(count) if _numeric(sheet, head, skip, c)]
    if len(numeric) != 3:
        raise InputError(
            f"{path} has {len(numeric)} columns of numbers and no header that names x, y and z; "
            "name them in its first line"
        )
    return numeric, None


def _numeric(sheet: Sheet, head: Sequence[str], skip: int, column: int) -> bool:
    rows = [sheet.cells(line) for line in head[skip:] if line.strip()]
    return all(len(r) > column and is_number(r[column], sheet.decimal_comma) for r in rows)


def _are_kinds(cells: Sequence[str]) -> bool:
    """Whether cells say what a row is rather than its name: `Sphere`, again and again."""
    return len(set(cells)) < len(cells) and any("sphere" in cell.lower() for cell in cells)


# ----------------------------------------------------------------------------------------- clouds


def _of_cloud(path: Path, options: Options) -> tuple[Spheres, list[str], list[str]]:
    blocks = [block.points for block in read_blocks(path)]
    points = np.concatenate(blocks) if blocks else np.zeros((0, 3))
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) < _FEWEST_POINTS:
        raise InputError(f"{path} has {len(points)} points; a sphere takes {_FEWEST_POINTS}")
    placing = find_placing(path, points, options)
    points_m, radius_m = placing.points(points), options.sphere_radius_m
    if radius_m is None or np.ptp(points_m, axis=0).max() < 2.5 * radius_m:
        fitted = [_fit(points_m, radius_m)]
        _must_be_one(path, fitted[0], len(points_m))
        names = (path.stem,)
    else:
        fitted = [_fit(points_m[near], radius_m) for near in find_spheres(points_m, radius_m)]
        fitted = [fit for fit in fitted if fit[2] < _LARGEST_RMS_M]
        names = tuple(f"{path.stem}_{k + 1}" for k in range(len(fitted)))
        if not fitted:
            raise InputError(f"{path} shows no sphere of radius {1000 * radius_m:g} mm")
    lines = [
        f"{name}: sphere of radius {1000 * radius:.2f} mm{'' if radius_m is None else ', as given'}"
        f", {kept} points, {1000 * rms:.2f} mm rms"
        for name, (_, radius, rms, kept) in zip(names, fitted, strict=True)
    ]
    centres_m = np.array([centre for centre, *_ in fitted])
    return Spheres(names, centres_m), [*lines, f"{path.name}: {placing.understood}"], [*placing.odd]


Fit = tuple[Array, float, float, int]


def _fit(points_m: Array, radius_m: float | None) -> Fit:
    """Centre, radius, rms and how many points: fitted again without what lies 3 sigmas off."""
    kept = points_m[_near_a_sphere(points_m)]
    for _ in range(20):
        centre, radius, _ = fit_sphere(kept, radius_m)
        off = np.linalg.norm(points_m - centre, axis=1) - radius
        sigma = 1.4826 * np.median(np.abs(off - np.median(off)))
        inliers = points_m[np.abs(off) <= max(3 * sigma, 1e-6)]
        if len(inliers) == len(kept) or len(inliers) < 4:
            break
        kept = inliers
    return *fit_sphere(kept, radius_m), len(kept)


def _near_a_sphere(points_m: Array, draws: int = 200) -> np.ndarray:
    """The half (N,) bool nearest to a sphere: the best of those through four points at random."""
    rng = np.random.default_rng(0)
    local = points_m - points_m.mean(axis=0)
    four = local[rng.integers(0, len(local), (draws, 4))]
    rows = np.concatenate([2 * four, np.ones((draws, 4, 1))], axis=2)
    four, rows = (part[np.abs(np.linalg.det(rows)) > 1e-15] for part in (four, rows))
    if not len(rows):
        return np.ones(len(local), bool)
    solution = np.linalg.solve(rows, np.sum(four**2, axis=2)[..., None])[..., 0]
    centre = solution[:, :3]
    radius = np.sqrt(np.maximum(solution[:, 3] + np.sum(centre**2, axis=1), 0))
    some = local[:: max(1, len(local) // 1000)]
    off = np.abs(np.linalg.norm(some[None] - centre[:, None], axis=2) - radius[:, None])
    best = np.median(off, axis=1).argmin()
    off = np.abs(np.linalg.norm(local - centre[best], axis=1) - radius[best])
    return off <= np.median(off)


def _must_be_one(path: Path, fit: Fit, count: int) -> None:
    _, radius, rms, kept = fit
    if rms > _LARGEST_RMS_M or kept < _LEAST_SHARE * count or radius > 1:
        raise InputError(
            f"{path} is not the cloud of one sphere: the nearest has a radius of "
            f"{1000 * radius:.0f} mm, {100 * kept / count:.0f} % of the points on it and "
            f"{1000 * rms:.1f} mm rms; cut it out, or give --sphere-radius"
        )


def find_spheres(points_m: Array, radius_m: float) -> list[np.ndarray]:
    """Indices of the points of each sphere of that radius in a cloud (N, 3), the clearest first.

    Every point votes for the two places a radius along its normal (Hough); the cap of a sphere
    votes for one place, where a wall of as many points spreads its votes over another wall.
    """
    from scipy.spatial import cKDTree

    normal = surface_normals(points_m)
    votes = np.concatenate([points_m + radius_m * normal, points_m - radius_m * normal])
    places, near = cKDTree(votes), cKDTree(points_m)
    spacing = np.median(near.query(points_m[:: max(1, len(points_m) // 5000)], 2)[0][:, 1])
    cap = 2 * np.pi * (radius_m / max(spacing, 1e-4)) ** 2
    needed = max(_FEWEST_POINTS, _SEEN_CAP * cap / 4)
    some = _crowded(votes, 0.1 * radius_m, needed / 8)
    count = places.query_ball_point(some, 0.1 * radius_m, return_length=True)
    clusters: list[np.ndarray] = []
    centres: list[Array] = []
    for k in np.argsort(-count):
        if count[k] < needed:
            break
        if any(np.linalg.norm(some[k] - centre) < 2 * radius_m for centre in centres):
            continue
        index = np.array(near.query_ball_point(some[k], 1.3 * radius_m))
        away = np.linalg.norm(points_m[index] - some[k], axis=1)
        index = index[np.abs(away - radius_m) < 0.2 * radius_m]
        if len(index) < _FEWEST_POINTS:
            continue
        centres.append(some[k])
        clusters.append(index)
    return clusters


def _crowded(places: Array, cell_m: float, least: float) -> Array:
    """The mean (K, 3) of the places (N, 3) in every cell of a grid that has at least so many."""
    cell = np.floor(places / cell_m).astype(np.int64)
    order = np.lexsort(cell.T)
    first = np.append(0, 1 + np.flatnonzero((np.diff(cell[order], axis=0) != 0).any(axis=1)))
    count = np.diff(np.append(first, len(places)))
    means = np.add.reduceat(places[order], first, axis=0) / count[:, None]
    return means[count >= least]
