"""What a residual depends on: the right covariates first, and nothing where nothing is."""

from dataclasses import replace

import numpy as np
import pytest

from calib.diagnosis.formulas.pursuit import pursue
from calib.diagnosis.formulas.smooths import Bases, hats, screen_smooths

from .made import table

ALPHA = 0.01  # as for structure


def shape(name, low, high, turns):
    return lambda c: np.sin(turns * np.pi * (c[name] - low) / (high - low))


HUMID = shape("humidity", 0.3, 0.6, 1.5)
WARM = shape("temperature_c", 15, 35, 1.5)
FAR = shape("range_m", 1, 12, 3)
PLANTED = {
    ("intensity",): lambda c: 0.001 * shape("intensity", 0, 1, 4)(c),
    ("azimuth_rad",): lambda c: 0.001 * np.sin(5 * c["azimuth_rad"]),
    ("range_m", "temperature_c"): lambda c: 0.0015 * FAR(c) * WARM(c),
    ("incidence_rad", "intensity"): lambda c: (
        0.002 * np.sin(4 * c["incidence_rad"] * c["intensity"])
    ),
    ("elevation_rad", "humidity"): lambda c: 0.002 * np.sin(8 * c["elevation_rad"]) * HUMID(c),
    ("range_m", "incidence_rad", "intensity"): lambda c: (
        0.004 * (c["range_m"] / 12) * (c["incidence_rad"] / 1.3) * c["intensity"]
    ),
}


def test_hats_sum_to_one_and_draw_every_line_between_knots():
    knots = np.array([0.0, 1.0, 1.5, 4.0])
    x = np.linspace(-1, 5, 601)
    columns = hats(x, knots)
    assert columns.sum(axis=1) == pytest.approx(np.ones(601))
    assert hats(knots, knots) == pytest.approx(np.eye(4))
    heights = np.array([2.0, -1.0, 0.5, 3.0])
    assert columns @ heights == pytest.approx(np.interp(x, knots, heights))


@pytest.mark.parametrize("name", ["range_m", "azimuth_rad", "temperature_c"])
def test_columns_of_a_covariate_sum_to_one(name):
    beams = table(1, stops=10, each=60)
    for together in (1, 2, 3):
        columns = Bases(beams, 10).of([name], together)
        assert columns.sum(axis=1) == pytest.approx(np.ones(len(beams)))
        assert columns.min() >= 0.0


@pytest.mark.parametrize("size", [1e200, 1e-200, 0.0])
def test_values_whose_squares_are_no_numbers_are_no_covariate(size):
    """Columns that nobody measured; they ended a diagnosis with an internal fault."""
    beams = table(1, stops=10, each=60)
    beams.covariates["intensity"][:] *= size
    assert "intensity" not in Bases(beams, 10).names()
    assert "range_m" in Bases(beams, 10).names()


def test_what_goes_round_has_no_seam():
    beams = table(1, stops=10, each=60)
    beams.covariates["azimuth_rad"][:2] = np.pi - 1e-9, -np.pi + 1e-9
    one, other = Bases(beams, 10).of(["azimuth_rad"])[:2]
    assert one == pytest.approx(other, abs=1e-6)


def test_columns_of_several_are_their_products():
    beams = table(1, stops=10, each=60)
    bases = Bases(beams, 10)
    one, two = bases.of(["range_m"], 2), bases.of(["azimuth_rad"], 2)
    both = bases.of(["range_m", "azimuth_rad"])
    expected = np.einsum("ni,nj->nij", one, two).reshape(len(beams), -1)
    assert both == pytest.approx(expected)


def test_a_row_without_a_value_has_no_columns():
    beams = table(1, stops=10, each=60)
    beams.covariates["intensity"][::7] = np.nan
    columns = Bases(beams, 10).of(["intensity"])
    assert np.all(columns[::7] == 0.0) and np.all(columns[1::7].sum(axis=1) > 0.99)


def test_a_column_of_the_stops_has_fewer_knots_than_stops():
    few, many = (Bases(table(1, stops=k, each=20), k).of(["humidity"]).shape[1] for k in (12, 60))
    assert few == 2 and many == 12


def test_what_is_the_same_everywhere_is_no_covariate():
    beams = table(1, stops=10, each=60, more=lambda rng, c: {"dead": 0 * c["ring"] + 3.0})
    names = Bases(beams, 10).names()
    assert "dead" not in names and "range_m" in names
    assert "ring" not in names and "elevation_rad" in names  # one of the two stands for both


@pytest.mark.parametrize("names", PLANTED, ids="-".join)
def test_the_right_covariates_come_first(names):
    beams = table(3, hidden=PLANTED[names])
    found = screen_smooths(beams.projection(), Bases(beams, 30))
    assert found[0].covariates == names
    assert found[0].evidence > np.log(found[0].looks / ALPHA)
    assert 1.0 <= found[0].looks < len(found)


@pytest.mark.long
def test_stops_that_are_few_confirm_a_joint_that_turns_beside_azimuth():
    """A joint has two knots in 30 stops, which do not see a cosine; its own sine and cosine do."""

    def elbow(rng, c):
        return {"elbow": np.repeat(rng.uniform(-1.2, 1.2, 30), len(c["ring"]) // 30)}

    def turns(c):
        return 0.003 * np.cos(2 * c["elbow"]) * np.sin(c["azimuth_rad"])

    beams = table(5, more=elbow, hidden=turns, scatter_m=0.0005)
    beams = replace(beams, by_stop=beams.by_stop | {"elbow"}, turning=frozenset({"elbow"}))
    found = screen_smooths(beams.projection(), Bases(beams, 30))
    assert found[0].covariates == ("azimuth_rad", "elbow") and found[0].plain
    (step,) = pursue(beams, ALPHA, lambda *_: None)
    assert {*step.form.term.covariates} == {"azimuth_rad", "elbow"}
    value = step.form.term.columns(beams.covariates)
    columns = np.column_stack([np.ones(len(beams)), np.sin(beams.covariates["azimuth_rad"])])
    off = np.linalg.lstsq(np.hstack([value, columns]), turns(beams.covariates), rcond=None)[0]
    left = turns(beams.covariates) - np.hstack([value, columns]) @ off
    assert np.std(left) < 0.1 * np.std(turns(beams.covariates))


def test_columns_that_go_along_with_the_right_one_come_after_it():
    """A column that is the right one and some noise explains less."""

    def beside(rng, c):
        return {"copy": c["range_m"] + rng.standard_normal(len(c["range_m"]))}

    beams = table(4, more=beside, hidden=lambda c: 0.001 * FAR(c))
    singles = [
        s for s in screen_smooths(beams.projection(), Bases(beams, 30)) if len(s.covariates) == 1
    ]
    assert [s.covariates for s in singles[:2]] == [("range_m",), ("copy",)]


@pytest.mark.parametrize("scatter_m", [0.0, 0.001])
@pytest.mark.parametrize("seed", range(6))
def test_where_nothing_is_hidden_nothing_is_found(seed, scatter_m):
    """At a level of 1 % a dozen worlds with one false formula are a chance of a ninth."""
    beams = table(100 + seed, stops=20, each=150, scatter_m=scatter_m)
    assert pursue(beams, ALPHA, lambda *_: None) == []
