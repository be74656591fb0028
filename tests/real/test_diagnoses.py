"""What the diagnosis says of real hardware, where something is missing and nobody knows what."""

import numpy as np
import pytest

import calib
from calib.diagnosis.verdict import worth_adding
from calib.problem.model import Model
from calib.runs.calibrate import calibrate
from calib.runs.diagnose import diagnose
from calib.runs.run import Run
from sensors.recording import read_table, write_table

from ..test_examples import of_a_ur10
from ..thinned import thinned
from . import foreign


@pytest.mark.long
def test_a_ur10_gives_way_and_errs_with_its_gears(shared, once):
    """Gravity and an error 17 times a turn: what stops that the fit never saw bear out."""
    folder = once(of_a_ur10, shared / "arms/ur10_tmac", "D")
    run, sagging, grown = (
        Run.open(folder / f"D-{name}")
        for name in ("geometry", "arm_gravity_sag", "arm_gear_error@17")
    )
    assert run.effects == ("arm_link_length", "arm_joint_offset", "arm_axis_tilt")
    assert grown.grown_from == sagging.folder and sagging.grown_from == run.folder
    found = run.diagnosis()
    assert found["verdict"] != "adequate"
    first, second = worth_adding(found["candidates"])[:2]
    assert first == sagging.effects[-1] == "arm_gravity_sag"
    assert second.startswith("arm_gear_error@1")
    # Sizes are of the tracked position, where there are no ranges.
    assert 0.2 < found["candidates"][0]["unabsorbed_rms_mm"] < 0.3
    assert "range" not in found["sentences"][0].split("Could not")[0]
    held_out = [r.summary["rms_mm"]["held_out"] for r in (run, grown)]
    assert held_out[1] < 0.75 * held_out[0]
    sag = grown.solution.shared.effects[first]
    lift, elbow = (list(sag.names).index(f"{joint}_joint") for joint in ("shoulder_lift", "elbow"))
    assert all(sag.estimate[i] > 10 * sag.sigma[i] for i in (lift, elbow)), "and it droops"


@pytest.mark.long
def test_a_base_that_creeps_is_what_creeps(shared, tmp_path):
    """Of another program's arm; a mount that creeps explains less."""
    run = calibrate([shared / "recordings/arm_base_creeps"], tmp_path / "run")
    found = diagnose(run)
    assert found.worth_adding == ["tracker_creep"]
    grown = calib.add(run, ["tracker_creep"], tmp_path / "grown")
    crept = grown.solution.shared.effects["tracker_creep"]
    per_h, sigma = np.linalg.norm(crept.estimate[3:]), np.linalg.norm(crept.sigma[3:])
    # 0.8 mm in the 299 poses x 20 s of the session.
    hidden = 0.0008 / (299 * 20 / 3600)
    assert abs(per_h - hidden) < 3 * sigma and sigma < hidden / 5
    assert grown.summary["rms_mm"]["held_out"] < 0.5 * run.summary["rms_mm"]["held_out"]


@pytest.mark.long
def test_dark_beams_that_were_rejected_are_no_matter_of_what_paint_they_hit(shared, tmp_path):
    """Paints differ in how dark they are: an offset by paint takes in most of a step of 48 mm, and
    the dark beams of bright paints are rejected beside it."""
    thinned(shared / "recordings/mystery_b", tmp_path / "rec", 1, 8)
    for path in (tmp_path / "rec/scans").iterdir():
        table = read_table(path)
        xyz = np.stack([table[axis] for axis in "xyz"], axis=1).astype(float)
        shorter = 0.048 * (table["intensity"] < 0.3)
        xyz *= (1 - shorter / np.linalg.norm(xyz, axis=1))[:, None]
        moved = {a: xyz[:, k].astype(np.float32) for k, a in enumerate("xyz")}
        write_table(path, table | moved)
    found = diagnose(calibrate([tmp_path / "rec"], tmp_path / "run"))
    (structure,) = found.unexplained
    (term,) = structure["terms"]
    assert term["text"].startswith("intensity > 0.71")  # 0.3, over the median
    assert abs(term["estimate"] - 0.048) < 4 * term["sigma"] < 0.002
    assert not found.worth_adding and not found.blunders


@pytest.mark.parametrize("kind", ["qt64", "ouster"])
@pytest.mark.long
def test_a_single_pose_proves_no_ring_offset(shared, tmp_path, kind):
    """A pattern over the rings repeats within a plane, and does not carry to the next."""
    if kind == "ouster":
        recording = foreign.ouster(shared / "lidar/ouster_sdk_tests", tmp_path / kind)
    else:
        recording = foreign.hesai(kind, shared / "lidar/hesai_nebula", tmp_path / kind)
    run = calibrate([recording], tmp_path / "run", Model(("range_offset",)))
    found = diagnose(run, refits=False)
    assert not any(name.startswith("ring_") for name in found.worth_adding)
    ring = next(c for c in found.candidates if c["effect"] == "ring_range_offset")
    assert ring["p_adjusted"] > 0.5 and ring["step"] is None
