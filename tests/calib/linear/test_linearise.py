"""The linearisation against dense rows: what is kept, the step, the covariance, and gradients."""

import numpy as np
import pytest
from scipy.linalg import block_diag
from scipy.sparse import csr_array

from calib.linear import assembly
from calib.linear.assembly import common, stops_first
from calib.linear.clusters import Gradients
from calib.linear.parallel import workers

from .. import rigs
from .cases import CASES, made

TOGETHER = {"one by one": 1, "all at once": 10**9}  # entries of stops that wait for each other
ORDERS = ("cells first", *TOGETHER)


@pytest.fixture(scope="module", params=CASES)
def case(request, tmp_path_factory):
    return made(request.param, tmp_path_factory.mktemp("linear"))


def eliminating(monkeypatch, order):
    """Cells before what stops have for themselves; or after it, so many stops at once."""
    monkeypatch.setattr(assembly, "begins_with_cells", lambda layout: order == "cells first")
    entries = TOGETHER.get(order, 1)
    monkeypatch.setattr(common, "WAITING_ENTRIES", entries)
    monkeypatch.setattr(stops_first, "STOPS_TOGETHER", min(entries, 256))


@pytest.fixture(params=ORDERS)
def order(request, monkeypatch):
    eliminating(monkeypatch, request.param)
    return request.param


def in_linearisation(case):
    """The kinds of rows that a linearisation holds: beams, bodies of stops, and priors of what is
    eliminated."""
    inner = set(case.dense.inner(case.held))

    def wanted(kind):
        what, _, names = kind.partition(":")
        return what == "beams" or (
            what in ("body", "prior") and bool(inner & set(names.split(",")))
        )

    return wanted


def apart(case):
    """Columns that are kept, and that are eliminated."""
    inner = case.dense.inner(case.held)
    gone = np.concatenate([np.zeros(0, int), *(case.dense.at[name] for name in inner)])
    return np.setdiff1d(np.arange(len(case.dense.sigma)), gone), gone


def sizes(matrix):
    size = np.sqrt(np.maximum(np.diag(matrix), 0.0))
    return np.where(size > 0, size, 1.0)


@pytest.fixture(scope="module")
def eliminated(case):
    """Dense rows over what is kept, and the right side; and how what is gone follows from these."""
    A, b = case.dense.some(in_linearisation(case))
    kept, gone = apart(case)
    rows = np.column_stack([A[:, kept], b])
    taken = np.linalg.lstsq(A[:, gone], rows, rcond=None)[0]
    return rows, rows - A[:, gone] @ taken, taken


def test_what_is_kept_is_the_schur_complement_of_dense_rows(case, eliminated, order):
    gradients = Gradients(len(case.dense.sigma))
    linear = case.linear(gradients=gradients)
    kept, gone = apart(case)
    np.testing.assert_array_equal(linear.layout.kept, kept)
    rows, beyond, taken = eliminated
    b, size = rows[:, -1], sizes(rows.T @ rows)
    unit = np.outer(size, size)
    np.testing.assert_allclose(linear.kept / unit, beyond.T @ beyond / unit, atol=1e-9)
    each = np.repeat(*unknown_of(linear.layout))
    alone = np.where(each[:, None] == each, (rows.T @ rows)[:-1, :-1], 0.0)
    found = block_diag(*linear.raw.values())
    np.testing.assert_allclose((found - alone) / unit[:-1, :-1], 0, atol=1e-9)
    assert linear.chi2 == pytest.approx(b @ b, rel=1e-9)
    # And the way back to what was eliminated: of directions, and of one with the right side.
    ahead = np.random.default_rng(2).normal(size=(len(kept) + 1, 3)) / size[:, None]
    back = linear.directions(ahead)
    np.testing.assert_allclose(back[kept], ahead[:-1], rtol=1e-12)
    limit = 1e-9 * np.abs(taken @ ahead).max(initial=1.0)
    np.testing.assert_allclose(back[gone], -taken @ ahead, atol=limit)


def unknown_of(layout):
    """Numbers of the kept unknowns, and how many columns each has."""
    kept = layout.outer().values()
    return np.arange(len(kept)), [unknown.dim for unknown in kept]


def test_what_is_touched_and_how_sure_beams_are(case, order):
    linear = case.linear()
    wanted = in_linearisation(case)
    A, _ = case.dense.some(lambda kind: wanted(kind) and not kind.startswith("prior"))
    np.testing.assert_array_equal(linear.touched, np.any(A != 0, axis=0))
    pairs = zip(case.start.problem.scans, case.start.associations, strict=True)
    rows = [scan.rows(case.dense.values, a) for scan, a in pairs]
    expected = sum(np.sum(r.weight / np.square(r.sigma_m)) for r in rows)
    assert linear.weight_m2 == pytest.approx(expected, rel=1e-12)


def test_the_step_of_every_unknown_is_that_of_dense_rows(case, order):
    """To a millionth of its sigma, and with it by how much the cost was to fall."""
    dense, linear = case.dense, case.linear()
    estimate = case.estimate(linear)
    after, moved, fall = estimate.graph.step(dense.values)
    outer = linear.layout.outer()
    kept = np.concatenate([moved[name] for name in outer])
    moved = {**{name: moved[name] for name in outer}, **linear.step(kept)}
    found = np.concatenate([moved[name] for name in dense.at])
    sigma = np.sqrt(np.diag(dense.covariance))
    expected = dense.step
    assert np.abs(expected / sigma).max() > 0.1
    assert np.abs((found - expected) / sigma).max() < 1e-6
    cost = np.sum(np.square(dense.b)) - np.sum(np.square(dense.b - dense.A @ expected))
    fall += (linear.chi2 - linear.kept[-1, -1]) / 2
    assert fall == pytest.approx(cost / 2, rel=1e-6)
    for name in outer:
        kind = case.start.problem.variables[name].kind
        stepped = rigs.retract(kind, dense.values[name], moved[name])
        np.testing.assert_allclose(after[name], stepped, atol=1e-9)


def test_covariances_are_those_of_dense_rows(case, order):
    """Of what is kept, of a stop's own, and of both together."""
    linear = case.linear()
    estimate, dense = case.estimate(linear), case.dense
    sigma = np.sqrt(np.diag(dense.covariance))
    correlation = dense.covariance / np.outer(sigma, sigma)
    own = [n for n in dense.inner(case.held) if not n.partition("/")[2].startswith("reference_")]
    outer = list(linear.layout.outer())
    for names in (outer[::-1], own[:3], [*own[-2:], *outer[1:3], *own[:1]]):
        if names:
            at = dense.columns(names)
            found = estimate.covariance_of(names) / np.outer(sigma[at], sigma[at])
            np.testing.assert_allclose(found, correlation[np.ix_(at, at)], atol=1e-6)


def test_reduced_rows_say_the_same_of_all_that_follows_the_kept(case, order, monkeypatch):
    """Rows about a few unknowns of any kind, of which one may stand twice, or about none."""
    monkeypatch.setattr("calib.linear.system.ROWS_AT_ONCE", 3)
    linear, rng = case.linear(), np.random.default_rng(6)
    layout, kept = linear.layout, np.diag(linear.layout.sigma[linear.layout.kept])
    parts = [*layout.cells, layout.kept, *layout.own.values()]
    touched = [rng.choice(part, 3) for part in parts if len(part)] + [np.zeros(0, int)]
    touched += [np.concatenate([touched[0], some]) for some in touched]
    ends = np.cumsum([0, *map(len, touched)])
    columns = np.concatenate(touched)
    entries = rng.normal(size=len(columns)) / layout.sigma[columns]
    rows = csr_array((entries, columns, ends), shape=(len(touched), layout.size))
    before = rows.indices.copy(), rows.data.copy()
    expected = rows.toarray() @ linear.followed(kept)
    found = linear.reduced(rows) @ kept
    size = np.abs(expected).max(axis=0).clip(1e-300)
    np.testing.assert_allclose(found / size, expected / size, atol=1e-9)
    for now, then in zip((rows.indices, rows.data), before, strict=True):
        np.testing.assert_array_equal(now, then)


def test_covariances_of_rows_over_any_unknowns_are_those_of_dense_rows(case, order):
    """Rows about one kind of unknown each, about all of them at once, and about nothing."""
    linear, dense = case.linear(), case.dense
    estimate, layout, rng = case.estimate(linear), linear.layout, np.random.default_rng(5)
    covariance = dense.covariance
    own = [*layout.own.values()]
    parts = [*layout.cells, layout.kept, *own[:1], *own[-1:], np.arange(layout.size)]
    rows = np.zeros((2 * len(parts) + 1, layout.size))
    for i, columns in enumerate(parts):
        some = rng.permutation(columns)[: 1 + len(columns) // 3]
        rows[2 * i, some], rows[2 * i + 1, columns] = 1.0, rng.normal(size=len(columns))
    rows = rows / np.sqrt(np.diag(covariance))
    kept = estimate.covariance_of(list(layout.outer()))
    before = rows.copy(), kept.copy()
    found, expected = linear.covariance(csr_array(rows), kept), rows @ covariance @ rows.T
    size = sizes(expected)
    unit = np.outer(size, size)
    np.testing.assert_allclose(found / unit, expected / unit, atol=1e-6)
    np.testing.assert_array_equal(rows, before[0])
    np.testing.assert_array_equal(kept, before[1])


def test_variances_of_sets_of_rows_are_the_diagonals_of_their_covariances(case, order, monkeypatch):
    """Of no set, of one, of several; also where not all rows are looked at at once."""
    linear = case.linear()
    kept = case.estimate(linear).covariance_of(list(linear.layout.outer()))
    names, rng = list(linear.layout.at), np.random.default_rng(6)
    some = [names[:1], names[::-1], names[1:4]]
    sets = [
        {n: rng.normal(size=(k, linear.layout.unknowns[n].dim)) for n in by}
        for k, by in enumerate(some, 2)
    ]
    monkeypatch.setattr("calib.linear.system.ROWS_AT_ONCE", 4)
    assert linear.variances([], kept) == []
    for by, found in zip(sets, linear.variances(sets, kept), strict=True):
        rows = np.zeros((len(found), linear.layout.size))
        rows[:, linear.layout.columns(list(by))] = np.hstack(list(by.values()))
        expected = np.diag(linear.covariance(csr_array(rows), kept))
        np.testing.assert_allclose(found, expected, rtol=1e-9)


def test_what_beams_say_of_their_lidars_twist_is_what_their_rows_say(case, order):
    """Of a twist that one stop alone has: its information, its score, its products with all."""
    linear, dense = case.linear(gradients=Gradients(len(case.dense.sigma))), case.dense
    assert case.linear().scans == {}, "nobody asked"
    numbers = {linear.layout.stops[s.recording.folder, s.index] for s in case.start.problem.scans}
    assert linear.scans.keys() == numbers
    pairs = zip(case.start.problem.scans, case.start.associations, strict=True)
    for k, (scan, association) in enumerate(pairs):
        rows = scan.rows(dense.values, association)
        weight, residual = rows.weight_m2, rows.residual_m
        twist = np.sqrt(weight)[:, None] * rows.by_twist
        mine = np.array([c is not None and c[0] == k for c in dense.cluster])
        A = dense.A[mine][: len(weight)]  # the rows of its scatter come after those of its beams
        sums = linear.scans[linear.layout.stops[scan.recording.folder, scan.index]]
        cross = np.zeros((6, linear.layout.size))
        np.add.at(cross.T, sums.columns, sums.cross.T)
        size, wide = sizes(twist.T @ twist), sizes(A.T @ A)
        unit = np.outer(size, size)
        np.testing.assert_allclose(sums.information / unit, twist.T @ twist / unit, atol=1e-9)
        expected = -twist.T @ (np.sqrt(weight) * residual)
        limit = 1e-9 * np.linalg.norm(np.sqrt(weight) * residual)
        np.testing.assert_allclose(sums.score / size, expected / size, atol=limit)
        unit = np.outer(size, wide)
        np.testing.assert_allclose(cross / unit, twist.T @ A / unit, atol=1e-9)


def test_the_cost_is_half_the_sum_of_all_squares(case, order):
    estimate = case.estimate(case.linear())
    assert estimate.cost == pytest.approx(case.dense.b @ case.dense.b / 2, rel=1e-9)


def test_gradients_by_cluster_are_those_of_their_rows(case, order):
    gradients = Gradients(len(case.dense.sigma))
    case.linear(gradients=gradients)
    chosen = np.flatnonzero(case.dense.kind == "beams")
    if not len(chosen):
        assert gradients._entries == []
        return
    expected = {}
    for i in chosen:
        row = case.dense.A[i] * case.dense.b[i]
        expected[case.dense.cluster[i]] = expected.get(case.dense.cluster[i], 0.0) + row
    table, stop, place = gradients.table()
    of = {number: key for key, number in gradients.places.items()}
    found = {}
    for i, (k, p) in enumerate(zip(stop.tolist(), place.tolist(), strict=True)):
        found[k, *of[p]] = found.get((k, *of[p]), 0.0) + table[[i]].toarray()[0]
    assert found.keys() == expected.keys()
    size = np.maximum(np.linalg.norm(case.dense.A[chosen], axis=0), 1e-12)
    for key, gradient in expected.items():
        np.testing.assert_allclose(found[key] / size, gradient / size, atol=1e-8)
    total = case.dense.A[chosen].T @ case.dense.b[chosen]
    np.testing.assert_allclose(table.sum(axis=0) / size, total / size, atol=1e-8)


def test_whatever_is_eliminated_first_the_same_is_said(case, monkeypatch):
    found = []
    for order in ORDERS:
        eliminating(monkeypatch, order)
        found.append(case.linear(gradients=Gradients(len(case.dense.sigma))))
    first, *others = found
    raw = block_diag(*first.raw.values())
    size = np.append(sizes(raw), np.sqrt(first.chi2))
    unit = np.outer(size, size)
    for other in others:
        same = block_diag(*other.raw.values())
        np.testing.assert_allclose(other.kept / unit, first.kept / unit, atol=1e-10)
        np.testing.assert_allclose(same / unit[:-1, :-1], raw / unit[:-1, :-1], atol=1e-12)
        assert other.chi2 == pytest.approx(first.chi2, rel=1e-12)
        np.testing.assert_array_equal(other.touched, first.touched)


def test_the_number_of_threads_changes_no_bit(case, order):
    def found(count):
        gradients = Gradients(len(case.dense.sigma))
        with workers(count):
            linear = case.linear(gradients=gradients)
        table = gradients.table() if case.start.problem.scans else ()
        arrays = [linear.kept, *linear.raw.values(), linear.chi2, linear.weight_m2, linear.touched]
        arrays += [a for e in linear.eliminated for a in (e.columns, e.over, e.factor, e.gain)]
        return arrays + [a.toarray() if hasattr(a, "toarray") else a for a in table]

    alone = found(1)
    for count in (2, 5):
        for a, b in zip(alone, found(count), strict=True):
            np.testing.assert_array_equal(a, b)
