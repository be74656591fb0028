"""What rows say of the unknowns that stops share: of all stops together, and of each planned one.

A planned stop's own unknowns (where its base stands, what its encoders misreport, how far the parts
of the mesh are off that it looks at) are eliminated from its sums, by the same Schur complement as
in a fit. What is left is one matrix per stop, and these add up. Taking the mesh's errors for a
stop's own is an approximation, for choosing among stops; what is told of those chosen comes from
one linearisation of all stops, in which the mesh errs once.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from calib.linear.elimination import eliminate, eliminate_apart
from calib.linear.layout import Layout, positions
from calib.linear.linearise import lidars, linearise
from calib.linear.parallel import in_order
from calib.linear.rows import TWIST, StopRows, StopSums
from calib.problem import Problem
from calib.problem.prior import JointPrior
from calib.problem.surfaces import with_surfaces
from calib.problem.unknowns import Key, Role, Unknown
from calib.residuals.beams import Association
from calib.residuals.compiled import add_at, add_both
from calib.residuals.seen import BodiesTogether
from calib.solve.clustered import of_graph
from calib.solve.graph import Graph


@dataclass(frozen=True)
class Information:
    """What is known of S components of unknowns, each in units of what was known before.

    Args:
        keys: (S,) unknown and component.
        unit: (S,) the sigma known before; 1 of what has no prior.
        data: (S, S) of all rows.
        paper: (S, S) of priors of the hardware: CAD, data sheets.
    """

    keys: tuple[Key, ...]
    unit: np.ndarray
    data: np.ndarray
    paper: np.ndarray

    def at(self, names: Sequence[str]) -> np.ndarray:
        """Where the components of some unknowns stand."""
        chosen = set(names)
        return np.array([i for i, (name, _) in enumerate(self.keys) if name in chosen], int)

    def covariance(self, at: np.ndarray) -> np.ndarray:
        """Covariance of some components (n,), in their own units."""
        return inverse(self.data + self.paper, at) * np.outer(self.unit[at], self.unit[at])

    def without(self, names: Sequence[str]) -> Information:
        """The same where some unknowns are known to be 0."""
        keep = np.setdiff1d(np.arange(len(self.keys)), self.at(names))
        return self._some(keep, self.data[np.ix_(keep, keep)])

    def _some(self, keep: np.ndarray, data: np.ndarray) -> Information:
        return Information(
            keys=tuple(self.keys[i] for i in keep),
            unit=self.unit[keep],
            data=data,
            paper=self.paper[np.ix_(keep, keep)],
        )

    def believing(self, prior: JointPrior) -> Information:
        """The same where an earlier estimate stands for what paper says of some unknowns."""
        held = [key for v in prior.held for key in v.keys]
        at, paper = np.array([self.keys.index(key) for key in held]), self.paper.copy()
        paper[at] = paper[:, at] = 0.0
        whole = inverse(prior.covariance, np.arange(len(at)))
        paper[np.ix_(at, at)] = whole * np.outer(self.unit[at], self.unit[at])
        return replace(self, paper=paper)

    def onto(self, keep: np.ndarray) -> Information:
        """The same of some components (n,), those others being known as well as they are."""
        gone = np.setdiff1d(np.arange(len(self.keys)), keep)
        whole = self.data + self.paper
        block, cross = whole[np.ix_(gone, gone)], whole[np.ix_(gone, keep)]
        lost = cross.T @ cho_solve(cho_factor(block), cross) if len(gone) else 0.0
        return self._some(keep, self.data[np.ix_(keep, keep)] - lost)


def inverse(matrix: np.ndarray, at: np.ndarray) -> np.ndarray:
    """The rows and columns `at` (n,) of the inverse of a positive definite matrix."""
    scale = 1.0 / np.sqrt(np.diag(matrix))
    wanted = np.zeros((len(matrix), len(at)))
    wanted[at, np.arange(len(at))] = 1.0
    factor = cho_factor(matrix * np.outer(scale, scale))
    return (cho_solve(factor, wanted) * scale[:, None])[at] * scale[at]


def of_all(
    problem: Problem,
    values: Mapping[str, np.ndarray],
    associations: Sequence[Association],
    unbounded: Sequence[str] = (),
) -> Information:
    """What all rows of a problem say of the unknowns that several stops share.

    Args:
        problem: with the unknowns of its surfaces.
        values: the state.
        associations: per scan.
        unbounded: unknowns that have no prior here.
    """
    layout = Layout.of(problem, unbounded=unbounded)
    linear = linearise(problem, values, associations, layout=layout)
    data, at = linear.kept[:-1, :-1].copy(), positions(layout.size, layout.kept)
    paper = np.zeros_like(data)
    graph = Graph(list(layout.outer().values()), layout.others, layout.unbounded)
    for block, name, rows in of_graph(graph, layout, values):
        scaled = rows.A * layout.sigma[rows.columns]
        into = paper if block is None and name in problem.calibration else data
        place = at[rows.columns]
        into[np.ix_(place, place)] += scaled.T @ scaled
    keys = tuple(key for unknown in layout.outer().values() for key in unknown.keys)
    return Information(keys, layout.sigma[layout.kept], data, paper)


@dataclass(frozen=True)
class Shared:
    """Which columns of a problem's layout are among the components that stops share.

    Args:
        layout: of the problem.
        at: (U,) where each stands among those; -1 for what is a stop's own.
        size: how many there are.
    """

    layout: Layout
    at: np.ndarray
    size: int

    @classmethod
    def of(cls, layout: Layout, keys: Sequence[Key]) -> Shared:
        """Those of these keys."""
        known = {key: i for i, key in enumerate(keys)}
        at = [known.get((n, d), -1) for n, u in layout.unknowns.items() for d in _dofs(u)]
        return cls(layout, np.array(at), len(keys))


def _dofs(unknown: Unknown) -> Sequence[str]:
    return unknown.dofs if unknown.role is not Role.SURFACE else [""] * unknown.dim


def of_each(
    problem: Problem,
    values: Mapping[str, np.ndarray],
    keys: Sequence[Key],
    first: int,
    count: int,
    unbounded: Sequence[str] = (),
) -> np.ndarray:
    """What each of some stops of the problem says by itself (n, S, S), of the components `keys`.

    Args:
        problem: of these stops alone.
        values: the state.
        keys: (S,).
        first, count: the stops' numbers in their recording: the first, and how many they are.
        unbounded: as of `of_all`.
    """
    scans = problem.scans
    met = list(in_order(lambda i: scans[i].associate(values, near_edges=True), len(scans)))
    problem = with_surfaces(problem, met)
    scans = problem.scans
    values = {n: u.mean for n, u in problem.variables.items()} | dict(values)
    values |= {name: problem.variables[name].mean for name in problem.cells}
    layout = Layout.of(problem, unbounded=unbounded)
    shared, placed = Shared.of(layout, keys), lidars(scans, values)
    bodies = _of_bodies(problem, values, layout)
    by_scan = {scan.index - first: i for i, scan in enumerate(scans)}

    def work(k: int) -> np.ndarray:
        i = by_scan.get(k)
        sums = None
        if i is not None:
            sums = StopRows.of(scans[i], layout, values, placed[i], met[i]).sums()
        return _left(shared, sums, bodies.get(first + k, []))

    return np.stack(list(in_order(work, count)))


def _of_bodies(
    problem: Problem, values: Mapping[str, np.ndarray], layout: Layout
) -> dict[int, list[tuple[np.ndarray, np.ndarray]]]:
    """Number of a stop -> whitened rows of its bodies, and the columns of these."""
    found: dict[int, list[tuple[np.ndarray, np.ndarray]]] = {}
    for together in BodiesTogether.of(problem.seen):
        for block, (_, d) in zip(together.blocks, together.evaluate(values), strict=True):
            columns = layout.columns(list(d))
            rows = np.split(np.hstack(list(d.values())), len(block.measured))
            for (_, k), A in zip(block.stop_names, rows, strict=True):
                found.setdefault(k, []).append((A, columns))
    return found


def _left(
    shared: Shared, sums: StopSums | None, bodies: Sequence[tuple[np.ndarray, np.ndarray]]
) -> np.ndarray:
    """What is left (S, S) of a stop's rows once its own unknowns, and their priors, are gone."""
    layout = shared.layout
    some = [columns for _, columns in bodies]
    some += [sums.chain_columns, sums.columns] if sums else []
    mine = np.unique(np.concatenate([np.zeros(0, int), *some]))
    at, size = positions(layout.size, mine), len(mine)
    whole = np.zeros((size, size))
    if sums:
        through = np.zeros((TWIST, size))
        through[:, at[sums.chain_columns]] = sums.chain
        place, gram = at[sums.columns], sums.whole()
        whole += through.T @ gram[:TWIST, :TWIST] @ through
        cross = through.T @ gram[:TWIST, TWIST + 1 :]
        add_both(whole, np.arange(size), place, cross)
        add_at(whole, place, place, gram[TWIST + 1 :, TWIST + 1 :])
    for A, columns in bodies:
        whole[np.ix_(at[columns], at[columns])] += A.T @ A
    unit = layout.sigma[mine]
    whole *= np.outer(unit, unit)
    own = shared.at[mine] < 0
    whole[own, own] += 1.0  # what was known of each before
    sets = [some[some >= 0] for some in (at[columns] for columns in layout.cells)]
    cells = np.concatenate([np.zeros(0, int), *sets])
    rest = np.setdiff1d(np.arange(size), cells)
    left = np.ascontiguousarray(whole[np.ix_(rest, rest)])
    if len(cells):
        block, cross = whole[np.ix_(cells, cells)], whole[np.ix_(cells, rest)]
        eliminate_apart(block, cross, left, [len(some) for some in sets if len(some)])
    inner, outer = np.flatnonzero(own[rest]), np.flatnonzero(~own[rest])
    out = np.zeros((shared.size, shared.size))
    kept = np.ascontiguousarray(left[np.ix_(outer, outer)])
    if len(inner):
        eliminate(left[np.ix_(inner, inner)], left[np.ix_(inner, outer)], kept)
    place = shared.at[mine[rest[outer]]]
    out[np.ix_(place, place)] = kept
    return out
