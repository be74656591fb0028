"""Errors of stops that follow each other: alike by chance as seldom as is said, and told where they
go in turn."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from calib.diagnosis.chance.in_turn import FEWEST_IN_TURN, p_in_turn
from calib.diagnosis.search import search
from calib.effects import find
from calib.runs.calibrate import calibrate
from calib.runs.diagnose import stand_of

from . import arm_worlds

STOPS = [f"s{k:03}" for k in range(60)]


def quiet(*told):
    """Nothing."""


def told(errors, time_s=None, effect="tracker_scatter"):
    """The p-value for errors (K, r) of a body at the stops of a table, with the times of these."""
    stops = STOPS[: len(errors)]
    timed = np.full(len(stops), time_s is not None)
    recording = SimpleNamespace(stops=stops, timed=timed, time_s=time_s)
    problem = SimpleNamespace(sources=[SimpleNamespace(recording=recording)])
    others = SimpleNamespace(problem=problem)
    known = 2.0 * np.eye(errors.shape[1])
    blunders = [
        SimpleNamespace(
            found=False,
            group=SimpleNamespace(kind="body"),
            shift=SimpleNamespace(
                group=SimpleNamespace(recording="", where=stop, what="tool"),
                dof=errors.shape[1],
                offset=error,
                covariance=known,
            ),
        )
        for stop, error in zip(stops, errors, strict=True)
    ]
    return p_in_turn(find(effect), others, blunders)


@pytest.mark.parametrize("count", [10, 20, 60])
@pytest.mark.parametrize("size", [1, 6])
def test_random_errors_are_seldom_alike(count, size):
    """However unevenly they scatter: a few stops by ten times as much as others."""
    rng = np.random.default_rng([count, size])
    p = []
    for _ in range(400):
        wide = np.where(rng.random(count) < 0.1, 10.0, 1.0)[:, None]
        p.append(told(wide * rng.normal(size=(count, size))))
    p = np.array(p)
    for level in (0.01, 0.05):
        assert (p < level).mean() < level + 3 * np.sqrt(level * (1 - level) / len(p)), level
    assert 0.4 < np.median(p) < 0.6


def test_what_drifts_and_what_was_changed_for_a_while_goes_in_turn():
    rng, k = np.random.default_rng(0), np.arange(30)
    noise = rng.normal(size=(30, 6))
    along = rng.normal(size=6)
    for course in (k - 14.5, np.where((k >= 10) & (k < 20), 10.0, -5.0)):
        errors = course[:, None] * along + noise
        assert told(errors) < 0.01
        order = rng.permutation(30)
        assert told(errors[order]) > 0.01  # as a table has them
        assert told(errors[order], time_s=60.0 * order) == pytest.approx(told(errors))


def test_few_stops_and_other_instruments_tell_nothing():
    drift = np.arange(FEWEST_IN_TURN - 1.0)[:, None] - 4.0
    assert told(drift) == 1.0
    drift = np.arange(30.0)[:, None] - 14.5
    assert told(drift) < 0.01
    assert told(drift, effect="target_scatter") == 1.0


def test_values_of_stops_are_taken_as_the_stops_were_made():
    """In each of two recordings, whose values stand in one unknown in any order."""
    rng, order = np.random.default_rng(5), np.random.default_rng(6).permutation(30)
    drift = np.arange(30.0) - 14.5
    for values, alike in ((drift, True), (rng.permutation(drift), False)):
        both = [
            SimpleNamespace(
                recording=SimpleNamespace(
                    folder=Path(day),
                    stops=[STOPS[k] for k in order],
                    timed=np.ones(30, bool),
                    time_s=60.0 * order,
                )
            )
            for day in ("mon", "tue")
        ]
        members = [f"{day}/{stop}" for day in ("mon", "tue") for stop in STOPS[:30]]
        effect = find("stop_range_scatter")
        terms = [
            [SimpleNamespace(effect=effect.among(members, f"{day}/"), variable="v")]
            for day in ("mon", "tue")
        ]
        others = SimpleNamespace(
            problem=SimpleNamespace(sources=both, terms=terms),
            whole=SimpleNamespace(values={"v": np.concatenate([values, rng.permutation(drift)])}),
        )
        assert (p_in_turn(effect, others, []) < 0.01) is alike


@pytest.mark.parametrize("random", [True, False])
def test_a_body_that_sat_elsewhere_for_a_while_is_not_called_random(tmp_path, random):
    """It is turned for a third of the poses, and back; or for as many, here and there."""
    rng = np.random.default_rng(77)
    world = arm_worlds.bent(tmp_path / "rec", "puma560", rng)
    read = world.draw(rng, 90)
    away = (np.arange(90) // 15) % 2 == 1
    if random:
        away = rng.permutation(away)
    twist = np.outer(away - 0.5, [4e-3, -3e-3, 2e-3, 3e-4, 2e-4, -3e-4])
    T = world.seen(read) * arm_worlds.exp(twist) * arm_worlds.exp(arm_worlds.noise(rng, 90))
    arm_worlds.save(tmp_path / "rec", world, read, T, {}, 2e-5)
    run = calibrate([tmp_path / "rec"], tmp_path / "run", hold_out="none")
    (chance,) = search(stand_of(run, quiet), quiet).chance
    assert chance.effect.name == "tracker_scatter"
    assert ("not at random" in chance.sentence) is not random
    assert ("random as far as these data show" in chance.sentence) is random
