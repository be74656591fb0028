"""How widely values scatter that chance draws anew: variance components, by REML.

Values ``u ~ N(0, D)`` of the members of some groups, D diagonal with one variance for each group,
are unknowns of the graph. All rows but their priors say of them, everything else being estimated,
``g = M u + e`` with ``e ~ N(0, M)``: score and information. So ``g ~ N(0, M + M D M)``, and the
variances of greatest likelihood are those of restricted maximum likelihood (Patterson and Thompson
1971). With C the covariance of u as fitted, ``M = C^-1 - D^-1`` and ``g = C^-1 u``.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType

import numpy as np

from calib.linear.system import Linearisation, Values
from calib.problem.places import joints_at
from calib.problem.problem import Block, Problem, SurfaceCells
from calib.problem.spread import Whose, by_chance, readings, sigmas, widening
from calib.problem.without import ROD
from calib.residuals.groups import Group
from calib.residuals.seen import BodiesTogether, SeenBody
from calib.residuals.targets import PARTS_OF_SIGMAS, TARGET_PARTS, HangingTarget
from calib.solve.components.checks import Checks
from calib.solve.components.joints import Readings
from calib.solve.components.told import sds, told
from calib.solve.estimate import Estimate

Sums = Mapping[Whose, Checks]
GraphRow = tuple[Block | None, Mapping[str, np.ndarray], np.ndarray]  # as of `Graph`
NO_CHECKS = Checks.alone(0.0, 0.0)


def squares(estimate: Estimate) -> Sums:
    """Whose rows -> what these rows say of their sigma; of those that a spread widens."""
    problem = estimate.problem
    whose = frozenset(widening(problem).values())
    rows = estimate.graph.linear_rows(estimate.values)
    out = squares_beside_bodies(
        problem, estimate.values, estimate.linear, estimate.kept, whose, rows
    )
    bodies = [b for b in problem.bodies if Whose("body", b.body, "m") in whose]
    return out | _of_bodies(bodies, estimate)


def _of_bodies(bodies: Sequence[SeenBody], estimate: Estimate) -> Sums:
    """Of tracked bodies."""
    found: dict[Whose, list[tuple[float, float]]] = {}
    together = BodiesTogether.of(bodies)
    blocks = [block for each in together for block in each.blocks]
    rows = [some for each in together for some in each.evaluate(estimate.values)]
    variances = estimate.variances([d for _, d in rows])
    for block, (residual, _), seen in zip(blocks, rows, variances, strict=True):
        count = len(block.measured)
        weight = np.ones(count) if block.weight is None else block.weight
        left = np.repeat(weight, len(residual) // count) - seen
        for k, unit in enumerate(dict.fromkeys(block.units)):
            mine = [each.reshape(count, -1, 3)[:, k] for each in (residual, left)]
            sums = float(np.square(mine[0]).sum()), float(mine[1].sum())
            found.setdefault(Whose("body", block.body, unit), []).append(sums)
    return {key: Checks.alone(*np.sum(sums, axis=0)) for key, sums in found.items()}


def squares_beside_bodies(
    problem: Problem,
    values: Values,
    linear: Linearisation,
    kept: np.ndarray,
    whose: Collection[Whose],
    graph_rows: Iterable[GraphRow],
    wild: Collection[Group] = (),
) -> dict[Whose, Checks]:
    """The same of joint readings, of targets, and of what parts of surfaces stand off, by kind.

    Args:
        problem: with its cells.
        values: the state.
        linear: there, or one step before.
        kept: covariance of what no elimination has taken out of it.
        whose: of which of them.
        graph_rows: rows, at the state, of the graph that it is in.
        wild: blunders, of which nothing is told.
    """
    cells = {n: c for n, c in problem.cells.items() if Whose("surface", c.kind, "m") in whose}
    out = _of_cells(problem, values, cells, lambda some: linear.variances(some, kept))
    if any(each.kind == "target" for each in whose):
        out |= _of_targets(linear, kept, graph_rows, wild)
    off = {joints_at(problem, group) for group in wild if group.kind == "joints"}
    joints = {w: s for w, s in sigmas(problem).items() if w.kind == "joints" and w in whose}
    good = [u for u in readings(problem) if u.name not in off]
    found = Readings.of(joints, good, values, linear, kept) if joints else None
    return out | (found.of_each if found else {})


def _of_targets(
    linear: Linearisation,
    kept: np.ndarray,
    graph_rows: Iterable[GraphRow],
    wild: Collection[Group],
) -> dict[Whose, Checks]:
    """Of spheres and of markers; the upper one counts across its rod alone."""
    rows = [row for row in graph_rows if isinstance(row[0], HangingTarget)]
    variances = linear.variances([by for _, by, _ in rows], kept)
    sums: dict[str, list[tuple[float, float]]] = {}
    for (block, _, residual), seen in zip(rows, variances, strict=True):
        weight = block.part_weights
        whole = replace(block.groups[0], what=ROD) in wild
        for of, parts in PARTS_OF_SIGMAS.items():
            for i in (TARGET_PARTS.index(part) for part in parts):
                if not whole and block.groups[i] not in wild:
                    here, count = slice(3 * i, 3 * i + 3), 2 if TARGET_PARTS[i] == "upper" else 3
                    left = count * weight[i] - seen[here].sum()
                    sums.setdefault(of, []).append((np.square(residual[here]).sum(), left))
    found = {of: Checks.alone(*np.sum(some, axis=0)) for of, some in sums.items()}
    return {Whose("target", of, "m"): checks for of, checks in found.items()}


def _of_cells(
    problem: Problem,
    values: Values,
    cells: Mapping[str, SurfaceCells],
    variances: Callable[[Sequence[Mapping[str, np.ndarray]]], list[np.ndarray]],
) -> dict[Whose, Checks]:
    """Of what parts of surfaces stand off, by their kind."""
    sums: dict[Whose, list[tuple[float, float]]] = {}
    each = variances([{n: np.eye(problem.variables[n].dim)} for n in cells])
    for (name, some), seen in zip(cells.items(), each, strict=True):
        sigma = problem.variables[name].sigma
        total = float(np.square(values[name] / sigma).sum())
        left = float(np.sum(1.0 - seen / np.square(sigma)))
        sums.setdefault(Whose("surface", some.kind, "m"), []).append((total, left))
    return {whose: Checks.alone(*np.sum(mine, axis=0)) for whose, mine in sums.items()}


def wider(
    problem: Problem, sums: Sums, earlier: Mapping[str, tuple[float, float]]
) -> dict[str, float]:
    """Key of a spread -> how widely rows scatter beyond their first sigma, as they have it, and
    other rows `earlier`: what these say, and the sigma of that."""
    out, known = {}, sigmas(problem)
    for key, whose in widening(problem).items():
        sigma, beyond = known[whose]
        checks = sums.get(whose, NO_CHECKS)
        if earlier.get(key, (0.0, 0.0))[1] > 0.0:
            checks = Checks.together([checks, _as_rows(sigma, beyond, *earlier[key])])
        grown = checks.growth()
        out[key] = float(np.sqrt(max(grown * sigma**2 + beyond**2, 0.0)))
    return out


def _as_rows(sigma: float, beyond: float, sd: float, sigma_sd: float) -> Checks:
    """What other rows said of a spread, as so many rows, whitened by this sigma, as say the same;
    `beyond` is what of that sigma is spread."""
    variance = sigma**2 - beyond**2 + sd**2
    count = variance**2 / (2.0 * (max(sd, sigma_sd) * sigma_sd) ** 2)
    return Checks.alone(count * variance / sigma**2, count)


def spreads(
    estimate: Estimate, earlier: Mapping[str, tuple[float, float]] = MappingProxyType({})
) -> dict[str, tuple[float, float]]:
    """Key of a spread, an unknown by chance or what widens rows -> that spread, and its sigma, as
    all rows have it, and other rows `earlier`."""
    some, out = by_chance(estimate.problem), {}
    if some:
        found = told(some, estimate.values, estimate.covariance_of([u.name for u in some]))
        now = sds(some)
        sd = np.array(list(now.values()))
        pairs = zip(sd.tolist(), found.sigma(sd).tolist(), strict=True)
        out |= dict(zip(now, pairs, strict=True))
    if keys := widening(estimate.problem):
        sums, known = squares(estimate), sigmas(estimate.problem)
        for key, whose in keys.items():
            sigma, beyond = known[whose]
            checks = sums.get(whose, NO_CHECKS)
            out[key] = beyond, sigma_beyond(beyond, sigma**2 * checks.sigma(0.0))
    for key in (key for key in out if earlier.get(key, (0.0, 0.0))[1] > 0.0):
        (sd, sigma), (_, known_sigma) = out[key], earlier[key]
        out[key] = sd, float(sigma * known_sigma / np.hypot(sigma, known_sigma))
    return out


def sigma_beyond(sd: float, of_variance: float) -> float:
    """Sigma of a spread beyond a known sigma, from that of the variance."""
    return float(np.sqrt(sd**2 + of_variance) - sd)
