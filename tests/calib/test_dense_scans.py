"""Scans of very many beams: what is missing is looked for in some of them."""

import re

import numpy as np
import pytest

import calib
from calib import problem as problems
from calib.diagnosis import linear
from calib.diagnosis.stand import Stand
from calib.problem.model import Model
from calib.residuals.beams import Association
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
    assert int(used.replace(",", "")) == 8 * SOME
    assert int(total.replace(",", "")) == pytest.approx(run.summary["points"], rel=0.05)


@pytest.mark.parametrize(
    ("counts", "most"),
    [([100, 100], 100), ([50, 500, 500], 200), ([10, 20, 30], 100), ([500], 450), ([], 100)],
)
def test_scans_with_fewer_beams_leave_their_share_to_others(counts, most, monkeypatch):
    monkeypatch.setattr(linear, "LOOKED_BEAMS", 450)
    monkeypatch.setattr(linear, "FEWEST_LOOKED", 1)
    met = [Association(np.r_[np.zeros(n, int), -np.ones(7, int)]) for n in counts]
    found = linear.beams_looked_at(met)
    used = sum(min(n, found) for n in counts)
    assert used == min(sum(counts), 450)
    assert found >= most or used == sum(counts)
