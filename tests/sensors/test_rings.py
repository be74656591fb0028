"""Rings that are numbered wrongly are named; real units, whose angles differ a little, are not."""

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sensors.lidar import catalog, load_lidar
from sensors.rings import least_off_rad, odd_rings, ring_elevations

HESAI = {
    "hesai_corrections/Pandar40P_Angle Correction File.csv": "hesai_pandar40p",
    "hesai_corrections/Pandar40M_Angle Correction File.csv": "hesai_pandar40p",
    "hesai_corrections/Pandar64_Angle Correction File.csv": "hesai_pandar64",
    "hesai_corrections/PandarQT_Angle Correction File.csv": "hesai_pandarqt64",
    "hesai_corrections/PandarXT-16_Angle Correction File.csv": "hesai_xt16",
    "hesai_corrections/PandarXT_Angle Correction File.csv": "hesai_pandarxt32",
    "hesai_corrections/QT128C2X_Angle Correction File.csv": "hesai_qt128",
    "hesai_corrections/XT32M2X_Angle Correction File.csv": "hesai_xt32m2x",
    "hesai_nebula/calibration/PandarXT32.csv": "hesai_pandarxt32",
    "hesai_nebula/calibration/PandarXT32M.csv": "hesai_xt32m2x",
}
OUSTER = {
    "OS-0-32-U1_v2.2.0_1024x10.json": "ouster_os0_32",
    "OS-0-128-U1_v2.3.0_1024x10.json": "ouster_os0_128_rev6",
    "OS-1-128_v2.3.0_1024x10.json": "ouster_os1_128",
    "OS-1-64_sensor_config_reduced.json": "ouster_os1_64",
}


def hesai(path: Path) -> np.ndarray:
    rows = [row for row in csv.reader(path.open(errors="replace")) if len(row) >= 3]
    return np.array([float(row[1]) for row in rows if row[0].strip().isdigit()])


def ouster(path: Path) -> np.ndarray:
    found = json.loads(path.read_text())
    found = found if "beam_altitude_angles" in found else found["beam_intrinsics"]
    return np.array(found["beam_altitude_angles"])


@pytest.fixture(scope="module", params=[*HESAI, *OUSTER])
def unit(request, shared):
    """A unit's own elevations, rad, and its model."""
    if request.param in HESAI:
        table, model = hesai(shared / "lidar" / request.param), HESAI[request.param]
    else:
        table = ouster(shared / "lidar/ouster_sdk_tests" / request.param)
        model = OUSTER[request.param]
    return np.radians(table), load_lidar(model)


def test_a_units_own_angles_are_no_alarm(unit):
    table, lidar = unit
    assert odd_rings(lidar, table) is None
    assert odd_rings(lidar, np.where(np.arange(len(table)) % 3, table, np.nan)) is None


def test_a_unit_numbered_from_the_other_end_is_found(unit):
    table, lidar = unit
    found = odd_rings(lidar, table[::-1])
    same = [m for m in catalog() if np.allclose(load_lidar(m).elevation_rad[: len(table)],
            lidar.elevation_rad[::-1])] if lidar.rings == 16 else []  # fmt: skip
    assert found.what == "reversed" or found.model in same
    assert found.left_rad < 0.6 * found.off_rad and "from the other end" in found.sentence


@pytest.mark.parametrize("shift", [-1, 1, 3])
def test_a_unit_numbered_too_high_or_too_low_is_found(unit, shift):
    table, lidar = unit
    ring = np.arange(len(table)) - shift
    inside = (ring >= 0) & (ring < len(table))
    numbered = np.where(inside, table[np.clip(ring, 0, len(table) - 1)], np.nan)
    found = odd_rings(lidar, numbered)
    step = np.median(np.diff(np.sort(lidar.elevation_rad)))
    if shift == 1 and np.sqrt(np.mean((table - lidar.elevation_rad) ** 2)) > 0.55 * step:
        assert found is None or found.what == "shifted"  # lies between two rings: not to be told
    else:
        assert (found.what, found.shift) == ("shifted", shift)


@pytest.mark.parametrize(
    ("declared", "true"),
    [
        ("hesai_pandarqt64", "hesai_pandarxt32"),
        ("hesai_xt32m2x", "hesai_pandarxt32"),
        ("ouster_os1_128", "ouster_os0_128_rev6"),
        ("velodyne_hdl64", "hesai_pandar64"),
    ],
)
def test_another_model_is_named(declared, true):
    lidar, other = load_lidar(declared), load_lidar(true)
    seen = np.full(lidar.rings, np.nan)
    seen[: other.rings] = other.elevation_rad + 1e-3
    found = odd_rings(lidar, seen)
    assert found.what == "model" and load_lidar(found.model).rings == other.rings
    np.testing.assert_allclose(load_lidar(found.model).elevation_rad, other.elevation_rad)
    assert found.model in found.sentence and "deg rms off" in found.sentence


def test_a_frame_upside_down_and_a_foreign_table_are_told_apart():
    lidar = load_lidar("hesai_pandarxt32")
    assert odd_rings(lidar, -lidar.elevation_rad).what == "upside_down"
    scrambled = np.random.default_rng(1).permutation(lidar.elevation_rad)
    assert odd_rings(lidar, scrambled).what == "unknown"


@pytest.mark.parametrize("model", ["hesai_pandarxt32", "ouster_os0_128_rev6"])
def test_other_numbers_are_told_from_the_least_size_on(model):
    """Of rings whose numbers are right in one part of the table and one off in the rest, more and
    more of them."""
    lidar, told = load_lidar(model), []
    table = lidar.elevation_rad
    for wrong in range(0, lidar.rings, 4):
        seen = table.copy()
        seen[:wrong] = table[1 : wrong + 1]
        off_rad = np.sqrt(np.mean((seen - table) ** 2))
        told.append((odd_rings(lidar, seen) is not None, off_rad >= least_off_rad(lidar)))
    found, large = np.array(told).T
    assert not (found & ~large).any() and found.any()
    assert np.isinf(least_off_rad(replace(lidar, elevation_rad=table[:4])))


def test_rings_that_bear_each_others_numbers_are_named(unit):
    """Two far from each other, two neighbours, three in a round: these rings and no others. A lone
    ring between two others as well."""
    table, lidar = unit
    for those in ([3, 12], [6, 7], [2, 9, 14]):
        seen = table.copy()
        seen[those] = table[np.roll(those, 1)]
        found = odd_rings(lidar, seen)
        assert found.what == "exchanged" and set(found.rings) == set(those)
        for ring, at in zip(those, np.roll(those, 1), strict=True):
            assert f"ring {ring} lies where ring {at} should" in found.sentence
        assert found.left_rad < 0.6 * found.off_rad
    seen = table.copy()
    seen[4] = table[11] + 0.1 * (table[12] - table[11])
    assert odd_rings(lidar, seen).rings == (4,)


def test_too_few_rings_tell_nothing():
    lidar = load_lidar("hesai_pandarxt32")
    counts = np.r_[np.ones(5), np.zeros(27)]
    elevation = ring_elevations(-lidar.elevation_rad * counts, counts)
    assert np.isfinite(elevation).sum() == 5 and odd_rings(lidar, elevation) is None
