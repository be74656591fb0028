"""A tracker that sees worse far away, or shakes for a while: no stop of it is a mishap."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform

from calib.blunders.shifts import Shift
from calib.blunders.uneven import FEWEST_UNEVEN, MOST_TIMES, Whereabouts, unevenly
from calib.problem import build
from calib.problem.model import Model
from calib.residuals.groups import Group
from calib.runs.calibrate import calibrate
from calib.runs.diagnose import diagnose
from calib.simulation import Spec

from . import arm_worlds
from .simulated import made


def shifts_of(squares):
    empty = np.zeros((0, 0))
    return [
        Shift(
            group=Group("body", f"p{k}", "tool"),
            statistic=float(square),
            dof=6,
            offset=np.zeros(0),
            covariance=empty,
            information=empty,
            axes=(),
            units=(),
        )
        for k, square in enumerate(squares)
    ]


def drawn(rng, count, along=lambda place, share: np.ones(len(share))):
    """Groups whose squares are so many times what chance makes them, by place and time."""
    place, share = rng.uniform(-2, 2, (count, 3)), np.sort(rng.uniform(size=count))
    squares = rng.chisquare(6, count) * along(place, share)
    keys = [("", f"p{k}") for k in range(count)]
    where = Whereabouts(
        time_s=dict(zip(keys, 3600 * share, strict=True)),
        place={"tool": dict(zip(keys, place, strict=True))},
    )
    return shifts_of(squares), where


@pytest.mark.parametrize("count", [FEWEST_UNEVEN, 150])
def test_even_scatter_seems_uneven_as_seldom_as_is_said(count):
    """At 0.5 %: of 2,000 worlds 10, and 20 at most."""
    rng = np.random.default_rng(count)
    assert sum(unevenly(*drawn(rng, count)) is not None for _ in range(2000)) <= 20


@pytest.mark.parametrize(
    ("along", "name", "times"),
    [
        (lambda place, share: np.exp(place[:, 0]), "place", np.exp(1.8)),  # 0.9 of +-2
        (lambda place, share: np.linalg.norm(place, axis=1) ** 4, "place", 5.3),
        (lambda place, share: np.where(abs(share - 0.5) < 0.1, 25.0, 1.0), "time", 5.0),
    ],
)
def test_what_scatter_hangs_on_is_told_and_how_much(along, name, times):
    rng = np.random.default_rng(4)
    found = [unevenly(*drawn(rng, 200, along)) for _ in range(20)]
    assert all(each is not None and each.along == name for each in found)
    assert np.median([each.times for each in found]) == pytest.approx(times, rel=0.25)


@pytest.mark.parametrize("count", [13, 40])
def test_gross_rows_that_lie_in_one_place_are_measured_against_most(count):
    """As of zeros, which a tracker writes where it saw nothing."""
    rng = np.random.default_rng(6)
    some, where = drawn(rng, 300)
    wrong = [f"p{k}" for k in range(0, 300, 300 // count)]
    for name in wrong:
        where.place["tool"]["", name] = np.zeros(3)
    some = [replace(s, statistic=1e8 if s.group.where in wrong else s.statistic) for s in some]
    found = unevenly(some, where)
    assert found is None or max(found.scale.values()) < 1.5 * MOST_TIMES**2


def test_a_short_while_is_told_and_its_stops_are_measured_against_each_other():
    """Five times the scatter for 16 of 200 stops; of these, those at its edges too."""
    rng, shaken = np.random.default_rng(8), slice(90, 106)
    times = np.where((np.arange(200) >= 90) & (np.arange(200) < 106), 25.0, 1.0)
    found = [unevenly(*drawn(rng, 200, lambda place, share: times)) for _ in range(20)]
    found = [each for each in found if each is not None and each.along == "time"]
    assert len(found) > 15 and np.median([each.times for each in found]) > 2.5
    least = [min(list(each.scale[("", f"p{k}")] for k in range(200)[shaken])) for each in found]
    assert np.median(least) > 4.0


def test_places_are_those_of_points_and_of_poses(tmp_path):
    """A body that stands still says nothing of where others are."""
    for name, tracker in (("poses", "poses"), ("points", "points")):
        source, _ = made(tmp_path / name, Spec(tracker=tracker, column_step=128), 2)
        where = Whereabouts.of(build([source], Model.of(None, (), (), [source.recording.folder])))
        for body, place in where.place.items():
            assert place and all(np.shape(at) == (3,) for at in place.values())
            seen = source.recording.bodies[body]
            known = np.isfinite(seen[:, :3]).all(axis=1)
            assert len(place) == known.sum()
            assert np.array_equal(np.stack(list(place.values())), seen[known, :3])
    rng = np.random.default_rng(9)
    some, where = drawn(rng, 100, lambda place, share: np.exp(2 * place[:, 0]))
    scans = [replace(s, group=replace(s.group, kind="scan", what="scan")) for s in some]
    still = {key: np.full(3, 1.0) + 1e-6 * at for key, at in where.place["tool"].items()}
    both = Whereabouts(where.time_s, {"base": still, **where.place})
    assert unevenly(scans, both).along == "place"


@pytest.mark.long
def test_a_zone_that_is_off_one_way_does_not_scatter(tmp_path):
    """2 mm in one direction where the arm reaches one corner: something is wrong there."""
    rng, folder = np.random.default_rng(23), tmp_path / "rec"
    world = arm_worlds.bent(folder, "ur10", rng)
    read = world.draw(rng, 150)
    T = world.seen(read)
    near = np.linalg.norm(T.translation - T.translation[0], axis=1) < 0.7
    T = RigidTransform.from_translation(np.outer(near, [0.002, 0.0, 0.0])) * T
    arm_worlds.save(folder, world, read, T * arm_worlds.exp(arm_worlds.noise(rng, 150)), {}, 2e-5)
    said = diagnose(calibrate([folder], tmp_path / "run", hold_out="none"), refits=False)
    assert near.sum() > 10 and said.verdict != "adequate"
    assert not any(each.startswith("The scatter of tool") for each in said.sentences)
    wrong = {f"p{k:04d}" for k in np.flatnonzero(near)}
    assert len(said.blunders) > near.sum() / 2
    assert sum(each["where"] in wrong for each in said.blunders) > 0.9 * len(said.blunders)


def test_few_stops_and_such_as_have_no_time_tell_nothing():
    rng = np.random.default_rng(2)
    few, where = drawn(rng, FEWEST_UNEVEN - 1, lambda place, share: np.exp(9 * share))
    assert unevenly(few, where) is None
    some, where = drawn(rng, 80, lambda place, share: np.exp(9 * share))
    still = Whereabouts(dict.fromkeys(where.time_s, 0.0), {})
    assert unevenly(some, still) is None and unevenly(some, where).along == "time"


@pytest.mark.long
@pytest.mark.parametrize("wild", [False, True])
def test_a_tracker_that_sees_worse_far_away_has_no_blunders_but_true_ones(tmp_path, wild):
    """Sigmas from half to six times those stated, by the distance: two stops would stand out of
    their bulk. A row that was written down wrongly still does."""
    rng, folder = np.random.default_rng(21), tmp_path / "rec"
    world = arm_worlds.bent(folder, "ur10", rng)
    read = world.draw(rng, 150)
    T = world.seen(read)
    far = np.linalg.norm(T.translation, axis=1)
    rank = np.argsort(np.argsort(far)) / len(far)
    off = arm_worlds.noise(rng, 150) * (0.5 * 12.0**rank)[:, None]
    off[np.argsort(far)[75], 3:] += 0.03 * wild
    arm_worlds.save(folder, world, read, T * arm_worlds.exp(off), {}, 2e-5)
    said = diagnose(calibrate([folder], tmp_path / "run", hold_out="none"), refits=False)
    assert [each["where"] for each in said.blunders] == [f"p{np.argsort(far)[75]:04d}"] * wild
    assert [c["effect"] for c in said.candidates if c["step"]] == ["tracker_scatter"]
    (told,) = (each for each in said.sentences if each.startswith("The scatter of tool"))
    assert "depends on where it is: it is " in told
    assert float(told.partition("is: it is ")[2].partition(" times")[0]) == pytest.approx(
        7.3, rel=0.25
    )
