"""The whole estimate against a dense least squares that shares none of its code.

The oracle places frames by scipy's RigidTransform, meets the walls by their own planes, and
minimises with `scipy.optimize.least_squares`. Of the fit it takes only what a fit may hold fixed:
which triangle each beam meets, the sigma of each row and how wide the bulk of a stop's rows is.
"""

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import RigidTransform, Rotation

from calib.fit import solve
from calib.model import Model, Source
from calib.problem import build

from . import rigs

MODEL = Model(("arm_link_length", "arm_joint_offset", "ring_range_offset"))
TUKEY = 4.685


class Dense:
    """All rows of a problem as one vector, for N states at once about the values a fit has found."""

    def __init__(self, source, estimate):
        self.source, self.estimate = source, estimate
        self.variables = list(estimate.graph.variables.values())
        ends = np.cumsum([0, *(v.dim for v in self.variables)])
        self.at = {v.name: slice(a, a + v.dim) for v, a in zip(self.variables, ends, strict=False)}
        self.size = int(ends[-1])
        pairs = zip(estimate.scans, estimate.associations, strict=True)
        self.stops = [self._stop(scan, association) for scan, association in pairs]
        scales = [np.full(len(stop["sigma"]), stop["scale"]) for stop in self.stops]
        self.reach = TUKEY * np.concatenate([np.zeros(0), *scales])

    def _stop(self, scan, association):
        """What is held of one stop: its beams, from the file, and the planes that they meet."""
        rows = scan.rows(self.estimate.values, association)
        read, kept = scan.recording.scan(scan.index), np.flatnonzero(rows.usable)
        x, y, _ = read.xyz_m.T
        H, B = rigs.BEAM_ORIGIN_M
        azimuth = np.arctan2(y, x) - np.arcsin(B / np.hypot(x, y))
        c, s = np.cos(azimuth), np.sin(azimuth)
        origin = np.stack([H * c - B * s, H * s + B * c, 0 * c], axis=1)
        range_m = np.linalg.norm(read.xyz_m - origin, axis=1)
        direction = (read.xyz_m - origin) / range_m[:, None]
        mesh = self.source.reference
        a, b, d = np.moveaxis(mesh.vertices_m[mesh.triangles[association.part]], 1, 0)
        normal = np.cross(b - a, d - a)
        normal /= np.linalg.norm(normal, axis=1)[:, None]
        columns = {"origin": origin, "direction": direction, "range_m": range_m, "normal": normal}
        columns |= {"ring": read.ring, "point": a, "sigma": rows.sigma_m}
        columns |= {part: rows.view[part] for part in ("surface", "patch")}
        held = {name: column[kept] for name, column in columns.items()}
        return held | {"name": scan.name, "scale": rows.scale}

    def rows(self, x, robust):
        """(N, m) priors, tracker, targets, beams at tangents x (N, P); beams as sqrt(2 rho)."""
        values = {v.name: self._moved(v, x[:, self.at[v.name]]) for v in self.variables}
        self.hardware = self._hardware(values)
        parts = [*self._priors(values), *self._bodies(values), *self._targets(values)]
        beams = [self._beams(stop, values) for stop in self.stops]
        z = np.concatenate([np.zeros((len(x), 0)), *beams], axis=1)
        if robust:
            u = np.minimum(np.square(z / self.reach), 1.0)
            # rho = c^2 / 6 (1 - (1 - u)^3), multiplied out: no digits are lost near zero.
            z = np.sign(z) * self.reach * np.sqrt(u * (3 - 3 * u + u * u) / 3)
        return np.concatenate([*parts, z], axis=1)

    def jacobian(self, x, robust, step=1e-7):
        """(m, P) by differences."""
        rows = self.rows(np.vstack([x, x + step * np.eye(self.size)]), robust)
        return (rows[1:] - rows[0]).T / step

    def information(self):
        """J^T W J at the values found, W the robust weights."""
        x = np.zeros((1, self.size))
        J, rows = self.jacobian(x, robust=False), self.rows(x, robust=False)[0]
        beams = slice(len(rows) - len(self.reach), None)
        u = np.square(rows[beams] / self.reach)
        J[beams] *= np.maximum(1.0 - u, 0.0)[:, None]
        return J.T @ J

    def _moved(self, v, step):
        """Vectors (N, dim), directions (N, 3), or N poses."""
        found = self.estimate.values[v.name]
        if v.kind == "vector":
            return found + step
        if v.kind == "pose":
            return RigidTransform.from_matrix(found) * RigidTransform.from_exp_coords(step)
        return np.stack([rigs.retract("direction", found, one) for one in step])

    def _hardware(self, values):
        frames = {}
        for name, sigma in self.source.rig.frame_sigma.items():
            frames[name] = np.zeros((len(values[name]), 6))
            frames[name][:, sigma > 0] = values[name]
        return rigs.Hardware(frames, values["arm_link_length"], values["arm_joint_offset"])

    def _place(self, frame, stop, values):
        location, joints = rigs.STOPS[stop]
        true = joints + values[f"joints@{stop}"]
        return values[f"root@{location}"] * rigs.placed(frame, true, self.hardware)

    def _beams(self, stop, values):
        T = self._place("lidar", stop["name"], values)
        if "faro" in values:
            T = values["faro"].inv() * T
        R, t = T.rotation.as_matrix(), T.translation
        n = stop["normal"].T
        along = np.einsum("nij,kj,ik->nk", R, stop["direction"], n, optimize=True)
        start = np.einsum("nij,kj,ik->nk", R, stop["origin"], n, optimize=True) + t @ n
        off = np.zeros_like(along)
        for column in ("surface", "patch"):
            name = f"0/reference_{column}"
            if name in values:
                dofs = self.estimate.graph.variables[name].dofs
                parts = [int(dof.split("_")[-1]) for dof in dofs]
                off += values[name][:, np.searchsorted(parts, stop[column])]
        # A surface that stands off does so towards the sensor.
        wall = np.einsum("ki,ki->k", stop["normal"], stop["point"]) - off * np.sign(along)
        true_m = (wall - start) / along
        return (stop["range_m"] - values["ring_range_offset"][:, stop["ring"]] - true_m) / stop["sigma"]

    def _bodies(self, values):
        tracker, recording = self.source.rig.tracker, self.source.recording
        for body in tracker.bodies if tracker else ():
            for seen, stop in zip(recording.bodies[body], recording.stops, strict=True):
                T = self._place(body, stop, values)
                turn = T.rotation.inv() * Rotation.from_quat(seen[3:], scalar_first=True)
                yield turn.as_rotvec() / tracker.sigma_rad
                yield T.rotation.inv().apply(seen[:3] - T.translation) / tracker.sigma_m

    def _targets(self, values):
        targets, spec = self.source.recording.targets, self.source.rig.target
        for m, name in enumerate(targets.names if "gravity" in values else ()):
            p, g = values[f"target:{name}"], values["gravity"]
            yield (targets.lower_m[m] - p) / spec.sigma_marker_m
            yield np.cross(g, targets.upper_m[m] - p) / spec.sigma_marker_m
            centre = values["faro"].inv().apply(p + rigs.BELOW_M * g)
            yield (targets.faro_m[m] - centre) / spec.sigma_sphere_m

    def _priors(self, values):
        for v in self.variables:
            if v.kind == "pose":
                apart = RigidTransform.from_matrix(v.mean).inv() * values[v.name]
                yield apart.as_exp_coords() / v.sigma
            elif v.kind == "direction":
                yield np.cross(v.mean, values[v.name]) / v.sigma[0]
            else:
                yield (values[v.name] - v.mean) / v.sigma


CASES = {
    "everything": {},
    "a perfect reference": {
        "reference": {"frame": "faro", "mesh": "reference/mesh.ply", "sigma_m": 0}
    },
    "no tracker": {"tracker": None, "target": None},
    "no lidar": {"lidar": None},
}


@pytest.mark.parametrize("case", CASES)
def test_the_solution_is_that_of_a_dense_least_squares(case, tmp_path):
    """To a millionth of a sigma, though priors alone tell frames, roots and joints apart."""
    source = Source.open(rigs.write(tmp_path / "box", seed=3, **CASES[case]))
    problem = build([source], MODEL)
    estimate = solve(problem, tolerance=1e-11)
    assert estimate.converged
    dense = Dense(source, estimate)
    information = dense.information()
    size = np.sqrt(np.diag(information))
    covariance = np.linalg.inv(information / np.outer(size, size)) / np.outer(size, size)
    sigma = np.sqrt(np.diag(covariance))
    correlation = covariance / np.outer(sigma, sigma)
    # Started where the fit ended: a better optimum, were there one, lies downhill.
    found = least_squares(
        lambda y: dense.rows(sigma * y[None], robust=True)[0],
        np.zeros(dense.size),
        lambda y: dense.jacobian(sigma * y, robust=True) * sigma,
        xtol=1e-12,
        ftol=None,
        gtol=None,
        max_nfev=10,
    )
    # What is left of the way is too short to lower the cost by a digit, but has a gradient.
    assert np.abs(found.x - correlation @ found.grad).max() < 1e-6
    at = np.concatenate([np.arange(dense.size)[dense.at[name]] for name in problem.calibration])
    found = estimate.covariance / np.outer(sigma[at], sigma[at])
    np.testing.assert_allclose(found, correlation[np.ix_(at, at)], atol=1e-6)


# ------------------------------------------------------------------------------------- the truth


@pytest.fixture(scope="module")
def fitted(tmp_path_factory):
    """A recording of known hardware, and what the default model makes of it."""
    folder = rigs.write(tmp_path_factory.mktemp("solve") / "box", seed=5)
    problem = build([Source.open(folder)], MODEL)
    return problem, solve(problem, tolerance=1e-10)


def truth(problem, seed):
    """The hardware that a recording was made with, as values of the calibration."""
    hardware = rigs.drawn(np.random.default_rng(seed))
    rig = problem.sources[0].rig
    frames = {n: twist[rig.frame_sigma[n] > 0] for n, twist in hardware.frames.items()}
    return frames | {
        "arm_link_length": hardware.link_m,
        "arm_joint_offset": hardware.joint,
        "ring_range_offset": hardware.ring_m,
        "faro": rigs.T_OPTI_FARO.as_matrix(),
    }


def test_the_truth_lies_within_the_sigmas(fitted):
    """All of the calibration at once: d' C^-1 d is a chi-square, outliers and gauges and all."""
    problem, estimate = fitted
    true, off = truth(problem, 5), []
    for name in problem.calibration:
        found = estimate.values[name]
        if problem.variables[name].kind == "pose":
            apart = RigidTransform.from_matrix(found).inv() * RigidTransform.from_matrix(true[name])
            off.append(apart.as_exp_coords())
        else:
            off.append(true[name] - found)
    off = np.concatenate(off)
    sigma = np.sqrt(np.diag(estimate.covariance))
    correlation = estimate.covariance / np.outer(sigma, sigma)
    chi2 = off / sigma @ np.linalg.solve(correlation, off / sigma)
    print(chi2, len(off), np.abs(off/sigma).max())
    assert 0.4 * len(off) < chi2 < 1.6 * len(off)
    assert np.abs(off / sigma).max() < 4.0


def test_a_reference_far_from_its_origin_gives_the_same_answer(fitted, tmp_path):
    problem, estimate = fitted
    folder = rigs.write(tmp_path / "far", seed=5, offset_m=(80.0, -60.0, 5.0))
    far = solve(build([Source.open(folder)], MODEL), tolerance=1e-10)
    start = 0
    for name in problem.calibration:
        stop = start + problem.variables[name].dim
        sigma = np.sqrt(np.diag(estimate.covariance))[start:stop]
        start = stop
        if name != "faro":
            apart = (far.values[name] - estimate.values[name]) / sigma
            print(name, np.abs(apart).max())
            assert np.abs(apart).max() < 1e-4, name
    moved = RigidTransform.from_matrix(far.values["faro"])
    here = moved * RigidTransform.from_translation([80.0, -60.0, 5.0])
    np.testing.assert_allclose(here.as_matrix(), estimate.values["faro"], atol=1e-8)


def test_a_ring_that_is_fixed_stays_and_the_others_do_not_take_its_place(fitted):
    problem, _ = fitted
    held = ("ring_range_offset.ring_003", "lidar.tz", "mount")
    again = build(problem.sources, Model(MODEL.effects, held))
    assert again.variables["lidar"].dofs == ("rx", "ry", "rz", "tx", "ty")
    assert "mount" not in again.variables
    rings = [int(dof.removeprefix("ring_")) for dof in again.variables["ring_range_offset"].dofs]
    assert rings == [k for k in range(rigs.RINGS) if k != 3]
    found = solve(again).values["ring_range_offset"]
    apart = found - truth(problem, 5)["ring_range_offset"][rings]
    assert np.abs(apart).max() < 0.003


def test_blas_runs_on_one_thread_while_stops_are_fitted(fitted):
    """On shared cores two threads make the small products of a fit many times slower."""
    threadpoolctl = pytest.importorskip("threadpoolctl")
    seen = []

    def look(what, done, total):
        pools = threadpoolctl.threadpool_info()
        seen.extend(pool["num_threads"] for pool in pools if pool["user_api"] == "blas")

    with threadpoolctl.threadpool_limits(2, user_api="blas"):
        if not any(p["num_threads"] == 2 for p in threadpoolctl.threadpool_info()):
            pytest.skip("the BLAS of this machine has one thread only")
        solve(fitted[0], progress=look)
    assert seen and set(seen) == {1}
