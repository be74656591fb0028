"""A tracked body, the mount or the tracker that moves with a column of the stops: no effect of the
catalogue does so with temperature, and it is told what moves, and with what."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calib.diagnosis.structure import structure
from calib.diagnosis.structure.empirical import PoseShape
from calib.diagnosis.verdict.sentences import WHAT_MOVES
from calib.effects import CATALOGUE
from calib.effects.base import View
from calib.problem.model import Source
from calib.rig import load_rig
from calib.runs.calibrate import calibrate
from calib.runs.diagnose import diagnose
from calib.simulation import Spec, simulate

from ..bench.formulas_worlds import Case, written
from ..mishaps import Scene
from ..mishaps.scene import QUAT
from .hidden import as_needed

# Six numbers of a motion together are seen over a column in 30 stops or more.
SPEC = Spec(
    lidar="hesai_pandarxt32", locations=5, stops_per_location=6, column_step=400, occluded_share=0
)
WHERE = {"base_markers": "before the arm", "mount_markers": "beyond the arm"}
MOVED_M = 0.002
SLIPS = {e.name: e for e in CATALOGUE if e.name.endswith("_slip") and hasattr(e, "moved")}


@pytest.fixture(scope="module")
def rig(tmp_path_factory):
    folder = tmp_path_factory.mktemp("poses")
    simulate("tiny", folder / "rec", 1)
    return load_rig(folder / "rec")


@pytest.mark.parametrize("name", sorted(SLIPS))
def test_each_wave_moves_what_the_slip_moves(rig, name):
    rig = as_needed(rig, SLIPS[name])
    effect = PoseShape(SLIPS[name], "humidity", (0.2, 0.6), 2)
    humidity = np.array([0.2, 0.3, 0.4, 0.6, np.nan])
    tracked = np.tile(np.eye(4), (len(humidity), len(WHERE), 1, 1))
    columns = {"humidity": humidity, "tracked": tracked}
    view = View(rig, len(humidity), columns, np.zeros((len(humidity), len(rig.joint_names))))
    basis = effect.basis(view)
    assert basis.shape[-1] == len(effect.params(rig)) == 12 and effect.what in WHAT_MOVES
    whole = SLIPS[name].moved(view, np.ones(len(humidity)))
    first, second = np.split(basis, 2, axis=-1)
    angle = np.pi * np.array([0.0, 0.25, 0.5, 1.0])
    for wave, m in ((first, 1), (second, 2)):
        np.testing.assert_allclose(wave[:4].T, whole[:4].T * np.cos(m * angle), atol=1e-12)
        assert not wave[4].any() and whole[4].any()  # where the column has a hole


def test_each_thing_that_moves_is_tried_once_and_has_its_words(tmp_path):
    """Not as often as the catalogue has courses for its motion."""
    simulate(SPEC, tmp_path / "rec", 1)
    source = Source.open(tmp_path / "rec")
    shapes = [e for e in structure([source], {}) if isinstance(e, PoseShape)]
    tried = [(e.what, e.column) for e in shapes]
    assert len(tried) == len(set(tried)) > 0
    assert {what for what, _ in tried} <= set(WHAT_MOVES)


def moved(folder, body):
    """A recording whose body moves with temperature."""
    simulate(SPEC, folder, 1)
    scene = Scene(folder, np.random.default_rng())
    rows = np.flatnonzero(scene.seen(body))
    (temperature,) = scene.stops.numbers("temperature_c")[rows].T
    quat = scene.stops.numbers(*(f"{body}.{q}" for q in QUAT))[rows]
    far = MOVED_M * np.cos(np.pi * (temperature - temperature.min()) / np.ptp(temperature))
    shift = Rotation.from_quat(quat, scalar_first=True).apply(far[:, None] * [0.0, 0.0, 1.0])
    scene.move(body, rows, shift, np.zeros(3))
    return folder


@pytest.mark.long
@pytest.mark.parametrize("body", sorted(WHERE))
def test_a_body_that_moves_with_temperature_is_told(tmp_path, body):
    run = calibrate([moved(tmp_path / "rec", body)], tmp_path / "run", hold_out="none")
    diagnose(run, refits=False)
    found = run.diagnosis()
    assert found["verdict"] == "unexplained_structure"
    assert found["unexplained"][0]["covariates"] == ["temperature_c"]
    said = " ".join(found["sentences"])
    assert f"depends on temperature, as if the tracked body {WHERE[body]} moved" in said


@pytest.mark.long
def test_no_formula_of_the_range_takes_the_place_of_a_motion(tmp_path):
    run = calibrate([moved(tmp_path / "rec", "mount_markers")], tmp_path / "run")
    diagnosis = diagnose(run)
    assert diagnosis.verdict == "unexplained_structure" and not diagnosis.formulas
    assert diagnosis.unexplained[0]["moves"] == "body"


@pytest.mark.long
def test_an_error_of_azimuth_is_told_as_a_formula_though_it_looks_like_a_motion(tmp_path):
    """In a room of planes `sin(azimuth)` that grows with temperature is nearly the LiDAR going
    sideways; with the formula nothing is left beside it, and with the motion much is."""
    case = Case("", ("sin(azimuth_rad) * (temperature_c - 26)",), "planes", 8, times=1.0)
    run = calibrate([written(case, tmp_path / "case").folder], tmp_path / "run")
    found = diagnose(run)
    (formula,) = found.unexplained
    assert sorted(formula["covariates"]) == ["azimuth_rad", "temperature_c"]
    after = formula["held_out_rms_mm"]["after"]
    assert after < 1.1 * run.summary["rms_mm"]["noise_floor"] / 2
