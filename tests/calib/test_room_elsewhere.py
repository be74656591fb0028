"""Recordings without targets or a guess, fitted from an earlier run: where the room is their scans
tell, and whether it is still where that run had it.

A tracker that was set up anew sees all bodies moved alike, and that is done to the tables here.
"""

import numpy as np
import pytest

from calib.effects import find
from calib.problem import build
from calib.problem.model import Model, Source
from calib.recalibration.prior import starting_from
from calib.results.check import check
from calib.runs.calibrate import calibrate, grow
from calib.runs.reopen import model_of
from calib.simulation import Spec
from calib.solve.otherwise.elsewhere import room_elsewhere
from chains import se3
from chains.errors import InputError
from sensors.stops import POSE

from ..mishaps import Scene
from .halves import halves

ROOM = Spec(lidar="hesai_pandarxt32", column_step=60, targets=3, locations=4)
STAYS = np.zeros(6)


def without_targets(folder):
    halves(ROOM, folder)
    (folder / "second" / "targets.csv").unlink()


def tracked_from(folder, twist):
    """The tracker's frame moved (6,), rad and m; T_new_old."""
    T = se3.exp(np.array(twist, float))
    with Scene(folder, np.random.default_rng()).sheet("stops.csv") as stops:
        for body in ("base_markers", "mount_markers"):
            names = [f"{body}.{part}" for part in POSE]
            pose = stops.numbers(*names)
            moved = T @ se3.from_xyz_quat(pose[:, :3], pose[:, 3:])
            stops.put(np.hstack([moved[:, :3, 3], se3.to_quat_wxyz(moved)]), *names)
    return T


def fitted(recordings, out, **how):
    return calibrate(recordings, out, hold_out="none", **how)


def frame(run):
    found = run.solution.shared.frames["faro"]
    return found.T_parent_child, np.concatenate([found.sigma_rad, found.sigma_m])


@pytest.mark.parametrize(
    "twist",
    [
        pytest.param((0, 0, 0, 0.05, -0.03, 0), id="60 mm"),
        pytest.param((0, 0, 0.8, 1.4, -2.3, 0.2), id="metres"),
        pytest.param((0, 0, np.pi, 0.1, 0.05, 0), id="half a turn"),
    ],
)
def test_a_tracker_that_was_set_up_anew_is_what_moved(once, tmp_path, twist):
    """It ended where the earlier run had the room, with scans set aside: "nothing moved"."""
    home = once(without_targets)
    first = fitted(home / "first", tmp_path / "first")
    T = tracked_from(home / "second", twist)
    run = fitted(home / "second", tmp_path / "run", prior=first.folder)
    assert run.summary["converged"] and not run.summary["set_aside"]
    assert [link["name"] for link in run.summary["links"] if link["moved"]] == ["faro"]
    (then, sigma_then), (now, sigma_now) = frame(first), frame(run)
    off = se3.log(se3.inverse(T @ then) @ now)
    R = (T @ then)[:3, :3]
    off = np.concatenate([off[:3], R @ off[3:]])  # origins are told in the tracker's axes
    assert np.abs(off / np.hypot(sigma_then, sigma_now)).max() < 4.0


def test_few_scans_do_not_tell_a_room_from_a_lidar_that_moved(once, tmp_path):
    """That is said, and not of many scans."""
    home = once(without_targets)
    first = fitted(home / "first", tmp_path / "first")
    tracked_from(home / "second", (0, 0, 0, 0.05, -0.03, 0))
    many = fitted(home / "second", tmp_path / "many", prior=first.folder)
    with Scene(home / "second", np.random.default_rng()).sheet("stops.csv") as stops:
        stops.keep([0, 1])
    few = fitted(home / "second", tmp_path / "few", prior=first.folder)
    said = "that 'faro' moved is told by 2 scans alone"
    assert any(each.startswith(said) for each in few.summary["odd"])
    assert not any("scans alone" in each for each in many.summary["odd"])
    assert [link["name"] for link in few.summary["links"] if link["moved"]] == ["faro"]


def test_a_room_that_stayed_is_not_looked_for_elsewhere(once, tmp_path):
    home = once(without_targets)
    first = fitted(home / "first", tmp_path / "first")
    source = Source.open(home / "second")
    problem = build([source], starting_from(Model(), first.solution, [source]))
    state = first.state()
    values = {n: state[n] if n in problem.calibration else x for n, x in problem.initial.items()}
    assert room_elsewhere(problem, values, "faro") is None
    far = values | {"faro": values["faro"] @ se3.exp(np.array([0, 0, 0.5, 1.0, 0.5, 0.0]))}
    back = se3.log(se3.inverse(values["faro"]) @ room_elsewhere(problem, far, "faro"))
    np.testing.assert_allclose(back, 0.0, atol=0.01)  # beams are off by this, and CAD
    with_targets = Source.open(home / "first")
    problem = build([with_targets], Model())
    assert room_elsewhere(problem, problem.initial, "faro") is None


def test_a_recording_that_nothing_ties_to_the_room_starts_where_the_earlier_run_has_it(
    once, tmp_path
):
    """It cannot be fitted alone. What is made of its run later finds its start there, too."""
    home = once(without_targets)
    first = fitted(home / "first", tmp_path / "first")
    found = check(home / "second")
    assert found.problems == [] and any("nothing ties 'faro'" in each for each in found.odd)
    with Scene(home / "second", np.random.default_rng()).sheet("stops.csv") as stops:
        for name in (n for n in stops.columns if "_markers." in n):
            stops.columns[name][1] = ""  # where the scanner is, is asked for such stops first
    with pytest.raises(InputError, match=r"nothing ties 'faro' to 'opti'.*--prior"):
        fitted(home / "second", tmp_path / "alone")
    run = calibrate(home / "second", tmp_path / "run", prior=first.folder)
    assert run.summary["converged"] and not any(link["moved"] for link in run.summary["links"])
    assert run.summary["rms_mm"]["fit"] < 1.2 * run.summary["rms_mm"]["noise_floor"]
    again = grow(run, model_of(run).plus((find("incidence_angle_bias"),)), tmp_path / "grown")
    assert again.summary["converged"]
