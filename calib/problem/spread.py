"""How widely things scatter by chance, as a problem has it: values of unknowns, and rows.

A spread has a key: the name of the unknown whose values scatter, with ``.sd.unit`` after it where
these are of several units; or, where rows have a wider sigma,
``effect.whose.unit``, whose being a tracked body, a joint, what of targets, or a kind of part of
the mesh; or, of how uneven the planes of a recording are, which no effect needs to say,
``planes/region.m``.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Literal, NamedTuple

import numpy as np

from calib.effects import Site
from calib.forward import Term
from calib.problem.problem import Block, Problem
from calib.problem.surfaces import SURFACE_SHARES, cell_sigma_m, kinds_of, scatter
from calib.problem.unknowns import Role, Unknown, is_read
from calib.residuals.scan import ScanStop
from calib.residuals.surfaces import PlaneSurface
from calib.residuals.targets import PARTS_OF_SIGMAS, HangingTarget
from calib.residuals.tracker import TrackedBody


class Whose(NamedTuple):
    """Rows that have one sigma.

    Args:
        kind: what kind of rows they are.
        what: the body; the joint; sphere or marker of targets; of surfaces, the kind of part.
        unit: of the sigma.
    """

    kind: Literal["body", "joints", "target", "surface"]
    what: str
    unit: str

    @property
    def text(self) -> str:
        """Whose they are, as keys and files have it: no body is called as what is of targets."""
        return f"target/{self.what}" if self.kind == "target" else self.what


class SpreadName(NamedTuple):
    """What files call a spread of an effect by chance.

    Args:
        name: among the effect's parameters.
        of: whose it is; empty where it is of the effect's own values.
        unit: of the spread.
    """

    name: str
    of: str
    unit: str

    @classmethod
    def made(cls, of: str, unit: str, several: bool) -> SpreadName:
        """That of one, or of one of several."""
        return cls(f"{of or 'sd'}.{unit}" if of or several else "sd", of, unit)


def by_chance(problem: Problem) -> list[Unknown]:
    """The unknowns whose spread is estimated."""
    return [u for u in problem.variables.values() if u.role is Role.SCATTER]


def spread_keys(unknown: Unknown) -> dict[str, np.ndarray]:
    """Key of each spread of an unknown by chance -> which (n,) of its values have it."""
    units = np.array(unknown.units)
    every = {
        f"{unknown.name}.sd.{unit}": np.flatnonzero(units == unit)
        for unit in sorted(dict.fromkeys(unknown.units))
    }
    return every if len(every) > 1 else {unknown.name: np.arange(len(units))}


def names_of(problem: Problem, term: Term) -> dict[str, SpreadName]:
    """Key of every spread of an effect by chance -> what files call it."""
    if term.effect.widens:
        mine = _widened_by(problem, term).items()
        return {key: SpreadName.made(whose.text, whose.unit, True) for key, whose in mine}
    unknown = problem.variables[term.variable]
    keys = spread_keys(unknown)
    units = [unknown.units[at[0]] for at in keys.values()]
    pairs = zip(keys, units, strict=True)
    return {key: SpreadName.made("", unit, len(keys) > 1) for key, unit in pairs}


def _widened_by(problem: Problem, term: Term) -> dict[str, Whose]:
    """Key of every spread by which an effect widens the sigma of rows -> whose."""
    mine = rows_at(problem, term.effect.site)
    return {f"{term.variable}.{whose.text}.{whose.unit}": whose for whose in mine}


def widening(problem: Problem) -> dict[str, Whose]:
    """Key of every spread that widens the sigma of rows -> whose."""
    out: dict[str, Whose] = {}
    for term in (t for some in problem.terms for t in some if t.effect.widens):
        out |= _widened_by(problem, term)
    planes = (
        kind for scan in problem.scans if _on_planes(scan) for kind in kinds_of(scan).values()
    )
    return out | {f"{kind}.m": Whose("surface", kind, "m") for kind in planes}


def rows_at(problem: Problem, site: Site) -> list[Whose]:
    """Whose rows have a sigma that an effect at a site may widen."""
    if site is Site.TRACKER:
        bodies = {block.body: block.is_point for block in problem.bodies}
        units = {body: ("m",) if point else ("rad", "m") for body, point in bodies.items()}
        return [Whose("body", body, unit) for body, some in units.items() for unit in some]
    if site is Site.JOINTS:
        return list(_joints(problem))
    if site is Site.TARGET:
        there = any(isinstance(block, HangingTarget) for block in problem.blocks)
        return [Whose("target", part, "m") for part in PARTS_OF_SIGMAS] if there else []
    meshes = any(scan.reference_sigma_m for scan in problem.scans if not _on_planes(scan))
    return [Whose("surface", part, "m") for part in SURFACE_SHARES] if meshes else []


def readings(problem: Problem) -> Iterator[Unknown]:
    """What encoders misreport at each stop."""
    return (u for u in problem.variables.values() if u.role is Role.JOINTS)


def _joints(problem: Problem) -> dict[Whose, tuple[float, float]]:
    """Joints that are read anywhere -> the sigma of their readings, and how much of it is beyond
    what it was at first."""
    out: dict[Whose, tuple[float, float]] = {}
    wanted: dict[object, np.ndarray] = {}  # of each arm's joints, those of which none is read yet
    for unknown in readings(problem):
        like = unknown.dofs, unknown.units
        left = wanted.setdefault(like, np.ones(unknown.dim, bool))
        for i in np.flatnonzero(left & is_read(unknown.sigma)) if left.any() else ():
            joint, left[i] = unknown.dofs[i], False
            found = float(unknown.sigma[i]), unknown.scatter.get(joint, 0.0)
            out.setdefault(Whose("joints", joint, unknown.units[i]), found)
    return out


def sigmas(problem: Problem) -> dict[Whose, tuple[float, float]]:
    """Whose rows -> their sigma, and how much of it is beyond what it was at first."""
    out = {
        Whose("body", block.body, unit): (getattr(block, f"sigma_{unit}"), block.scatter[unit])
        for block in problem.bodies
        for unit in ("rad", "m")
    }
    out |= _joints(problem)
    for block in (b for b in problem.blocks if isinstance(b, HangingTarget)):
        for part, beyond in block.scatter.items():
            sigma = getattr(block, f"sigma_{part}_m")
            out[Whose("target", part, "m")] = sigma, beyond
    for scan in problem.scans:
        for part, kind in kinds_of(scan).items():
            beyond = scan.reference_scatter_m.get(part, 0.0)
            out.setdefault(Whose("surface", kind, "m"), (cell_sigma_m(scan, part), beyond))
    return out


def spread_of(problem: Problem) -> dict[str, float]:
    """Key of every spread, an unknown's by chance or what widens rows -> what it is."""
    known = sigmas(problem)
    out = {
        key: float(unknown.sigma[at[0]])
        for unknown in by_chance(problem)
        for key, at in spread_keys(unknown).items()
    }
    return out | {key: float(known[whose][1]) for key, whose in widening(problem).items()}


def with_spread(problem: Problem, spread: Mapping[str, float], settled: float = 0.0) -> Problem:
    """The problem with other spreads; itself where they are what it has.

    Args:
        problem: as it is.
        spread: by the keys of `spread_of`; of some of them.
        settled: relative change of a sigma that is none.
    """
    changed = {}
    for unknown in by_chance(problem):
        sigma = unknown.sigma.copy()
        for key, at in spread_keys(unknown).items():
            sd = spread.get(key, sigma[at[0]])
            if abs(sigma[at[0]] - sd) > settled * sd:
                sigma[at] = sd
        if not np.array_equal(sigma, unknown.sigma):
            changed[unknown.name] = replace(unknown, sigma=sigma)
    problem = replace(problem, variables=problem.variables | changed) if changed else problem
    now = sigmas(problem)
    for key, whose in widening(problem).items():
        sigma, beyond = now[whose]
        other = np.sqrt(sigma**2 - beyond**2 + spread.get(key, beyond) ** 2)
        if abs(other - sigma) > settled * sigma:
            problem = _widened(problem, whose, spread[key])
    return problem


def _widened(problem: Problem, whose: Whose, sd: float) -> Problem:
    """The problem with another spread of some rows."""
    kind, what, unit = whose
    if kind == "joints":
        joints = {u.name: u.scattering(what, unit, sd) for u in readings(problem)}
        return replace(problem, variables=problem.variables | joints)
    if kind != "surface":
        blocks = [_block_scattering(block, whose, sd) for block in problem.blocks]
        return replace(problem, blocks=blocks)
    scans, aside = (
        [_scattering(scan, what, sd) for scan in some] for some in (problem.scans, problem.aside)
    )
    wider = replace(problem, scans=scans, aside=aside)
    sigma_m = sigmas(wider)[whose][0]
    cells = {
        name: replace(known, sigma=scatter(problem.cells[name], sigma_m))
        for name, known in problem.variables.items()
        if name in problem.cells and problem.cells[name].kind == what
    }
    return replace(wider, variables=problem.variables | cells)


def _block_scattering(block: Block, whose: Whose, sd: float) -> Block:
    """The block with another spread, if it is a target, or of the body, whose that is."""
    if isinstance(block, HangingTarget) and whose.kind == "target":
        return block.scattering(whose.what, sd)
    mine = isinstance(block, TrackedBody) and whose[:2] == ("body", block.body)
    return block.scattering(whose.unit, sd) if mine else block


def _scattering(scan: ScanStop, what: str, sd: float) -> ScanStop:
    """The scan with another spread of a kind of part, if it is of what the scan meets."""
    mine = [part for part, kind in kinds_of(scan).items() if kind == what]
    return scan.scattering(mine[0], sd) if mine else scan


def _on_planes(scan: ScanStop) -> bool:
    return isinstance(scan.meeting, PlaneSurface)
