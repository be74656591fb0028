"""The whole estimate against a dense least squares that shares none of its code.

The oracle places frames by scipy's RigidTransform, meets the walls by their own planes, and
minimises with `scipy.optimize.least_squares`. Of the fit it takes only what a fit may hold fixed:
which triangle each beam meets, the sigma of each row and how wide the bulk of a stop's rows is.
"""

import csv

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import RigidTransform, Rotation

from calib.problem import build
from calib.problem.model import Model, Source
from calib.runs.calibrate import calibrate
from calib.solve.descent import LAST
from calib.solve.fit import solve
from calib.solve.loop import Loop
from chains.errors import InputError

from . import rigs, simulated

MODEL = Model(("arm_link_length", "arm_joint_offset", "ring_range_offset"))
DOFS = ["rx", "ry", "rz", "tx", "ty", "tz"]
TUKEY = 4.685


class Dense:
    """All rows of a problem as one vector, at N states about the values that a fit has found."""

    def __init__(self, source, estimate):
        self.source, self.estimate = source, estimate
        self.variables = list(estimate.problem.variables.values())
        ends = np.cumsum([0, *(v.dim for v in self.variables)])
        self.at = {v.name: slice(a, a + v.dim) for v, a in zip(self.variables, ends, strict=False)}
        self.size = int(ends[-1])
        # Gravity's length has a sigma of 1: steps for millirad would be lost in rounding there.
        steps = [np.full(v.dim, 3e-5 if v.name == "gravity" else 3e-7) for v in self.variables]
        self.step = np.concatenate(steps)
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
        columns |= {part: rows.view[part] for part in ("surface", "region", "patch")}
        columns |= {f"in_{part}": away_m for part, away_m in association.from_middle_m.items()}
        held = {name: column[kept] for name, column in columns.items()}
        return held | {"name": scan.name, "scale": rows.scale}

    def rows(self, x):
        """(N, m) priors, tracker, targets and, last, beams at tangents x (N, P)."""
        values = {v.name: self._moved(v, x[:, self.at[v.name]]) for v in self.variables}
        self.hardware = self._hardware(values)
        parts = [*self._priors(values), *self._bodies(values), *self._targets(values)]
        parts += self._levels(values)
        return np.concatenate([*parts, *(self._beams(s, values) for s in self.stops)], axis=1)

    def robust(self, rows):
        """The same with sqrt(2 rho) of every beam, whose square is twice its robust cost."""
        rows = rows.copy()
        z = rows[:, rows.shape[1] - len(self.reach) :]
        u = np.minimum(np.square(z / self.reach), 1.0)
        # rho = c^2 / 6 (1 - (1 - u)^3), multiplied out: no digits are lost near zero.
        z[:] = np.sign(z) * self.reach * np.sqrt(u * (3 - 3 * u + u * u) / 3)
        return rows

    def around(self, x):
        """Rows at, and on both sides of, a tangent x (P,) along every component."""
        return self.rows(np.vstack([x, x + np.diag(self.step), x - np.diag(self.step)]))

    def jacobian(self, around):
        """(m, P) by differences."""
        plus, minus = np.split(around[1:], 2)
        return (plus - minus).T / (2 * self.step)

    def weights(self, rows):
        """Square roots of the robust weights of one state's rows (m,)."""
        root = np.ones(len(rows))
        beams = slice(len(rows) - len(self.reach), None)
        root[beams] = np.maximum(1.0 - np.square(rows[beams] / self.reach), 0.0)
        return root

    def _moved(self, v, step):
        """Vectors (N, dim), or N poses."""
        found = self.estimate.values[v.name]
        if v.kind == "vector":
            return found + step
        return RigidTransform.from_matrix(found) * RigidTransform.from_exp_coords(step)

    def _whole(self, name, values, dofs):
        """An effect's parameters (N, P), those that are held included."""
        found = np.zeros((len(next(iter(values.values()))), len(dofs)))
        if name in values:
            free = [dofs.index(dof) for dof in self.estimate.problem.variables[name].dofs]
            found[:, free] = values[name]
        return found

    def _hardware(self, values):
        vectors = {v.name: values[v.name] for v in self.variables if v.kind == "vector"}
        return rigs.Hardware(
            {name: self._whole(name, vectors, DOFS) for name in rigs.FRAMES},
            self._whole("arm_link_length", vectors, list(rigs.ARM)),
            self._whole("arm_joint_offset", vectors, list(rigs.JOINTS)),
            self._whole("ring_range_offset", vectors, [f"ring_{k:03d}" for k in range(rigs.RINGS)]),
        )

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
        for column in ("surface", "region", "patch"):
            name = f"0/reference_{column}"
            off += self._of_part(name, stop[column], values)
            for axis, along_m in enumerate(stop.get(f"in_{column}", np.zeros((0, 0))).T):
                off += self._of_part(f"{name}.tilt_{axis}", stop[column], values) * along_m
        # A surface that stands off does so towards the sensor.
        wall = np.einsum("ki,ki->k", stop["normal"], stop["point"]) - off * np.sign(along)
        true_m = (wall - start) / along
        return (stop["range_m"] - self.hardware.ring_m[:, stop["ring"]] - true_m) / stop["sigma"]

    def _of_part(self, name, part, values):
        """(N, n) what an unknown of surfaces adds to the parts (n,) that beams meet."""
        if name not in values:
            return 0.0
        dofs = self.estimate.problem.variables[name].dofs
        of = {int(dof.split("_")[-1]): i for i, dof in enumerate(dofs)}
        at = np.array([of.get(int(p), len(dofs)) for p in part])
        return np.pad(values[name], ((0, 0), (0, 1)))[:, at]

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
        for m, name in enumerate(targets.names if "target:t0" in values else ()):
            p, g = values[f"target:{name}"], _unit(values["gravity"])
            yield (targets.lower_m[m] - p) / spec.sigma_marker_m
            yield np.cross(g, targets.upper_m[m] - p) / spec.sigma_marker_m
            centre = values["faro"].inv().apply(p + rigs.BELOW_M * g)
            yield (targets.faro_m[m] - centre) / spec.sigma_sphere_m

    def _levels(self, values):
        """By the rotation vectors that turn what should be felt into what was."""
        levels, recording = self.source.rig.levels, self.source.recording
        for frame, felt in recording.levels.items():
            for up, stop in zip(felt, recording.stops, strict=True):
                if np.isfinite(up).all():
                    turn = self._place(frame, stop, values).rotation
                    should = turn.inv().apply(-_unit(values["gravity"]))
                    axis = np.cross(should, up)
                    sine = np.linalg.norm(axis, axis=1, keepdims=True)
                    yield np.arctan2(sine, (should @ up)[:, None]) * axis / sine / levels.sigma_rad

    def _priors(self, values):
        for v in self.variables:
            if v.kind == "pose":
                apart = RigidTransform.from_matrix(v.mean).inv() * values[v.name]
                yield apart.as_exp_coords() / v.sigma
            else:
                yield (values[v.name] - v.mean) @ rigs.whitening(v).T


def _unit(vectors):
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


LEVELS = {"frames": ["base", "arm_2", "lidar"], "sigma_rad": rigs.LEVEL_RAD}
PERFECT = {"frame": "faro", "mesh": "reference/mesh.ply", "sigma_m": 0}
CASES = {  # changes of rig.yaml, and what is held
    "everything": ({}, ()),
    "no tracker": (
        {"tracker": None, "target": None, "reference": PERFECT},
        ("ring_range_offset.ring_003", "lidar.tz", "mount"),
    ),
    "no lidar": ({"lidar": None}, ("arm_link_length.lift",)),
    "levels": ({"levels": LEVELS}, ()),
    "levels alone": (
        {
            "tracker": None,
            "target": None,
            "reference": PERFECT,
            "levels": {**LEVELS, "up": [0.001, 0.0, 2.0], "sigma_up_rad": 0.002},
        },
        (),
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_the_solution_is_that_of_a_dense_least_squares(case, tmp_path):
    """To a millionth of a sigma, though priors alone tell frames, roots and joints apart."""
    changes, held = CASES[case]
    source = Source.open(rigs.write(tmp_path / "box", seed=3, **changes))
    problem = build([source], Model(MODEL.effects, held))
    estimate = solve(problem, tolerance=1e-11)
    assert estimate.converged
    dense = Dense(source, estimate)
    start = np.zeros(dense.size)
    around = dense.around(start)
    J = dense.weights(around[0])[:, None] * dense.jacobian(around)
    size = np.linalg.norm(J, axis=0)
    covariance = np.linalg.inv((J / size).T @ (J / size)) / np.outer(size, size)
    sigma = np.sqrt(np.diag(covariance))
    correlation = covariance / np.outer(sigma, sigma)
    around = dense.robust(around)
    step = correlation @ (dense.jacobian(around) * sigma).T @ around[0]
    assert np.abs(step).max() < 1e-6
    # A better optimum, were there one, lies downhill; shorter ways lower the cost by no digit.
    best = least_squares(
        lambda y: dense.robust(dense.rows(sigma * y[None]))[0],
        start,
        lambda y: dense.jacobian(dense.robust(dense.around(sigma * y))) * sigma,
        xtol=1e-12,
        ftol=None,
        gtol=None,
        max_nfev=10,
    )
    assert np.abs(best.x).max() < 1e-5
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
            assert np.abs(apart).max() < 1e-4, name
    moved = RigidTransform.from_matrix(far.values["faro"])
    here = moved * RigidTransform.from_translation([80.0, -60.0, 5.0])
    np.testing.assert_allclose(here.as_matrix(), estimate.values["faro"], atol=1e-8)


def test_the_surface_has_an_unknown_for_every_part_met_and_no_other(fitted):
    _, estimate = fitted
    parts = range(6)  # four walls, floor and ceiling
    found = estimate.problem.variables["0/reference_surface"].dofs
    assert found == tuple(f"surface_{part}" for part in parts)
    assert not any("-" in dof for dof in estimate.problem.variables["0/reference_patch"].dofs)


def test_a_rig_that_nothing_places_in_its_mesh_is_refused(tmp_path):
    """Any choice of world will do without a mesh; with one, a guess of the drawing is wrong."""
    folder = rigs.write(tmp_path / "box", tracker=None, target=None, base={"moves": "never"})
    with (folder / "stops.csv").open() as file:
        names, *rows = csv.reader(file)
    known = [k for k, name in enumerate(names) if not name.startswith("base_guess")]
    with (folder / "stops.csv").open("w", newline="") as file:
        csv.writer(file).writerows([row[k] for k in known] for row in (names, *rows))
    with pytest.raises(InputError, match="base_guess"):
        build([Source.open(folder)], MODEL)


def test_a_fit_of_few_beams_with_many_outliers_ends(tmp_path):
    source, _ = simulated.made(tmp_path / "rec", "tiny", seed=1)
    estimate = solve(build([source], MODEL))
    assert estimate.converged and estimate.iterations < 25


def test_scales_that_are_kept_stay_wherever_the_state_goes_and_each_pass_lowers_the_cost(tmp_path):
    """At scales that do not follow the state a descent has one cost, which no pass raises; where
    they follow, the same move changes them."""
    source, _ = simulated.made(tmp_path / "rec", "tiny", seed=1)
    loop = Loop(build([source], MODEL), None, lambda what, done, total: None)
    loop.solve_without_scans()
    loop.fix_association()
    loop.linearise()
    first = [each.scale for each in loop.linear.weighed]
    step, _ = loop.step()
    start, there = loop.values, loop.moved(loop.values, step)
    loop.values = there
    loop.linearise()
    assert [each.scale for each in loop.linear.weighed] != first
    loop.values = start
    loop.linearise()
    loop.keep_scales()
    costs = []
    for _ in range(12):
        loop.linearise()
        assert [each.scale for each in loop.linear.weighed] == first
        costs.append(loop.cost())
        if loop.descend(LAST, passes=1):
            break
    assert len(costs) > 2 and np.all(np.diff(costs) < 1e-6 * costs[0]), costs


class Seen(Exception):
    """Enough has been seen."""


def test_blas_runs_on_one_thread_while_stops_are_fitted(fitted, tmp_path):
    """On shared cores two threads make the small products of a fit many times slower."""
    threadpoolctl = pytest.importorskip("threadpoolctl")
    threads = []

    def blas():
        pools = threadpoolctl.threadpool_info()
        return {pool["num_threads"] for pool in pools if pool["user_api"] == "blas"}

    def look(what, done, total):
        threads.append(blas())
        raise Seen

    with threadpoolctl.threadpool_limits(2, user_api="blas"), pytest.raises(Seen):
        if 2 not in blas():
            pytest.skip("the BLAS of this machine has one thread only")
        calibrate([fitted[0].sources[0].recording.folder], tmp_path / "run", progress=look)
    assert threads == [{1}]
