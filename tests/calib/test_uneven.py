"""A tracker that sees worse far away, or shakes for a while: no stop of it is a mishap."""

from dataclasses import replace

import numpy as np
import pytest

from calib.blunders.shifts import Shift
from calib.blunders.uneven import FEWEST_UNEVEN, MOST_TIMES, Whereabouts, unevenly
from calib.residuals.groups import Group
from calib.runs.calibrate import calibrate
from calib.runs.diagnose import diagnose

from . import arm_worlds


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
        (lambda place, share: np.exp(place[:, 0]), "place", np.exp(1.6)),  # 0.8 of +-2 in squares
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


def test_few_stops_and_such_as_have_no_time_tell_nothing():
    rng = np.random.default_rng(2)
    few, where = drawn(rng, FEWEST_UNEVEN - 1, lambda place, share: np.exp(9 * share))
    assert unevenly(few, where) is None
    some, where = drawn(rng, 80, lambda place, share: np.exp(9 * share))
    still = Whereabouts(dict.fromkeys(where.time_s, 0.0), {})
    assert unevenly(some, still) is None and unevenly(some, where).along == "time"


@pytest.mark.slow
@pytest.mark.parametrize("wild", [False, True])
def test_a_tracker_that_sees_worse_far_away_has_no_blunders_but_true_ones(tmp_path, wild):
    """Sigmas from half to six times those stated, by the distance: two stops would stand out of
    their bulk. A row that was written down wrongly still does."""
    rng, folder = np.random.default_rng(21), tmp_path / "rec"
    folder.mkdir()
    world = arm_worlds.bent(folder, "ur10", rng)
    (folder / "ur10.urdf").rename(folder / "arm.urdf")
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
    (told,) = (each for each in said.sentences if each.startswith("How much tool scatters"))
    assert "depends on where it is: " in told
    assert float(told.partition("is: ")[2].partition(" times")[0]) == pytest.approx(7.3, rel=0.25)
