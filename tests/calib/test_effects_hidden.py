"""Every effect, hidden by the simulator, is what the fit's rows take it for."""

from functools import cache

import numpy as np
import pytest

from calib.effects import CATALOGUE, DEFAULT, Site, View, load_effects
from calib.problem import build
from calib.problem.model import Model, Source
from calib.residuals.beams import Columns
from calib.solve.fit import solve
from chains.errors import InputError

from . import rigs
from .hidden import STANDING, at_truth, every_column, hide, residuals
from .simulated import made, off_mesh

# The noise of every LiDAR of the catalogue dithers its rounding away.
DITHERED = "range_quantisation"
# Not those that only widen what rows may be off: they are in `test_components`.
SHOWN = [e for e in CATALOGUE if e.site is not Site.NOISE and not e.widens]
OF_OTHER_ARMS = ("prismatic", "mimic")  # see test_rail and test_coupled
SHOWN = [e.name for e in SHOWN if e.name != DITHERED and e.joint_kind not in OF_OTHER_ARMS]
# Effects that trackers and targets alone can show.
UNSEEN_BY_BEAMS = {e.name for e in CATALOGUE if e.site in (Site.TRACKER, Site.TARGET)}
# Their sigma is a maker's tolerance, not what is left after his calibration.
BUILT_ROUGHLY = ("arm_link_length", "arm_joint_offset", "arm_axis_tilt", "ring_range_offset")
BUILT_ROUGHLY += ("arm_geometry",)


@pytest.mark.parametrize("name", [*SHOWN, "range_cyclic@0.8", "arm_gear_error@3", "mount_slip@300"])
@pytest.mark.long
def test_what_is_hidden_is_what_the_rows_explain(tmp_path, name):
    source, truth = hide(tmp_path / "rec", name)
    problem, values, theta = at_truth(source, truth, name)
    left_m, left = residuals(problem, values)
    shown_m, shown = residuals(problem, {**values, name: 0 * theta})
    # A beam that its effect turns across an edge meets another surface: so not the largest.
    left_m, shown_m = (np.quantile(np.abs(r), 0.9) for r in (left_m, shown_m))
    assert left_m < 0.02 * shown_m + 1e-6
    assert np.abs(left).max() < 0.01 * np.abs(shown).max() + 1e-3
    if name in UNSEEN_BY_BEAMS:
        assert shown_m < 1e-6 and np.sqrt(np.mean(shown**2)) > 0.1
    else:
        largest_m = 0.1 if name in BUILT_ROUGHLY else 0.02
        assert 1e-4 < shown_m < largest_m, "size 1 is not what one meets"
    flipped_m, flipped = residuals(problem, {**values, name: -theta})
    if name not in UNSEEN_BY_BEAMS:
        assert np.quantile(np.abs(flipped_m), 0.9) > 1.5 * shown_m
    if np.abs(shown).max() > 1e-3:
        assert np.abs(flipped).max() > 1.5 * np.abs(shown).max()


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A function: a recording with nothing wrong, of a rig that an effect can act on."""
    folder = tmp_path_factory.mktemp("whole")

    @cache
    def of(moves):
        return every_column(folder / moves, base_moves=moves)

    return lambda name: of("location" if name in STANDING else "stop")


@pytest.mark.parametrize("name", SHOWN)
def test_rows_move_as_their_derivatives_say(whole, name):
    source, truth = whole(name)
    truth = {**truth, "effects": {name: np.zeros(1000)}}
    problem, values, theta = at_truth(source, truth, name)
    term = next(t for t in problem.terms[0] if t.variable == name)
    sigma = np.array([p.sigma for p in term.effect.params(source.rig)])[term.free]
    step = 0.01 * sigma * np.random.default_rng(1).standard_normal(len(theta))
    there, back = {**values, name: step}, {**values, name: -step}
    scan = problem.scans[-1]
    if term.effect.site in (Site.BEAM, Site.REFERENCE):
        association = scan.associate(values, near_edges=True)
        moved = scan.rows(there, association).residual_m - scan.rows(back, association).residual_m
        rows = scan.rows(values, association)
        expected = np.zeros(len(moved))
        if name in rows.dense:
            expected = rows.dense[name] @ step
        for c in (c for c in rows.sparse if isinstance(c, Columns) and c.variable == name):
            expected = np.where(c.index >= 0, c.value * step[c.index], 0.0)
        assert np.abs(expected[rows.usable]).max() > 1e-7
        close = np.abs(moved / 2 - expected)[rows.usable] <= 1e-4 * np.abs(expected).max()
        assert close.all()
        return
    moving = 0
    for block in problem.blocks:
        if name in block.variables:
            _, d = block.evaluate(values, True)
            moved = block.evaluate(there, False)[0] - block.evaluate(back, False)[0]
            np.testing.assert_allclose(moved / 2, d[name] @ step, atol=1e-4)
            moving += np.abs(d[name] @ step).max() > 1e-3
    placed, far = (scan.stops.in_reference("lidar", v).T[0] for v in (back, there))
    moving += np.abs(far - placed).max() > 1e-7
    assert moving


@pytest.mark.parametrize("name", [e.name for e in CATALOGUE if e.site is Site.NOISE])
def test_hidden_noise_grows_as_the_effect_says(tmp_path, name):
    source, truth = hide(tmp_path / "rec", name, noise=1, column_step=25, sweeps=60)
    (theta,) = truth["effects"][name]
    growth, spread = [], []
    for k in range(len(source.recording.stops)):
        scan, (_, hits) = source.recording.scan(k), off_mesh(source, truth, k)
        steep = hits.incidence_rad < np.radians(80)
        nominal_m = source.rig.lidar.sigma_range(hits.range_m, hits.incidence_rad)
        by = {
            "noise_range": np.log(hits.range_m / 3.0),
            "noise_incidence": -np.log(np.cos(hits.incidence_rad)),
            "noise_intensity": -np.log(scan.intensity / 100.0),
        }
        growth.append(by[name][steep])
        spread.append(np.log(scan.range_std_m / nominal_m)[steep])
    slope, _ = np.polyfit(np.concatenate(growth), np.concatenate(spread), 1)
    assert slope == pytest.approx(theta, rel=0.05)


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["beam_origin_offset", "range_cyclic@1", "base_flex", "mount_slip@300"]
)
def test_a_fit_finds_what_was_hidden(tmp_path, name):
    """With noise, mesh errors and hardware off from paper, within its own sigma."""
    source, truth = made(tmp_path / "rec", "tiny", 5, **{name: 1.0})
    problem = build([source], Model((*DEFAULT, name)))
    found = solve(problem)
    first = 0
    for variable in found.variables:
        if variable.name == name:
            break
        first += variable.dim
    theta = np.array(truth["effects"][name])
    sigma = np.sqrt(np.diag(found.covariance))[first : first + len(theta)]
    assert found.converged
    assert np.sqrt(np.mean(((found.values[name] - theta) / sigma) ** 2)) < 2.5
    assert np.abs(theta / sigma).max() > 4


def test_an_effect_that_has_nothing_to_act_on_is_not_hidden(tmp_path):
    with pytest.raises(InputError, match=f"'{DITHERED}' has nothing to act on"):
        hide(tmp_path / "rec", DITHERED)
    assert not (tmp_path / "rec").exists()


def test_an_effect_is_hidden_by_any_spelling(tmp_path):
    _, truth = hide(tmp_path / "a", "range_cyclic@0.80")
    assert truth["hidden"] == {"range_cyclic@0.8": 1.0}
    assert len(truth["effects"]["range_cyclic@0.8"]) == 2
    mine = tmp_path / "mine.yaml"
    mine.write_text(
        "{name: damp, site: range, unit: m, sigma: 0.01, basis: ['(humidity - 0.3) * range']}"
    )
    source, truth = hide(tmp_path / "b", str(mine))
    (theta,) = truth["effects"]["damp"]
    off_m, hits = off_mesh(source, truth, 2)
    damp = source.recording.covariates["humidity"][2] - 0.3
    np.testing.assert_allclose(off_m, theta * damp * hits.range_m, atol=1e-5)
    with pytest.raises(InputError, match="did you mean 'range_cyclic'"):
        hide(tmp_path / "c", "range_cyclc@0.8")


@pytest.mark.parametrize(
    "effect",
    [e for e in CATALOGUE if e.shape_name and e.joint_kind != "prismatic" and not e.of_members],
    ids=lambda e: e.name,
)
def test_every_shape_to_try_is_another_effect(whole, effect):
    source, truth = whole(effect.name)
    problem, values, _ = at_truth(
        source, {**truth, "effects": {effect.name: np.zeros(99)}}, effect.name
    )
    stops, seen = stops_of(source), []
    views = [stops]
    if effect.site in (Site.BEAM, Site.REFERENCE):
        views = [scan.rows(values).view for scan in problem.scans]
    shapes = effect.shapes(stops)
    assert len(set(shapes)) == len(shapes) > 2
    for shape in shapes:
        chosen = effect.at(shape)
        assert load_effects(chosen.name)[0].shape == pytest.approx(shape, rel=1e-5)
        seen.append(np.concatenate([chosen.basis(view) for view in views]))
        assert np.isfinite(seen[-1]).all() and seen[-1].any()
    assert all((a != b).any() for i, a in enumerate(seen) for b in seen[:i])


def stops_of(source: Source) -> View:
    """What effects see of a recording's stops."""
    count = len(source.recording.stops)
    return View(source.rig, count, source.columns, source.recording.joints)


def test_a_slip_is_sought_between_stops(whole, tmp_path):
    (effect,) = load_effects("mount_slip")
    stops = stops_of(whole(effect.name)[0])
    elapsed_s = stops["elapsed_s"]
    assert elapsed_s.min() == 0
    for when in effect.shapes(stops):
        assert 3 <= (elapsed_s > when).sum() <= len(elapsed_s) - 3
    few = Source.open(rigs.write(tmp_path / "box"))
    assert len(few.recording.stops) < 6 and effect.shapes(stops_of(few)) == ()
