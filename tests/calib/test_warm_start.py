"""A fit that starts from the state of another: what it takes over, and that it ends the same."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform

from calib.problem import build
from calib.problem.model import Model, Source
from calib.problem.spread import spread_of
from calib.residuals.surfaces import PlaneSurface
from calib.results import holdout
from calib.results.holdout import held_out
from calib.simulation import Spec
from calib.solve.estimate import SD, Start
from calib.solve.fit import solve

from . import rigs, simulated

MODEL = Model(("arm_link_length", "arm_joint_offset", "ring_range_offset"))
SMALL = Model(("arm_link_length", "ring_range_offset"))
PLANES = Spec(mesh=False, targets=0, locations=3, stops_per_location=2, column_step=40)


@pytest.fixture(scope="module", params=["mesh", "planes", "no lidar"])
def cold(request, tmp_path_factory):
    """A recording, and what a small model makes of it."""
    folder = tmp_path_factory.mktemp("cold") / "rec"
    if request.param == "planes":
        source, _ = simulated.made(folder, PLANES)
    else:
        changes = {"lidar": None} if request.param == "no lidar" else {}
        source = Source.open(rigs.write(folder, seed=4, **changes))
    return source, solve(build([source], SMALL))


def sigmas_apart(a, b):
    """The largest difference of two estimates' calibrations, in sigmas of the first."""
    off = []
    for v in a.variables:
        here, there = a.values[v.name], b.values[v.name]
        if v.kind == "pose":
            here, there = map(RigidTransform.from_matrix, (here, there))
            off.append((here.inv() * there).as_exp_coords())
        else:
            off.append(there - here)
    return np.abs(np.concatenate(off) / np.sqrt(np.diag(a.covariance))).max()


@pytest.mark.parametrize("known", ["what was met", "the state alone"])
def test_a_fit_goes_on_from_its_own_state(cold, known):
    """Planes too are found anew, and found the same; so is what beams meet, where it is asked."""
    source, first = cold
    problem = build([source], SMALL)
    start = first.start if known == "what was met" else Start(first.state)
    again = solve(problem, start=start)
    assert first.converged and again.converged
    assert again.iterations <= 2 < first.iterations
    assert sigmas_apart(first, again) < 0.01
    for a, b in zip(first.associations, again.associations, strict=True):
        np.testing.assert_array_equal(a.part, b.part)
    for meeting in problem.meetings.values():
        if isinstance(meeting, PlaneSurface):
            np.testing.assert_array_equal(
                meeting.planes.normal, first.scans[0].meeting.planes.normal
            )


def test_a_larger_model_goes_on_from_a_smaller_one_and_back(cold):
    source, first = cold
    whole = solve(build([source], MODEL))
    grown = solve(build([source], MODEL), start=first.start)
    assert grown.converged and grown.iterations <= whole.iterations
    assert sigmas_apart(whole, grown) < 0.15 < sigmas_apart(grown, _with(first, grown))
    smaller = solve(build([source], SMALL), start=whole.start)
    assert smaller.converged and sigmas_apart(first, smaller) < 0.15


def _with(estimate, other):
    """An estimate with zeros for what only another has."""
    missing = {v.name: np.zeros(v.dim) for v in other.variables if v.name not in estimate.values}
    return type("Values", (), {"values": missing | estimate.values})


def test_values_are_taken_over_by_the_names_of_their_parameters(cold):
    """A state may list parts of surfaces in another order, and know others."""
    source, first = cold
    state = dict(first.state)
    vectors = [name.removesuffix(".dofs") for name in state if name.endswith(".dofs")]
    on_mesh = bool(first.scans) and source.reference is not None
    assert any(name.startswith("0/reference") for name in vectors) == on_mesh
    for name in vectors:
        for key in (name, f"{name}.seen"):
            if key in state:
                state[key] = np.append(state[key][::-1], 1e3)
        state[f"{name}.dofs"] = np.append(state[f"{name}.dofs"][::-1], "of another rig")
    again = solve(build([source], SMALL), start=Start(state, first.start.met))
    assert again.iterations <= 2 and sigmas_apart(first, again) < 0.01


def test_what_a_state_does_not_know_starts_at_its_mean(cold):
    """Nothing but the poses is known: the rest is found again. Which plane a beam at its edge meets
    has several answers, each of which stays as it is when it is looked at again."""
    source, first = cold
    poses = {name: value for name, value in first.values.items() if value.shape == (4, 4)}
    again = solve(build([source], SMALL), start=Start(poses))
    pairs = list(zip(first.associations, again.associations, strict=True))
    differ = sum(np.count_nonzero(a.part != b.part) for a, b in pairs)
    assert differ <= sum(len(a.part) for a, _ in pairs) / 500
    assert again.converged and sigmas_apart(first, again) < (0.25 if differ else 0.01)


def test_a_start_forgets_what_it_is_told_to_and_nothing_whose_name_begins_alike():
    kept = {"planes_east": 1, "planes/region.m.sd": 2, "range_cyclic@1.2": 3, "a.planes": 4}
    gone = {f"planes{ending}": 0 for ending in ("", ".dofs", ".seen")} | {"range_cyclic@1": 0}
    assert Start(kept | gone).without(["planes", "range_cyclic@1"]).state == kept


def test_from_afar_beams_look_anew_what_they_meet(tmp_path):
    """A state of another place is a poor start, and no worse than that."""
    source = Source.open(rigs.write(tmp_path / "box", seed=4))
    whole = solve(build([source], SMALL))
    state = dict(whole.state)
    for name in ("faro", "faro.seen"):
        state[name] = rigs.retract("pose", state[name], np.array([0.01, 0, -0.01, 0.03, 0.03, 0]))
    again = solve(build([source], SMALL), start=Start(state))
    assert again.converged and sigmas_apart(whole, again) < 0.1
    met = [a.part != b.part for a, b in zip(whole.associations, again.associations, strict=True)]
    assert np.mean(np.concatenate(met)) < 0.01


def test_held_out_errors_do_not_depend_on_where_their_fit_starts(cold):
    source, first = cold
    passes = {}

    def told(start):
        """Held-out rms, and how many passes were told of."""
        seen = set()
        errors = held_out([source], SMALL, "stop", 1, lambda *what: seen.add(what[0]), start)
        passes[start is None] = len(seen)
        return errors.rms_mm

    assert told(first.start) == pytest.approx(told(None), rel=0.01)
    assert passes[False] < passes[True] or not first.scans


@pytest.mark.parametrize("arrives", [True, False])
def test_a_fold_scatters_as_the_fit_of_all_stops_does(tmp_path, monkeypatch, arrives):
    """Unless that leads to no optimum: then the fold is fitted from nothing."""
    source = Source.open(rigs.write(tmp_path / "rec", seed=4))
    model = Model(("arm_link_length", "stop_range_scatter"))
    known = {"stop_range_scatter": 7e-3}
    start = solve(build([source], model)).start
    start = Start(start.state | {f"{name}{SD}": np.array(sd) for name, sd in known.items()})
    found = []

    def solved(problem, *prior, **how):
        estimate = solve(problem, *prior, **how)
        if prior:
            return estimate
        at_first = how.get("start") is not None
        found.append((at_first, spread_of(estimate.problem)["stop_range_scatter"]))
        return replace(estimate, converged=arrives or not at_first)

    monkeypatch.setattr(holdout, "solve", solved)
    held_out([source], model, "stop", 1, lambda *what: None, start)
    assert found[0] == (True, known["stop_range_scatter"])
    assert len(found) == (1 if arrives else 2)
    assert arrives or found[1][1] < 0.8 * known["stop_range_scatter"]
