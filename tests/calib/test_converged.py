"""Converged means at the optimum: found from afar, never left upwards, and said where it is not."""

import csv
import shutil
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares

from calib.effects import find
from calib.exporters import export
from calib.problem import build
from calib.problem.model import Model, Source
from calib.residuals.robust import tukey_cost
from calib.runs.calibrate import calibrate
from calib.runs.diagnose import diagnose
from calib.solve import fit
from calib.solve.descent import MAX_PASSES, Descent
from calib.solve.fit import preview, solve
from calib.solve.loop import HOPEFUL, Loop
from chains.errors import InputError

from ..mishaps import MISHAPS, Scene
from ..worlds import World, write
from . import simulated
from .rigs import whitening

ARMS = ("arm_axes_miss_each_other", "arm_base_creeps", "arm_payload")
ARM = ("arm_link_length", "arm_joint_offset", "arm_axis_tilt", "arm_gravity_sag")
ADDED_TO_ARMS = (
    *("arm_axis_tilt", "arm_gravity_sag", "arm_joint_scale", "arm_joint_eccentricity"),
    *("arm_backlash", "arm_gear_error@2", "base_flex", "mount_slip@3000", "mount_creep"),
)
ADDED_TO_SCANS = (
    *("range_scale", "incidence_angle_bias", "warmup_drift", "arm_gravity_sag", "arm_axis_tilt"),
    *("ring_elevation_offset", "beam_origin_offset", "arm_joint_eccentricity"),
)


def whitened(problem, values):
    """Every row of trackers, targets and priors, plainly one after the other."""
    rows = [block.evaluate(values, False)[0] for block in problem.blocks]
    for v in problem.variables.values():
        rows.append(whitening(v) @ v.difference(v.mean, values[v.name]))
    return np.concatenate(rows)


@pytest.mark.parametrize("name", ARMS)
@pytest.mark.parametrize(
    "effects", [ARM[:2], pytest.param(ARM[:3], marks=pytest.mark.long), ARM], ids=len
)
def test_an_arm_under_a_tracker_reaches_the_attainable_cost(name, effects, shared):
    """scipy's trust region from the same start, derivatives by differences, finds none lower; with
    the robust weights that the fit came to."""
    found = solve(build([Source.open(shared / "recordings" / name)], Model(effects)))
    problem = found.problem
    unknowns = list(problem.variables.values())
    ends = np.cumsum([v.dim for v in unknowns])

    def rows(x):
        steps = np.split(x, ends[:-1])
        moved = {
            v.name: v.moved(problem.initial[v.name], v.sigma * step)
            for v, step in zip(unknowns, steps, strict=True)
        }
        return whitened(problem, moved)

    best = least_squares(rows, np.zeros(ends[-1]), x_scale="jac", xtol=1e-12, max_nfev=60)
    assert found.converged
    assert found.cost == pytest.approx(np.square(whitened(problem, found.values)).sum() / 2)
    assert found.cost < best.cost + 1e-3


def robust_cost(problem, estimate, values):
    """Half the robust chi-square at a state: what beams meet, their sigmas and scales as of the
    estimate; priors included."""
    cost = np.square(whitened(problem, values)).sum() / 2
    for scan, met in zip(estimate.scans, estimate.associations, strict=True):
        here, there = scan.rows(estimate.values, met), scan.rows(values, met)
        z = np.where(there.usable, there.residual_m / here.sigma_m, 0.0)
        cost += tukey_cost(z, here.scale)
    return cost


def grown(source, small, effect):
    """The problem with one effect more, solved from a smaller one's optimum, and where it began."""
    problem = build([source], Model().plus((find(effect),)), meetings=small.problem.meetings)
    estimate = solve(problem, start=small.start)
    wide = estimate.problem
    began = {n: small.values.get(n, v.mean) for n, v in wide.variables.items()}
    same = {n: v for n, v in began.items() if np.shape(v) == np.shape(wide.variables[n].mean)}
    assert same.keys() == began.keys()
    return wide, estimate, began


@pytest.fixture(scope="module", params=["arm_payload", "arm_base_creeps", "tiny"])
def fitted(request, tmp_path_factory):
    """A recording, its fit, and effects to add to it."""
    if request.param == "tiny":
        source, _ = simulated.made(tmp_path_factory.mktemp("tiny") / "rec", "tiny")
        return source, solve(build([source], Model())), ADDED_TO_SCANS
    source = Source.open(request.getfixturevalue("shared") / "recordings" / request.param)
    return source, solve(build([source], Model())), ADDED_TO_ARMS


@pytest.mark.long
def test_adding_an_effect_never_raises_the_cost(fitted):
    source, small, added = fitted
    assert small.converged
    for name in added:
        problem, estimate, began = grown(source, small, name)
        before = robust_cost(problem, estimate, began)
        after = robust_cost(problem, estimate, estimate.values)
        assert after <= before * (1 + 1e-9), name
        assert estimate.converged, name


def edited(folder, to, change):
    """A copy of a recording with its stops.csv changed: `change` of its rows, by column."""
    shutil.copytree(folder, to, copy_function=shutil.copyfile)
    with (to / "stops.csv").open() as file:
        rows = list(csv.DictReader(file))
    change(rows)
    with (to / "stops.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, rows[0])
        writer.writeheader()
        writer.writerows(rows)
    return to


@pytest.mark.parametrize(
    "turns", [{"joint_3": 90}, {"joint_2": 180}, {"joint_2": -90, "joint_5": 90}]
)
def test_an_arm_whose_zeros_are_off_by_quarter_turns_is_fitted_as_any_other(
    turns, shared, tmp_path
):
    """From CAD's zeros no way leads downhill to the arm."""

    def turn(rows):
        for row in rows:
            for joint, angle in turns.items():
                row[joint] = float(row[joint]) + np.radians(angle)

    folder = shared / "recordings" / "arm_base_creeps"
    plain = solve(build([Source.open(folder)], Model()))
    problem = build([Source.open(edited(folder, tmp_path / "rec", turn))], Model())
    found = solve(problem)
    assert found.converged
    names, offsets = (x["arm_joint_offset"] for x in (problem.variables, found.values))
    offset = dict(zip(names.dofs, offsets, strict=True))
    for joint, angle in turns.items():
        assert np.cos(offset[joint] + np.radians(angle)) > np.cos(0.05)
    # What is left is what the prior asks for so large a zero.
    prior = sum((np.radians(angle) / 0.005) ** 2 / 2 for angle in turns.values())
    assert found.cost < 1.05 * prior + 2 * plain.cost


def swapped(rows):
    """Two bodies exchanged."""
    for row in rows:
        for part in ("x", "y", "z", "qw", "qx", "qy", "qz"):
            a, b = f"base_markers.{part}", f"mount_markers.{part}"
            row[a], row[b] = row[b], row[a]


def misread(rows):
    """Quaternions written as x, y, z, w."""
    for row in rows:
        for body in ("base_markers", "mount_markers"):
            names = [f"{body}.{q}" for q in ("qw", "qx", "qy", "qz")]
            for name, value in zip(names, [row[n] for n in (*names[1:], names[0])], strict=True):
                row[name] = value


def shifted(rows):
    """Every row at the stop before."""
    names = [row["stop"] for row in rows]
    for row, name in zip(rows, names[1:] + names[:1], strict=True):
        row["stop"] = name


@pytest.fixture(scope="module")
def tiny(tmp_path_factory):
    source, _ = simulated.made(tmp_path_factory.mktemp("good") / "rec", "tiny")
    return source.recording.folder


@pytest.mark.parametrize("damage", [swapped, misread, shifted])
def test_a_hopeless_start_is_given_up_and_nothing_of_it_looks_usable(
    damage, tiny, tmp_path, rigcal
):
    rec = edited(tiny, tmp_path / "rec", damage)
    code, out, err = rigcal("fit", rec, "-o", tmp_path / "run")
    assert code == 3 and "NOT CONVERGED" in out and "NOT CONVERGED" in err
    code, _, err = rigcal("export", tmp_path / "run", "-o", tmp_path / "out")
    assert code == 2 and "NOT CONVERGED" in err and not (tmp_path / "out").exists()
    code, _, err = rigcal("export", tmp_path / "run", "-o", tmp_path / "out", "--force")
    assert code == 0
    for file in (tmp_path / "out").iterdir():
        assert "NOT CONVERGED" in file.read_text(), file
    code, _, err = rigcal("apply", tmp_path / "run", rec, "-o", tmp_path / "clouds")
    assert code == 2 and "NOT CONVERGED" in err


def test_a_hopeless_fit_takes_no_more_passes_than_a_good_one_might(tiny, tmp_path):
    source = Source.open(edited(tiny, tmp_path / "rec", shifted))
    found = solve(build([source], Model()))
    assert not found.converged and found.iterations <= 11


@pytest.mark.parametrize("damage", [swapped, misread])
def test_bodies_that_no_start_brings_near_are_not_followed_far(damage, tiny, tmp_path, monkeypatch):
    """All starts together, with and without weights, take no more steps than one descent may; two
    to four descents went to their end before. And nobody asks the scans how the LiDAR is turned."""
    monkeypatch.setattr(fit, "lidars_turned", None)
    steps, step = [], Descent.step
    monkeypatch.setattr(Descent, "step", lambda self: steps.append(1) or step(self))
    problem = build([Source.open(edited(tiny, tmp_path / "rec", damage))], Model())
    assert not solve(problem).converged and len(steps) <= MAX_PASSES
    preview(problem)


def test_weights_are_not_sought_for_long_where_rows_stay_hopeless(tmp_path, monkeypatch):
    """An encoder that is stuck: 24 rounds of weights at most, where 200 are allowed."""
    source, _ = simulated.made(tmp_path / "rec", "laser-tracker")
    joints = source.recording.joints.copy()
    joints[:, 2] = joints[0, 2]
    wrong = replace(source, recording=replace(source.recording, joints=joints))
    rounds, weigh = [], Loop.take_weights
    monkeypatch.setattr(Loop, "take_weights", lambda self, *a: rounds.append(1) or weigh(self, *a))
    few = np.arange(len(joints)) < 12
    assert not preview(build([wrong], Model(), [few])).converged
    assert len(rounds) <= 3 * HOPEFUL


@pytest.fixture
def stops_short(monkeypatch):
    """Fits that may take one pass at a time, and half of its step."""
    moved = Descent.moved
    monkeypatch.setattr("calib.solve.descent.MAX_PASSES", 1)
    monkeypatch.setattr(Descent, "moved", lambda self, *a: moved(self, *a[:2], 0.5))


def test_a_fit_that_is_not_at_its_optimum_is_not_called_converged(tiny, request):
    """Too few passes, and a step left that would lower the cost."""
    problem = build([Source.open(tiny)], Model())
    assert solve(problem).converged
    request.getfixturevalue("stops_short")
    assert not solve(problem).converged


@pytest.mark.usefixtures("stops_short")
def test_python_refuses_too(tiny, tmp_path):
    run = calibrate([tiny], tmp_path / "run", hold_out="none")
    with pytest.raises(InputError, match="--force"):
        export(run, tmp_path / "out")


@pytest.mark.long
def test_scales_that_swing_about_the_state_come_to_rest(tmp_path):
    """Stops of an XT32 scatter by three times a beam's sigma: the scale of each scan's residuals
    follows the state, and the state the scale. At half the way each time, both come to rest."""
    write(World(seed=266072375, stop_scatter_m=3e-3), tmp_path / "rec")
    estimate = solve(build([Source.open(tmp_path / "rec")], Model()))
    assert estimate.converged and estimate.iterations < 100


@pytest.mark.long
def test_stops_each_far_off_by_itself_have_an_optimum(tmp_path):
    """A wave over time, of 6 mm: the scales of 12 scans drift for 60 passes, and what a step still
    lowers the cost by comes and goes."""
    wave = "{name: mine, site: range, unit: m, sigma: 0.003, basis: [sin(time_s / 300)]}"
    (tmp_path / "wave.yaml").write_text(wave)
    simulated.made(tmp_path / "rec", "tiny", 1, **{str(tmp_path / "wave.yaml"): 2.0})
    run = calibrate([tmp_path / "rec"], tmp_path / "run", hold_out="none")
    assert run.summary["converged"] and run.summary["iterations"] < 150


@pytest.mark.long
def test_what_is_out_where_nothing_converges_is_a_suspect_and_no_blunder(
    tiny, tmp_path, monkeypatch
):
    """A body that was moved at one stop, and no optimum with or without it."""
    recording = shutil.copytree(tiny, tmp_path / "rec")
    scene = Scene(recording, np.random.default_rng(1))
    (moved,) = MISHAPS["mount body shifted at one stop"].apply(scene, 10).right
    monkeypatch.setattr("calib.solve.loop.AT_OPTIMUM", -1.0)  # nothing is
    found = diagnose(calibrate([recording], tmp_path / "run", hold_out="none"))
    said = " ".join(found.sentences)
    assert found.verdict == "bad_data" and not found.blunders and not found.command
    assert "not converged" in said and f"Furthest from everything else: {moved[:6]}" in said


@pytest.fixture(scope="module")
def of_arm(tmp_path_factory):
    """An arm under a tracker alone, its fit, and the problem with one effect more."""
    source, _ = simulated.made(tmp_path_factory.mktemp("arm") / "rec", "laser-tracker")
    small = solve(build([source], Model()))
    return small, build([source], Model().plus((find("arm_gravity_sag"),)))


def led_astray(monkeypatch):
    """Weights that leave the optimum: joint zeros are off by 2 mrad."""

    def reweigh(self, beams):
        moved = self.values["arm_joint_offset"] + 2e-3
        self.values = {**self.values, "arm_joint_offset": moved}
        return True

    monkeypatch.setattr(Loop, "reweigh", reweigh)


def test_a_fit_of_an_arm_that_is_led_astray_goes_back_to_where_it_began(of_arm, monkeypatch):
    small, wide = of_arm
    alone = solve(wide, start=small.start)
    led_astray(monkeypatch)
    found = solve(wide, start=small.start)
    assert found.converged and found.cost == pytest.approx(alone.cost, abs=1e-3)
    assert found.cost <= small.cost + 1e-9


def test_a_cost_that_an_effect_has_raised_is_no_optimum(of_arm, monkeypatch):
    small, wide = of_arm
    led_astray(monkeypatch)
    monkeypatch.setattr("calib.solve.fit._stay_below", lambda loop, descend: None)
    monkeypatch.setattr("calib.solve.loop.AT_OPTIMUM", np.inf)  # or it is not called converged
    assert not solve(wide, start=small.start).converged
