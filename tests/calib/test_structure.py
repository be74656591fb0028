"""Structure of a world's own: where beams point over azimuth, and one ring over temperature."""

import json

import numpy as np
import pandas as pd
import pytest

from calib import add, diagnose, fit

from ..worlds import World, write


def elevations(scan, stop):
    """Three times a turn, by 1.2 mrad; the way that a beam goes is else as it was."""
    xyz = scan[["x", "y", "z"]].to_numpy(float)
    range_m, azimuth = np.linalg.norm(xyz, axis=1), np.arctan2(xyz[:, 1], xyz[:, 0])
    elevation = np.arcsin(xyz[:, 2] / range_m) + 0.0012 * np.sin(3 * azimuth + 0.4)
    level = range_m * np.cos(elevation)
    way = level * np.cos(azimuth), level * np.sin(azimuth), range_m * np.sin(elevation)
    return np.column_stack(way)


def one_ring(scan, stop):
    """By 2 mm for each kelvin."""
    xyz = scan[["x", "y", "z"]].to_numpy(float)
    range_m = np.linalg.norm(xyz, axis=1, keepdims=True)
    longer_m = 0.002 * (stop["temperature_c"] - 21.0) * (scan["ring"].to_numpy() == 13)
    return xyz * (1.0 + longer_m[:, None] / range_m)


HIDDEN = {
    elevations: (
        {"covariates": ["azimuth_rad"], "moves": "elevation", "ring": None},
        "depends on azimuth, as if beams pointed higher or lower than they should",
        "empirical_elevation_by_azimuth",
    ),
    one_ring: (
        {"covariates": ["ring", "temperature_c"], "moves": None, "ring": 13},
        "depends on temperature, most clearly in ring 13",
        "empirical_ring_013_temperature_c",
    ),
}


@pytest.mark.long
@pytest.mark.parametrize("change", HIDDEN, ids=lambda c: c.__name__)
def test_it_is_told_and_what_describes_it_leaves_nothing(tmp_path, change):
    folder = tmp_path / "rec"
    write(World(seed=8, locations=5, stops=4, beams=2500), folder)
    stops = pd.read_csv(folder / "stops.csv").set_index("stop")
    for path in (folder / "scans").glob("*.parquet"):
        scan = pd.read_parquet(path)
        xyz = change(scan, stops.loc[path.stem]).astype(np.float32)
        scan.assign(x=xyz[:, 0], y=xyz[:, 1], z=xyz[:, 2]).to_parquet(path, index=False)
    told, said, name = HIDDEN[change]
    run = fit(folder, tmp_path / "run", hold_out="none")
    found = diagnose(run)
    first = json.loads((run.folder / "diagnosis.json").read_text())["unexplained"][0]
    assert found.verdict == "unexplained_structure"
    assert {key: first[key] for key in told} == told and first["formula"]["name"] == name
    assert any(said in sentence for sentence in found.sentences)
    assert diagnose(add(run, name, tmp_path / "added")).verdict == "adequate"
