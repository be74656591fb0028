"""Scans of very many beams: a fit begins with few of them, and what is missing is looked for in
some."""

from dataclasses import replace

import numpy as np
import pytest

import calib
from calib import problem as problems
from calib.diagnosis import linear
from calib.diagnosis.stand import Stand
from calib.problem import Problem
from calib.problem.model import Model
from calib.simulation import Spec
from calib.solve import fit
from calib.solve.loop import Loop
from chains import se3
from chains.errors import NothingMetError
from tests.calib.simulated import made

DENSE = Spec(lidar="hesai_pandarxt32", locations=4, stops_per_location=2, column_step=4)
SOME = 2000  # beams of each scan
OF_BEAMS = ("encoder_eccentricity", "elevation_scale", "spin_axis_wobble", "beam_origin_offset")
OF_BODIES = ("arm_gravity_sag", "arm_joint_scale", "base_flex", "target_sphere_offset")


def quiet(*_):
    pass


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """A recording of 14,000 beams a scan."""
    return made(tmp_path_factory.mktemp("dense") / "rec", DENSE, 5)[0]


@pytest.fixture(scope="module")
def direct(recorded):
    """A fit that uses all beams from its first pass on."""
    return fit.solve(problems.build([recorded], Model()))


def few_first(recorded, monkeypatch, few):
    """A fit that begins with so many beams of each scan; and of how many each pass was."""
    monkeypatch.setattr(fit, "FEW_BEAMS", few)
    problem, told = problems.build([recorded], Model()), []
    assert fit.is_dense(problem)
    return fit.solve(problem, progress=lambda what, *_: told.append(what)), set(told)


def test_a_fit_that_begins_with_few_beams_ends_where_one_of_all_beams_does(
    recorded, direct, monkeypatch
):
    assert not fit.is_dense(direct.problem)
    found, told = few_first(recorded, monkeypatch, 1000)
    assert "pass 4, few beams" in told
    assert found.converged and found.iterations < direct.iterations
    for met, before in zip(found.associations, direct.associations, strict=True):
        assert met.part.shape == before.part.shape
    sigma = np.sqrt(np.diag(direct.covariance))
    pairs = ((direct.values[v.name], found.values[v.name]) for v in direct.variables)
    off = [se3.log(se3.inverse(a) @ b) if a.shape == (4, 4) else b - a for a, b in pairs]
    assert np.abs(np.concatenate(off) / sigma).max() < 0.2
    np.testing.assert_allclose(np.sqrt(np.diag(found.covariance)), sigma, rtol=0.02)
    assert found.robust_cost < direct.robust_cost * 1.0005


@pytest.mark.parametrize("turned", [False, True])
def test_where_few_beams_lead_nowhere_a_fit_is_that_of_all(recorded, direct, monkeypatch, turned):
    """They meet nothing, or their fit comes to no end."""
    thinned = Problem.thinned

    def astray(self, most):
        if not turned:
            raise NothingMetError("none of its beams meets a surface")
        few = thinned(self, most)
        return replace(few, scans=few.scans[1:], terms=few.terms)

    def unsettled(self, tolerance=None):
        estimate = ended(self, tolerance)
        few = len(estimate.scans) < len(direct.scans)
        return replace(estimate, converged=estimate.converged and not few)

    ended = Loop.estimate
    monkeypatch.setattr(Problem, "thinned", astray)
    monkeypatch.setattr(Loop, "estimate", unsettled)
    found, told = few_first(recorded, monkeypatch, 1000)
    assert turned == any(what.endswith("few beams") for what in told)
    assert found.iterations == direct.iterations
    for name, value in direct.values.items():
        np.testing.assert_array_equal(found.values[name], value)


def test_beams_that_are_not_looked_at_cost_what_beams_alone_tell_and_no_more(
    recorded, direct, monkeypatch
):
    """What beams alone tell is known less well by the root of how many fewer they are; what the
    arm, the tracker and the targets tell, as well as before."""
    stand = Stand([recorded], Model(), direct.problem, direct)
    whole = stand.look(quiet)
    count = np.median([np.count_nonzero(met.part >= 0) for met in direct.associations])
    monkeypatch.setattr(linear, "LOOKED_BEAMS", SOME * len(direct.scans))
    monkeypatch.setattr(linear, "FEWEST_LOOKED", 1)
    some = stand.look(quiet)
    fewer = SOME / count
    assert some.linear.weight_m2 / whole.linear.weight_m2 == pytest.approx(fewer, rel=0.1)
    tests = [{c.effect.name: c.test for c in look.named.candidates} for look in (whole, some)]
    sigma = [
        {name: np.linalg.norm(test.whiten) for name, test in each.items() if test.dof}
        for each in tests
    ]
    for family in OF_BEAMS:
        assert sigma[0][family] / sigma[1][family] == pytest.approx(np.sqrt(fewer), rel=0.1)
    for family in OF_BODIES:
        assert sigma[0][family] / sigma[1][family] == pytest.approx(1.0, abs=0.03)
    assert some.named.common == pytest.approx(whole.named.common, rel=0.2)


def test_a_diagnosis_of_some_beams_names_what_is_missing_and_says_how_many_they_were(
    tmp_path, monkeypatch
):
    made(tmp_path / "rec", DENSE, 6, incidence_angle_bias=1.0)
    run = calib.fit([tmp_path / "rec"], tmp_path / "run", hold_out="none")
    monkeypatch.setattr(linear, "LOOKED_BEAMS", SOME * 8)
    monkeypatch.setattr(linear, "FEWEST_LOOKED", 1)
    found = calib.diagnose(run)
    assert [c["effect"] for c in found.candidates if c["step"]] == ["incidence_angle_bias"]
    said = "looked for in 0.0 of 0.1 million beams, drawn evenly from every scan"
    assert any(said in each for each in found.sentences), found.sentences
