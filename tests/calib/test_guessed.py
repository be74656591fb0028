"""LiDARs of which a guess alone says where they stood."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

from calib.problem import build
from calib.problem.model import Model, Source
from calib.residuals.groups import Group
from calib.residuals.surfaces import PlaneSurface
from calib.results.observability import seen_alone
from calib.runs.calibrate import calibrate
from calib.runs.diagnose import diagnose
from calib.simulation import Spec
from calib.solve.fit import solve
from calib.solve.torn import _beyond_doubt
from chains import se3
from tests.worlds import World, write
from tests.worlds.beams import model
from tests.worlds.hardware import built
from tests.worlds.session import visited

from .simulated import QUICK, made

GUESS = [f"base_guess.{part}" for part in ("x", "y", "z", "qw", "qx", "qy", "qz")]
ROOM = World(seed=3, locations=1, stops=12, beams=8000, stands=True)
LEVEL = World(seed=1, locations=12, stops=1, beams=1500, turned=(0.0,) * 6)


def guessed(folder, world, sigma_m, sigma_rad):
    """The LiDAR of a world on a tripod: no arm, no tracker, and a guess so good; where it was."""
    write(world, folder)
    T = visited(world, built(world, model(world.lidar))).T_faro_lidar
    rig = json.loads((folder / "rig.yaml").read_text())
    rig = {k: v for k, v in rig.items() if k not in ("arm", "tracker", "target")}
    placed = {"xyz_m": [0, 0, 0], "rpy_rad": [0, 0, 0], "sigma_m": 0.001, "sigma_rad": 0.002}
    rig["frames"] = {"lidar": {"parent": "base", **placed}}
    (folder / "rig.yaml").write_text(json.dumps(rig))
    (folder / "targets.csv").unlink()
    off = np.random.default_rng(world.seed).standard_normal((len(T), 6))
    near = T @ se3.exp(off * np.repeat([sigma_rad, sigma_m], 3))
    table = pd.read_csv(folder / "stops.csv")[["stop", "location", "time_s"]]
    table[GUESS] = np.concatenate([near[:, :3, 3], se3.to_quat_wxyz(near)], axis=1)
    table.to_csv(folder / "stops.csv", index=False)
    return T


@pytest.mark.parametrize(
    ("world", "sigma_m", "deg"),
    [
        pytest.param(LEVEL, 0.05, 1.0, id="near"),
        pytest.param(LEVEL, 0.2, 4.0, id="rough"),
        pytest.param(replace(LEVEL, seed=2, clutter=0.1), 0.05, 1.0, id="clutter"),
    ],
)
def test_level_lidars_end_at_their_true_heights(tmp_path, world, sigma_m, deg):
    """A floor that one beam in a hundred meets is all that tells these. It was rejected, and some
    LiDARs ended up to 150 mm too high or low, in fits that were called converged."""
    wanted = guessed(tmp_path / "rec", world, sigma_m, np.radians(deg))
    problem = build([Source.open(tmp_path / "rec")], Model(("ring_range_offset",)))
    estimate = solve(problem)
    assert estimate.converged
    found = np.array([scan.pose(estimate.values) for scan in estimate.scans])
    off = se3.log(se3.inverse(wanted) @ found)
    # Sigmas of 0.2 mm, along with what the LiDAR on its base, by CAD, leaves open.
    np.testing.assert_allclose(off[:, 3:], 0.0, atol=1.5e-3)


def test_a_stop_that_the_tracker_missed_ends_where_it_was(tmp_path):
    """The world has the tracker's axes here, and the beams tell least along the LiDAR's axis, which
    the arm holds level."""
    world = World(seed=2, locations=4, stops=5, beams=1500)
    folder = tmp_path / "rec"
    write(world, folder)
    hardware = built(world, model(world.lidar))
    stops = visited(world, hardware)
    markers = se3.inverse(hardware.frames["base_markers"])
    near = hardware.T_faro_opti @ stops.T_opti_body["base_markers"] @ markers
    near[0, :3, 3] += 0.45, -0.1, 0.1
    table = pd.read_csv(folder / "stops.csv")
    table.loc[0, [name for name in table if "markers." in name]] = np.nan
    table[GUESS] = np.concatenate([near[:, :3, 3], se3.to_quat_wxyz(near)], axis=1)
    table.to_csv(folder / "stops.csv", index=False)
    problem = build(
        [Source.open(folder)], Model(("arm_link_length", "arm_joint_offset", "ring_range_offset"))
    )
    estimate = solve(problem)
    assert estimate.converged and not estimate.problem.set_aside
    found = np.array([scan.pose(estimate.values) for scan in estimate.scans])
    off = se3.log(se3.inverse(stops.T_faro_lidar) @ found)
    np.testing.assert_allclose(off[:, 3:], 0.0, atol=1.5e-3)


def untracked(folder, world):
    """A world's rig without tracker and mesh, its base guessed where it stands; the folder."""
    write(world, folder)
    hardware = built(world, model(world.lidar))
    stops = visited(world, hardware)
    markers = se3.inverse(hardware.frames["base_markers"])
    base = hardware.T_faro_opti @ stops.T_opti_body["base_markers"] @ markers
    rig = json.loads((folder / "rig.yaml").read_text())
    rig = {k: v for k, v in rig.items() if k not in ("tracker", "target", "reference")}
    rig["frames"] = {k: v for k, v in rig["frames"].items() if "markers" not in k}
    (folder / "rig.yaml").write_text(json.dumps(rig))
    (folder / "targets.csv").unlink()
    table = pd.read_csv(folder / "stops.csv")
    table = table[[name for name in table if "markers." not in name]]
    table[GUESS] = np.concatenate([base[:, :3, 3], se3.to_quat_wxyz(base)], axis=1)
    table.to_csv(folder / "stops.csv", index=False)
    return folder


def test_where_all_may_be_shifted_together_stops_held_out_are_expected_as_they_are(tmp_path):
    """Without tracker and mesh a guess alone says where the room is, and nothing hangs on it. What
    was expected of stops held out was off by as much as that guess: 490 mm, where they were 1.4."""
    folder = untracked(tmp_path / "rec", ROOM)
    summary = calibrate([folder], tmp_path / "run").summary
    rms_mm = summary["rms_mm"]
    assert rms_mm["held_out"] / rms_mm["noise_floor"] == pytest.approx(1.0, abs=0.1)
    assert not summary["odd"]


@pytest.mark.long
def test_exchanged_scans_of_a_room_without_a_mesh_are_told(tmp_path):
    """Each makes planes of its own, which fit: nothing else is off."""
    folder = untracked(tmp_path / "rec", ROOM)
    a, b = (folder / f"scans/L00P{k:02d}.parquet" for k in (4, 9))
    a.rename(folder / "scan.parquet")
    b.rename(a)
    (folder / "scan.parquet").rename(b)
    run = calibrate([folder], tmp_path / "run", hold_out="none")
    (said,) = run.summary["odd"]
    assert "L00P04, L00P09" in said and "another stop" in said
    found = diagnose(run)
    assert found.verdict == "bad_data" and found.blunders[0]["stop"] == "L00P04"
    assert found.command.endswith("--without L00P04:scan --without L00P09:scan")


@pytest.mark.parametrize(("moved_m", "tells"), [((0.02, 0, 0), False), ((0, 0.004, 0), True)])
def test_along_a_corridor_scans_need_not_look_again(moved_m, tells):
    """Walls at y = 1 m alone, with bumps of half a milliradian: 20 mm along them are 0.2 sigmas.
    Scans drifted from look to look, and the fit was given up."""
    rng = np.random.default_rng(0)
    slope = np.column_stack([5e-4 * rng.standard_normal(1000), np.ones(1000), np.zeros(1000)])
    rows = SimpleNamespace(
        by_twist=np.hstack([np.zeros((1000, 3)), slope]),
        sigma_m=np.full(1000, 1.5e-3),
        weight=np.ones(1000),
    )
    scan = SimpleNamespace(rows=lambda values, met: rows)
    assert _beyond_doubt({}, scan, None, np.array([0.0] * 3 + [*moved_m])) == tells


@pytest.mark.parametrize(
    ("beams", "alone"),
    [
        ([[10] * 40] * 5, ()),  # planes of which none has much
        ([[500, 500, 0, 0]], ()),  # nothing to compare it with
        ([[500, 400, 0, 0], [400, 500, 0, 0], [0, 0, 600, 400]], ("s2",)),
        ([[500, 400, 0, 0], [400, 500, 30, 0], [0, 0, 600, 400]], ()),  # another sees of it
    ],
)
def test_a_scan_is_alone_where_no_other_sees_what_it_does(beams, alone):
    room = PlaneSurface(planes=None, variable="planes")
    estimate = SimpleNamespace(
        scans=[
            SimpleNamespace(group=Group("scan", f"s{k}", "scan"), meeting=room)
            for k in range(len(beams))
        ],
        associations=[
            SimpleNamespace(part=np.repeat(np.arange(len(each)), each)) for each in beams
        ],
    )
    assert [scan.where for scan in seen_alone(estimate)] == list(alone)


def test_a_guess_at_one_stop_is_of_all_where_the_base_never_moves(tmp_path):
    """Also for the fit of a fold from which that stop is held out."""
    spec = Spec(tracker=None, targets=0, base_moves="never", **QUICK | {"locations": 3})
    made(tmp_path / "rec", spec)
    table = pd.read_csv(tmp_path / "rec/stops.csv")
    table.loc[1:, GUESS] = np.nan
    table.to_csv(tmp_path / "rec/stops.csv", index=False)
    run = calibrate([tmp_path / "rec"], tmp_path / "run")
    assert run.summary["rms_mm"]["held_out"] < 10.0
