"""What data could not tell, by names that hold points, slashes, commas and shapes."""

import numpy as np
import pytest

from calib.problem.unknowns import Unknown
from calib.results.observability import not_estimated
from calib.runs.estimates import _told

AWKWARD = {
    "range_cyclic@1.2": ("sin", "cos"),
    "left.rig/arm_joint_offset": ("hip.yaw", "hip.roll", "knee", "foot.pitch"),
    "label_range_offset": ("0_floor, left", "1_wall.a", "2_wall … b", "3_wall"),
}


def unknowns(variables):
    return [
        Unknown(
            name=name,
            kind="vector",
            mean=np.zeros(len(dofs)),
            sigma=np.full(len(dofs), 0.01),
            dofs=dofs,
            units=("m",) * len(dofs),
        )
        for name, dofs in variables.items()
    ]


@pytest.mark.parametrize(
    ("untold", "names"),
    [
        ([0], ["range_cyclic@1.2.sin"]),
        ([0, 1], ["range_cyclic@1.2"]),
        ([3], ["left.rig/arm_joint_offset.hip.roll"]),
        ([2, 3, 4], ["left.rig/arm_joint_offset (hip.yaw … knee)"]),
        ([0, 2, 5], ["range_cyclic@1.2.sin", "left.rig/arm_joint_offset (hip.yaw, foot.pitch)"]),
        ([6, 7, 9], ["label_range_offset (0_floor, left, 1_wall.a, 3_wall)"]),
        ([7, 8, 9], ["label_range_offset (1_wall.a … 3_wall)"]),
    ],
)
def test_names_are_not_cut_at_their_points_and_are_read_back(untold, names):
    variables = unknowns(AWKWARD)
    sigma = np.full(10, 1e-4)
    sigma[untold] = 0.01
    found = not_estimated(variables, np.diag(sigma**2), frozenset(AWKWARD), np.ones(10, bool), {})
    assert [entry["name"] for entry in found] == names
    told = np.concatenate([_told(name, dofs, found) for name, dofs in AWKWARD.items()])
    assert np.flatnonzero(~told).tolist() == untold


@pytest.mark.parametrize(
    ("left", "touched", "rejected", "why"),
    [
        (1.0, False, False, "no measurement that has weight depends on it"),
        (1.0, False, True, "half or more of the beams that depend on it are rejected"),
        (0.1, True, True, "half or more of the beams that depend on it are rejected"),
        (1.0 - 1e-4, True, False, "the data tell it less exactly than what was known before"),
    ],
)
def test_why_a_parameter_alone_is_not_estimated(left, touched, rejected, why):
    """By what is left of its prior's variance."""
    variables = unknowns({"range_offset": ("zero", "other")})
    covariance = np.diag([left, 1e-4]) * 0.01**2
    lost = {"range_offset": np.array([True, False])} if rejected else {}
    measured = np.array([touched, True])
    (found,) = not_estimated(variables, covariance, frozenset(), measured, lost)
    assert found["name"] == "range_offset.zero"
    assert found["why"].startswith(why)


def test_what_is_tied_to_rings_that_are_not_trusted_is_listed_all_the_same():
    variables = unknowns({"range_offset": ("zero",), "ring_range_offset": ("a", "b")})
    tie = np.ones(3) / np.sqrt(3)
    covariance = (np.outer(tie, tie) + 1e-4 * (np.eye(3) - np.outer(tie, tie))) * 0.01**2
    lost, measured = {"ring_range_offset": np.ones(2, bool)}, np.ones(3, bool)
    found = not_estimated(variables, covariance, frozenset(), measured, lost)
    assert {each["name"] for each in found} == {"range_offset", "ring_range_offset"}
