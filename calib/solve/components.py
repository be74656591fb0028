"""How widely values scatter that chance draws anew: variance components, by REML.

Values ``u ~ N(0, D)`` of the members of some groups, D diagonal with one variance for each group,
are unknowns of the graph. All rows but their priors say of them, everything else being estimated,
``g = M u + e`` with ``e ~ N(0, M)``: score and information. So ``g ~ N(0, M + M D M)``, and the
variances of greatest likelihood are those of restricted maximum likelihood (Patterson and Thompson
1971). With C the covariance of u as fitted, ``M = C^-1 - D^-1`` and ``g = C^-1 u``.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import minimize, minimize_scalar

from calib.linear.clusters import Entries, over_all
from calib.linear.elimination import inverse_and_log_det
from calib.linear.system import Linearisation, Values
from calib.problem.places import joints_at
from calib.problem.problem import Block, Problem, SurfaceCells
from calib.problem.spread import Whose, by_chance, read, sigmas, spread_keys, widening
from calib.problem.unknowns import Unknown
from calib.problem.without import ROD
from calib.residuals.groups import Group
from calib.residuals.seen import BodiesTogether, SeenBody
from calib.residuals.targets import PARTS_OF_SIGMAS, TARGET_PARTS, HangingTarget
from calib.solve.estimate import Estimate

PRECISE = {"ftol": 1e-15, "gtol": 1e-7}  # of twice a log-likelihood: sds to some 1e-6 of theirs
LEAST_SD = 1e-3  # of the sd that a group starts from: what is smaller counts as none
LARGEST_SD = 1e6  # times that: far from an optimum scores are of any size, and squares overflow
DIRECTION_SEEN = 1e-9  # of the largest information, below which a direction of values is not seen
# Of a variance; no less and no more is found at once. Joints read to 0.1 mrad may scatter by 1 rad.
GROWN = np.geomspace(1e-3, 1e8, 78) - 1.0
UNSEEN_REDUNDANCY = 1e-6  # of a redundancy: rounding of a covariance is some 1e-9 of it
UNTOLD_ROWS = 1e-6  # rows: what fewer tell of a variance is nothing
READINGS_TOGETHER = 400  # joint readings whose covariance is computed at once: bounds the memory


@dataclass(frozen=True)
class Told:
    """What all rows but their priors say of values by chance (Q,).

    Args:
        score: (Q,) at zero, all else being estimated there.
        information: (Q, Q), all else being estimated.
        group: (Q,) which group each belongs to, from 0.
    """

    score: np.ndarray
    information: np.ndarray
    group: np.ndarray

    @classmethod
    def fitted(
        cls, values: np.ndarray, covariance: np.ndarray, variance: np.ndarray, group: np.ndarray
    ) -> Told:
        """From the values (Q,) as fitted, their covariance (Q, Q) and the variances (Q,) that they
        were held by; the group (Q,) of each is a number from 0."""
        root = np.sqrt(variance)
        scaled = np.linalg.inv(covariance / np.outer(root, root))
        information = (scaled - np.eye(len(values))) / np.outer(root, root)
        score = (scaled @ (values / root)) / root
        return cls(score, (information + information.T) / 2, group)

    def spread(self, start: np.ndarray) -> np.ndarray:
        """The sd (G,) of each group.

        Args:
            start: (G,) sd to start from.
        """
        first = 2.0 * np.log(start)
        ends = [first + 2.0 * np.log(times) for times in (LEAST_SD, LARGEST_SD)]
        bounds = np.stack(ends, axis=1)
        best = minimize(
            self._unlikely, first, jac=True, method="L-BFGS-B", bounds=bounds, options=PRECISE
        )
        return np.exp(best.x / 2.0)

    def _unlikely(self, log_variance: np.ndarray) -> tuple[float, np.ndarray]:
        """Minus the restricted log-likelihood, twice, and its derivative (G,) by the logs of the
        variances: nought where the squares of the values are as many variances as all rows tell of
        (MacKay 1992)."""
        variance = np.exp(log_variance)
        values, covariance, log_det = self._given(variance)
        count = np.bincount(self.group, minlength=len(variance))
        told = count - np.bincount(self.group, np.diag(covariance)) / variance
        slope = told - np.bincount(self.group, np.square(values)) / variance
        return log_det - float(self.score @ values), slope

    def of(self, group: int) -> Told:
        """Of one group, all others being 0."""
        at = np.flatnonzero(self.group == group)
        return Told(self.score[at], self.information[np.ix_(at, at)], np.zeros(len(at), int))

    def statistic(self, sd: np.ndarray) -> float:
        """Twice the log of the likelihood ratio of the sds (G,) against none."""
        values, _, log_det = self._given(np.square(sd))
        return float(self.score @ values) - log_det

    def _given(self, variance: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        """The values (Q,) and their covariance, given the variances of the groups; and by how much
        the log of the determinant of what is told of them grows."""
        root = np.sqrt(variance)[self.group]
        inner = np.eye(len(root)) + root[:, None] * self.information * root
        of_inner, log_det = inverse_and_log_det(inner)
        covariance = root[:, None] * of_inner * root
        return covariance @ self.score, covariance, log_det

    def sigma(self, sd: np.ndarray) -> np.ndarray:
        """Of the sds (G,), from the expected information of the variances: ``tr(P E_i P E_j) / 2``
        with ``P = M - M C M``; of one that is no more than that, the sd of such a variance."""
        _, covariance, _ = self._given(np.square(sd))
        P = self.information - self.information @ covariance @ self.information
        sums = np.zeros((len(sd), len(sd)))
        np.add.at(sums, (self.group[:, None], self.group), np.square(P) / 2)
        scale = np.sqrt(np.maximum(np.diag(sums), 1e-300))
        inverse = np.linalg.pinv(sums / np.outer(scale, scale)) / np.outer(scale, scale)
        of_variance = np.sqrt(np.maximum(np.diag(inverse), 0.0))
        beyond = np.sqrt(np.square(sd) + of_variance) - sd
        return np.where(of_variance < 2 * np.square(sd), of_variance / (2 * sd), beyond)


def told(some: Sequence[Unknown], values: Mapping[str, np.ndarray], covariance: np.ndarray) -> Told:
    """What all rows say of some unknowns by chance; `covariance` is their joint one, as fitted."""
    return Told.fitted(
        np.concatenate([values[u.name] for u in some]),
        covariance,
        np.square(np.concatenate([u.sigma for u in some])),
        groups(some),
    )


def groups(some: Sequence[Unknown]) -> np.ndarray:
    """Which spread (Q,) each value of some unknowns by chance has, in the order of their keys."""
    out, count = [], 0
    for unknown in some:
        of = np.zeros(unknown.dim, int)
        for at in spread_keys(unknown).values():
            of[at] = count
            count += 1
        out.append(of)
    return np.concatenate(out)


def sds(some: Sequence[Unknown]) -> dict[str, float]:
    """Key of each spread of some unknowns by chance -> what it is."""
    return {key: float(u.sigma[at[0]]) for u in some for key, at in spread_keys(u).items()}


@dataclass(frozen=True)
class Checks:
    """What residuals (n,) of rows with one sigma, whitened and independent, say of that sigma.

    A residual has the variance ``r + d r^2``, r its redundancy and d by how much more the rows'
    variance is than their sigma has it. Rows that check each other alone have r = 1; joint readings
    also show what bodies and beams err by, and little of what they err by themselves.

    Args:
        square: (n,) of each residual; sum of so many.
        redundancy: (n,) r.
        count: (n,) how many there are of each.
    """

    square: np.ndarray
    redundancy: np.ndarray
    count: np.ndarray

    @classmethod
    def alone(cls, total: float, left: float) -> Checks:
        """Of rows that check each other: the sum of their squares, and of their redundancies."""
        return cls(np.array([total]), np.ones(1), np.array([left]))

    @classmethod
    def of(cls, residual: np.ndarray, redundancy: np.ndarray) -> Checks:
        """Of residuals (m,) whose covariance is the redundancy (m, m), where sigmas are right."""
        values, axes = np.linalg.eigh(redundancy)
        seen = values > UNSEEN_REDUNDANCY  # in the others nothing checks the rows: residuals are 0
        square = np.square(axes[:, seen].T @ residual)
        return cls(square, np.minimum(values[seen], 1.0), np.ones(int(seen.sum())))

    @classmethod
    def together(cls, some: Sequence[Checks]) -> Checks:
        """Of all of these rows."""
        return cls(
            square=np.concatenate([each.square for each in some]),
            redundancy=np.concatenate([each.redundancy for each in some]),
            count=np.concatenate([each.count for each in some]),
        )

    @property
    def total(self) -> float:
        """Sum of squares, about `left` where the sigma is right (Foerstner 1979)."""
        return float(self.square.sum())

    @property
    def left(self) -> float:
        """The redundancy of all rows."""
        return float(self.count @ self.redundancy)

    @property
    def told(self) -> float:
        """How many rows without error beside them would tell as much of the variance."""
        return float(self.count @ np.square(self.redundancy))

    @property
    def dof(self) -> float:
        """Of the chi-square that `total` is in `scaled` units, of the same mean and variance
        (Satterthwaite 1946)."""
        return self.left**2 / self.told

    @property
    def scaled(self) -> float:
        return self.total * self.left / self.told

    def growth(self) -> float:
        """The d of greatest restricted likelihood, down to -1 where nothing tells."""
        if self.told <= 0:
            return -1.0
        best = int(np.argmax([self.statistic(d) for d in GROWN]))
        around = GROWN[max(best - 1, 0)], GROWN[min(best + 1, len(GROWN) - 1)]
        found = minimize_scalar(
            lambda x: -self.statistic(np.expm1(x)), bounds=np.log1p(around), method="bounded"
        )
        return float(np.expm1(found.x))

    def sigma(self, d: float) -> float:
        """Sigma of `growth` where that is d."""
        weight = self.count @ np.square(self.redundancy / (1.0 + d * self.redundancy))
        return float(np.sqrt(2.0 / max(weight, UNTOLD_ROWS)))

    def statistic(self, d: float) -> float:
        """Twice the log of the likelihood ratio of d against none."""
        grown = 1.0 + d * self.redundancy
        return float(self.square @ (d / grown) - self.count @ np.log(grown))

    def had_variance(self, share: float) -> Checks:
        """What they would be had the rows' sigma this share of its variance."""
        r = self.redundancy
        grown = 1.0 - r + share * r
        return Checks(share * self.square / grown**2, share * r / grown, self.count)


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
    for each in (each for each in whose if each.kind == "joints"):
        if good := [u for u in read(problem, each.unit) if u.name not in off]:
            out[each] = _of_joints(good, each.unit, values, linear, kept)
    return out


def _of_joints(
    some: Sequence[Unknown], unit: str, values: Values, linear: Linearisation, kept: np.ndarray
) -> Checks:
    """Of what encoders misreport, about the zero that they say."""
    at = [u.read(unit) for u in some]
    residual = [(values[u.name] / u.prior_sigma)[i] for u, i in zip(some, at, strict=True)]
    sigma = [u.prior_sigma[i] for u, i in zip(some, at, strict=True)]
    columns = [linear.layout.columns([u.name])[i] for u, i in zip(some, at, strict=True)]
    parts, found = (np.concatenate(each) for each in (residual, sigma, columns)), []
    batches = (np.array_split(part, -(-len(part) // READINGS_TOGETHER)) for part in parts)
    for v, s, c in zip(*batches, strict=True):
        rows = over_all([Entries.one_each(1.0 / s, c)], linear.layout.size)
        found.append(Checks.of(v, np.eye(len(c)) - linear.covariance(rows, kept)))
    return Checks.together(found)


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
        weight = np.ones(len(TARGET_PARTS)) if block.weight is None else block.weight
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


def wider(problem: Problem, sums: Sums) -> dict[str, float]:
    """Key of a spread -> how widely rows scatter beyond their first sigma, as they have it."""
    out, known = {}, sigmas(problem)
    for key, whose in widening(problem).items():
        sigma, beyond = known[whose]
        grown = sums.get(whose, NO_CHECKS).growth()
        out[key] = float(np.sqrt(max(grown * sigma**2 + beyond**2, 0.0)))
    return out


def spreads(estimate: Estimate) -> dict[str, tuple[float, float]]:
    """Key of a spread, an unknown by chance or what widens rows -> that spread, and its sigma."""
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
    return out


def sigma_beyond(sd: float, of_variance: float) -> float:
    """Sigma of a spread beyond a known sigma, from that of the variance."""
    return float(np.sqrt(sd**2 + of_variance) - sd)
