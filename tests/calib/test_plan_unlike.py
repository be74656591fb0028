"""Planned stops that are unlike all that was measured are told, in words."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calib.planning.room.unlike import unlike
from calib.planning.stops import Poses
from calib.problem.model import Source

from . import rigs


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    return Source.open(rigs.write(tmp_path_factory.mktemp("unlike") / "rec"))


def poses(joints, *turns):
    """Poses at which the base is turned about x by so many rad, in the world's frame."""
    T = np.tile(np.eye(4), (len(joints), 1, 1))
    for each, turn in zip(T, turns, strict=True):
        each[:3, :3] = Rotation.from_euler("x", turn).as_matrix()
    return Poses(np.array(["a"] * len(joints)), np.array(joints, float), T)


def test_what_lies_beyond_all_measured_is_told_with_both_ranges(source):
    measured = poses([[0.0, 0.1, 0.05], [1.0, 0.2, 0.06]], 0.0, 0.0)
    planned = poses([[0.5, 0.1, 0.2], [0.9, 1.2, 0.05], [0.9, 1.5, 0.055]], 0.0, 0.0, 0.0)
    found = {each.what: each for each in unlike(source, measured, planned) if not each.tilt}
    assert set(found) == {"lift", "slide"}
    assert found["lift"].planned == pytest.approx((1.2, 1.5))
    assert found["lift"].measured == pytest.approx((0.1, 0.2))
    assert str(found["lift"]) == "lift at 69 to 86 deg (so far 6 to 11)"
    assert str(found["slide"]) == "slide at 200 mm (so far 50 to 60)"
    assert found["slide"].document()["joint"] == "slide"


def test_a_lidar_that_was_always_upright_is_tilted(source):
    """As its z axis is from the world's: the angle of scipy's rotation of it."""
    still = [[0.3, 0.1, 0.05]] * 3
    measured, planned = poses(still, 0.0, 0.01, -0.01), poses(still, 1.2, 0.0, -0.9)
    frame = source.rig.lidar_frame or source.rig.tracker.bodies[-1]
    (tilt,) = (each for each in unlike(source, measured, planned) if each.tilt)
    assert tilt.what == frame and not [e for e in unlike(source, measured, planned) if not e.tilt]
    here = source.rig.tree.place(frame, np.array(still)).Ts_root_frame[0, :3, 2]
    angles = [np.arccos(Rotation.from_euler("x", turn).apply(here)[2]) for turn in (1.2, -0.9)]
    assert tilt.planned == pytest.approx((min(angles), max(angles)))
    assert str(tilt).startswith(f"'{frame}' tilted by ")


def test_nothing_is_new_within_what_was_measured_or_where_nothing_was(source):
    wide = poses([[-1.0, 0.0, 0.0], [1.0, 1.0, 0.1]], 0.0, 0.0)
    near = poses([[1.05, 0.5, 0.105]], 0.02)
    assert unlike(source, wide, near) == []
    nothing = Poses(np.zeros(0, str), np.zeros((0, 3)), np.zeros((0, 4, 4)))
    assert unlike(source, nothing, near) == []
