"""Errors of what was measured once, a mesh or the scan of the spheres, are the same in all that
rests on it: what they make does not average out, neither in one fit nor from run to run.

The oracles are what comes of a fit where such an error is another; one recording with the mean of
all that was measured anew; and a joint fit, in which the mesh is one.
"""

import numpy as np
import pytest
from scipy.linalg import block_diag

from calib.problem.model import Source
from calib.problem.prior import CommonErrors, JointPrior
from calib.problem.surfaces import SURFACE_SHARES
from calib.problem.unknowns import vector_unknown
from calib.results.intervals import Intervals
from calib.runs.calibrate import calibrate
from calib.simulation import Spec
from chains import se3
from chains.errors import InputError

from ..mishaps import Scene
from .halves import halves

SPHERES = Spec(lidar=None, mesh=False, targets=8, locations=4, stops_per_location=4, noise=0.0)
ROOM = Spec(lidar="hesai_pandarxt32", column_step=60, targets=3, locations=4, mesh_error_m=0.002)
AGAIN_M = 1e-7  # markers that were tracked again are another measurement, however near
NUDGE_M = 4e-4  # no fit ends a hundredth of it from its optimum


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
def test_a_sphere_scanned_once_counts_once_where_its_markers_are_tracked_twice(
    once, tmp_path, way, monkeypatch
):
    home = once(spheres)
    sphere, marker = 1e-3, 4e-4
    for name in ("first", "second"):
        described(home / name, sigma_sphere_m=sphere, sigma_marker_m=marker)
    described(home / "whole", sigma_sphere_m=sphere, sigma_marker_m=marker / np.sqrt(2.0))
    oracle = faro(fitted(home / "whole", tmp_path / "oracle"))
    both = [home / "first", home / "second"]
    run = fitted(both, tmp_path / "both") if way == "one fit" else chain(home, tmp_path)
    np.testing.assert_allclose(faro(run), oracle, rtol=0.02)
    monkeypatch.setattr(CommonErrors, "together", staticmethod(alone))
    both_twice = np.hypot(sphere, marker) / np.sqrt(2.0) / np.hypot(sphere, marker / np.sqrt(2.0))
    blind = fitted(both, tmp_path / "b") if way == "one fit" else chain(home, tmp_path / "b")
    np.testing.assert_allclose((faro(blind) / oracle).min(), both_twice, rtol=0.02)


def alone(some, parameters):
    """In place of `CommonErrors.together`: each error is another in each way."""
    return np.zeros(2 * (parameters,)), CommonErrors.none(parameters)


def moved_by(home, out, before):
    """How far a chain's frame of the scanner went, as a tangent, for a unit of a nudge."""
    then, now = (
        r.solution.shared.frames["faro"].T_parent_child for r in (before, chain(home, out))
    )
    return se3.log(se3.inverse(then) @ now) / NUDGE_M


def said_of(run, what):
    solution = run.solution
    (k,) = np.flatnonzero(solution.common.names == what)
    return solution.common.by[k, [key.unknown == "faro" for key in solution.keys]]


def test_a_chain_of_runs_goes_with_an_error_of_a_sphere_as_it_says(once, tmp_path):
    home, sigma_m = once(spheres), 1e-3
    for name in ("first", "second"):
        described(home / name, sigma_sphere_m=sigma_m)
    run = chain(home, tmp_path)
    with Scene(home / "first", np.random.default_rng()).sheet("targets.csv") as targets:
        at_m = targets.numbers("faro_x", "faro_y", "faro_z")[2]
    for name in ("first", "second"):
        with Scene(home / name, np.random.default_rng()).sheet("targets.csv") as targets:
            x = targets.numbers("faro_x")
            x[2, 0] += NUDGE_M
            targets.put(x, "faro_x")
    moved = moved_by(home, tmp_path / "nudged", run)
    said = said_of(run, f"sphere {at_m.tobytes().hex()} x") / sigma_m
    assert np.abs(said).max() > 0.05
    np.testing.assert_allclose(moved, said, atol=0.01 * np.abs(said).max())


def test_a_chain_of_runs_goes_with_an_error_of_the_mesh_as_it_says(once, tmp_path):
    home = once(room)
    run = chain(home, tmp_path)
    source = Source.open(home / "first")
    mesh, sigma_m = source.reference, np.sqrt(SURFACE_SHARES["surface"]) * ROOM.mesh_error_m
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
    said = said_of(run, f"{mesh.digest} surface 0.0000 None {wall}") / sigma_m
    assert np.abs(said).max() > 0.05
    np.testing.assert_allclose(moved, -said, atol=0.1 * np.abs(said).max())


def test_a_chain_of_runs_knows_no_more_of_a_room_than_one_fit_of_all(once, tmp_path, monkeypatch):
    home = once(room)
    joint = fitted([home / "first", home / "second"], tmp_path / "joint")
    run = chain(home, tmp_path)
    ratio = faro(run) / faro(joint)
    assert ((ratio > 0.95) & (ratio < 1.25)).all()
    monkeypatch.setattr(CommonErrors, "together", staticmethod(alone))
    assert (faro(chain(home, tmp_path / "blind")) / faro(joint)).min() < 0.9


def test_ways_together_are_the_covariance_of_a_dense_filter():
    """Three runs of a linear world, each from the one before, whose rows meet the same errors m, of
    which each run has another opinion how large they are: how its estimate goes with all that is by
    chance, written out."""
    rng = np.random.default_rng(2)
    P, M, rows, sigma_x = 3, 4, 40, np.array([4.0, 5.0, 6.0])
    like = rng.normal(size=(P, M))  # moves of x that rows can hardly tell from errors
    by_x, by_m, by_n, prior = -np.eye(P), np.zeros((P, M)), np.zeros((P, 0)), None
    known = np.diag(np.square(sigma_x))
    for times in (1.0, 3.0, -0.5):
        J = rng.normal(size=(rows, P))
        A = np.hstack([J, times * (J @ like + 0.1 * rng.normal(size=(rows, M)))])
        weight = block_diag(np.linalg.inv(known), np.eye(M))
        C = np.linalg.inv(A.T @ A + weight)
        of_rows, of_before = C[:P] @ A.T, C[:P] @ weight[:, :P]
        by_x, by_m = of_before @ by_x, of_rows @ A[:, P:] + of_before @ by_m
        by_n = np.hstack([of_before @ by_n, of_rows])
        ways = [CommonErrors(np.array([*"klmn"]), -C[P:, :P])]
        if prior:
            _, by = prior.evaluate({"x": np.zeros(P)}, derivatives=True)
            ways.append(prior.off_by(by["x"] @ C[:P, :P]))
        repeated, common = CommonErrors.together(ways, P)
        known = C[:P, :P] + repeated
        every = np.hstack([by_x * sigma_x, by_m, by_n])
        np.testing.assert_allclose(common.by, by_m.T, atol=1e-9)
        np.testing.assert_allclose(known, every @ every.T, rtol=1e-9)
        held = vector_unknown("x", sigma_x, dofs="abc", units=("m",) * P)
        prior = JointPrior([held], {"x": np.zeros(P)}, known, common=common)
        assert (np.abs(repeated).max() > 0.1 * known.max()) == (len(ways) > 1)


def test_no_interval_is_narrower_than_the_graph_has_it_where_ways_work_against_each_other():
    graph = np.diag([4.0, 1.0])
    known = intervals(graph, repeated=np.array([[-3.0, 0.5], [0.5, 2.0]]))
    assert np.diag(known.covariance).tolist() == [4.0, 3.0]
    assert np.linalg.eigvalsh(known.covariance).min() > 0.0
    assert np.diag(known.without_repeated.covariance).tolist() == [4.0, 1.0]


def test_errors_that_are_larger_than_stated_are_so_in_what_ways_have_in_common():
    """Two equal steps whose sigmas are a third of what errors truly are: the first was widened for
    it in its run, the second is, and errors of both are wholly one."""
    first, second = 9.0, 1.0  # variances of what each adds
    a = np.sqrt(np.array([[first], [second]]))
    repeated = (a.sum() ** 2 - first - second) * np.ones((1, 1))
    known = intervals(np.array([[first + second]]), repeated, given=np.array([[first]]))
    np.testing.assert_allclose(known.at_least(3.0).covariance, (3.0 + 3.0) ** 2)


def intervals(graph, repeated, given=None):
    none = np.zeros_like(graph)
    return Intervals(
        names=("x",),
        dims=(len(graph),),
        graph=graph,
        data=graph,
        paper=none,
        given=none if given is None else given,
        wider=np.ones(len(graph)),
        repeated=repeated,
        common=CommonErrors.none(len(graph)),
    )


def test_a_run_of_an_older_version_does_not_say_what_it_shares_nor_do_runs_after_it(once, tmp_path):
    home = once(spheres)
    path = fitted(home / "first", tmp_path / "run_first").folder / "covariance.npz"
    with np.load(path) as arrays:
        kept = {name: x for name, x in arrays.items() if not name.startswith("common")}
    np.savez(path, **kept)
    second = fitted(home / "second", tmp_path / "run_second", prior=path.parent)
    assert any("earlier version" in each for each in second.summary["odd"])
    assert second.solution.common is None
    np.savez(path, **kept, common_names=np.array([b"a"]), common_by=np.zeros((2, 3)))
    with pytest.raises(InputError, match=r"covariance\.npz: common_names and common_by do not fit"):
        fitted(home / "second", tmp_path / "other", prior=path.parent)


def test_a_file_holds_errors_in_common(tmp_path):
    common = CommonErrors(np.array(["a", "bc"]), np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]))
    np.savez(tmp_path / "a.npz", **common.arrays)
    with np.load(tmp_path / "a.npz") as arrays:
        again = CommonErrors.read(dict(arrays), 3)
    assert again.names.tolist() == ["a", "bc"] and again.by.tolist() == common.by.tolist()
    assert CommonErrors.read({"names": np.zeros(2)}, 3) is None
