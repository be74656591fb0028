"""Errors of the mesh or of planes, common to the points of a surface or cell, as unknowns.

Mesh error is smooth over whole surfaces, so a fit carries one displacement along the normal per
surface, per region and per patch: without them neighbouring points would count as independent
facts. Surfaces and regions are tilted, too: an error that is smooth has slopes, and without tilts
the slope of a floor, which many beams show, would count as a tilt of the whole room. Walls are no
flatter: planes found in the scans have regions and patches as well. Where a plane is as a whole is
itself estimated.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from calib.problem.problem import Problem, SurfaceCells
from calib.problem.unknowns import Owner, Role, Unknown, vector_unknown
from calib.residuals.beams import Association
from calib.residuals.groups import PATCH, REGION_PART, SURFACE
from calib.residuals.scan import ScanStop
from calib.residuals.surfaces import PLANE_PATCHES_M, Meeting, PlaneSurface

LEAST_BEAMS = 100  # on a plane: three numbers of it, known ten times better than by a single beam
LOST_BEAMS = 0.5  # of these, below which a plane that was found has lost its beams
TILT = "tilt"  # of whole surfaces: by how much they lean from end to end, m
# Variances as shares of the reference's: of how far parts of a surface stand off, and of by how
# much a whole surface leans; and by how much regions tilt, rad, for each metre that they stand off.
# Chosen by how far errors smooth over 0.4, 1 and 2 m turn the mesh of a lab, in its sigmas: 0.8,
# 1.0 and 1.3; without tilts, and with shares of 0.6, 0.6 and 2, by 1.3, 1.4 and 1.7. Over 24 labs
# of 24 stops rotations were 0.98 of their sigmas off (rms), and 1.30 without tilts of regions; ring
# zeros of an XT32, over 12, 1.17 and 1.40. What is no wider than a patch has no tilt of its own.
# That whole surfaces lean hardly changes this (0.89 and 0.92 over 8 labs); without it a floor that
# leans by 1 mrad turned the room by 6 to 7 of its sigmas.
SURFACE_SHARES = {SURFACE: 0.6, REGION_PART: 1.0, PATCH: 0.5, TILT: 0.6}
TILT_PER_M = np.sqrt(2.0)


def with_surfaces(problem: Problem, associations: Sequence[Association]) -> Problem:
    """A problem with the unknowns of the surfaces that its beams meet.

    Args:
        problem: without them.
        associations: per scan, what its beams meet, with their patches.
    """
    unknowns: list[Unknown] = []
    cells: dict[str, SurfaceCells] = {}
    for room, scans in _by_room(problem).items():
        first = problem.scans[scans[0]]
        if not first.reference_sigma_m:
            continue
        on_planes = isinstance(first.meeting, PlaneSurface)
        for column, kind in kinds_of(first).items():
            if column == TILT:
                continue  # of surfaces, with which it comes
            met = (np.unique(problem.scans[i].parts(associations[i], column)) for i in scans)
            parts = np.unique(np.concatenate(list(met)))
            parts = parts[parts >= 0].astype(int)
            if not len(parts):
                continue  # no beam meets the room: there is nothing to estimate
            name = kind if on_planes else f"{room}/reference_{column}"
            whole = SurfaceCells(
                column=column,
                kind=kind,
                parts=parts,
                surface=first.meeting.surface_of(column, parts),
                room=room,
            )
            some = {name: whole} | _tilts(name, whole, first.meeting)
            for each_name, each in some.items():
                sigma_m = cell_sigma_m(first, TILT if each.kind == TILT else column)
                unknowns.append(_unknown(each_name, each, scatter(each, sigma_m)))
            cells |= some
    return problem.with_cells(unknowns, cells)


def kinds_of(scan: ScanStop) -> dict[str, str]:
    """Column of the parts of what a scan meets, or `TILT` -> what those with one spread are called:
    all meshes have one for each; the planes of a recording have their own."""
    if isinstance(scan.meeting, PlaneSurface):
        return dict(zip(PLANE_PATCHES_M, parts_of(scan.meeting), strict=True))
    return {column: column for column in SURFACE_SHARES}


def parts_of(planes: PlaneSurface) -> list[str]:
    """The unknowns of how far the parts of planes stand off, one for each kind."""
    return [f"{planes.variable}/{column}" for column in PLANE_PATCHES_M]


def cells_of(planes: PlaneSurface) -> list[str]:
    """All unknowns of the parts of planes, tilts included."""
    names = dict(zip(PLANE_PATCHES_M, parts_of(planes), strict=True))
    return [*names.values(), *(_tilt(names[REGION_PART], axis) for axis in (0, 1))]


def cell_sigma_m(scan: ScanStop, column: str) -> float:
    """How far parts of a kind may stand off the mesh, or the planes, that a scan meets; or by how
    much whole surfaces may lean."""
    beyond = scan.reference_scatter_m.get(column, 0.0)
    return float(np.sqrt(SURFACE_SHARES[column] * scan.stated_sigma_m**2 + beyond**2))


def scatter(cells: SurfaceCells, sigma_m: float) -> np.ndarray:
    """How widely cells (P,) scatter, in their unit, where parts of their kind stand off by that."""
    if cells.axis is None:
        per_m = 1.0
    else:
        per_m = TILT_PER_M if cells.column == REGION_PART else 1.0 / cells.width_m
    return np.full(len(cells.parts), sigma_m * per_m)


def well_seen(problem: Problem, associations: Sequence[Association]) -> list[Association]:
    """What beams meet, without planes that too few of them meet: stops that seemed elsewhere when
    the planes were found leave such, and a fit does not settle on them.

    Args:
        problem: whose recordings may have no mesh.
        associations: per scan, what its beams meet.
    """
    found = list(associations)
    rooms: dict[object, list[int]] = {}
    for i, scan in enumerate(problem.scans):
        if isinstance(scan.meeting, PlaneSurface):
            rooms.setdefault(scan.room, []).append(i)
    for scans in rooms.values():
        count = len(problem.scans[scans[0]].meeting.planes.normal)
        beams = sum(np.bincount(found[i].part + 1, minlength=count + 1)[1:] for i in scans)
        few = np.append(beams < LOST_BEAMS * LEAST_BEAMS, False)  # the last stands for -1
        for i in scans:
            found[i] = replace(found[i], part=np.where(few[found[i].part], -1, found[i].part))
    return found


def _tilts(name: str, whole: SurfaceCells, met: Meeting) -> dict[str, SurfaceCells]:
    """Tilts of the parts that are wide enough for one, by unknown."""
    found = {}
    kind = TILT if whole.column == SURFACE else whole.kind
    for axis, width_m in enumerate(met.tilting(whole.column, whole.parts).T):
        if (wide := width_m > 0.0).any():
            found[_tilt(name, axis)] = replace(
                whole,
                kind=kind,
                parts=whole.parts[wide],
                surface=whole.surface[wide],
                axis=axis,
                width_m=width_m[wide],
            )
    return found


def _tilt(regions: str, axis: int) -> str:
    """The unknown of the tilts of some regions along an axis of their surfaces."""
    return f"{regions}.tilt_{axis}"


def _unknown(name: str, cells: SurfaceCells, sigma: np.ndarray) -> Unknown:
    return vector_unknown(
        name,
        sigma,
        dofs=(f"{cells.column}_{part}" for part in cells.parts),
        units=("m" if cells.axis is None else "rad",) * len(cells.parts),
        role=Role.SURFACE,
        owner=Owner(room=cells.room),
    )


def _by_room(problem: Problem) -> dict[int | str, list[int]]:
    """The scans on each mesh, of whatever recording, and on the planes of each recording."""
    found: dict[int | str, list[int]] = {}
    for i, scan in enumerate(problem.scans):
        if scan.reference_sigma_m:
            found.setdefault(scan.room, []).append(i)
    return found
