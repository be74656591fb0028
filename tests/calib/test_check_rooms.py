"""Rooms that look nearly the same turned: whether a base_guess has them the wrong way round."""

from dataclasses import replace

import numpy as np
import pytest

from calib.results.check import check
from calib.runs.calibrate import calibrate
from calib.runs.diagnose import diagnose
from chains import se3

from ..worlds import room
from .handheld import HAND, handheld, rewritten

CART = replace(HAND, turned=(0.0,) * 6)
FURNISHED = room.furnished
LIKE = "the room looks the same turned by "
BETTER = "the scans fit the mesh better with the rig turned by "


def bare(*boxes):
    """What furnishes a room with these boxes alone."""

    def furnished(rng):
        shell = FURNISHED(rng)
        there = room.Quads(*(each[:6] for each in vars(shell).values()))
        for centre, size in boxes:
            there = there.and_(room.box(np.array(centre), np.array(size), 0.3, "foam"))
        return there

    return furnished


ONE_BOX = bare(((2.9, 1.4, 0.6), (0.6, 0.7, 1.2)))
ROOMS = {  # what is in the room, its size, and who goes round in it
    "furnished": (FURNISHED, (8.0, 7.0, 2.9), HAND),
    "furnished, from a cart": (FURNISHED, (8.0, 7.0, 2.9), CART),
    "one box": (ONE_BOX, (8.0, 7.0, 2.9), HAND),
    "one box in a square": (ONE_BOX, (7.0, 7.0, 2.9), replace(HAND, locations=12)),
    "bare": (bare(), (8.0, 7.0, 2.9), HAND),
    "bare square": (bare(), (7.0, 7.0, 2.9), HAND),
}
SOUND = [name for name in ROOMS if "bare" not in name]
UNTRACKED = pytest.param(False, marks=pytest.mark.long)


def recorded(folder, name, degrees=0.0, **how):
    """A recording of a room, whose base_guess has it turned."""
    furnished, size_m, world = ROOMS[name]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(room, "furnished", furnished)
        patch.setattr(room, "SIZE_M", np.array(size_m))
        handheld(folder, world, guess=(0.1, 0.04), **{"targets": False, **how})
    turn = se3.from_xyz_rpy([0.0, 0.0, 0.0], [0.0, 0.0, np.radians(degrees)])

    def turned(pose):
        T = turn @ se3.from_xyz_quat(pose[:, :3], pose[:, 3:])
        return np.concatenate([T[:, :3, 3], se3.to_quat_wxyz(T)], axis=1)

    rewritten(folder, turned, "base_guess")
    return folder


def told(folder):
    """What is said of how things lie in the room."""
    found = check(folder)
    assert found.problems == []
    starts = ("the scans", "the room")
    return [line for line in found.odd if line.startswith(starts)]


@pytest.mark.parametrize("tracked", [True, UNTRACKED], ids=["tracked", "untracked"])
@pytest.mark.parametrize("name", SOUND)
def test_a_guess_that_is_right_is_left_alone(tmp_path, name, tracked):
    assert told(recorded(tmp_path / "rec", name, tracked=tracked)) == []


@pytest.mark.parametrize("tracked", [True, UNTRACKED], ids=["tracked", "untracked"])
@pytest.mark.parametrize(
    ("name", "degrees"),
    [(name, 180) for name in SOUND] + [("one box in a square", 90), ("one box in a square", -90)],
)
def test_a_guess_that_has_the_room_turned_is_told(tmp_path, name, degrees, tracked):
    """Also where the wrong way round fits but for what a single box shows."""
    (said,) = told(recorded(tmp_path / "rec", name, degrees, tracked=tracked))
    assert said.startswith(f"{BETTER}{-degrees % 360} deg about the middle of the room: ")
    assert ("ties 'opti' to 'faro'" in said) == tracked


@pytest.mark.parametrize("tracked", [True, False], ids=["tracked", "untracked"])
@pytest.mark.parametrize(("name", "by"), [("bare", "180"), ("bare square", "90, 180 or 270")])
@pytest.mark.parametrize("degrees", [pytest.param(0, marks=pytest.mark.long), 180])
def test_where_only_a_guess_tells_it_is_said(tmp_path, name, by, degrees, tracked):
    (said,) = told(recorded(tmp_path / "rec", name, degrees, tracked=tracked))
    assert said.startswith(f"{LIKE}{by} deg about its middle")


def test_nothing_is_said_where_targets_tell(tmp_path):
    assert told(recorded(tmp_path / "rec", "bare", targets=True)) == []


def test_a_fit_that_ended_the_wrong_way_round_is_not_to_be_used(tmp_path):
    """It converges, and its error is as expected but for what the box does to a few beams."""
    folder = recorded(tmp_path / "rec", "one box", 180, tracked=True)
    run = calibrate([folder], tmp_path / "run", hold_out="none")
    found = diagnose(run)
    assert found.verdict == "bad_data"
    first = found.blunders[0]
    assert first["sentence"].startswith(BETTER.replace("the", "The", 1)) and not first["without"]
    assert sum(first["sentence"] in said for said in found.sentences) == 1


def test_a_fit_says_where_only_a_guess_tells(tmp_path):
    run = calibrate([recorded(tmp_path / "rec", "bare")], tmp_path / "run", hold_out="none")
    (said,) = (each for each in run.summary["odd"] if "room" in each)
    assert said.startswith(LIKE) and "base_guess alone" in said
