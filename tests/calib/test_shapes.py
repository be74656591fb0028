"""What is known of an effect with a shape, a time constant say, includes what is not known of that:
against refits with other shapes."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import yaml

from calib import problem as problems
from calib.diagnosis.search import shapes
from calib.effects import CATALOGUE, find
from calib.linear.linearise import beams_cost
from calib.problem.model import Model
from calib.report.calibration import _numbers
from calib.results.intervals import intervals
from calib.runs.calibrate import calibrate
from calib.runs.estimates import variable_estimates
from calib.runs.run import Run
from calib.show.tables import effect_cells
from calib.simulation import Spec
from calib.solve.fit import shapes_freed, solve

from .simulated import made

SPEC = Spec(lidar="hesai_pandarxt32", locations=4, stops_per_location=3, column_step=100)
DRIFT, STEP = "warmup_drift@480", "shape of warmup_drift@480"
CHANGE = 0.06  # of the shape's logarithm, to either side
SMALLER, LARGER = (f"warmup_drift@{480 * np.exp(by):.6g}" for by in (-CHANGE, CHANGE))
# Tukey's cost curves less than its weights say: by 0.86 where errors are normal.
TUKEY = (0.80, 0.92)


def with_shape(shape: float) -> Model:
    names = (
        "arm_link_length",
        "arm_joint_offset",
        "ring_range_offset",
        f"warmup_drift@{shape:.6g}",
    )
    return Model(effects=names)


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    return made(tmp_path_factory.mktemp("shapes") / "rec", SPEC, 5, **{DRIFT: 1.0})[0]


@pytest.fixture(scope="module")
def fits(source):
    """Of a smaller shape, the true one, and a larger one."""
    shapes = [480 * float(np.exp(by)) for by in (-CHANGE, 0.0, CHANGE)]
    models = [with_shape(shape) for shape in shapes]
    return [
        (model, solve(problems.build([source], model), tolerance=1e-9, spread=False))
        for model in models
    ]


def test_a_drift_is_as_uncertain_as_its_time_constant_makes_it(fits):
    """The shape's variance is the inverse curvature of the least cost over it, and that of the
    drift grows by the square of how much it changes with the shape."""
    (_, less), (model, fit), (_, more) = fits
    freed = shapes_freed(fit, model)
    known = intervals(freed)
    shape, amount = (known.of([name]).graph[0, 0] for name in (STEP, DRIFT))

    slope = (more.values[LARGER][0] - less.values[SMALLER][0]) / (2 * CHANGE)
    alone = fit.covariance_of([DRIFT])[0, 0]
    assert amount == pytest.approx(alone + slope**2 * shape, rel=0.03)
    assert amount > 1.2 * alone  # so that it matters here

    costs = [cost_as(fit, each) for each in (less, fit, more)]
    curvature = (costs[0] + costs[2] - 2 * costs[1]) / CHANGE**2
    prior = 1 / freed.problem.variables[STEP].sigma[0] ** 2
    assert TUKEY[0] < (curvature + prior) * shape < TUKEY[1]


def cost_as(fit, other):
    """Half the chi-square of another fit, its beams weighed as a fit weighs them."""
    at = other.problem, other.values, other.associations
    return other.cost - other.linear.beams_chi2 / 2 + beams_cost(*at, fit.linear.weighed)


def test_the_fit_itself_is_the_same(fits):
    """Only what is known of it changes, and no sigma becomes smaller."""
    _, (model, fit), _ = fits
    freed = shapes_freed(fit, model)
    for name, value in fit.values.items():
        np.testing.assert_array_equal(freed.values[name], value)
    names = [v.name for v in fit.variables]
    before, after = (np.diag(e.covariance_of(names)) for e in (fit, freed))
    assert np.all(after > before * (1 - 1e-6))


def test_without_such_an_effect_it_is_the_same_estimate(fits):
    _, (_, fit), _ = fits
    assert shapes_freed(fit, Model()) is fit


def test_two_shapes_of_one_effect_have_a_sigma_each(source):
    waves = "range_cyclic@1", "range_cyclic@1.7"
    model = Model(effects=("ring_range_offset", *waves))
    fit = solve(problems.build([source], model), spread=False)
    known = intervals(shapes_freed(fit, model))
    apart = known.of([f"shape of {name}" for name in waves]).covariance
    assert np.all(np.diag(apart) > 0)
    assert abs(apart[0, 1]) < np.sqrt(apart[0, 0] * apart[1, 1])


def test_a_run_tells_the_shape_with_its_sigma(source, tmp_path):
    run = calibrate([source.recording.folder], tmp_path / "run", with_shape(480))
    document = yaml.safe_load((run.folder / "solution.yaml").read_text())
    told = document["effects"][DRIFT]["shape"]
    assert (told["name"], told["value"]) == ("tau_s", 480.0)
    assert 5 < told["sigma"] < 480
    shape = Run.open(run.folder).solution.shared.effects[DRIFT].shape
    assert shape.sigma == told["sigma"]
    row = next(row for row in variable_estimates(run) if row.variable == DRIFT)
    assert next(iter(effect_cells(row))) == ("tau", f"480 ± {told['sigma']:.0f}", "s", True)
    assert "shape" not in document["effects"]["ring_range_offset"]
    tau, amount = _numbers(row, {})  # as the report lists them
    texts = [cell.text for cell in tau]
    assert texts == ["tau", "480", f"{told['sigma']:.0f}", "", "s", "", "", "yes"]
    assert amount[0].text == "amount" and len(amount) == len(tau)


def test_a_shape_at_which_the_basis_jumps_is_not_estimated():
    """The time of a slip lies anywhere between two stops: it has no derivative."""
    smooth = {e.name for e in CATALOGUE if e.has_derivative_by_shape}
    assert {"warmup_drift", "near_range_bias", "range_cyclic", "mount_settle"} <= smooth
    assert not {"mount_slip", "arm_joint_slip", "range_step", "arm_gear_error"} & smooth
    assert {e.name for e in CATALOGUE if e.jumps} >= {"body_slip", "tracker_slip", "base_slip"}


def test_of_places_that_each_seem_better_from_the_other_that_which_costs_less_is_kept(monkeypatch):
    """Rows between the two err another way than the model has it on either side."""
    costs = {"mesh_seam_x@0.5": 11.0, "mesh_seam_x@0.6": 10.0}
    here, there = (find(name) for name in costs)

    def fitted(effect):
        estimate = SimpleNamespace(linear=True, robust_cost=costs[effect.name])
        return SimpleNamespace(estimate=estimate, model=SimpleNamespace(effects=(effect,)))

    def better(stand, names, progress):
        (effect,) = stand.model.effects
        return {effect.name: there if effect is here else here}

    monkeypatch.setattr(shapes, "_better_shapes", better)
    monkeypatch.setattr(
        shapes, "_with_shapes", lambda stand, swapped, progress: fitted(*swapped.values())
    )
    for first in (here, there):
        stand, swapped = shapes.retuned(fitted(first), [first.name], print)
        assert stand.model.effects == (there,)
        assert swapped == ({here.name: there} if first is here else {})
