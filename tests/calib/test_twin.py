"""What is told as a twin of an effect does the very same to all that is measured."""

import csv
import io
import shutil

import numpy as np
import pytest

from calib.effects import CATALOGUE, DEFAULT
from calib.problem.model import Model
from calib.runs.calibrate import calibrate
from calib.runs.diagnose import diagnose
from calib.simulation import simulate
from chains import se3

from . import broken

# How a tracker's frame was set anew: about z, so that rods still hang along it.
RESET = np.array([0.0, 0.0, 1e-3, 6e-3, -4e-3, 2e-3])
SLIGHTLY = 0.25  # of that, which the prior of a shift hardly opposes


def seen_anew(text, by=RESET):
    """The table of targets as a tracker sees them whose frame is elsewhere."""
    rows = list(csv.DictReader(io.StringIO(text)))
    for row in rows:
        for part in ("upper", "lower"):
            at = [f"{part}_{axis}" for axis in "xyz"]
            (moved,) = se3.apply(se3.exp(by), np.array([[float(row[name]) for name in at]]))
            row |= dict(zip(at, map(repr, moved.tolist()), strict=True))
    out = io.StringIO()
    writer = csv.DictWriter(out, list(rows[0]))
    writer.writeheader()
    writer.writerows(rows)
    return out.getvalue()


def test_which_effects_have_a_twin():
    assert [effect.name for effect in CATALOGUE if effect.twin] == ["mesh_shift"]


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """A recording as it is and one whose tracker was reset, with a mesh that may be shifted."""
    folder = tmp_path_factory.mktemp("twin")
    simulate("tiny", folder / "rec", 4, {})
    shutil.copytree(folder / "rec", folder / "reset")
    broken.text("targets.csv", lambda text: seen_anew(text, SLIGHTLY * RESET))(folder / "reset")
    model = Model((*DEFAULT, "mesh_shift"))
    return {
        name: calibrate([folder / name], folder / f"{name}-run", model, hold_out="none")
        for name in ("rec", "reset")
    }


def test_a_reset_tracker_is_a_shift_of_the_mesh_to_all_that_is_measured(runs):
    """The two explain the recording equally well. Only where the reference is differs."""
    rms_mm = {name: run.summary["rms_mm"]["fit"] for name, run in runs.items()}
    assert rms_mm["reset"] == pytest.approx(rms_mm["rec"], rel=0.002)
    was, now = (runs[name].summary["misfit"] for name in ("rec", "reset"))
    for kind in ("tracker", "target", "beams"):
        assert now[kind] == pytest.approx(was[kind], abs=0.01), kind
    found = runs["reset"].solution.shared.effects["mesh_shift"]
    assert np.linalg.norm(found.estimate[:3]) > 0.001


def test_the_twin_is_told_with_the_finding(runs, tmp_path):
    rec = shutil.copytree(runs["rec"].recordings[0], tmp_path / "rec")
    broken.text("targets.csv", seen_anew)(rec)
    said = " ".join(diagnose(calibrate([rec], tmp_path / "run", hold_out="none")).sentences)
    assert "mesh_shift is missing" in said
    assert "tells it from a tracker whose frame was set anew between the targets" in said
