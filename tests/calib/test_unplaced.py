"""Scans of which nothing says where they were taken."""

import logging

import numpy as np
import pandas as pd
import pytest

from calib.problem.model import Model, Source
from calib.problem.without import placed
from calib.runs.calibrate import calibrate
from calib.simulation import Spec
from chains.errors import InputError

from .simulated import made

HANDHELD = Spec(arm=False, locations=3, stops_per_location=4, column_step=100)


def unseen(folder, stops):
    """Blank all that the tracker saw at some stops."""
    path = folder / "stops.csv"
    table = pd.read_csv(path, dtype={"stop": str, "location": str})
    bodies = [c for c in table if c.partition(".")[0] in ("mount_markers", "base_markers")]
    table.loc[table["stop"].isin(stops), bodies] = np.nan
    table.to_csv(path, index=False)


def test_a_scan_that_nothing_places_is_left_out_and_it_is_said(tmp_path, caplog):
    """A LiDAR in somebody's hand stands metres away at the next stop. With such scans the fit ended
    far from any optimum."""
    source, _ = made(tmp_path / "rec", HANDHELD, 1)
    blank = np.isnan(source.recording.bodies["mount_markers"]).any(axis=1)
    hidden = {*np.array(source.recording.stops)[blank].tolist(), "L02P01"}
    unseen(tmp_path / "rec", hidden)
    with caplog.at_level(logging.WARNING, "rigcal"):
        run = calibrate([tmp_path / "rec"], tmp_path / "run")
    assert set(run.left_out) == {f"{stop}:scan" for stop in hidden}
    assert all(token in caplog.text for token in run.left_out)
    assert "base_guess columns in stops.csv would place them" in caplog.text
    assert run.converged and not run.set_aside
    rms = run.summary["rms_mm"]
    assert rms["held_out"] < 1.2 * rms["noise_floor"]


def test_without_a_mesh_what_nothing_places_is_left_out(tmp_path):
    """It would meet planes of its own, or none at all."""
    source, _ = made(tmp_path / "rec", Spec(**{**HANDHELD.model_dump(), "mesh": False}), 1)
    blank = np.isnan(source.recording.bodies["mount_markers"]).any(axis=1)
    hidden = {*np.array(source.recording.stops)[blank].tolist(), "L02P01", "L01P02"}
    unseen(tmp_path / "rec", hidden)
    source = Source.open(tmp_path / "rec")
    _, model = placed([source], Model.of(None, (), (), [tmp_path / "rec"]))
    assert set(model.without) == {f"{stop}:scan" for stop in hidden}


def test_a_scan_of_a_base_that_hardly_moved_is_placed_by_its_neighbour(tmp_path, caplog):
    made(tmp_path / "rec", "tiny", 5)
    unseen(tmp_path / "rec", {"L00P01", "L02P01"})
    source, model = Source.open(tmp_path / "rec"), Model.of(None, (), (), [tmp_path / "rec"])
    (same,), still = placed([source], model)
    assert same is source and still is model and not caplog.records


def test_scans_of_which_none_has_a_place_are_refused(tmp_path):
    source, _ = made(tmp_path / "rec", HANDHELD, 1)
    unseen(tmp_path / "rec", set(source.recording.stops))
    with pytest.raises(InputError, match="base_guess"):
        calibrate([tmp_path / "rec"], tmp_path / "run")
