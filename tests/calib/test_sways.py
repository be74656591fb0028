"""A base that does not stand still where rig.yaml says it does is told as such, not as scatter."""

import json
import re

import numpy as np
import pytest
import yaml

from calib.diagnosis.search import search
from calib.runs.calibrate import calibrate
from calib.runs.diagnose import diagnose
from calib.runs.reopen import stand_of
from calib.simulation import Spec, simulate
from chains import se3

SPEC = Spec(lidar="hesai_pandarxt32", locations=4, stops_per_location=5, column_step=800)
STILL = SPEC.model_copy(update={"base_moves": "location"})


def quiet(what, done, total):
    pass


def described(folder, **changes):
    """The recording, with other words in parts of its rig.yaml."""
    path = folder / "rig.yaml"
    rig = yaml.safe_load(path.read_text(encoding="utf-8"))
    for part, words in changes.items():
        rig[part] |= words
    path.write_text(yaml.safe_dump(rig), encoding="utf-8")
    return folder


def moves(truth):
    """Rms of how far the base stood from its mean of a location, of five stops, rad and m."""
    T = {stop: np.array(at["T_faro_root"]) for stop, at in truth["stops"].items()}
    found = []
    for location in {stop[:3] for stop in T}:
        some = np.array([each for stop, each in T.items() if stop.startswith(location)])
        away = se3.log(se3.inverse(some[0]) @ some)
        found.append((away - away.mean(axis=0)).reshape(-1, 2, 3))
    return np.sqrt(np.mean(np.sum(np.square(np.concatenate(found)), axis=2), axis=0) * 5 / 4)


@pytest.mark.long
def test_a_base_that_sways_is_no_scatter(tmp_path):
    simulate(SPEC, tmp_path / "rec", 5, {})
    described(tmp_path / "rec", base={"moves": "location"})
    run = calibrate([tmp_path / "rec"], tmp_path / "run", hold_out="none")
    told = diagnose(run).document()["sentences"]
    (said,) = (each for each in told if "stands still at a location, but" in each)
    sways = [float(x) / 1e3 for x in re.findall(r"(\S+) mm and (\S+) mrad rms", said)[0]]
    truth = json.loads((tmp_path / "rec.truth.json").read_text(encoding="utf-8"))
    turn_rad, shift_m = moves(truth)
    assert sways[0] == pytest.approx(shift_m, rel=0.25)
    # Its variance is told by 48 values that each scatter by 0.3 mrad, so to 0.06 mrad.
    assert sways[1] == pytest.approx(turn_rad, abs=1.5e-4)
    assert not any("scatter more than" in each or "Stops scatter" in each for each in told)


@pytest.mark.parametrize("scatter", ["tracker_scatter", "joint_scatter", "stop_pose_scatter"])
@pytest.mark.long
def test_scatter_of_a_rig_that_stands_still_is_scatter(tmp_path, scatter):
    """Bodies and scans of one stop contradict each other, wherever the base may stand."""
    simulate(STILL, tmp_path / "rec", 6, {scatter: 5.0})
    run = calibrate([tmp_path / "rec"], tmp_path / "run", hold_out="none")
    done = search(stand_of(run, quiet), quiet)
    assert scatter in [chance.effect.name for chance in done.chance]
    assert done.sways is None
