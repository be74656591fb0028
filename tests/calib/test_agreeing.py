"""Stops that seem to scatter by chance, of which most agree: then the others are off."""

import numpy as np
import pandas as pd
import pytest
from scipy.spatial.transform import Rotation

from calib.diagnosis.chance.agreeing import ALPHA_AGREE, _seen, _split
from calib.residuals.groups import Group
from calib.runs.calibrate import calibrate
from calib.runs.diagnose import diagnose
from calib.simulation import Spec
from calib.solve.components.told import Told

from .simulated import made

HAND_HELD = Spec(arm=False, occluded_share=0, locations=4, stops_per_location=3, column_step=128)
UNITS = np.array(["rad"] * 3 + ["m"] * 3)


def split(values, covariance=None):
    """Names of the values (K, 6) that are off."""
    covariance = np.eye(6) if covariance is None else covariance
    wide = np.broadcast_to(covariance, (len(values), 6, 6))
    who = [Group("scan", str(k), "scan") for k in range(len(values))]
    found = _split(values, wide, who, UNITS, ("in where it is", "it"))
    return found and [int(group.where) for group, _ in found.off]


SHAPES = {  # sds along six axes, of which the others are assumed to be as wide as the first
    "even": [1, 1, 1, 1, 1, 1],
    "one axis": [1, 0.02, 0.02, 0.02, 0.02, 0.02],
    "a turn and a shift": [1, 0.02, 0.02, 1, 0.02, 0.02],
    "one far wider": [10, 1, 1, 1, 1, 1],
}


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("count", [8, 12, 40])
def test_what_scatters_by_chance_hardly_ever_agrees(count, shape):
    """However its variance lies in directions, which nobody knows."""
    rng = np.random.default_rng(count)
    draws = 1000
    told = sum(split(rng.normal(size=(count, 6)) * SHAPES[shape]) is not None for _ in range(draws))
    assert told <= 2 * draws * ALPHA_AGREE


def test_a_turn_and_a_shift_that_go_together_agree_no_more_often():
    rng = np.random.default_rng(1)
    axes = np.array([1.0, 0.0, 0.0, 0.0, 1.0, 0.0])
    told = [
        split(rng.normal(size=(12, 1)) * axes + 0.02 * rng.normal(size=(12, 6)))
        for _ in range(1000)
    ]
    assert sum(each is not None for each in told) <= 3


def test_stops_of_which_nothing_tells_do_not_agree():
    """They have no value, so they seem to have the same one."""
    information = np.diag([0.0] * 7 + [1e4] * 5)
    rows = Told(
        information @ np.random.default_rng(4).normal(size=12), information, np.zeros(12, int)
    )
    rows = rows.about_means([slice(0, 12)])
    assert np.flatnonzero(_seen(rows, 12)).tolist() == [7, 8, 9, 10, 11]


@pytest.mark.parametrize(("count", "off"), [(10, 3), (12, 5), (24, 12), (400, 30)])
def test_those_that_are_off_are_told_from_those_that_agree(count, off):
    rng = np.random.default_rng(off)
    C = np.diag([1.0, 2.0, 3.0, 0.1, 0.2, 0.3])
    which = np.sort(rng.choice(count, off, replace=False))
    values = 0.01 * rng.normal(size=(count, 6)) + 0.5
    values[which] += 2.0 * rng.normal(size=6) + 0.3 * rng.normal(size=(off, 6))
    assert split(values, C @ C) == which.tolist()


def test_where_no_gap_is_between_nobody_is_off():
    """Half of them close together, and the others ever further: no two of these are told apart."""
    rng = np.random.default_rng(2)
    away = np.geomspace(0.01, 2.0, 30)[:, None] * rng.normal(size=(30, 6))
    assert split(away) is None


def test_a_single_one_is_left_to_others():
    values = 0.01 * np.random.default_rng(3).normal(size=(10, 6))
    values[4] += 1.0
    assert split(values) is None


@pytest.mark.long
@pytest.mark.parametrize("which", [(2, 5, 6), (1, 3, 5, 7, 9, 11)])
def test_a_body_that_is_seen_turned_at_some_stops_is_no_scatter(tmp_path, which):
    """One marker is taken for another, and the body turns by a degree: stops scattered, "random as
    far as these data show", and with that the model was adequate."""
    source, _ = made(tmp_path / "rec", HAND_HELD)
    (body,) = source.rig.tracker.bodies
    table, which = pd.read_csv(tmp_path / "rec" / "stops.csv"), list(which)
    names = [f"{body}.q{c}" for c in "wxyz"]
    turn = Rotation.from_quat(table.loc[which, names], scalar_first=True)
    turn = turn * Rotation.from_rotvec([0.0, np.radians(1.0), 0.0])
    table.loc[which, names] = turn.as_quat(scalar_first=True)
    table.to_csv(tmp_path / "rec" / "stops.csv", index=False)
    found = diagnose(calibrate([tmp_path / "rec"], tmp_path / "run"))
    assert found.verdict == "bad_data" and not found.worth_adding
    off = [b["stop"] for b in found.blunders]
    half = 2 * len(which) == len(table)
    either = table["stop"][which].tolist(), table["stop"].drop(index=which).tolist()
    assert off in (either if half else either[:1])
    assert "all that are off are off by the same" in found.blunders[0]["sentence"]
    assert ("either half may be right" in found.blunders[0]["sentence"]) == half
    sizes = [b["size"] for b in found.blunders if b["unit"] == "rad"]
    assert sizes == pytest.approx([np.radians(1.0)] * len(which), rel=0.1)


def test_a_covariance_that_rounding_has_spoiled_is_no_fault():
    """Of bodies that other rows hardly check it may have a direction of less than nothing."""
    rng = np.random.default_rng(5)
    C = np.eye(6)
    C[0, 1] = C[1, 0] = 1.0 + 1e-12
    assert np.linalg.eigvalsh(C)[0] < 0.0
    assert split(rng.normal(size=(12, 6)) @ np.diag([1, 0, 1, 1, 1, 1]), C) is None
