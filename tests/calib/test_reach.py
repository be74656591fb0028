"""How far a mishap that is not found could move an estimate: by dense algebra, and by doing it."""

import numpy as np
import pytest

from calib.blunders.judged import judge
from calib.blunders.others import Others
from calib.blunders.reach import PROMISED_SIGMAS, FurthestMoved, hardly_checked, reaches
from calib.linear.clusters import Gradients
from calib.residuals.groups import CAD, Group

from .linear import cases
from .linear.groups import Groups, by_place

CASES = [name for name in cases.CASES if name != "an earlier estimate"]
WELL = 1e-4  # of a group's directions, checked by others: those that rounding leaves as they are


@pytest.fixture(scope="module", params=CASES)
def both(request, tmp_path_factory):
    """A case, and of each place the dense rows with their full weight there."""
    case = cases.made(request.param, tmp_path_factory.mktemp("reach"))
    return case, by_place(case)


def estimates(there):
    """Names of all (P,), and their derivatives (P, m) by right sides, from dense rows."""
    size = np.linalg.norm(there.A, axis=0)
    Q, R = np.linalg.qr(there.A / size)
    at, unknowns = there.dense.at, there.problem.variables
    names = [f"{v}.{d}" for v in there.problem.calibration for d in unknowns[v].dofs]
    mine = np.concatenate([at[v] for v in there.problem.calibration])
    return names, (np.linalg.solve(R.T, np.eye(len(size))[:, mine]).T / size[mine, None]) @ Q.T


@pytest.mark.long
def test_no_unseen_mishap_moves_an_estimate_further_and_one_goes_so_far(both):
    case, places = both
    linear, problem = case.linear(gradients=Gradients(len(case.dense.sigma))), case.start.problem
    names, by_rows = estimates(Groups(case.dense))
    sigma = np.linalg.norm(by_rows, axis=1)
    dense = {*places[CAD].parts, *places[CAD].scans}
    others = Others.of(linear, problem)
    every = [b for b in judge(others) if not b.shift.of_ranges]
    blunders = [b for b in every if b.group in dense]  # of exact encoders there are no dense rows
    rng, same = np.random.default_rng(3), 0
    found = reaches(others, every, dict(zip(names, sigma.tolist(), strict=True)))
    for each in blunders:
        there = places[each.group.where]
        D = there.directions(each.group)
        checked = D.T @ there.beyond(D)
        values, axes = np.linalg.eigh(checked)
        axes = axes[:, values > WELL * values.max()]
        if case.weighted:
            _, by_rows = estimates(there)
        reach, moves = found[each.group], (by_rows @ D @ axes) / sigma[:, None]
        checked = axes.T @ checked @ axes
        tried = np.hstack([np.linalg.solve(checked, moves.T), rng.standard_normal(moves.T.shape)])
        size = np.sqrt(np.einsum("qn,qr,rn->n", tried, checked, tried))
        moved = np.abs(moves @ tried) * np.sqrt(each.enough) / np.maximum(size, 1e-300)
        furthest = moved.max(initial=0.0)
        assert furthest <= reach.sigmas * (1 + 1e-5) + 1e-9, str(each.group)
        if axes.shape[1] == each.shift.dof:  # else some of it is hardly checked, and goes further
            assert furthest == pytest.approx(reach.sigmas, rel=1e-4, abs=1e-9), str(each.group)
            same += 1
    assert same > len(blunders) / 3


def test_what_could_go_unseen_is_said_of_measurements_not_of_paper():
    body, paper = Group("body", "s1", "base_markers"), Group("frame", CAD, "mount")
    far, near = (
        FurthestMoved("lidar.tx", PROMISED_SIGMAS + 1.0),
        FurthestMoved("lidar.tx", PROMISED_SIGMAS - 1.0),
    )
    assert not hardly_checked({body: near, paper: far})
    (sentence,) = hardly_checked({body: far, paper: far})
    assert "s1: base_markers" in sentence and "lidar.tx by up to 4.0 of its sigmas" in sentence
    two, three = ({Group("body", f"s{i}", "base_markers"): far for i in range(n)} for n in (2, 3))
    assert "so could 1 other in" in hardly_checked(two)[0]
    assert "so could 2 others in" in hardly_checked(three)[0]
