"""By how much each group of rows is off what all other rows say of it.

Each group (a body at a stop, the joints there, a scan, a part of a target, a value on paper) is
held against the estimate that leaves it out. With whitened rows ``b = A d`` of a group and the
covariance C of all unknowns as fitted, ``H = A C A^T``, and

    e = (I - H)^-1 b        its residual under the fit without it
    V = (I - H)^-1          the covariance of e
    T = e^T V^-1 e = b^T (I - H)^-1 b

(Baarda 1968, A testing procedure for use in geodetic networks). Directions in which I - H is 0 are
held by the group alone: nothing contradicts it there. A scan is held against all others through a
twist of its LiDAR at that stop, which is the score test of the six columns of a mean shift. Robust
weights of other stops stay as they are, so that one wild row does not hide the next.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from scipy.linalg import block_diag

from calib.blunders.others import Others, at_their_sigmas, contradicted, parts, whitening
from calib.blunders.rows import GroupRows, group_rows, scan_rows
from calib.linear.system import Linearisation
from calib.problem.problem import Problem
from calib.problem.spread import Whose
from calib.problem.unknowns import is_read
from calib.residuals.groups import ALONG_BEAMS, Group
from calib.residuals.store import drawn_evenly
from calib.solve.components import Sums, squares_beside_bodies
from calib.solve.components.told import Told, ToldApart

# Scans that tell how places of the LiDAR scatter, of more: a choice. So many tell it to 1 part in
# 24, and the matrix over 6 unknowns of each is factored in 2 s, that of 1,000 in 40 s.
TELLING_SCANS = 300
TOLD_TOGETHER = {"body", "joints"}  # kinds of groups whose scatter is compared
Squares = Mapping[str, tuple[float, float]]


@dataclass(frozen=True)
class Shift:
    """A group of rows against all others.

    Args:
        group: which.
        statistic: T, in squared sigmas.
        dof: in how many directions anything contradicts it.
        offset: (q,) by how much it is off what all others say: as measured, less as predicted.
        covariance: (q, q) of the offset.
        information: (q, q) of an offset, all else being estimated.
        axes: (q,) names of the directions.
        units: (q,) "m" or "rad" each.
        squares: unit -> sum of squares of its whitened rows, and of their redundancies; of rows.
    """

    group: Group
    statistic: float
    dof: int
    offset: np.ndarray
    covariance: np.ndarray
    information: np.ndarray
    axes: Sequence[str]
    units: Sequence[str]
    squares: Squares = field(default_factory=dict)

    @property
    def of_ranges(self) -> bool:
        """Whether it is a range zero, and not a place."""
        return list(self.axes) == [ALONG_BEAMS]

    @cached_property
    def parts(self) -> dict[str, np.ndarray]:
        """Unit -> directions (r,) in it, which have one length together."""
        units = np.array(self.units)
        return {unit: np.flatnonzero(units == unit) for unit in dict.fromkeys(self.units)}


def shifts(whole: Linearisation, problem: Problem) -> Iterator[Shift]:
    """Every group of rows against all others.

    Args:
        whole: all rows at the solution of a fit, with its scans.
        problem: of that fit; candidates beside it change nothing.
    """
    others = Others.of(whole)
    for sets in others.groups(problem):
        yield from _against(others, sets)


def standing_alone(
    whole: Linearisation, problem: Problem, some: Sequence[tuple[Shift, float]]
) -> list[Group]:
    """Of groups at different places that stand out, those that still do once those before them are
    left out: what one of them does to the estimate makes others stand out.

    With score u and information M of the shifts of all of them (``u = b``, ``M = I - H`` for rows),
    that of one beside others is their Schur complement.

    Args:
        whole, problem: as of `shifts`.
        some: shifts of these, and the limit of the statistic beyond which each stands out; the
            worst first.
    """
    others = Others.of(whole)
    wanted = {(shift.group, shift.of_ranges) for shift, _ in some}
    mine = {
        key: rows
        for rows in group_rows(whole, problem, others.graph_rows)
        for group in rows.groups
        if (key := (group, rows.of_ranges)) in wanted
    }
    order = [shift.group for shift, _ in some]
    every = [mine[shift.group, shift.of_ranges] for shift, _ in some]
    H, b = at_their_sigmas(every, *others.against(every))
    own = block_diag(*(rows.groups[group] for group, rows in zip(order, every, strict=True)))
    raw = block_diag(*(rows.own_information for rows in every))
    M, u = own.T @ (raw - H) @ own, own.T @ b
    ends = np.cumsum([0, *(rows.groups[g].shape[1] for g, rows in zip(order, every, strict=True))])
    gone, alone = np.zeros(0, int), []
    for (shift, limit), start, end in zip(some, ends, ends[1:], strict=False):
        at = np.arange(start, end)
        if _statistic(M, u, np.append(gone, at)) - _statistic(M, u, gone) > limit:
            gone, alone = np.append(gone, at), [*alone, shift.group]
    return alone


def beside_bodies(
    whole: Linearisation,
    problem: Problem,
    whose: Collection[Whose],
    wild: Collection[Group],
) -> Sums:
    """What rows that are of no body say of their sigmas; arguments as of
    `components.squares_beside_bodies`."""
    others = Others.of(whole)
    return squares_beside_bodies(
        problem, whole.values, whole, others.kept, whose, others.graph_rows, wild
    )


def told_by_stop(
    whole: Linearisation, problem: Problem, whose: Mapping[Whose, int], wild: Collection[Group]
) -> ToldApart:
    """What rows of bodies and of joints say of their errors beyond their sigmas, all of a stop
    together and at their full weights, in these sigmas.

    Args:
        whole, problem: as of `shifts`.
        whose: rows that are asked -> the group that they are of.
        wild: blunders; stops that have one are not asked.
    """
    others, found = Others.of(whole), []
    for sets in others.groups(problem):
        H, b = others.against([rows for some in sets for rows in some])
        for some, mine in zip(sets, parts(sets), strict=True):
            group = np.array([whose.get(each, -1) for rows in some for each in _whose(rows)])
            at = np.flatnonzero(group >= 0)
            if len(at) and not any(set(wild).intersection(rows.groups) for rows in some):
                left, score = at_their_sigmas(some, H[mine, mine], b[mine])
                left = block_diag(*(rows.own_information for rows in some)) - left
                found.append(Told(score[at], left[np.ix_(at, at)], group[at]))
    return ToldApart.at_stops(found)


def _whose(rows: GroupRows) -> list[Whose | None]:
    """Whose each row (m,) is, of a body or a joint that is read; None of others."""
    kinds = {group.kind for group in rows.groups}
    if rows.information is not None or not kinds <= TOLD_TOGETHER:
        return [None] * len(rows.A)
    (kind,) = kinds
    what, known = next(iter(rows.groups)).what, is_read(np.abs(rows.sigma))
    if kind == "body":
        return [Whose("body", what, unit) for unit in rows.units]
    each = zip(rows.axes, rows.units, known, strict=True)
    return [Whose("joints", axis, unit) if there else None for axis, unit, there in each]


def of_poses(whole: Linearisation, problem: Problem, wild: Collection[Group]) -> Told | None:
    """What all rows say of twists (6 K) of the LiDAR at stops, those of a kind in one group: 0 of
    shifts, 1 of turns. Of the `wild` scans, nothing; None where there is no other. Where there are
    many stops, K of them, drawn evenly, stand for all."""
    every = [
        rows
        for rows in scan_rows(whole, problem)
        if not rows.of_ranges and not set(wild) & set(rows.groups)
    ]
    if not every:
        return None
    every = [every[i] for i in drawn_evenly(len(every), TELLING_SCANS, seed=0)]
    H, b = Others.of(whole).against(every)
    raw = block_diag(*(rows.information for rows in every))
    size = np.sqrt(np.maximum(np.diag(raw), 1e-300))
    values, axes = contradicted((raw - H) / np.outer(size, size))
    told, along = size[:, None] * axes * values, size[:, None] * axes
    return Told(
        score=along @ (axes.T @ (b / size)),
        information=told @ along.T,
        group=np.tile(np.repeat([1, 0], 3), len(every)),
    )


def _statistic(M: np.ndarray, u: np.ndarray, at: np.ndarray) -> float:
    """``u^T M^-1 u`` of some shifts, in the directions that anything contradicts."""
    if not len(at):
        return 0.0
    size = np.sqrt(np.maximum(np.diag(M)[at], 1e-300))
    return float(np.sum(np.square(whitening(M[np.ix_(at, at)], size).T @ u[at])))


def _against(others: Others, sets: Sequence[Sequence[GroupRows]]) -> Iterator[Shift]:
    """Groups against all other rows."""
    H, b = others.against([rows for some in sets for rows in some])
    for some, mine in zip(sets, parts(sets), strict=True):
        yield from _of_set(some, *at_their_sigmas(some, H[mine, mine], b[mine]))


def _of_set(some: Sequence[GroupRows], H: np.ndarray, b: np.ndarray) -> Iterator[Shift]:
    for rows, here in zip(some, parts([rows] for rows in some), strict=True):
        left, squares = rows.own_information - H[here, here], {}
        of = _of_sums
        if rows.information is None:
            of, squares = _of_rows, _squares(rows, b[here], np.diag(left))
        for group, own in rows.groups.items():
            yield of(group, own, rows, b[here], left, squares)


def _of_sums(
    group: Group,
    own: np.ndarray,
    rows: GroupRows,
    score: np.ndarray,
    left: np.ndarray,
    squares: Squares,
) -> Shift:
    """The score test of a shift that some rows of the stop alone have."""
    left, score = own.T @ left @ own, own.T @ score
    size = np.sqrt(np.maximum(np.diag(own.T @ rows.information @ own), 1e-300))
    at = np.argmax(own, axis=0)
    whiten = whitening(left, size)
    score = whiten.T @ score
    return Shift(
        group=group,
        statistic=float(score @ score),
        dof=len(score),
        offset=whiten @ score,
        covariance=whiten @ whiten.T,
        information=left if len(score) == len(left) else np.zeros_like(left),
        axes=[rows.axes[i] for i in at],
        units=[rows.units[i] for i in at],
        squares=squares,
    )


def _of_rows(
    group: Group,
    own: np.ndarray,
    rows: GroupRows,
    b: np.ndarray,
    left: np.ndarray,
    squares: Squares,
) -> Shift:
    """The residual of a group under the fit without it; see the module."""
    values, axes = contradicted(own.T @ left @ own)
    basis = own @ axes
    along = (basis.T @ b) / values
    at = np.flatnonzero(np.any(own != 0, axis=1))
    turned = (basis if rows.turn is None else rows.turn @ basis)[at]
    out, told = rows.sigma[at][:, None] * turned, turned / rows.sigma[at][:, None]
    return Shift(
        group=group,
        statistic=float(along @ (values * along)),
        dof=len(values),
        offset=-out @ along,
        covariance=(out / values) @ out.T,
        information=(told * values) @ told.T,
        axes=[rows.axes[i] for i in at],
        units=[rows.units[i] for i in at],
        squares=squares,
    )


def _squares(rows: GroupRows, b: np.ndarray, left: np.ndarray) -> Squares:
    """Unit -> sum of squares (m,) of rows of it, and of their redundancies `left`."""
    units = np.array(rows.units)
    return {
        unit: (float(np.square(b[units == unit]).sum()), float(left[units == unit].sum()))
        for unit in dict.fromkeys(rows.units)
    }
