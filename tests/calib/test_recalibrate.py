"""Recalibration: who has moved is found, and by how much, however much links have in common."""

from collections import Counter
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import kstest

from calib.effects import find
from calib.problem.model import Model, default_effects
from calib.problem.prior import CommonErrors, JointPrior
from calib.problem.unknowns import Unknown, pose_unknown
from calib.recalibration import refit
from calib.recalibration.letgo import let_go
from calib.recalibration.newer import NewerData
from calib.recalibration.prior import change as change_of
from calib.results.intervals import Intervals
from calib.results.outstanding import freedoms
from chains import se3

NAMES = ("mount", "lidar", "arm", "unseen")
DIM, CAD_SIGMA = 3, 1.0
SIZE = DIM * len(NAMES)


def linked(name, sigma):
    """A link of which CAD is so sure."""
    return Unknown(
        name=name,
        kind="vector",
        mean=np.zeros(len(sigma)),
        sigma=sigma,
        dofs=tuple("abc"[: len(sigma)]),
        units=("m",) * len(sigma),
    )


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
        given=np.zeros_like(C),
        wider=np.ones(len(C)),
        repeated=np.zeros_like(C),
        common=CommonErrors.none(len(C)),
    )


@pytest.fixture
def world(monkeypatch):
    """A linear world: links of which sums are seen, once before and once after."""
    rng = np.random.default_rng(5)
    variables = [linked(name, np.full(DIM, CAD_SIGMA)) for name in NAMES]
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
                problem=None,
                not_trusted={},
                values=values(x),
                covariance=covariance,
                information=information,
                converged=True,
            )

        monkeypatch.setattr(refit, "solve", solve)
        known = as_the_graph_has_them if noise == 1.0 else as_the_rows_have_them
        monkeypatch.setattr(refit, "intervals", known)
        monkeypatch.setattr(refit, "shapes_freed", lambda estimate, *_: estimate)
        monkeypatch.setattr(refit, "errors_at", lambda *_: None)
        monkeypatch.setattr(refit, "widened", lambda known, *_: known)
        prior = JointPrior(variables, values(m), then)
        named = {v.name: v for v in variables}
        problem = SimpleNamespace(calibration=NAMES, variables=named, initial={})
        return {link.name: link for link in refit.solve_from(problem, Model(), prior, None)[-1]}

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


@pytest.mark.parametrize("size", [0.08, 0.5, 2.0, 8.0])  # of CAD's sigmas
def test_of_links_seen_only_together_either_may_have_moved(world, size):
    """However far: what CAD says of one does not make the other move as well."""
    moved = np.zeros(SIZE)
    moved[DIM] = size
    links = world(moved)
    (one,) = (name for name in ("mount", "lidar") if links[name].moved)
    other = "mount" if one == "lidar" else "lidar"
    assert links[one].instead == (other,) and not links["arm"].moved
    seen = links[one].change * (0.5 if one == "lidar" else 1.0)
    assert seen[0] == pytest.approx(0.5 * size, abs=0.1)
    # Which it was is not known, so both were let go.
    assert min(links[name].freed for name in (one, other)) >= max(1.0, size / 4)


@pytest.mark.parametrize("noise", [1.0, 2.0])
@pytest.mark.parametrize("size", [3.0, 10.0, 40.0])
def test_a_link_that_moved_further_than_cad_allows_is_named_alone(world, size, noise):
    moved = np.zeros(SIZE)
    moved[2 * DIM] = size
    links = world(moved, noise)
    assert [n for n in NAMES if links[n].moved] == ["arm"] and links["arm"].instead == ()
    off = (links["arm"].change - moved[2 * DIM : 3 * DIM]) / links["arm"].sigma
    assert np.abs(off).max() < 4.0
    assert abs(np.log2(links["arm"].freed * np.sqrt(DIM) / size)) <= 1.0


def test_a_link_that_cad_holds_too_well_did_not_move():
    """Of two that are seen only together, the one that CAD is unsure of."""
    rng, sigma = np.random.default_rng(11), np.repeat([0.02, 3.0, 1.0], 2)
    names, moved = ("length", "zero", "other"), Counter()
    links = [linked(n, sigma[2 * i : 2 * i + 2]) for i, n in enumerate(names)]
    for _ in range(100):
        J = rng.normal(size=(30, 6)) / 0.03
        J[:, :2] = J[:, 2:4]
        cad, information = np.diag(sigma**-2.0), J.T @ J
        then, truth = np.linalg.inv(information + cad), sigma * rng.normal(size=6)
        mean = then @ J.T @ (J @ truth + rng.normal(size=30))
        truth[2:4] += [3.0, -4.0]
        right = J.T @ (J @ (truth - mean) + rng.normal(size=30))
        data = NewerData(information, right, np.zeros((6, 6)))
        found = let_go(JointPrior(links, {}, then), data.fitted)
        moved[tuple((link.name, link.instead) for link in found if link.moved)] += 1
    assert moved[("zero", ()),] >= 98  # 1 % of alarms


def test_what_was_let_go_is_let_go_again(world):
    """As the factor graph of a run that was fitted from another has it."""
    moved = np.zeros(SIZE)
    moved[2 * DIM] = 10.0
    links = [link.document() for link in world(moved).values()]
    prior = JointPrior([linked(n, np.ones(DIM)) for n in NAMES], {}, np.eye(SIZE))
    freed = prior.loosened(freedoms({"links": links})).covariance - np.eye(SIZE)
    assert freed[2 * DIM, 2 * DIM] == links[2]["freed"] ** 2 > 9.0
    assert np.count_nonzero(freed) == DIM
    del links[2]["freed"]  # a run of an earlier version: by CAD's own sigma
    before = prior.loosened(freedoms({"links": links}))
    assert before.covariance[2 * DIM, 2 * DIM] == 2.0


def test_what_nobody_saw_is_not_judged(world):
    assert world(np.zeros(SIZE))["unseen"].p_value is None


def test_a_frame_that_is_turned_far_has_other_axes():
    """How its change goes with a step at the estimate, by differences."""
    then, now = se3.exp([0.3, -0.2, 0.1, 1.0, 2.0, -0.5]), se3.exp([-0.2, 0.4, 0.9, 0.5, 1.0, 0.5])
    faro = pose_unknown("faro", then)
    prior = JointPrior([faro, linked("mount", np.ones(2))], {"faro": then, "mount": 0.0}, np.eye(8))

    def change(step):
        return change_of(prior, {"faro": now @ se3.exp(step[:6]), "mount": step[6:]})

    by_differences = [(change(x)[0] - change(-x)[0]) / 2e-6 for x in 1e-6 * np.eye(8)]
    assert change(np.zeros(8))[1] == pytest.approx(np.transpose(by_differences), abs=1e-7)


def test_of_links_that_are_found_in_turn_both_are_let_go():
    """Where the data seem to change with what is let go, as where beams meet other surfaces."""
    links = [linked(n, np.ones(1)) for n in ("one", "other")]
    prior = JointPrior(links, {}, 1e-4 * np.eye(2))
    at = {(): [1.0, 0.0], ("one",): [0.0, 1.0], ("other",): [1.0, 0.0]}
    asked = []

    def fit(held):
        free = tuple(
            v.name for v, s in zip(links, np.diag(held.covariance), strict=True) if s > 0.1
        )
        asked.append(free)
        data = NewerData(
            1e6 * np.eye(2), 1e6 * np.array(at.get(free, [1.0, 1.0])), np.zeros((2, 2))
        )
        return data.fitted(held)

    found = let_go(prior, fit)
    assert asked == [(), ("one",), ("other",), ("one", "other")]
    assert [link.moved for link in found] == [True, True] and all(link.freed for link in found)


@pytest.mark.parametrize(("times", "held"), [(1.0, False), (3.0, True)])
def test_what_larger_residuals_explain_has_not_moved(times, held):
    """A change of 6 sigmas, where residuals are so many times larger than their sigmas allow."""
    links = [linked(n, np.ones(1)) for n in ("one", "other")]
    prior = JointPrior(links, {}, 1e-4 * np.eye(2))
    data = NewerData(
        1e4 * np.eye(2), 1e4 * np.array([6.0e-2 * np.sqrt(2.0), 0.0]), np.zeros((2, 2))
    )
    asked = []

    def fit(held):
        asked.append(held.covariance[0, 0] > 0.1)
        now = data.fitted(held)
        own = now.graph @ data.information @ now.graph
        return now._replace(widened=now.graph + (times**2 - 1.0) * own)

    one, other = let_go(prior, fit)
    assert not other.moved and one.moved is not held and bool(one.freed) is not held
    assert asked == [False, True] + [False] * held  # once more, with nothing let go


def test_an_effect_of_the_day_is_not_of_the_next():
    known = [find("arm_backlash"), find("warmup_drift"), find("tracker_creep"), find("range_scale")]
    names = [getattr(each, "name", each) for each in default_effects([], known)]
    assert {"arm_backlash", "range_scale"} <= set(names) and len(names) == len(set(names))
    assert not {"warmup_drift", "tracker_creep"} & set(names)
