"""What newer data can see of a move since an earlier run, and what they leave if they cannot."""

import numpy as np
import pytest

from calib.problem.prior import JointPrior
from calib.problem.unknowns import Unknown
from calib.recalibration import newer
from calib.recalibration.letgo import let_go
from calib.recalibration.newer import NewerData, left_by_moves, told_from

DRAWS = 400


def linked(name, sigma, of_members=False):
    dim = len(sigma)
    return Unknown(
        name=name,
        kind="vector",
        mean=np.zeros(dim),
        sigma=np.asarray(sigma, float),
        dofs=tuple(f"{name}_{i}" for i in range(dim)),
        units=("m",) * dim,
        of_members=of_members,
    )


def rows(rng, J, truth):
    """What newer rows of unit noise say of all that is held at zero."""
    return NewerData(
        J.T @ J, J.T @ (J @ truth + rng.normal(size=len(J))), np.zeros((len(truth),) * 2)
    )


@pytest.mark.parametrize("of_members", [False, True])
def test_a_move_from_that_size_on_is_seen_four_times_of_five(of_members):
    rng = np.random.default_rng(3)
    links = [linked("one", np.ones(3), of_members), linked("other", np.ones(2))]
    root = rng.normal(size=(5, 5)) * 0.3
    prior = JointPrior(links, {}, root @ root.T + 0.01 * np.eye(5))
    J, limit = rng.normal(size=(12, 5)), 0.002
    least = told_from(prior, rows(rng, J, np.zeros(5)), limit)
    for name, first in (("one", 0), ("other", 3)):
        seen = 0
        for _ in range(DRAWS):
            error = rng.multivariate_normal(np.zeros(5), prior.covariance)
            error[first] += least[name][0]  # the truth now, where the earlier run had zero
            p = newer.tests(prior, rows(rng, J, error))[name]
            seen += p is not None and p <= limit
        # of rings three tests share the level, and one may see what another does not
        assert 0.74 <= seen / DRAWS <= (0.92 if of_members else 0.86)


def test_one_stop_that_knows_less_than_the_earlier_run_may_contradict_it():
    """New data ten times less sure, and a move of eight of their own sigmas."""
    links = [linked("one", [0.5]), linked("other", [0.5])]
    prior = JointPrior(links, {}, 0.01**2 * np.eye(2))
    data = rows(np.random.default_rng(0), np.diag([10.0, 10.0]), np.array([0.8, 0.0]))
    one, other = let_go(prior, data.fitted)
    assert one.moved and not other.moved
    assert one.change == pytest.approx([0.8], abs=0.3) and one.shown_by == "one_0"


def test_of_one_joint_and_a_mount_that_nothing_tells_apart_either_may_have_moved():
    """The mount has small sigmas and one parameter, the joints many: neither is evidence."""
    rng, sigma = np.random.default_rng(2), np.array([0.4, 1.0, 1.0, 1.0, 1.0, 1.0])
    links = [linked("mount", sigma[:1]), linked("joints", sigma[1:])]
    J = rng.normal(size=(40, 6)) / 0.05
    J[:, 5] = J[:, 0]
    then = np.linalg.inv(J.T @ J + np.diag(sigma**-2.0))
    prior = JointPrior(links, {}, then)
    for moved in (0, 5):
        truth = rng.multivariate_normal(np.zeros(6), then)
        truth[moved] += 0.6
        found = {link.name: link for link in let_go(prior, rows(rng, J, truth).fitted)}
        (named,) = (link for link in found.values() if link.moved)
        (other,) = (name for name in found if name != named.name)
        assert named.instead == (other,)
        assert min(link.freed for link in found.values()) > 0.0


def test_the_parameter_that_moved_is_named_and_not_one_that_goes_along_with_it():
    """Two joints that data tell apart badly: let go together, either's change may be the surer."""
    named, off = [], []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        links = [linked("joints", np.full(3, 0.5)), linked("rest", np.full(2, 0.5))]
        J = rng.normal(size=(60, 5)) / 0.05
        J[:, 1] = 0.9 * J[:, 0] + 0.1 * J[:, 1]
        prior = JointPrior(links, {}, np.linalg.inv(J.T @ J + 4.0 * np.eye(5)))
        truth = rng.multivariate_normal(np.zeros(5), prior.covariance)
        truth[1] += 0.2
        joints, _ = let_go(prior, rows(rng, J, truth).fitted)
        named.append(joints.shown_by if joints.moved else None)
        if named[-1] == "joints_1":
            off.append((joints.alone[0] - 0.2) / joints.alone[1])
    assert np.std(off) < 1.4 and abs(np.mean(off)) < 0.6
    assert named.count("joints_1") >= 32 and None not in named


def test_what_an_unseen_move_leaves_is_what_a_fit_to_noiseless_rows_is_off_by():
    rng = np.random.default_rng(5)
    links = [linked("one", np.ones(2)), linked("other", np.ones(2))]
    root = rng.normal(size=(4, 4)) * 0.2
    prior = JointPrior(links, {}, root @ root.T + 0.01 * np.eye(4))
    J = rng.normal(size=(3, 4))
    left = left_by_moves(prior, rows(rng, J, np.zeros(4)))
    for i in range(4):
        move = np.eye(4)[i]
        now = NewerData(J.T @ J, J.T @ J @ move, np.zeros((4, 4))).fitted(prior)
        off = (move - now.change)[i] / np.sqrt(now.covariance[i, i])
        assert left[i] == pytest.approx(abs(off), rel=1e-9)


def test_what_is_hardly_checked_is_said():
    """One parameter well seen, one seen by a row that knows it as badly as CAD."""
    links = [linked("zeros", [1.0, 1.0]), linked("rest", [1.0])]
    prior = JointPrior(links, {}, 0.05**2 * np.eye(3))
    J = np.diag([20.0, 0.5, 20.0])
    zeros, rest = let_go(prior, rows(np.random.default_rng(1), J, np.zeros(3)).fitted)
    assert not zeros.moved and zeros.unchecked == ("zeros_1",) and rest.unchecked == ()
    sure, blind = zeros.told_from
    assert 0.2 < sure < 0.6 and blind > 1.0


def test_a_move_hidden_by_its_residuals_is_found_where_another_seemed_to_be_the_one():
    """What the residuals of a held move widen leaves the wrong link; let go, that has not moved."""
    links = [linked("wrong", [1.0]), linked("hidden", [1.0])]
    prior = JointPrior(links, {}, 1e-4 * np.eye(2))
    asked = []

    def fit(held):
        free = tuple(
            link.name for link, s in zip(links, np.diag(held.covariance), strict=True) if s > 0.1
        )
        asked.append(free)
        at = [0.0 if free else 0.05, 0.06]
        wide = np.diag([0.0, 0.0 if "hidden" in free else 1e10])
        return NewerData(1e6 * np.eye(2), 1e6 * np.array(at), wide).fitted(held)

    wrong, hidden = let_go(prior, fit)
    assert hidden.moved and not wrong.moved and wrong.freed == 0.0
    assert asked[:3] == [(), ("wrong",), ()] and asked[-1] == ("hidden",)
    assert hidden.change == pytest.approx([0.06], abs=1e-3)


def test_a_parameter_that_the_data_never_show_has_no_size_from_which_it_is_seen():
    """Nor one that goes along with what they show, but for what rounding leaves."""
    links = [linked("zeros", [1.0, 1.0, 1.0]), linked("rest", [1.0])]
    root = np.random.default_rng(4).normal(size=(4, 4)) * 0.1
    prior = JointPrior(links, {}, root @ root.T + 1e-4 * np.eye(4))
    J = np.zeros((6, 4))
    J[:, 0] = np.random.default_rng(5).normal(size=6) * 30.0
    least = told_from(prior, rows(np.random.default_rng(6), J, np.zeros(4)), 0.002)
    assert np.isfinite(least["zeros"][0])
    assert np.isinf([*least["zeros"][1:], *least["rest"]]).all()


def test_weak_data_alarm_no_more_often_than_others():
    """Ten times less sure than the earlier run, as one stop is."""
    alarms = 0
    for seed in range(DRAWS):
        rng = np.random.default_rng(seed)
        links = [linked("one", np.ones(3)), linked("other", np.ones(3))]
        root = rng.normal(size=(6, 6)) * 0.1
        prior = JointPrior(links, {}, root @ root.T + 1e-4 * np.eye(6))
        truth = rng.multivariate_normal(np.zeros(6), prior.covariance)
        J = rng.normal(size=(8, 6))
        alarms += any(link.moved for link in let_go(prior, rows(rng, J, truth).fitted))
    assert alarms <= 0.03 * DRAWS  # of 1.1 %
