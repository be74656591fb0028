"""Recalibration: who has moved is found, and by how much, however much links have in common."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import kstest

from calib.problem.model import Model
from calib.problem.prior import JointPrior
from calib.problem.unknowns import Unknown
from calib.results import recalibrate
from calib.results.intervals import Intervals

NAMES = ("mount", "lidar", "arm", "unseen")
DIM, CAD_SIGMA = 3, 1.0
SIZE = DIM * len(NAMES)


def as_the_rows_have_them(estimate, _):
    """The data err by twice their sigmas."""
    plain = as_the_graph_has_them(estimate, _)
    data = estimate.covariance @ estimate.information @ estimate.covariance
    wider = np.sqrt(1.0 + 3.0 * np.diag(data) / np.diag(estimate.covariance))
    return replace(plain, data=data, wider=wider)


def as_the_graph_has_them(estimate, _):
    C, names = estimate.covariance, tuple(v.name for v in estimate.variables)
    return Intervals(
        names=names,
        dims=(DIM,) * len(names),
        graph=C,
        data=C,
        paper=np.zeros_like(C),
        wider=np.ones(len(C)),
    )


@pytest.fixture
def world(monkeypatch):
    """A linear world: links of which sums are seen, once before and once after."""
    rng = np.random.default_rng(5)
    variables = [
        Unknown(
            name=name,
            kind="vector",
            mean=np.zeros(DIM),
            sigma=np.full(DIM, CAD_SIGMA),
            dofs=("a", "b", "c"),
            units=("m",) * 3,
        )
        for name in NAMES
    ]
    J = rng.normal(size=(40, SIZE)) / 0.03
    J[:, DIM : 2 * DIM] = J[:, :DIM] @ np.diag([0.5, 2.0, 1.0])  # mount and lidar: sums only
    J[:, 3 * DIM :] = 0.0
    information = J.T @ J
    then = np.linalg.inv(information + np.eye(SIZE) / CAD_SIGMA**2)

    def values(x):
        return {name: x[DIM * i : DIM * (i + 1)] for i, name in enumerate(NAMES)}

    def at(moved, noise=1.0):
        """Prior and data of one draw: the truth from CAD, the fit before, the move, new data, whose
        noise is so many times what it is taken for."""
        truth = CAD_SIGMA * rng.normal(size=SIZE)
        m = then @ J.T @ (J @ truth + rng.normal(size=40))
        y = J @ (truth + moved) + noise * rng.normal(size=40)

        def solve(problem, prior, progress):
            weight = np.linalg.inv(prior.covariance)
            covariance = np.linalg.inv(weight + information)
            x = covariance @ (weight @ m + J.T @ y)
            return SimpleNamespace(
                variables=variables,
                values=values(x),
                covariance=covariance,
                information=information,
            )

        monkeypatch.setattr(recalibrate, "solve", solve)
        known = as_the_graph_has_them if noise == 1.0 else as_the_rows_have_them
        monkeypatch.setattr(recalibrate, "intervals", known)
        monkeypatch.setattr(recalibrate, "shapes_freed", lambda estimate, *_: estimate)
        prior = JointPrior(variables, values(m), then)
        problem = SimpleNamespace(calibration=NAMES, variables={v.name: v for v in variables})
        return {
            link.name: link for link in recalibrate.solve_from(problem, Model(), prior, None)[-1]
        }

    return at


def test_chances_are_chances_where_nothing_moved(world):
    draws = [world(np.zeros(SIZE)) for _ in range(300)]
    for name in ("mount", "lidar", "arm"):
        assert kstest([links[name].p_value for links in draws], "uniform").pvalue > 1e-3
    alarms = np.mean([any(link.moved for link in links.values()) for links in draws])
    assert alarms < 0.03


def test_chances_are_chances_where_the_new_rows_err_together(world):
    draws = [world(np.zeros(SIZE), noise=2.0) for _ in range(300)]
    for name in ("mount", "lidar", "arm"):
        assert kstest([links[name].p_value for links in draws], "uniform").pvalue > 1e-3


def test_what_moved_is_found_and_its_move_has_an_honest_sigma(world):
    moved = np.zeros(SIZE)
    moved[2 * DIM : 3 * DIM] = [0.3, -0.2, 0.25]
    draws = [world(moved) for _ in range(200)]
    assert all([n for n in NAMES if links[n].moved] == ["arm"] for links in draws)
    z = [(links["arm"].change - moved[2 * DIM : 3 * DIM]) / links["arm"].sigma for links in draws]
    assert np.abs(np.mean(z)) < 0.2
    assert np.std(z) == pytest.approx(1.0, abs=0.12)
    # Far better than where the link is, which its own data tell as badly as before.
    assert draws[0]["arm"].sigma.max() < 0.1


def test_of_links_seen_only_together_one_is_named(world):
    moved = np.zeros(SIZE)
    moved[DIM] = 0.5
    links = world(moved)
    assert sum(links[name].moved for name in ("mount", "lidar")) == 1
    assert not links["arm"].moved


def test_what_nobody_saw_is_not_judged(world):
    assert world(np.zeros(SIZE))["unseen"].p_value is None
