"""Residuals of stops as large as errors are: against the hat matrix of all rows, and in size."""

import numpy as np
import pytest

from calib import problem as problems
from calib.diagnosis.linear import WIDENED, other_rows
from calib.diagnosis.score import project, score_test
from calib.diagnosis.stand import Stand
from calib.effects import GEOMETRY, find
from calib.linear.clusters import Gradients, over_all
from calib.linear.layout import Layout
from calib.linear.own import own_rows
from calib.problem.model import Model, Source
from calib.solve.fit import solve

from . import arm_worlds, two_arms

GONE = 1.0 - 1e-6  # of a direction that a stop's own unknowns take in


def quiet(what, done, total):
    pass


def arm(folder, seed, sigma_joint_rad=0.0):
    """Forty poses of a UR10 with nothing wrong but its geometry."""
    rng = np.random.default_rng(seed)
    world = arm_worlds.bent(folder, "ur10", rng)
    q, noise = world.draw(rng, 40), arm_worlds.exp(arm_worlds.noise(rng, 40))
    read = q + sigma_joint_rad * rng.normal(size=q.shape)
    arm_worlds.save(folder, world, read, world.seen(q) * noise, {}, sigma_joint_rad)
    return folder


def hands(folder, seed):
    rng = np.random.default_rng(seed)
    two_arms.write(folder / "rec", two_arms.drawn(rng), 80, rng)
    return folder / "rec"


def fitted(folder):
    source, model = Source.open(folder), Model(GEOMETRY)
    problem = problems.build([source], model)
    return Stand([source], model, problem, solve(problem))


@pytest.mark.parametrize("make", [arm, hands, lambda f, s: arm(f, s, 2e-5)])
def test_a_stop_grows_by_its_part_of_the_hat_matrix(tmp_path, make):
    stand = fitted(make(tmp_path, 1))
    linear = stand.linearise([], quiet)[0]
    layout, values = Layout.of(stand.problem), stand.estimate.values
    own = own_rows(layout, values)
    rows = list(other_rows(stand.problem, layout, values, Gradients(layout.size), own))
    A = over_all([r.entries() for r in rows], layout.size).toarray()
    e, stop = (np.concatenate([getattr(r, k) for r in rows]) for k in ("b", "stop"))
    # Priors of the hardware are wider among these rows than they are in the fit.
    wide = np.where(stop < 0, WIDENED, 1.0)
    scale = np.linalg.norm(A, axis=0)
    known = A * wide[:, None] / scale
    C = np.linalg.pinv(known.T @ known, rcond=1e-13)
    grown = np.concatenate([r.b for r in linear.others])
    for k in (0, 7):
        mine = stop == k
        values, axes = np.linalg.eigh((A[mine] / scale) @ C @ (A[mine] / scale).T)
        root = np.where(values < GONE, 1.0 / np.sqrt(np.maximum(1.0 - values, 1e-12)), 0.0)
        expected = axes @ (root * (axes.T @ e[mine]))
        np.testing.assert_allclose(grown[mine], expected, atol=2e-3)
    assert np.array_equal(grown[stop < 0], e[stop < 0])


def test_scores_scatter_as_far_as_clusters_say(tmp_path):
    """Over empty worlds; of residuals as they are, clusters say 0.8 of it."""
    told = []
    for seed in range(12):
        (tmp_path / str(seed)).mkdir()
        stand = fitted(arm(tmp_path / str(seed), seed))
        names = ("arm_joint_eccentricity", "arm_joint_scale", "optitrack_distortion")
        linear, at, _ = stand.linearise([find(name) for name in names], quiet)
        scores = project(linear, linear.candidates, stand.spent)
        for columns in at.values():
            test = score_test(scores, columns)
            told.append(test.chances[0].trace / test.dof)
    assert 0.93 < np.mean(told) < 1.07


def test_the_score_itself_is_that_of_residuals_as_they_are(tmp_path):
    stand = fitted(arm(tmp_path, 3))
    linear, at, _ = stand.linearise([find("arm_joint_scale")], quiet)
    scores = project(linear, linear.candidates, stand.spent)
    test = score_test(scores, at["arm_joint_scale"])
    grown = stand.with_effects([find("arm_joint_scale")], quiet)
    fell = 2.0 * (stand.estimate.cost - grown.estimate.cost)
    assert fell == pytest.approx(test.statistic, rel=0.02)
    assert not np.allclose(scores.cells.sum(axis=0), scores.score, rtol=1e-3)
