"""Bodies that are tracked as points: a retroreflector has no turn, and hangs on an arm as well."""

import csv

import numpy as np
import pytest
import yaml

from calib.intake import import_files
from calib.rig import load_rig
from calib.runs.calibrate import calibrate
from chains.errors import InputError
from sensors.stops import POSE

from .moving import JOINTS, T_BASE_FOOT, T_TIP_CUP, T_WORLD_BASE, dh, tip

RNG = np.random.default_rng(3)
HELD = RNG.uniform(-1.2, 1.2, (30, 4))
BALL_M, FOOT_M = np.array([0.1, -0.15, 0.12]), T_BASE_FOOT.translation


def bodies(which, T_world_base=T_WORLD_BASE):
    """Columns of bodies: what a tracker with 0.1 mm of noise saw of each."""
    arm = T_world_base * tip(HELD)
    seen = {
        "ball": arm.apply(BALL_M),
        "cup": (arm * T_TIP_CUP).translation,
        "foot": np.broadcast_to(T_world_base.apply(FOOT_M), (len(HELD), 3)),
        "lamp": np.cumsum(RNG.normal(size=(len(HELD), 3)), axis=0),
    }
    quat = (arm * T_TIP_CUP).rotation.as_quat(scalar_first=True)
    out = {}
    for name in which:
        xyz = seen[name] + 1e-4 * RNG.normal(size=(len(HELD), 3))
        out |= {f"{name}.{axis}": xyz[:, k] for k, axis in enumerate("xyz")}
        if name == "cup":
            out |= {f"cup.{part}": quat[:, k] for k, part in enumerate(POSE[3:])}
    return out


def bring(folder, columns):
    stops = {"stop": [f"s{k}" for k in range(len(HELD))]}
    columns = stops | dict(zip(JOINTS, HELD.T, strict=True)) | columns
    with (folder / "stops.csv").open("w", newline="") as file:
        csv.writer(file).writerows([columns, *zip(*columns.values(), strict=True)])
    given = [("table", [folder / "stops.csv"]), ("dh", [dh(folder / "arm.yaml")])]
    return import_files(given, folder / "rec")


@pytest.mark.parametrize("which", [("ball",), ("ball", "foot"), ("cup", "ball", "foot")])
def test_points_hang_where_they_move(which, tmp_path):
    done = bring(tmp_path, bodies(which))
    frames = yaml.safe_load((tmp_path / "rec/rig.yaml").read_text())["frames"]
    assert frames.keys() == {*which} and load_rig(tmp_path / "rec").tracker.bodies
    true = {"ball": (BALL_M, "arm_end"), "foot": (FOOT_M, "arm_base")}
    for name in {*which} & true.keys():
        at_m, parent = true[name]
        assert frames[name]["parent"] == parent and frames[name]["sigma_rad"] == 0
        np.testing.assert_allclose(frames[name]["xyz_m"], at_m, atol=1e-3)
    assert not done.odd or not any("left out" in line for line in done.odd)


def test_a_point_alone_calibrates_the_arm(tmp_path):
    bring(tmp_path, bodies(("ball",)))
    run = calibrate([tmp_path / "rec"], tmp_path / "run")
    moved = run.solution.shared.frames["ball"].T_parent_child[:3, 3]
    np.testing.assert_allclose(moved, BALL_M, atol=2e-3)


def test_a_point_that_moves_with_nothing_is_named(tmp_path):
    done = bring(tmp_path, bodies(("cup", "lamp")))
    assert any("lamp moves with neither end of the arm" in line for line in done.odd)
    folder = tmp_path / "alone"
    folder.mkdir()
    with pytest.raises(InputError, match="lamp does not move as the joints say"):
        bring(folder, bodies(("lamp",)))
