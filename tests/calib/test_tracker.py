"""Tracked bodies and hanging targets: what should be zero is, and every derivative is right."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from calib.forward import place
from calib.problem import build
from calib.problem.model import Model, Source
from calib.residuals.targets import HangingTarget
from calib.residuals.tracker import TrackedBody
from chains import se3

from . import rigs


@pytest.fixture(scope="module")
def problem(tmp_path_factory):
    return build([Source.open(rigs.write(tmp_path_factory.mktemp("tracker") / "box"))], Model())


@pytest.fixture(scope="module")
def values(problem):
    """A state away from the drawing."""
    return rigs.shaken(problem.variables, problem.initial, 0.1)


@pytest.fixture
def tracked(problem, values):
    """A body seen at some stops that share every variable, far from where it should be."""

    def block(stops, is_point=False, **bases):
        rig, joints = problem.sources[0].rig, problem.sources[0].recording.joints[stops]
        chain = place(rig, problem.terms[0], joints, {}, "root@a", None)
        chain = chain.with_joint_noise("joints@s0")
        apart = np.random.default_rng(2).uniform(-0.7, 0.7, (len(stops), 6))
        measured = chain.in_world("mount_markers", values).T @ se3.exp(apart)
        if is_point:
            measured[:, :3, :3] = np.eye(3)
        return TrackedBody(
            name="body",
            stops=chain,
            body="mount_markers",
            measured=measured,
            sigma_m=2e-4,
            sigma_rad=3e-4,
            is_point=is_point,
            bases=bases,
        )

    return block


@pytest.mark.parametrize("is_point", [False, True])
@pytest.mark.parametrize("stops", [[1], [0, 1, 2, 3]])
@pytest.mark.parametrize("biases", ["none", "constant", "by stop"])
def test_tracked_body_derivatives(problem, values, tracked, stops, is_point, biases):
    rng = np.random.default_rng(4)
    shapes = {
        "none": {},
        "constant": {"bias": (1, 6, 2)},
        "by stop": {"bias": (len(stops), 6, 2), "b": (1, 6, 6)},
    }
    bases = {name: rng.normal(size=shape) for name, shape in shapes[biases].items()}
    biased = {name: rng.uniform(-0.2, 0.2, b.shape[-1]) for name, b in bases.items()}
    block = tracked(stops, is_point, **bases)
    assert block.rows == len(stops) * (3 if is_point else 6)
    rigs.assert_block_derivatives(block, problem.variables, values | biased)


def test_a_tracker_adds_its_error_to_the_pose(values, tracked):
    """measured = true * exp(error) has no residual under just that error."""
    error = np.array([0.02, -0.01, 0.03, 0.01, 0.02, -0.03])
    block = tracked([0, 1], bias=np.eye(6)[None])
    true = block.stops.in_world("mount_markers", values).T
    seen = true @ rigs.gtsam.Pose3.Expmap(error).matrix()
    residual, _ = replace(block, measured=seen).evaluate({**values, "bias": error}, False)
    assert np.abs(residual).max() < 1e-8


def test_tracked_body_rows_are_measured_less_predicted_in_sigmas(values, tracked):
    block = tracked([2])
    predicted = block.stops.in_world("mount_markers", values).T
    step = np.array([0.001, 0.002, -0.003, 0.0004, -0.0005, 0.0006])
    rotation = rigs.gtsam.Rot3.Expmap(step[:3]).matrix()
    measured = predicted.copy()
    measured[0, :3, :3] = predicted[0, :3, :3] @ rotation
    measured[0, :3, 3] += predicted[0, :3, :3] @ step[3:]
    residual, _ = replace(block, measured=measured).evaluate(values, False)
    np.testing.assert_allclose(residual, step / np.repeat([3e-4, 2e-4], 3), rtol=1e-9)


def hanging(shift=None, scanned=None):
    rng = np.random.default_rng(6)
    faro_m, upper_m, lower_m = rng.normal(size=(3, 3))
    return HangingTarget(
        name="rod",
        marker="p",
        gravity="g",
        reference="faro",
        faro_m=faro_m,
        upper_m=upper_m,
        lower_m=lower_m,
        below_m=0.18,
        sigma_sphere_m=6e-4,
        sigma_marker_m=2e-4,
        shift=shift or {},
        scanned=scanned or {},
    )


def test_hanging_target_derivatives():
    rng = np.random.default_rng(7)
    shift = {"off": rng.normal(size=(3, 2)), "low": rng.normal(size=(3, 1))}
    block = hanging(shift, {"scale": rng.normal(size=(3, 1))})
    down = np.array([0.3, -0.4, -1.0])
    values = {
        "p": rng.normal(size=3),
        "g": down,
        "faro": rigs.T_OPTI_FARO.as_matrix(),
    }
    values |= {"off": np.array([0.01, -0.02]), "low": np.array([0.03]), "scale": np.array([0.02])}
    kinds = {"faro": SimpleNamespace(kind="pose")}
    rigs.assert_block_derivatives(block, kinds, values)


def test_a_true_rod_has_no_residual_whatever_the_spacing_of_its_markers():
    down, T = np.array([0.0, 0.6, -0.8]), rigs.T_OPTI_FARO
    lower, shift = np.array([1.0, 2.0, 3.0]), np.array([0.001, 0.002, 0.003])
    sphere = T.inv().apply(lower + 0.18 * down + shift)
    values = {"p": lower, "g": down, "faro": T.as_matrix(), "off": np.ones(1)}
    for spacing in (0.2, 0.5):
        upper = lower - spacing * down
        seen = replace(
            hanging({"off": shift[:, None]}), faro_m=sphere, upper_m=upper, lower_m=lower
        )
        assert np.abs(seen.evaluate(values, False)[0]).max() < 1e-9
