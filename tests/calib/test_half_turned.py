"""Bodies whose markers look the same half a turn on."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calib.rig.tracked import odd_bodies

from .test_check_suspects import BASE, MOUNT, changed, opened


def half_turned(axis):
    def change(pose):
        turned = Rotation.from_quat(pose[:, 3:], scalar_first=True) * Rotation.from_rotvec(
            np.pi * np.eye(3)["xyz".index(axis)]
        )
        return np.hstack([pose[:, :3], turned.as_quat(scalar_first=True)])

    return change


@pytest.mark.parametrize(
    ("name", "body", "axis", "every"),
    [
        ("known_nothing_hidden", MOUNT, "z", 2),
        ("known_nothing_hidden", MOUNT, "x", 7),
        ("known_incidence", BASE, "y", 2),
        ("arm_payload", "tool", "z", 3),
    ],
)
def test_a_body_whose_markers_look_the_same_half_a_turn_on_is_told(shared, name, body, axis, every):
    """At every second stop: no fit with it came to an optimum, and nothing said why."""
    rig, recording = opened(shared, name)
    seen = np.all([np.isfinite(x).all(axis=1) for x in recording.bodies.values()], axis=0)
    rows = np.flatnonzero(seen)[1::every]
    (told,) = odd_bodies(rig, changed(recording, body, rows, half_turned(axis)))
    assert (told.name, told.kind) == (body, "body")
    assert f"half a turn about its {axis} axis" in told.sentence
    assert list(told.stops) == [recording.stops[k] for k in rows]


@pytest.mark.parametrize(("body", "axis"), [(MOUNT, "x"), (BASE, "z")])
def test_a_body_that_is_drawn_the_other_way_round_is_told(shared, body, axis):
    """The arm's base, or its first joint, was blamed instead."""
    rig, recording = opened(shared, "known_nothing_hidden")
    every = np.flatnonzero(np.isfinite(recording.bodies[body]).all(axis=1))
    (told,) = odd_bodies(rig, changed(recording, body, every, half_turned(axis)))
    assert (told.name, told.stops) == (body, ())
    assert f"if {body} is turned round by half a turn about its {axis} axis" in told.sentence
