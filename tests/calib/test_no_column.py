"""Effects that look at a column that a recording has not."""

import pickle

import pandas as pd
import pytest

from calib.effects import find
from calib.effects.own.formula import FormulaEffect
from calib.problem.model import Model
from calib.runs.calibrate import calibrate
from calib.simulation import simulate
from calib.simulation.spec import load_spec
from chains.errors import InputError, NoColumnError

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


def test_what_is_missing_is_told_from_a_worker_too():
    error = pickle.loads(pickle.dumps(NoColumnError("there is no such column", "humidity")))
    assert (str(error), error.column) == ("there is no such column", "humidity")
