"""The budget in a report: what each variable does to ranges, and how unsure it leaves them."""

import numpy as np
import pytest

from calib.report import Evidence
from calib.report.budget import beam_jacobian, budget
from calib.results.solution import Solution
from calib.runs.run import Run

from .rigs import retract
from .viewed import small_run


@pytest.fixture(scope="module")
def evidence(once) -> Evidence:
    return Evidence.of([Run.open(once(small_run) / "run")])


@pytest.mark.parametrize(
    "name", ["lidar", "arm_joint_offset", "arm_link_length", "ring_range_offset", "faro"]
)
def test_derivatives_are_differences_of_residuals(evidence, name):
    """The columns of a variable, against residuals with it moved; beams keep what they meet."""
    scan, values = evidence.problem.scans[0], evidence.values
    J = beam_jacobian(scan, values)
    association = scan.associate(values, near_edges=False)
    kept = np.flatnonzero(scan.rows(values, association).weight > 0)
    assert len(kept) == len(J[name])

    def residuals(step):
        kind = evidence.problem.variables[name].kind
        moved = values | {name: retract(kind, values[name], step)}
        return scan.rows(moved, association).residual_m[kept]

    step = 1e-5 * np.random.default_rng(0).normal(size=J[name].shape[1])
    difference = (residuals(step) - residuals(-step)) / 2
    np.testing.assert_allclose(J[name] @ step, difference, atol=1e-4 * np.abs(difference).max())


def test_a_budget_is_the_rms_of_what_one_variable_does(evidence):
    """Where the only thing unknown is every ring's zero, ranges are unsure by just as much."""
    solution, sigma = evidence.run.solution, 0.003
    rings = np.array([key.unknown == "ring_range_offset" for key in solution.keys])
    told = Solution(
        shared=solution.shared,
        recordings={},
        not_estimated=[],
        keys=solution.keys,
        covariance=np.diag(np.where(rings, sigma**2, 0.0)),
    )
    values = evidence.values | {"ring_range_offset": np.full(rings.sum(), 0.002)}
    found = budget(evidence.problem, values, told)
    assert found.uncertain_m["ring_range_offset"] == pytest.approx(sigma)
    assert found.moved_m["ring_range_offset"] == pytest.approx(0.002)
    assert found.uncertain_m["lidar"] == 0.0
    assert "faro" in found.uncertain_m and "faro" not in found.moved_m  # no paper says where
