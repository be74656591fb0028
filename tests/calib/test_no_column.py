"""Effects that look at a column that a recording has not."""

import pickle

import numpy as np
import pandas as pd
import pytest

from calib.effects import find
from calib.effects.own.formula import FormulaEffect
from calib.problem.model import Model
from calib.runs.calibrate import calibrate
from calib.runs.diagnose import diagnose
from calib.simulation import Spec, simulate
from calib.simulation.spec import load_spec
from chains.errors import InputError, NoColumnError

from ..mishaps import Scene
from .simulated import changed

DAMP = {"name": "damp", "site": "range", "unit": "m", "sigma": 0.001, "basis": "humidity - 0.5"}


@pytest.mark.long
def test_a_column_that_there_is_not_is_told_with_the_effect_that_looks_at_it(tmp_path):
    """And, of a fit from an earlier run, where that effect comes from."""
    for k, name in enumerate(("monday", "friday")):
        simulate(load_spec("tiny"), tmp_path / name, k, {})
    table = pd.read_csv(tmp_path / "friday" / "stops.csv")
    table.drop(columns=["temperature_c", "time_s", "humidity"]).to_csv(
        tmp_path / "friday" / "stops.csv", index=False
    )
    drift = Model((find("temperature_drift"), find("arm_link_length")))
    calibrate([tmp_path / "monday"], tmp_path / "run", drift, hold_out="none")
    with pytest.raises(InputError, match=r"temperature_drift.*temperature_c.*Without --effects"):
        calibrate([tmp_path / "friday"], tmp_path / "out", prior=tmp_path / "run")
    damp = FormulaEffect.read(DAMP, "mine.yaml", {})
    calibrate([tmp_path / "monday"], tmp_path / "damp", Model((damp,)), hold_out="none")
    with pytest.raises(InputError, match=r"'damp'.*no column humidity.*Without --effects"):
        calibrate([tmp_path / "friday"], tmp_path / "out", prior=tmp_path / "damp")
    with pytest.raises(InputError, match=r"tracker_creep.*elapsed_s") as raised:
        calibrate([tmp_path / "friday"], tmp_path / "out", Model((find("tracker_creep"),)))
    assert "Without" not in str(raised.value)
    assert not (tmp_path / "out").exists()


def one_of_two(folder, change, column_step=200):
    """A run of two recordings of one rig in one room, the second without something; diagnosed."""
    spec = Spec(
        lidar="hesai_pandarxt32", column_step=column_step, locations=3, stops_per_location=2
    )
    for k, name in enumerate(("monday", "friday")):
        simulate(changed(spec, world_seed=4), folder / name, k)
    change(folder / "friday")
    run = calibrate([folder / "monday", folder / "friday"], folder / "run", hold_out="none")
    return diagnose(run, refits=False)


def otherwise(folder):
    """Another table: no temperature, and a column of one's own."""
    table = pd.read_csv(folder / "stops.csv").drop(columns="temperature_c")
    table.assign(fan_rpm=range(len(table))).to_csv(folder / "stops.csv", index=False)


def without_mesh(folder):
    with Scene(folder, np.random.default_rng()).description() as rig:
        del rig["reference"]


@pytest.mark.long
def test_what_one_recording_of_two_lacks_is_not_tested_and_said(tmp_path):
    """It was an error of the diagnosis: no effect could be looked for in such recordings."""
    found = one_of_two(tmp_path, otherwise)
    assert found.untestable["temperature_drift"] == "the recordings lack temperature_c in friday"
    for column, lacks in (("temperature_c", "friday"), ("fan_rpm", "monday")):
        said = f"No effect that depends on {column} was tested: {lacks} has none."
        assert said in found.sentences
    over = {c["effect"] for c in found.candidates}
    assert "incidence_angle_bias" in over and "temperature_drift" not in over


@pytest.mark.long
def test_labels_of_a_mesh_that_one_recording_of_two_has_are_not_tested(tmp_path):
    found = one_of_two(tmp_path, without_mesh, column_step=60)
    assert found.untestable["label_range_offset"] == "the recordings lack label in friday"
    assert "No effect of labels was tested: friday has no mesh." in found.sentences
    assert "incidence_angle_bias" in {c["effect"] for c in found.candidates}


def test_what_is_missing_is_told_from_a_worker_too():
    error = pickle.loads(pickle.dumps(NoColumnError("there is no such column", "humidity")))
    assert (str(error), error.column) == ("there is no such column", "humidity")
