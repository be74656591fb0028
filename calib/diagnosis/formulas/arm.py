"""Poses of an arm under a tracker, as a table to try formulas of a joint on.

What trackers see at a pose is turned so that one row is how far a joint seems to be from its
reading, and no other row depends on that joint (Householder 1958). That row takes the place of a
beam; all others stay beside it, as do targets and priors.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import chain

import numpy as np
from scipy.sparse import csr_array

from calib.diagnosis.formulas.factors import covariates_of
from calib.diagnosis.formulas.table import BeamTable, rows_of_others
from calib.diagnosis.linear import beside
from calib.diagnosis.stand import Stand, variables_of
from calib.effects.own.formula import FormulaEffect
from calib.linear.clusters import Gradients
from calib.linear.layout import Layout
from calib.problem.build import stops_view

# Unknowns that stops share: with more no table is made.
MOST_UNKNOWNS = 3000
ANGLE_SEEN = 1e-6  # of the largest: a joint whose angle changes less at a pose is not seen there


def joint_tables(stand: Stand) -> Iterator[tuple[str, BeamTable]]:
    """Each joint that the trackers see, and its table, in rad, or in m of a linear one:
    `residual_m` is how much further it is moved than it says, `sigma_m` how well one pose tells.
    Not of a passive one, which is where the rest of the arm has it."""
    rig = stand.sources[0].rig
    read = {n: unit for n, unit in rig.joint_units.items() if n not in rig.passive}
    if not read:
        return
    levers = [_lever(i, *each) for i, each in enumerate(read.items())]
    wide, values = beside(
        stand.problem_of(stand.model.plus(tuple(effect for _, effect in levers))), stand.estimate
    )
    turned = variables_of(wide, {effect.name for _, effect in levers})
    layout = Layout.of(wide, unbounded=[*chain(*turned.values())])
    rows = rows_of_others(wide, layout, values, Gradients(layout.size))
    shared = _shared(layout)
    A, *of_rows = _without_own(layout, shared, *rows)
    if A.shape[1] > MOST_UNKNOWNS:
        return
    covariates = _covariates(stand, layout)
    columns = {joint: layout.columns(turned[effect.name]) for joint, effect in levers}
    at = {joint: np.searchsorted(shared, mine) for joint, mine in columns.items()}
    model = np.setdiff1d(np.arange(len(shared)), np.concatenate(list(at.values())))
    for joint, columns in at.items():
        if found := _table(A[:, model], A[:, columns].sum(axis=1), *of_rows, covariates):
            weight = sum(len(body.measured) / body.sigma_m**2 for body in wide.bodies)
            known = {"joints": frozenset(rig.joint_names), "turning": rig.turning}
            yield joint, replace(found, weight_m2=weight, unit=read[joint], **known)


def _shared(layout: Layout) -> np.ndarray:
    """Columns (M,) of unknowns that no stop has for itself."""
    own = np.concatenate([np.zeros(0, int), *layout.own.values()])
    return np.setdiff1d(np.arange(layout.size), own)


def _without_own(
    layout: Layout,
    shared: np.ndarray,
    A: csr_array,
    b: np.ndarray,
    stop: np.ndarray,
    place: np.ndarray,
) -> tuple[np.ndarray, ...]:
    """Rows as `rows_of_others` has them, over the shared columns (M,): of each stop those that its
    own unknowns, as joints' misreadings are, leave (elimination by orthogonal rows: Golub 1965)."""
    right = np.column_stack([A[:, shared].toarray(), b])
    order = np.argsort(stop, kind="stable")
    numbers = list(layout.own)
    first, end = (np.searchsorted(stop[order], numbers, side) for side in ("left", "right"))
    left = np.ones(len(b), bool)
    for number, start, stopped in zip(numbers, first, end, strict=True):
        rows = order[start:stopped]
        Q, _ = np.linalg.qr(A[rows][:, layout.own[number]].toarray(), mode="complete")
        right[rows] = Q.T @ right[rows]
        left[rows[: len(layout.own[number])]] = False
    return right[left, :-1], right[left, -1], stop[left], place[left]


def _lever(number: int, joint: str, unit: str) -> tuple[str, FormulaEffect]:
    """A joint moved by a constant amount."""
    document = {
        "name": f"moved_{number}",
        "site": f"joint:{joint}",
        "unit": unit,
        "sigma": 1.0,
        "basis": "1",
    }
    return joint, FormulaEffect.read(document, "a table of poses", {})


def _table(
    A: np.ndarray,
    lever: np.ndarray,
    b: np.ndarray,
    stop: np.ndarray,
    place: np.ndarray,
    covariates: dict[str, np.ndarray],
) -> BeamTable | None:
    """The table of one joint, of whitened rows A (R, U), b (R,); `lever` (R,) is how they change as
    it turns."""
    a = np.where(stop >= 0, lever, 0.0)
    size = np.sqrt(np.bincount(np.maximum(stop, 0), np.square(a)))
    seen = size > ANGLE_SEEN * size.max(initial=0.0)
    if not seen.any():
        return None
    at = np.flatnonzero(stop >= 0)
    first = at[np.unique(stop[at], return_index=True)[1]]  # of each stop, by its number
    first = first[seen[stop[first]]]
    # The reflection that turns a stop's lever into its first row.
    v = a.copy()
    v[first] += np.where(a[first] < 0, -1.0, 1.0) * size[stop[first]]
    length = np.bincount(np.maximum(stop, 0), np.square(v))
    v = np.where((stop >= 0) & seen[np.maximum(stop, 0)], v, 0.0)
    full = np.column_stack([A, b])
    groups = csr_array((v, (np.maximum(stop, 0), np.arange(len(v)))), (len(size), len(v)))
    along = (groups @ full) * (2 / np.maximum(length, 1e-300))[:, None]
    full -= v[:, None] * along[np.maximum(stop, 0)]
    sign = np.where(a[first] < 0, 1.0, -1.0)
    scale = sign / size[stop[first]]
    rest = np.setdiff1d(np.arange(len(b)), first)
    return BeamTable(
        covariates={n: c[stop[first]] for n, c in covariates.items()},
        by_stop=frozenset(covariates),
        residual_m=full[first, -1] * scale,
        sigma_m=1 / size[stop[first]],
        stop=stop[first],
        place=np.full(len(first), -1),
        share=1.0,
        twists=-full[first, :-1] * scale[:, None],
        chain=np.eye(A.shape[1]),
        others=full[rest, :-1],
        others_b=full[rest, -1],
        others_stop=stop[rest],
        others_place=place[rest],
    )


def _covariates(stand: Stand, layout: Layout) -> dict[str, np.ndarray]:
    """Columns (K,) of all stops, in the layout's order, that every recording has."""
    rows, every = {}, []
    for number, source in enumerate(stand.sources):
        view, stops = stops_view(source), len(source.recording.stops)
        columns = covariates_of(view)
        every.append({n: np.broadcast_to(c, stops).astype(float) for n, c in columns})
        rows |= {(source.recording.folder, i): (number, i) for i in range(stops)}
    names = [n for n in every[0] if all(n in c for c in every)]
    at = [rows[key] for key in layout.stops]
    return {n: np.array([every[k][n][i] for k, i in at]) for n in names}
