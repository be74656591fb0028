"""One thing wrong in a recording, from the file to its name: twelve stops of a simulated rig."""

import shutil

import numpy as np
import pytest

from calib.diagnosis.search import search
from calib.diagnosis.stand import Stand
from calib.problem import build
from calib.problem.model import Model, Source
from calib.runs.explain import explain
from calib.simulation import Spec, simulate
from calib.solve.fit import solve
from sensors.recording import read_table, write_table

from ..mishaps import MISHAPS as MISHAPS_OF_ALL
from ..mishaps import Scene
from ..mishaps.judge import asked
from . import broken

SPEC = Spec(lidar="hesai_pandarxt32", locations=4, stops_per_location=3, column_step=400)
STOP = "L01P01"  # row 4 of stops.csv


def turned(angle_rad, stop=STOP):
    """The scan of that stop, turned about the LiDAR's axis."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)

    def apply(rec):
        table = read_table(rec / f"scans/{stop}.parquet")
        x, y = table["x"], table["y"]
        table |= {"x": (c * x - s * y).astype("f4"), "y": (s * x + c * y).astype("f4")}
        write_table(rec / f"scans/{stop}.parquet", table)

    return apply


MISHAPS = {  # what is done, what is to be named, and by how much it is off, m or rad
    "a body": (broken.cells("stops.csv", r"base_markers\.y", lambda y: y + 0.005, 4), 0.005),
    "the other body": (
        broken.cells("stops.csv", r"mount_markers\.z", lambda z: z - 0.005, 4),
        0.005,
    ),
    "a joint": (broken.cells("stops.csv", "joint_2", lambda q: q + 0.005, 4), 0.005),
    "a scan": (turned(0.01), 0.01),
    "a sphere": (broken.cells("targets.csv", "faro_x", lambda x: x + 0.01, 1), 0.01),
    "a sign in the CAD": (broken.rig("frames", "lidar", "xyz_m", value=[0.0, 0.0, -0.085]), 0.17),
    "a length": (broken.text("arm.urdf", 'xyz="0.0 0.35 0.0"', 'xyz="0.0 0.38 0.0"'), 0.03),
}
NAMES = {
    "a body": f"{STOP}:base_markers",
    "the other body": f"{STOP}:mount_markers",
    "a joint": f"{STOP}:joint_2",
    "a scan": f"{STOP}:scan",
    "a sphere": "T2:sphere",
    "a sign in the CAD": "cad:lidar",
    "a length": "cad:arm_link_length.joint_3",
}
QUICK = ("a joint",)


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    folder = tmp_path_factory.mktemp("mishaps") / "rec"
    simulate(SPEC, folder, 3, {})
    return folder


def searched(folder):
    """What a search finds from a fit of the default model."""
    source = Source.open(folder)
    problem = build([source], Model())
    stand = Stand([source], Model(), problem, solve(problem))
    return search(stand, lambda what, done, total: None)


def marked(mishap):
    return mishap if mishap in QUICK else pytest.param(mishap, marks=pytest.mark.long)


@pytest.mark.parametrize("mishap", [marked(mishap) for mishap in MISHAPS])
def test_it_is_named_and_sized_and_nothing_else_is(recording, tmp_path, mishap):
    rec = shutil.copytree(recording, tmp_path / "rec")
    done, size = MISHAPS[mishap]
    done(rec)
    found = searched(rec)
    assert [left.blunder.group.token for left in found.blunders] == [NAMES[mishap]]
    assert not found.found and not found.unnamed, "no effect takes its place"
    estimate, sigma, _, _ = found.blunders[0].blunder.leading()
    assert abs(estimate - size) < 4 * sigma < size


@pytest.mark.long
def test_what_slips_late_is_one_effect_and_not_a_mishap_at_every_stop_after_it(tmp_path):
    spec = SPEC.model_copy(update={"locations": 5, "column_step": 100})
    simulate(spec, tmp_path / "sound", 2)
    times_s = Source.open(tmp_path / "sound").recording.time_s
    times_s = times_s - times_s[0]
    late_s = (times_s[-4] + times_s[-3]) / 2
    simulate(spec, tmp_path / "rec", 2, {f"arm_joint_slip@{late_s:.0f}": 5.0})
    found = searched(tmp_path / "rec")
    (step,) = found.found
    assert step.effect.family == "arm_joint_slip" and not found.blunders
    assert times_s[-4] < step.effect.shape < times_s[-3]


@pytest.mark.long
def test_a_lidar_that_turned_on_its_mount_from_a_stop_on_is_that_and_no_joint(tmp_path):
    """It was told as a joint and a body that slipped, each making up for the other."""
    spec = SPEC.model_copy(update={"locations": 5, "column_step": 100})
    simulate(spec, tmp_path / "rec", 2)
    recording = Source.open(tmp_path / "rec").recording
    for stop in recording.stops[8:]:
        turned(0.006, stop)(tmp_path / "rec")
    (step,) = searched(tmp_path / "rec").found
    assert step.effect.family == "lidar_slip"
    times_s = recording.time_s - recording.time_s[0]
    assert times_s[7] < step.effect.shape < times_s[8]


@pytest.mark.long
def test_mishaps_of_two_stops_are_no_effect(recording, tmp_path):
    """One effect might explain both: none does, as they have nothing in common."""
    rec = shutil.copytree(recording, tmp_path / "rec")
    MISHAPS["a body"][0](rec)
    broken.cells("stops.csv", r"mount_markers\.x", lambda x: x - 0.006, 10)(rec)
    found = searched(rec)
    tokens = {left.blunder.group.token for left in found.blunders}
    assert tokens == {NAMES["a body"], "L03P01:mount_markers"} and not found.found


@pytest.mark.long
@pytest.mark.parametrize("seed", range(8))
def test_where_nothing_was_done_nothing_is_named(tmp_path, seed):
    simulate("tiny", tmp_path / "rec", seed, {})
    assert searched(tmp_path / "rec").blunders == []


@pytest.mark.long
@pytest.mark.parametrize(
    ("kind", "blunder", "effect"),
    [
        ("mesh scaled", None, "faro_scale"),
        ("one surface moved", "mesh:surface_", None),
        ("mesh shifted against the spheres", None, "mesh_shift"),
        *(
            pytest.param(*each, marks=pytest.mark.long)
            for each in (
                ("base body taped anew from a stop on", None, "base_slip"),
                ("rings numbered one off", "rings", None),
                ("two rings exchanged", "rings", None),
                ("ranges long at one stop", ":scan", None),
            )
        ),
    ],
)
def test_what_lasts_is_an_effect_and_what_does_not_a_blunder(
    recording, tmp_path, kind, blunder, effect
):
    """Each by its one name, and none beside it."""
    folder = shutil.copytree(recording, tmp_path / "rec")
    MISHAPS_OF_ALL[kind].apply(Scene(folder, np.random.default_rng(5)), 10)
    said = asked(folder, tmp_path / "run", at_any_rate=False)
    assert [name for name in said["names"] if name != "surface"] == ([effect] if effect else [])
    assert len(said["blunders"]) == (blunder is not None)
    assert all(blunder in first for first, *_ in said["blunders"])
    assert said["outcome"] == ("bad_data" if blunder else "missing_effect")


@pytest.mark.long
def test_explain_leaves_it_out_and_goes_on(recording, tmp_path):
    """A body that is 5 mm off at one stop: a rung of its own, and an adequate model after that."""
    rec = shutil.copytree(recording, tmp_path / "rec")
    MISHAPS["a body"][0](rec)
    found = explain([rec], tmp_path / "ladder")
    assert [step["left_out"] for step in found.steps] == [[], [NAMES["a body"]]]
    assert [step["added"] for step in found.steps] == [[], []]
    assert found.diagnosis.verdict == "adequate" and not found.diagnosis.blunders
    assert f"Left out: {NAMES['a body']}" in found.diagnosis.sentences
    first = found.runs[0].diagnosis()
    assert first["verdict"] == "bad_data" and first["blunders"][0]["stop"] == STOP
    assert first["command"].endswith(f"--without {NAMES['a body']}")
