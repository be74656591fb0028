"""The usual graph: one `gtsam.CustomFactor` per point, over all unknowns of a workload."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cached_property, partial

import gtsam
import numpy as np
from workload import Values, Work

from calib.residuals.beams import Association, Rows
from calib.residuals.scan import ScanStop
from calib.solve.graph import Graph
from sensors.lidar import beams

RINGS = "ring_range_offset"


class PointFactors:
    """The graph of a workload, linearised at its start; what beams meet is kept.

    In its favour, each ring's offset and each error of the mesh is a key of its own, and where the
    rig's chain puts the LiDAR is computed beforehand, once per stop. With `given`, residuals and
    derivatives are too, so that a callback does no more than hand them over.
    """

    def __init__(self, work: Work, given: bool) -> None:
        self.work, self.given = work, given
        unknowns, singles = work.problem.variables, (RINGS, *work.problem.cells)
        rest = [u for u in unknowns.values() if u.name not in singles]
        self.rest = Graph(rest, work.problem.blocks)
        ends = len(rest) + np.cumsum([0, *(unknowns[name].dim for name in singles)])
        self.keys = {n: a + np.arange(unknowns[n].dim) for n, a in zip(singles, ends, strict=False)}

    @cached_property
    def graph(self) -> gtsam.NonlinearFactorGraph:
        """Priors, trackers and targets as ever, then point by point."""
        graph = gtsam.NonlinearFactorGraph(self.rest._graph)
        for name, keys in self.keys.items():
            known = self.work.problem.variables[name]
            if known.of_members:
                graph.add(_together(keys, known.sigma))
                continue
            for key, sigma in zip(keys, known.sigma, strict=True):
                noise = gtsam.noiseModel.Isotropic.Sigma(1, sigma)
                graph.add(gtsam.PriorFactorVector(key, np.zeros(1), noise))
        for i in range(len(self.work.problem.scans)):
            for factor in self._factors(i):
                graph.add(factor)
        return graph

    def _factors(self, i: int) -> Iterator[gtsam.CustomFactor]:
        scan, values = self.work.problem.scans[i], self.work.start
        rows = scan.rows(values, self.work.associations[i])
        placed = scan.stops.in_reference(self.work.source.rig.lidar_frame, values)
        chain = {name: d[0] for name, d in placed.d.items() if d.any()}
        keys = [self.rest._key[name] for name in chain]
        own = np.column_stack([self.keys[c.variable][c.components[c.index]] for c in rows.sparse])
        known = np.column_stack([c.index >= 0 for c in rows.sparse])
        make = _given if self.given else partial(_computed, self.work.associations[i])
        callbacks = make(rows, scan, placed.T[0], list(chain.values()), known)
        noise = gtsam.noiseModel.Unit.Create(1)
        for mine, there, callback in zip(own, known, callbacks, strict=True):
            yield gtsam.CustomFactor(noise, [*keys, *mine[there]], callback)

    def step(self) -> Values:
        """One Gauss-Newton step from the start, as GTSAM does it by default."""
        at = self.rest._to_gtsam(self.work.start)
        for name, keys in self.keys.items():
            for key, value in zip(keys, self.work.start[name], strict=True):
                at.insert(key, np.array([value]))
        after = at.retract(self.graph.linearize(at).optimize())
        singles = {
            name: np.concatenate([after.atVector(key) for key in keys])
            for name, keys in self.keys.items()
        }
        return self.rest._from_gtsam(after) | singles


def _given(
    rows: Rows, scan: ScanStop, T: np.ndarray, chain: list[np.ndarray], known: np.ndarray
) -> Iterator[Callable]:
    root = (np.sqrt(rows.weight) / rows.sigma_m)[:, None]
    residual = root * rows.residual_m[:, None]
    derivatives = [root * rows.by_twist @ d for d in chain]
    own = root * np.column_stack([c.value for c in rows.sparse])
    for n in range(len(root)):
        row = [d[n : n + 1] for d in derivatives] + list(own[n, known[n]].reshape(-1, 1, 1))
        yield partial(_hand_over, residual[n], gtsam.JacobianVector(row))


def _hand_over(residual, row, factor, values, jacobians):
    if jacobians is not None:
        jacobians[:] = row
    return residual


def _computed(
    met: Association,
    rows: Rows,
    scan: ScanStop,
    T: np.ndarray,
    chain: list[np.ndarray],
    known: np.ndarray,
) -> Iterator[Callable]:
    root = np.sqrt(rows.weight) / rows.sigma_m
    ray = beams(scan.recording.scan(scan.index).xyz_m, scan.lidar.beam_origin_m)
    normal, point = rows.view["normal"], np.where(rows.usable[:, None], rows.view["point_m"], 0)
    ring = np.array([c.variable == RINGS for c in rows.sparse])
    away_m = np.ones(
        (len(root), len(ring))
    )  # what a unit of each moves the surface by, at its point
    for k, column in enumerate(rows.sparse):
        cells = None if ring[k] else scan.cells[column.variable]
        if cells is not None and cells.axis is not None:
            away_m[:, k] = met.from_middle_m[cells.column][:, cells.axis]
    for n in range(len(root)):
        beam = ray.origin_m[n], ray.direction[n], ray.range_m[n]
        plane = normal[n], normal[n] @ point[n]
        mine = ring[known[n]], away_m[n, known[n]]
        yield partial(_compute, T, chain, *mine, beam, *plane, root[n])


def _compute(T, chain, ring, away_m, beam, normal, distance, root, factor, values, jacobians):
    if root == 0.0:
        normal = -T[:3, :3] @ beam[1]
    origin, direction, range_m = beam
    n = normal @ T[:3, :3]
    along = n @ direction
    t = (distance - normal @ T[:3, 3] - n @ origin) / along
    own = np.where(ring, -1.0, away_m / abs(along))  # a ring's offset, or along the normal
    shift = own @ [values.atVector(key)[0] for key in factor.keys()[len(chain) :]]
    n = n / along
    if jacobians is not None:
        x, y, z = origin + t * direction
        a, b, c = n
        by_twist = root * np.array([[y * c - z * b, z * a - x * c, x * b - y * a, a, b, c]])
        for i, d in enumerate(chain):
            jacobians[i] = by_twist @ d
        for i, d in enumerate(own):
            jacobians[len(chain) + i] = np.array([[root * d]])
    return np.array([root * (range_m - t + shift)])


def _together(keys: np.ndarray, sigma: np.ndarray) -> gtsam.CustomFactor:
    """What is known of numbers about zero whose mean is as uncertain as each is about it."""
    root = np.linalg.cholesky(np.linalg.inv(np.diag(sigma**2) + np.outer(sigma, sigma))).T

    def rows(_: gtsam.CustomFactor, values: gtsam.Values, jacobians: list | None) -> np.ndarray:
        for i in range(len(keys) if jacobians is not None else 0):
            jacobians[i] = np.asfortranarray(root[:, [i]])
        return root @ np.concatenate([values.atVector(int(key)) for key in keys])

    noise = gtsam.noiseModel.Unit.Create(len(keys))
    return gtsam.CustomFactor(noise, [int(key) for key in keys], rows)
