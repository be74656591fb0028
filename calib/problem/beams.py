"""Scans against what their beams meet: the mesh, or planes found in the scans."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from calib.effects import Site
from calib.problem.model import Source
from calib.problem.places import Places
from calib.problem.problem import Problem, SourceStops
from calib.problem.surfaces import LEAST_BEAMS
from calib.problem.unknowns import Owner, Role, Unknown, vector_unknown
from calib.residuals.groups import MESH_PARTS, SCAN, Group, kind_and_number
from calib.residuals.scan import ScanStop
from calib.residuals.surfaces import PLANE_PATCHES_M, Meeting, MeshSurface, PlaneSurface
from chains import se3
from chains.errors import InputError
from sensors.planes import PlaneFinder, Planes
from sensors.reference import Reference

Progress = Callable[[str, int, int], None]
OF_BEAMS = (Site.BEAM, Site.REFERENCE, Site.NOISE)
# How uneven planes are, region by region and patch by patch: a third of the 3 mm over 1 m that DIN
# 18202 (table 3, row 7) allows a good wall. A fit starts from it and estimates it, but for what is
# always there: a coat of paint, 0.05 mm thick or more, assumed to be no more even than that.
UNEVEN_M, FLATTEST_M = 1e-3, 5e-5
# Widths of the cells that planes are looked for in. A choice: walls are wider than the last.
CELLS_M = (0.3, 0.6, 1.2)


def add_beams(problem: Problem, part: SourceStops, places: Places, progress: Progress) -> None:
    """Add every scan of a recording, and the planes' unknowns where there is no mesh."""
    source = part.source
    meeting = _meeting(problem, part, places, progress)
    terms = [t for t in part.terms if t.effect.site in OF_BEAMS and not t.effect.widens]
    uneven_m = dict.fromkeys(PLANE_PATCHES_M, UNEVEN_M) if isinstance(meeting, PlaneSurface) else {}
    stated_m = FLATTEST_M if uneven_m else source.rig.reference.sigma_m
    for k, stops in places.scanned():
        problem.scans.append(
            ScanStop(
                name=source.recording.stops[k],
                recording=source.recording,
                index=k,
                stops=stops,
                terms=terms,
                columns={name: values[[k]] for name, values in source.columns.items()},
                meeting=meeting,
                reference_sigma_m=float(np.hypot(stated_m, np.linalg.norm([*uneven_m.values()]))),
                store=source.store,
                alike=tuple(s.store for s in problem.sources if s.rig.name == source.rig.name),
                room=_room(problem, part),
                group=Group("scan", source.recording.stops[k], SCAN, part.label),
                reference_scatter_m=uneven_m,
            )
        )


def _room(problem: Problem, part: SourceStops) -> int | str:
    """The first source with the same mesh; without one the recording itself."""
    if part.source.reference is None:
        return str(part.source.recording.folder)
    meshes = [s.reference for s in problem.sources]
    return next(i for i, mesh in enumerate(meshes) if same_mesh(mesh, part.source.reference))


def _meeting(problem: Problem, part: SourceStops, places: Places, progress: Progress) -> Meeting:
    """What the beams meet: the mesh, or else planes found in the scans."""
    found = problem.meetings.get(part.number)
    if found is None:
        lidar, reference = part.source.rig.lidar, part.source.reference
        found = (
            MeshSurface(
                reference,
                1.5 * lidar.beam_divergence_rad,
                {kind: _left_out(part.source, kind) for kind in MESH_PARTS},
            )
            if reference is not None
            else PlaneSurface(_find_planes(problem, part, places, progress), f"{part.prefix}planes")
        )
        problem.meetings[part.number] = found
    if isinstance(found, PlaneSurface):
        problem.add(_planes_unknown(found, Owner(recording=part.label, room=_room(problem, part))))
    return found


def _left_out(source: Source, kind: str) -> frozenset[int]:
    """Numbers of the parts of its mesh that are left out, of one of `MESH_PARTS`."""
    parts = (kind_and_number(what) for _, what in source.lacks("surface"))
    return frozenset(number for part, number in parts if part == kind)


def _planes_unknown(found: PlaneSurface, owner: Owner) -> Unknown:
    """The planes' numbers, free within half a radian and a metre."""
    count = len(found.planes.normal)
    kinds = ("tilt_1", "tilt_2", "distance")
    return vector_unknown(
        found.variable,
        np.tile([0.5, 0.5, 1.0], count),
        dofs=(f"plane_{m}.{kind}" for m in range(count) for kind in kinds),
        units=("rad", "rad", "m") * count,
        role=Role.PLANE,
        owner=owner,
    )


def _find_planes(problem: Problem, part: SourceStops, places: Places, progress: Progress) -> Planes:
    """Planes in cells as wide as most points are then in planes: where scans are sparse, there are
    too few of them in a narrow cell to see that it is flat, and a wide one has edges in it."""
    recording, rig = part.source.recording, part.source.rig
    finders = [PlaneFinder(cell_m=width, noise_m=rig.lidar.sigma_range_m) for width in CELLS_M]
    store = part.source.of_beams(None).store  # the same planes, however many beams are used
    scanned = list(places.scanned())
    for i, (k, stops) in enumerate(scanned):
        progress("looking for planes", i, len(scanned))
        _, ray = store.read(k)
        T = stops.in_reference(rig.lidar_frame, problem.initial, False).T[0]
        points_m = ray.origin_m + ray.range_m[:, None] * ray.direction
        for finder in finders:
            finder.add(k, se3.apply(T, points_m), T[:3, 3])
    found = [finder.planes(min_points=LEAST_BEAMS) for finder in finders]
    planes = max(found, key=lambda planes: planes.count.sum())
    if not len(planes.normal):
        raise InputError(
            f"{recording.folder}: there is no mesh, and no flat patch in the scans to fit to; "
            f"add reference/mesh.ply, or scan walls"
        )
    return planes


def same_mesh(a: Reference | None, b: Reference | None) -> bool:
    """Whether two references are one, labels and all: their errors are then the same too."""
    return a is b or (a is not None and b is not None and a.digest == b.digest)
