"""One pass over all rows: the normal equations of model and candidates, and who says what.

At the solution of a fit every row is linear in what the model estimates and in what it does not:
``b = J d + Z g + noise``, whitened. The tests need two things of a million such rows: the Gram
matrix of ``[J | Z]``, and the gradient ``[J | Z]^T b`` of each cluster of rows that err together.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.sparse import csr_array, vstack

from calib.fit import Estimate, Progress
from calib.forward import Values
from calib.graph import Block, Graph
from calib.problem import Problem
from calib.residuals.beams import Rows, unknown_columns
from calib.residuals.rows import Group, gram
from calib.residuals.scan import ScanStop
from calib.residuals.surfaces import Meeting
from calib.residuals.tracker import TrackedBody

# What paper says of the hardware is no evidence against a candidate: its sigmas are widened so much
# that what only they would tell apart counts as a gauge.
WIDENED = 100.0
PLACES = ("surface", "plane")  # beams that meet the same one share its error


@dataclass(frozen=True)
class Linear:
    """Normal equations of U unknowns about a solution, and their right side by clusters of rows.

    Args:
        candidates: variables that the model does not have.
        at: variable -> its columns among the unknowns.
        information: (U, U) Gram matrix of all whitened rows, the model's priors included.
        gradient: (C, U) sparse, of each cluster; their sum is the whole gradient.
        stop: (C,) which stop the rows of a cluster belong to, -1 for none.
        place: (C,) which part of the room they look at, -1 for none.
        weight_m2: sum of the beams' weights over their variances [1/m2].
    """

    candidates: tuple[str, ...]
    at: dict[str, slice]
    information: np.ndarray
    gradient: csr_array
    stop: np.ndarray
    place: np.ndarray
    weight_m2: float


def linearise(
    wide: Problem, estimate: Estimate, candidates: Sequence[str], progress: Progress
) -> Linear:
    """Linearise a problem that holds candidates beside the model, at the model's solution.

    Args:
        wide: the model's problem with the candidates' variables added.
        estimate: the model's solution.
        candidates: variables that the model does not have; they have no prior here.
        progress: called with what is being done, how many stops are done, and of how many.
    """
    variables = list((wide.variables | estimate.graph.variables).values())
    values = {n: wide.variables[n].mean for n in candidates} | estimate.values
    graph = Graph(variables, wide.blocks, frozenset(candidates))
    sums = _Sums(graph, values, wide.meetings)
    for i, scan in enumerate(wide.scans):
        progress("testing what is missing", i, len(wide.scans))
        surfaces = [t for t in estimate.scans[i].terms if t.variable not in wide.variables]
        scan = replace(scan, terms=[*scan.terms, *surfaces])
        room = next((t.variable.partition("/")[0] for t in surfaces), str(scan.recording.folder))
        sums.add_scan(scan, scan.rows(values, estimate.associations[i]), room)
    priors = []
    for block, by, b in graph.linear_rows(values):
        if block is None:
            priors.append((*by.items(), b))
        else:
            sums.add_block(block, by, b)
    for (name, A), b in priors:
        scale = 1.0 / WIDENED if name in wide.calibration else 1.0
        sums.add_prior(name, scale * A, scale * b)
    return sums.total(candidates)


@dataclass
class _Sums:
    """Adds rows up."""

    graph: Graph
    values: Values
    meetings: Mapping[int, Meeting]
    at: dict[str, slice] = field(default_factory=dict)
    stops: dict[object, int] = field(default_factory=dict)
    places: dict[object, int] = field(default_factory=dict)
    known_to: dict[str, set[int]] = field(default_factory=dict)
    gradients: list[csr_array] = field(default_factory=list)
    clusters: list[np.ndarray] = field(default_factory=list)
    weight_m2: float = 0.0

    def __post_init__(self) -> None:
        start = 0
        for name, variable in self.graph.variables.items():
            self.at[name] = slice(start, start + variable.dim)
            start += variable.dim
        self.information = np.zeros((start, start))

    def total(self, candidates: Sequence[str]) -> Linear:
        """What was added up."""
        stop, place = np.concatenate(self.clusters, axis=1)
        gradient = csr_array(vstack(self.gradients))
        return Linear(
            tuple(candidates), self.at, self.information, gradient, stop, place, self.weight_m2
        )

    def add_scan(self, scan: ScanStop, rows: Rows, room: str) -> None:
        """A stop's beams; their clusters are the places in the room that they meet."""
        parts, groups = unknown_columns(rows)
        weight = rows.weight / np.square(rows.sigma_m)
        dense = np.hstack([rows.by_twist, *rows.dense.values()])
        kind = next(name for name in PLACES if name in rows.view.columns)
        found, cluster = np.unique(rows.view[kind], return_inverse=True)
        gradient = _by_cluster(dense, groups, -weight * rows.residual_m, cluster, len(found))
        # The twist is the doing of all that places the lidar; other columns are unknowns as such.
        placed = scan.stops.in_reference(scan.stops.rig.lidar_frame, self.values)
        chain = np.hstack([d[0] for d in placed.d.values()])
        columns = [*map(self._columns, placed.d)]
        columns += [self._columns(p.variable)[p.components] for p in parts]
        columns = np.concatenate(columns)
        local = gram(dense, groups, weight)
        self.information[np.ix_(columns, columns)] += _chained(_chained(local, chain).T, chain)
        places = [self._number(self.places, (room, p)) for p in found.tolist()]
        stop = self._number(self.stops, (scan.recording.folder, scan.index))
        stops = np.full(len(found), stop)
        self._add(_chained(gradient, chain), columns, stops, np.array(places))
        for name in scan.stops.variables:
            self.known_to.setdefault(name, set()).add(stop)
        self.weight_m2 += float(weight.sum())

    def add_block(self, block: Block, by: dict[str, np.ndarray], b: np.ndarray) -> None:
        """Rows of trackers and targets: whitened derivatives, and what is left."""
        columns = np.concatenate([self._columns(name) for name in by])
        A = np.hstack(list(by.values()))
        self.information[np.ix_(columns, columns)] += A.T @ A
        if isinstance(block, TrackedBody):
            count = len(block.stop_names)
            stop = np.array([self._number(self.stops, name) for name in block.stop_names])
            each = A.reshape(count, -1, len(columns)), b.reshape(count, -1)
            self._add(np.einsum("kri,kr->ki", *each), columns, stop, np.full(count, -1))
            for name in by:
                self.known_to.setdefault(name, set()).update(stop.tolist())
        else:
            place = np.array([self._number(self.places, block.name)])
            self._add((A.T @ b)[None], columns, np.array([-1]), place)
            for name in by:
                self.known_to.setdefault(name, set()).add(-1)

    def add_prior(self, name: str, A: np.ndarray, b: np.ndarray) -> None:
        """A prior: it belongs to the one stop, or to the surface, whose error it bounds."""
        columns = self._columns(name)
        self.information[np.ix_(columns, columns)] += A.T @ A
        known = self.known_to.get(name, set())
        room, _, kind = name.partition("/reference_")
        dofs = self.graph.variables[name].dofs
        nowhere = np.full(len(b), -1)
        if len(known) == 1:
            self._add(A * b[:, None], columns, np.full(len(b), *known), nowhere)
            return
        if kind:
            parts = np.array([int(dof.rpartition("_")[2]) for dof in dofs])
            keys = [(room, s) for s in self.meetings[int(room)].surface_of(kind, parts).tolist()]
        else:
            keys = [(name, dof) for dof in dofs]
        place = np.array([self._number(self.places, key) for key in keys])
        self._add(A * b[:, None], columns, nowhere, place)

    def _add(
        self, gradient: np.ndarray, columns: np.ndarray, stop: np.ndarray, place: np.ndarray
    ) -> None:
        found = csr_array(gradient)
        found = csr_array(
            (found.data, columns[found.indices], found.indptr),
            shape=(len(stop), len(self.information)),
        )
        self.gradients.append(found)
        self.clusters.append(np.stack([stop, place]))

    def _columns(self, variable: str) -> np.ndarray:
        return np.arange(self.at[variable].start, self.at[variable].stop)

    def _number(self, among: dict[object, int], key: object) -> int:
        return among.setdefault(key, len(among))


def _chained(rows: np.ndarray, chain: np.ndarray) -> np.ndarray:
    """Rows over [twist | others] as rows over [what the twist depends on | others]."""
    return np.hstack([rows[:, :6] @ chain, rows[:, 6:]])


def _by_cluster(
    dense: np.ndarray, groups: Sequence[Group], b: np.ndarray, cluster: np.ndarray, count: int
) -> np.ndarray:
    """``[dense | groups]^T b`` of each cluster of rows, (count, columns)."""
    rows = len(b)
    pick = csr_array((b, cluster, np.arange(rows + 1)), shape=(rows, count))
    out = [pick.T @ dense]
    for g in groups:
        flat = np.where(g.index >= 0, cluster * g.size + g.index, 0)
        value = np.where(g.index >= 0, g.value * b, 0.0)
        out.append(np.bincount(flat, value, count * g.size).reshape(count, g.size))
    return np.hstack(out)
