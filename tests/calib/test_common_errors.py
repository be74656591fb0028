"""Errors of what was measured once, a mesh or the scan of the spheres, are the same in all that
rests on it: what they make does not average out, neither in one fit nor from run to run.

The oracles are what comes of a fit where such an error is another; one recording with the mean of
all that was measured anew; and a joint fit, in which the mesh is one.
"""

import shutil

import numpy as np
import pytest
from scipy.linalg import block_diag

from calib.effects import find
from calib.problem.model import Source
from calib.problem.prior import CommonErrors, JointPrior
from calib.problem.unknowns import vector_unknown
from calib.results import intervals
from calib.results.intervals import Way, by_all_ways
from calib.runs.calibrate import calibrate, grow
from calib.runs.reopen import model_of
from calib.simulation import Spec, simulate
from chains import se3
from chains.errors import InputError

from ..mishaps import Scene

SPHERES = Spec(lidar=None, mesh=False, targets=8, locations=4, stops_per_location=4, noise=0.0)
ROOM = Spec(lidar="hesai_pandarxt32", column_step=60, targets=3, locations=4, mesh_error_m=0.002)
AGAIN_M = 1e-7  # markers that were tracked again are another measurement, however near
NUDGE_M = 4e-4  # no fit ends a hundredth of it from its optimum


def halves(spec, folder):
    simulate(spec, folder / "whole", seed=5)
    with Scene(folder / "whole", np.random.default_rng()).sheet("stops.csv") as stops:
        count = len(stops)
    for half, kept in (("first", range(count // 2)), ("second", range(count // 2, count))):
        shutil.copytree(folder / "whole", folder / half)
        with Scene(folder / half, np.random.default_rng()).sheet("stops.csv") as stops:
            stops.keep(list(kept))


def spheres(folder):
    """The second half has its markers tracked again."""
    halves(SPHERES, folder)
    rng = np.random.default_rng(1)
    markers = [f"{part}_{axis}" for part in ("upper", "lower") for axis in "xyz"]
    with Scene(folder / "second", rng).sheet("targets.csv") as targets:
        there = targets.numbers(*markers)
        targets.put(there + rng.normal(0.0, AGAIN_M, there.shape), *markers)


def room(folder):
    halves(ROOM, folder)


def fitted(recordings, out, **how):
    return calibrate(recordings, out, hold_out="none", **how)


def chain(home, out):
    first = fitted(home / "first", out / "run_first")
    return fitted(home / "second", out / "run_second", prior=first.folder)


def faro(run):
    frame = run.solution.shared.frames["faro"]
    return np.concatenate([frame.sigma_m, frame.sigma_rad])


def described(folder, **sigmas):
    with Scene(folder, np.random.default_rng()).description() as rig:
        rig["target"] |= sigmas


@pytest.mark.parametrize("way", ["one fit", "from run to run"])
def test_a_sphere_scanned_once_counts_once_where_its_markers_are_tracked_twice(once, tmp_path, way):
    home = once(spheres)
    sphere, marker = 1e-3, 4e-4
    for name in ("first", "second"):
        described(home / name, sigma_sphere_m=sphere, sigma_marker_m=marker)
    described(home / "whole", sigma_sphere_m=sphere, sigma_marker_m=marker / np.sqrt(2.0))
    oracle = faro(fitted(home / "whole", tmp_path / "oracle"))
    both = [home / "first", home / "second"]
    run = fitted(both, tmp_path / "both") if way == "one fit" else chain(home, tmp_path)
    np.testing.assert_allclose(faro(run), oracle, rtol=0.02)
    least = np.hypot(sphere, marker) / np.sqrt(2.0) / np.hypot(sphere, marker / np.sqrt(2.0))
    assert least < 0.8  # of it, what two measurements of each sphere would leave


def moved_by(home, out, before):
    """How far a chain's frame of the scanner went, as a tangent, for a unit of a nudge."""
    then, now = (
        r.solution.shared.frames["faro"].T_parent_child for r in (before, chain(home, out))
    )
    return se3.log(se3.inverse(then) @ now) / NUDGE_M


def said_of(run, what):
    solution = run.solution
    (k,) = np.flatnonzero(solution.common.of == what)
    return solution.common.by[k, [key.unknown == "faro" for key in solution.keys]]


def test_a_chain_of_runs_goes_with_an_error_of_a_sphere_as_it_says(once, tmp_path):
    home = once(spheres)
    run = chain(home, tmp_path)
    with Scene(home / "first", np.random.default_rng()).sheet("targets.csv") as targets:
        at_m = targets.numbers("faro_x", "faro_y", "faro_z")[2]
    for name in ("first", "second"):
        with Scene(home / name, np.random.default_rng()).sheet("targets.csv") as targets:
            x = targets.numbers("faro_x")
            x[2, 0] += NUDGE_M
            targets.put(x, "faro_x")
    moved = moved_by(home, tmp_path / "nudged", run)
    said = said_of(run, f"sphere {at_m.tobytes().hex()} x")
    assert np.abs(said).max() > 0.05
    np.testing.assert_allclose(moved, said, atol=0.01 * np.abs(said).max())


def test_a_chain_of_runs_goes_with_an_error_of_the_mesh_as_it_says(once, tmp_path):
    home = once(room)
    run = chain(home, tmp_path)
    mesh = Source.open(home / "first").reference
    upright = np.abs(mesh.planes[:-1, 2]) < 0.5
    wall = int(np.argmax(np.bincount(mesh.surface, mesh.area_m2 * upright)))
    normal = mesh.planes[np.flatnonzero(mesh.surface == wall)[0], :3]
    corners = np.unique(mesh.triangles[mesh.surface == wall])
    for name in ("first", "second"):

        def nudged(vertices, faces):
            vertices[corners] += NUDGE_M * normal
            return vertices

        Scene(home / name, np.random.default_rng()).remesh(nudged)
    moved = moved_by(home, tmp_path / "nudged", run)
    said = said_of(run, f"{mesh.digest} surface None {wall}")
    assert np.abs(said).max() > 0.05
    np.testing.assert_allclose(moved, -said, atol=0.1 * np.abs(said).max())


def test_a_chain_of_runs_knows_no_more_of_a_room_than_one_fit_of_all(once, tmp_path, monkeypatch):
    home = once(room)
    joint = fitted([home / "first", home / "second"], tmp_path / "joint")
    run = chain(home, tmp_path)
    ratio = faro(run) / faro(joint)
    assert ((ratio > 0.95) & (ratio < 1.25)).all()
    none = lambda ways, parameters: (np.zeros(2 * (parameters,)), CommonErrors.none(parameters))  # noqa: E731
    monkeypatch.setattr(intervals, "by_all_ways", none)
    assert (faro(chain(home, tmp_path / "blind")) / faro(joint)).min() < 0.9


def test_all_ways_together_are_the_covariance_of_a_dense_filter():
    """Two runs of a linear world, the second from the first, whose rows meet the same errors m: how
    its estimate goes with all that is by chance, written out."""
    rng = np.random.default_rng(2)
    P, M, rows = 3, 4, 40
    sigma_x, sigma_m = np.array([4.0, 5.0, 6.0]), np.array([0.5, 1.0, 2.0, 3.0])
    like = rng.normal(size=(P, M))  # moves of x that rows can hardly tell from errors
    by_x, by_m, by_n, prior = -np.eye(P), np.zeros((P, M)), np.zeros((P, 0)), None
    known = np.diag(np.square(sigma_x))
    for _ in range(2):
        J = rng.normal(size=(rows, P))
        A = np.hstack([J, J @ like + 0.1 * rng.normal(size=(rows, M))])
        weight = block_diag(np.linalg.inv(known), np.diag(1.0 / np.square(sigma_m)))
        C = np.linalg.inv(A.T @ A + weight)
        of_rows, of_before = C[:P] @ A.T, C[:P] @ weight[:, :P]
        off = of_before @ by_x, of_rows @ A[:, P:] + of_before @ by_m
        (by_x, by_m), by_n = off, np.hstack([of_before @ by_n, of_rows])
        errors = CommonErrors(np.array([*"klmn"]), -C[P:, :P] / np.square(sigma_m)[:, None])
        ways = [Way(errors, np.square(sigma_m))]
        if prior:
            _, by = prior.evaluate({"x": np.zeros(P)}, derivatives=True)
            ways.append(Way(prior.off_by(by["x"] @ C[:P, :P]), np.zeros(M)))
        shared, common = by_all_ways(ways, P)
        known = C[:P, :P] + shared
        every = np.hstack([by_x * sigma_x, by_m * sigma_m, by_n])
        np.testing.assert_allclose(common.by, by_m.T, atol=1e-9)
        np.testing.assert_allclose(known, every @ every.T, rtol=1e-9)
        held = vector_unknown("x", sigma_x, dofs="abc", units=("m",) * P)
        prior = JointPrior([held], {"x": np.zeros(P)}, known, common=common)
    assert np.abs(shared).max() > 0.1 * known.max()


def test_a_file_holds_errors_in_common(tmp_path):
    common = CommonErrors(np.array(["a", "bc"]), np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]))
    np.savez(tmp_path / "a.npz", **common.arrays)
    with np.load(tmp_path / "a.npz") as arrays:
        again = CommonErrors.read(dict(arrays))
    assert again.of.tolist() == ["a", "bc"] and again.by.tolist() == common.by.tolist()
    assert CommonErrors.read({"names": np.zeros(2)}) is None


def test_a_recording_that_nothing_ties_to_the_room_starts_where_the_earlier_run_has_it(
    once, tmp_path
):
    """It cannot be fitted alone. What is made of its run later finds its start there, too."""
    home = once(room)
    (home / "second" / "targets.csv").unlink()
    with pytest.raises(InputError, match=r"nothing ties 'faro' to 'opti'.*--prior"):
        fitted(home / "second", tmp_path / "alone")
    first = fitted(home / "first", tmp_path / "first")
    run = fitted(home / "second", tmp_path / "run", prior=first.folder)
    assert run.summary["converged"] and not any(link["moved"] for link in run.summary["links"])
    assert run.summary["rms_mm"]["fit"] < 1.2 * run.summary["rms_mm"]["noise_floor"]
    again = grow(run, model_of(run).plus((find("incidence_angle_bias"),)), tmp_path / "grown")
    assert again.summary["converged"]
