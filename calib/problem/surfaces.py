"""Errors of the mesh or of planes, common to the points of a surface or cell, as unknowns.

Mesh error is smooth over whole surfaces, so a fit carries one displacement along the normal per
surface, per region and per patch: without them neighbouring points would count as independent
facts. Regions are tilted, too: an error that is smooth has slopes, and without tilts of regions the
slope of a floor, which many beams show, would count as a tilt of the whole room. Walls are no
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
from calib.residuals.groups import REGION_PART
from calib.residuals.scan import ScanStop
from calib.residuals.surfaces import PLANE_PATCHES_M, Meeting, PlaneSurface

LEAST_BEAMS = 100  # on a plane: three numbers of it, known ten times better than by a single beam
LOST_BEAMS = 0.5  # of these, below which a plane that was found has lost its beams
# Variance of the displacements, as shares of the reference's; and by how much regions tilt, rad,
# for each metre that they stand off. Chosen by how far errors smooth over 0.4, 1 and 2 m turn the
# mesh of a lab, in its sigmas: 0.8, 1.0 and 1.3; without tilts, and with shares of 0.6, 0.6 and 2,
# by 1.3, 1.4 and 1.7. Over 24 labs of 24 stops rotations were 0.98 of their sigmas off (rms), and
# 1.30 without tilts; ring zeros of an XT32, over 12, 1.17 and 1.40. What is no wider than a patch
# has no tilt of its own.
SURFACE_SHARES = {"surface": 0.6, "region": 1.0, "patch": 0.5}
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
            some = {name: whole}
            if column == REGION_PART:
                some |= _tilts(name, whole, first.meeting)
            sigma_m = cell_sigma_m(first, column)
            unknowns += [_unknown(n, each, scatter(each, sigma_m)) for n, each in some.items()]
            cells |= some
    return problem.with_cells(unknowns, cells)


def kinds_of(scan: ScanStop) -> dict[str, str]:
    """Column of the parts of what a scan meets -> what those with one spread are called: all meshes
    have one for each column; the planes of a recording have their own."""
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
    """How far parts of a kind may stand off the mesh, or the planes, that a scan meets."""
    beyond = scan.reference_scatter_m.get(column, 0.0)
    return float(np.sqrt(SURFACE_SHARES[column] * scan.stated_sigma_m**2 + beyond**2))


def scatter(cells: SurfaceCells, sigma_m: float) -> float:
    """How widely cells scatter, in their unit, where parts of their kind stand off by that."""
    return sigma_m if cells.axis is None else float(TILT_PER_M * sigma_m)


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


def _tilts(name: str, regions: SurfaceCells, met: Meeting) -> dict[str, SurfaceCells]:
    """Tilts of the regions that are wide enough for one, by unknown."""
    found = {}
    for axis, wide in enumerate(met.tilting(regions.parts).T):
        if wide.any():
            parts, surface = regions.parts[wide], regions.surface[wide]
            tilts = replace(regions, parts=parts, surface=surface, axis=axis)
            found[_tilt(name, axis)] = tilts
    return found


def _tilt(regions: str, axis: int) -> str:
    """The unknown of the tilts of some regions along an axis of their surfaces."""
    return f"{regions}.tilt_{axis}"


def _unknown(name: str, cells: SurfaceCells, sigma: float) -> Unknown:
    return vector_unknown(
        name,
        np.full(len(cells.parts), sigma),
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
