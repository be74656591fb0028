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
from functools import cache
from itertools import pairwise

import numpy as np
from scipy.linalg import block_diag

from calib.blunders.others import Alike, Others, at_their_sigmas, contradicted, whitening
from calib.blunders.rows import GroupRows, scan_rows
from calib.linear.symmetric import pinv
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
        turn: (q, q) from the rows' own axes to these, where they differ.
    """

    group: Group
    statistic: float
    dof: int
    offset: np.ndarray
    covariance: np.ndarray
    information: np.ndarray
    axes: tuple[str, ...]
    units: tuple[str, ...]
    squares: Squares = field(default_factory=dict)
    turn: np.ndarray | None = None

    @property
    def of_ranges(self) -> bool:
        """Whether it is a range zero, and not a place."""
        return list(self.axes) == [ALONG_BEAMS]

    @property
    def parts(self) -> Mapping[str, np.ndarray]:
        """Unit -> directions (r,) in it, which have one length together."""
        return _of_units(self.units)


@cache
def _of_units(units: tuple[str, ...]) -> dict[str, np.ndarray]:
    """Unit -> where it stands."""
    names = np.array(units)
    return {unit: np.flatnonzero(names == unit) for unit in dict.fromkeys(units)}


def shifts(others: Others) -> list[Shift]:
    """Every group of rows against all others."""
    found: dict[int, list[Shift]] = {}
    for some in others.alike():
        summed = some.rows[0].information is not None
        squares = [{}] * len(some.rows) if summed else list(_squares(some))
        for groups in some.groups():
            every = (_of_sums if summed else _of_rows)(some, groups, squares)
            for number, shift in zip(some.number, every, strict=True):
                found.setdefault(number, []).append(shift)
    return [shift for _, mine in sorted(found.items()) for shift in mine]


def standing_alone(others: Others, some: Sequence[tuple[Shift, float]]) -> list[Group]:
    """Of groups at different places that stand out, those that still do once the others are left
    out: what one of them does to the estimate makes others stand out. Taken up one by one, the
    worst first, and dropped again where those taken up later explain them (stepwise).

    With score u and information M of the shifts of all of them (``u = b``, ``M = I - H`` for rows),
    that of one beside others is their Schur complement.

    Args:
        others: as of `shifts`.
        some: shifts of these, and the limit of the statistic beyond which each stands out; the
            worst first.
    """
    wanted = {(shift.group, shift.of_ranges) for shift, _ in some}
    mine = {
        key: rows
        for rows in others.every()
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
    each = [np.arange(start, end) for start, end in pairwise(ends)]
    limits, gone, kept = np.array([limit for _, limit in some]), np.zeros(0, int), []
    for i, at in enumerate(each):
        if _statistic(M, u, np.append(gone, at)) - _statistic(M, u, gone) > limits[i]:
            gone, kept = np.append(gone, at), [*kept, i]
    while kept and min(beyond := _beside_others(M, u, [each[i] for i in kept]) - limits[kept]) <= 0:
        del kept[int(np.argmin(beyond))]
    return [order[i] for i in kept]


def _beside_others(M: np.ndarray, u: np.ndarray, each: Sequence[np.ndarray]) -> np.ndarray:
    """What each of some shifts (G,) explains that all others of them do not. With ``C`` the inverse
    of M, that is ``x_i^T C_ii^-1 x_i`` of ``x = C u``."""
    at = np.concatenate(each)
    whiten = _whitening_of(M, at)
    C, x = whiten @ whiten.T, whiten @ (whiten.T @ u[at])
    ends = np.cumsum([0, *map(len, each)]).tolist()
    parts = [slice(*pair) for pair in pairwise(ends)]
    return np.array([x[i] @ pinv(C[i, i]) @ x[i] for i in parts])


def beside_bodies(others: Others, whose: Collection[Whose], wild: Collection[Group]) -> Sums:
    """What rows that are of no body say of their sigmas; arguments as of
    `components.squares_beside_bodies`."""
    whole = others.whole
    return squares_beside_bodies(
        others.problem, whole.values, whole, others.kept, whose, others.graph_rows, wild
    )


def told_by_stop(others: Others, whose: Mapping[Whose, int], wild: Collection[Group]) -> ToldApart:
    """What rows of bodies and of joints say of their errors beyond their sigmas, all of a stop
    together and at their full weights, in these sigmas.

    Args:
        others: as of `shifts`.
        whose: rows that are asked -> the group that they are of.
        wild: blunders; stops that have one are not asked.
    """
    found = []
    for some, H, b in others.held:
        group = np.array([whose.get(each, -1) for rows in some for each in _whose(rows)])
        at = np.flatnonzero(group >= 0)
        if len(at) and not any(set(wild).intersection(rows.groups) for rows in some):
            H, score = at_their_sigmas(some, H, b)
            left = block_diag(*(rows.own_information for rows in some)) - H
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


def of_poses(others: Others, wild: Collection[Group]) -> Told | None:
    """What all rows say of twists (6 K) of the LiDAR at stops, those of a kind in one group: 0 of
    shifts, 1 of turns. Of the `wild` scans, nothing; None where there is no other. Where there are
    many stops, K of them, drawn evenly, stand for all."""
    every = [
        rows
        for rows in scan_rows(others.whole, others.problem)
        if not rows.of_ranges and not set(wild) & set(rows.groups)
    ]
    if not every:
        return None
    every = [every[i] for i in drawn_evenly(len(every), TELLING_SCANS, seed=0)]
    H, b = others.against(every)
    raw = block_diag(*(rows.information for rows in every))
    size = np.sqrt(np.maximum(np.diag(raw), 1e-300))
    values, axes, seen = contradicted((raw - H) / np.outer(size, size))
    values, axes = values[seen], axes[:, seen]
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
    return float(np.sum(np.square(_whitening_of(M, at).T @ u[at])))


def _whitening_of(M: np.ndarray, at: np.ndarray) -> np.ndarray:
    """`whitening` of some shifts, each in units of its own sigma."""
    return whitening(M[np.ix_(at, at)], np.sqrt(np.maximum(np.diag(M)[at], 1e-300)))[0]


def _of_sums(some: Alike, groups: Sequence[Group], squares: Sequence[Squares]) -> Iterator[Shift]:
    """The score tests of shifts that some rows of each stop alone have."""
    first = some.rows[0]
    own = first.groups[groups[0]]
    left, score = own.T @ some.left @ own, some.b @ own
    whiten, dof = whitening(left, some.size(own))
    score = np.vecmat(score, whiten)
    offset, covariance = np.matvec(whiten, score), whiten @ whiten.mT
    held = dof < left.shape[1]
    left[held] = 0.0
    found = np.square(score).sum(axis=1), dof, offset, covariance, left
    return _told(some, groups, np.argmax(own, axis=0), squares, found)


def _of_rows(some: Alike, groups: Sequence[Group], squares: Sequence[Squares]) -> Iterator[Shift]:
    """The residuals of groups under the fit without each; see the module."""
    first = some.rows[0]
    own = first.groups[groups[0]]
    values, axes, seen = contradicted(own.T @ some.left @ own)
    values = np.where(seen, values, 0.0)
    over = np.divide(1.0, values, out=np.zeros_like(values), where=seen)
    basis = own @ axes
    along = np.vecmat(some.b, basis) * over
    at = np.flatnonzero(np.any(own != 0, axis=1))
    turned = basis if first.turn is None else np.stack([r.turn for r in some.rows]) @ basis
    sigma = np.stack([rows.sigma[at] for rows in some.rows])[:, :, None]
    out, told = sigma * turned[:, at], turned[:, at] / sigma
    statistic = np.sum(values * np.square(along), axis=1)
    offset, covariance = -np.matvec(out, along), (out * over[:, None]) @ out.mT
    information = (told * values[:, None]) @ told.mT
    found = statistic, seen.sum(axis=1), offset, covariance, information
    return _told(some, groups, at, squares, found)


def _told(
    some: Alike,
    groups: Sequence[Group],
    at: np.ndarray,
    squares: Sequence[Squares],
    found: Sequence[np.ndarray],
) -> Iterator[Shift]:
    """The shifts of groups (K,) along rows (q,): what was found are statistics and dofs (K,),
    offsets (K, q), their covariances and informations (K, q, q)."""
    first = some.rows[0]
    axes, units = (tuple(each[i] for i in at) for each in (first.axes, first.units))
    every = zip(some.rows, groups, squares, *found, strict=True)
    for rows, group, its_squares, statistic, dof, offset, covariance, information in every:
        yield Shift(
            group=group,
            statistic=float(statistic),
            dof=int(dof),
            offset=offset,
            covariance=covariance,
            information=information,
            axes=axes,
            units=units,
            squares=its_squares,
            turn=rows.turn if len(at) == len(first.axes) else None,
        )


def _squares(some: Alike) -> Iterator[Squares]:
    """Of each place unit -> sum of squares of rows of it, and of their redundancies."""
    left = np.einsum("kii->ki", some.left)
    each = {
        unit: (np.square(some.b[:, at]).sum(axis=1), left[:, at].sum(axis=1))
        for unit, at in _of_units(tuple(some.rows[0].units)).items()
    }
    for k in range(len(some.rows)):
        yield {unit: (float(b[k]), float(of[k])) for unit, (b, of) in each.items()}
