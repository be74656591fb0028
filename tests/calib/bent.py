"""Stops with every kind of error of beams and surfaces, away from their start, and their rows."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np

from calib.effects import Effect, OneHot, Param, Site
from calib.forward import Term
from calib.linear.layout import Layout
from calib.linear.rows import StopRows
from calib.problem.build import build, effect_unknown
from calib.problem.model import Model, Source
from calib.problem.surfaces import with_surfaces
from calib.residuals.surfaces import PlaneSurface
from sensors.planes import Planes

from . import rigs


class Warp(Effect):
    """Range, azimuth and elevation all lie, and in a way that turns with the beam."""

    name, site = "warp", Site.BEAM

    def params(self, rig):
        return tuple(Param(f"{what}_{k}", "", 0.01) for what in ("r", "a", "e") for k in (0, 1))

    def basis(self, view):
        turn = np.stack([np.ones(view.rows), np.cos(view["azimuth_rad"])], axis=1)
        basis = np.zeros((view.rows, 3, 6))
        for site in range(3):
            basis[:, site, 2 * site : 2 * site + 2] = turn
        return basis


class RingElevation(Effect):
    """Every other ring points too high: one parameter each, the rest right."""

    name, site = "ring_elevation", Site.BEAM

    def params(self, rig):
        return tuple(Param(f"ring_{k}", "rad", 0.01) for k in range(rigs.RINGS // 2))

    def basis(self, view):
        ring = view["ring"]
        index = np.where(ring % 2, -1, ring // 2)
        return OneHot(index, np.tile([0.0, 0.0, 1.0], (view.rows, 1)), rigs.RINGS // 2)


def on_mesh(folder):
    """Beams on a mesh of which every part stands off."""
    return bent(build([Source.open(rigs.write(folder / "mesh"))], Model()))


def on_planes(folder):
    """Beams on planes, themselves unknown, of which every part stands off."""
    source = Source.open(rigs.write(folder / "planes", reference=None))
    walls = np.repeat(np.arange(6), rigs.WALL_STEPS**2 * 2)
    vertices, triangles = rigs.room()
    found = Planes(
        normal=np.repeat(np.eye(3), 2, axis=0),
        distance_m=np.ravel([[0, size] for size in rigs.ROOM_M]),
        count=np.full(6, 100),
        cell_mean_m=vertices[triangles].mean(axis=1),
        cell_plane=walls,
        cell_m=1.0,
        tolerance_m=0.3,
    )
    met = {0: PlaneSurface(found, "planes")}
    return bent(build([source], Model(), meetings=met))


def bent(problem):
    """The problem with every kind of beam and surface error switched on, away from its start."""
    source = problem.sources[0]
    terms = [
        Term(e, e.name, np.arange(len(e.params(source.rig)))) for e in (Warp(), RingElevation())
    ]
    for term in terms:
        problem.add(effect_unknown(term, source))
    problem.scans = [replace(s, terms=[*s.terms, *terms]) for s in problem.scans]
    values = rigs.shaken(problem.variables, problem.initial, 0.01)
    association = [s.associate(values, near_edges=False) for s in problem.scans]
    pairs = zip(problem.scans, association, strict=True)
    with_patches = [scan.settled(a.part, values) for scan, a in pairs]
    problem = with_surfaces(problem, with_patches)
    cells = {name: problem.variables[name] for name in problem.cells}
    values |= rigs.shaken(cells, problem.initial, 0.01)
    return SimpleNamespace(problem=problem, values=values, association=with_patches)


def dense(columns, count, dim):
    """Columns with one non-zero per row, in full."""
    out = np.zeros((count, dim))
    touched = np.flatnonzero(columns.index >= 0)
    out[touched, columns.components[columns.index[touched]]] = columns.value[touched]
    return out


def by_variable(scan, rows, values):
    """Derivative (N, dim) of a stop's residuals by everything they depend on."""
    placed = scan.stops.in_reference("lidar", values)
    d = {name: rows.by_twist @ columns[0] for name, columns in placed.d.items()} | dict(rows.dense)
    for c in rows.sparse:
        full = dense(c, len(rows.residual_m), len(values[c.variable]))
        d[c.variable] = d.get(c.variable, 0.0) + full
    return d


def stop_rows(case, scan, association):
    """One stop's linear rows over the unknowns of a case."""
    placed = scan.stops.in_reference("lidar", case.values)
    return StopRows.of(scan, Layout.of(case.problem), case.values, placed, association)
