"""Stops against blunders and against scatter: what they are chosen by, and what they bring."""

from __future__ import annotations

import numpy as np
import pytest

import calib
from calib.effects.scatter import StopPoseScatter, StopRangeScatter
from calib.planning import planner_of
from calib.planning.criteria import chosen
from calib.planning.information import Information
from calib.planning.reliability import Reliable
from calib.planning.worth import criterion
from calib.problem.unknowns import Key
from chains.errors import InputError
from tests.calib.narrow import run_of


@pytest.fixture(scope="module")
def narrow(once):
    return run_of(once)


def silent(done: int, total: int) -> None:
    """Progress that nobody sees."""


def known(size, data):
    keys = tuple(Key("u", f"p{k}") for k in range(size))
    return Information(keys, np.ones(size), data, np.eye(size))


def test_what_a_mishap_at_a_stop_does_unseen_is_what_is_lost_without_the_stop():
    """By brute force over all shapes of an error of a stop's rows."""
    rng = np.random.default_rng(0)
    stops = [rng.standard_normal((5, 3)) * s for s in (1.0, 0.3, 2.0)]
    M = np.eye(3) + sum(A.T @ A for A in stops)
    C = np.linalg.inv(M)
    for A in stops:
        lost = np.linalg.inv(M - A.T @ A)
        checked = np.eye(5) - A @ C @ A.T
        e = rng.standard_normal((200_000, 5))
        e /= np.sqrt(np.einsum("ni,ij,nj->n", e, checked, e))[:, None]  # each as hard to find
        moved = np.abs(e @ (A @ C)).max(axis=0)
        most = np.sqrt(np.diag(lost - C))
        assert (moved < most * (1 + 1e-9)).all() and (moved > 0.97 * most).all()


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("stops", [0, 7])
def test_the_stop_that_is_added_is_the_best_once_any_other_is_lost(seed, stops):
    rng = np.random.default_rng(seed)
    rows = rng.standard_normal((30, 2, 4)) * rng.uniform(0.2, 3, (30, 1, 1))
    each = rows.mT @ rows
    measured = each[20 : 20 + stops]
    by = Reliable(known(4, measured.sum(axis=0)), np.arange(4), measured)
    planned, rest = each[:2], each[2:20]
    base = by.start + planned.sum(axis=0)
    value = by.each(base, rest, planned)
    lost = [*measured, *planned]
    whole = np.array([min(by.inner.of((base + E - L)[None])[0] for L in lost) for E in rest])
    assert np.argmax(value) == np.argmax(whole)
    assert value.max() == pytest.approx(whole.max())
    assert (value > whole - 1e-9).all()
    assert len(set(chosen(by, each[:20], 4, silent))) == 4


def test_the_calibration_leans_less_on_any_one_stop_than_with_the_best_or_random_ones(narrow):
    """Of what is known, what is left once the worst stop is lost."""
    planner = planner_of(narrow, "reliability")
    poses = planner.candidates(150, 0)
    each = planner.look(poses, 4)
    by = criterion(planner.scene, planner.aim, planner.lasting)
    best = chosen(by, each, 4, silent)
    plain = criterion(planner.scene, planner_of(narrow, "all").aim, planner.lasting)
    rng = np.random.default_rng(0)
    designs = [best, chosen(plain, each, 4, silent)]
    designs += [rng.choice(150, 4, replace=False) for _ in range(40)]

    def left(design):
        M = by.start + each[list(design)].sum(axis=0)
        return min(by.inner.of((M - L)[None])[0] for L in [*by.measured, *each[list(design)]])

    mine, theirs, *random = (left(design) for design in designs)
    assert mine > theirs and mine > np.max(random)


def test_what_a_stop_tells_where_stops_scatter_is_less_by_what_scatters(narrow):
    """The range zero is all rings at once, and a seat of the LiDAR its own twist: by Woodbury's
    identity from what the stop tells without scatter."""
    plain, scattered = planner_of(narrow, "all"), planner_of(narrow, "scatter")
    assert {e.name for e in scattered.aim.added} == {"stop_range_scatter", "stop_pose_scatter"}
    assert scattered.lasting.keys == plain.lasting.keys
    poses = plain.candidates(60, 0)
    keys, unit = plain.lasting.keys, plain.lasting.unit
    E, less = (p.scene.each(poses, keys) for p in (plain, scattered))
    at = {name: [i for i, k in enumerate(keys) if k.unknown == name] for name, _ in keys}
    U = np.zeros((len(keys), 7))
    U[at["ring_range_offset"], 0] = 1.0 / unit[at["ring_range_offset"]]
    U[at["lidar"], np.arange(1, 7)] = 1.0 / unit[at["lidar"]]
    sd = np.repeat([StopRangeScatter.sigma, StopPoseScatter.sigma], [1, 6])
    cross = E @ U
    gain = np.linalg.solve(np.diag(sd**-2.0) + U.T @ cross, cross.mT)
    wanted = E - cross @ gain
    for got, want, whole in zip(less, wanted, E, strict=True):
        assert np.linalg.norm(got - want) < 0.02 * np.linalg.norm(whole - want)
    assert np.linalg.norm(E - less) > 0.1 * np.linalg.norm(E)


@pytest.mark.long
def test_plans_for_both_are_made_and_are_not_those_for_all(narrow, rigcal):
    poses = {}
    for purpose in ("all", "reliability", "scatter"):
        words = ["plan", narrow.folder, "--for", purpose, "--stops", 3, "--candidates", 80]
        code, said, _ = rigcal(*words)
        assert code == 0
        poses[purpose] = [line for line in said.splitlines() if line[:1] in "123"]
    assert poses["all"] != poses["reliability"] and poses["all"] != poses["scatter"]


def test_without_a_lidar_nothing_scatters_from_stop_to_stop(tmp_path):
    from calib.simulation import PRESETS, simulate

    spec = PRESETS["arm-tracker"].model_copy(update={"locations": 2, "stops_per_location": 4})
    simulate(spec, tmp_path / "rec")
    run = calib.fit([tmp_path / "rec"], tmp_path / "run", hold_out="none")
    with pytest.raises(InputError, match="without a LiDAR nothing differs from stop to stop"):
        calib.plan(run, purpose="scatter", stops=2, candidates=40)
    assert len(calib.plan(run, purpose="reliability", stops=2, candidates=40).stops) == 2
