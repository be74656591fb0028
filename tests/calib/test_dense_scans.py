"""Scans of very many beams: what is missing is looked for in some of them."""

import re

import numpy as np
import pytest

import calib
from calib import effects
from calib import problem as problems
from calib.diagnosis import linear
from calib.diagnosis.linear import rows_along
from calib.diagnosis.score import away_from_model
from calib.diagnosis.stand import Stand
from calib.problem.model import Model
from calib.residuals.beams import Association
from calib.residuals.store import drawn_of_each
from calib.simulation import Spec
from calib.solve import fit
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
    """Its fit."""
    return fit.solve(problems.build([recorded], Model()))


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
    assert some.linear.looked == pytest.approx(SOME * len(direct.scans), rel=0.05)
    for name in (*OF_BEAMS[:2], *OF_BODIES[:2]):  # what clusters hold adds up to the whole
        test = next(c.test for c in some.named.candidates if c.effect.name == name)
        every = list(some.named.scores.at)
        away = away_from_model(some.linear, [every[k] for k in positions_of(some, test)])
        wide = stand.problem_of(stand.model.plus((effects.find(name),)))
        rows = rows_along(some.linear, wide, direct, away @ test.whiten, quiet)
        told = sum(each.A.T @ each.A for each in rows)
        np.testing.assert_allclose(told, np.eye(len(told)), atol=1e-6)


def positions_of(look, test):
    """Which candidates' columns a test has."""
    at = look.named.scores.at.values()
    return [k for k, columns in enumerate(at) if np.isin(np.r_[columns], test.columns).any()]


def test_as_many_are_drawn_as_are_asked_for():
    group = np.repeat([0, 1, -1, 2, 3], [5000, 300, 700, 40, 7])
    for most in (5347, 5000, 4000, 2000, 300):
        some, times = drawn_of_each(group, most, 0)
        assert most <= len(some) <= most + 4
        assert times.sum() == 5347 and (np.diff(some) > 0).all()
        assert np.ptp(times[group[some] == 0]) <= 1
        assert set(group[some]) == {0, 1, 2, 3}


@pytest.mark.long
def test_a_diagnosis_of_some_beams_names_what_is_missing_and_says_how_many_they_were(
    tmp_path, monkeypatch
):
    made(tmp_path / "rec", DENSE, 6, incidence_angle_bias=1.0)
    run = calib.fit([tmp_path / "rec"], tmp_path / "run", hold_out="none")
    monkeypatch.setattr(linear, "LOOKED_BEAMS", SOME * 8)
    monkeypatch.setattr(linear, "FEWEST_LOOKED", 1)
    found = calib.diagnose(run)
    assert [c["effect"] for c in found.candidates if c["step"]] == ["incidence_angle_bias"]
    said = " ".join(found.sentences)
    (used, total) = re.search(r"looked for in ([\d,]+) of ([\d,]+) beams", said).groups()
    assert int(used.replace(",", "")) == pytest.approx(8 * SOME, rel=0.05)
    assert int(total.replace(",", "")) == pytest.approx(run.summary["points"], rel=0.05)


@pytest.mark.parametrize(
    ("counts", "most"),
    [([50, 500, 500], 200), ([500], 450), ([449, 449], 225), ([100, 100], 450), ([], 450)],
)
def test_scans_with_fewer_beams_leave_their_share_to_others(counts, most, monkeypatch):
    monkeypatch.setattr(linear, "LOOKED_BEAMS", 450)
    monkeypatch.setattr(linear, "FEWEST_LOOKED", 1)
    met = [Association(np.r_[np.zeros(n, int), -np.ones(7, int)]) for n in counts]
    assert linear.beams_looked_at(met) == most
