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

TUKEY = 4.685


class Dense:
    """All rows of a problem as one vector, about the values that a fit has found."""

    def __init__(self, source, variables, estimate):
        self.source, self.estimate = source, estimate
        named = {v.name: v for v in (*variables.values(), *estimate.graph.variables.values())}
        self.variables = list(named.values())
        ends = np.cumsum([0, *(v.dim for v in self.variables)])
        self.at = {v.name: slice(a, a + v.dim) for v, a in zip(self.variables, ends, strict=False)}
        self.size = int(ends[-1])
        reference = source.reference
        corners = reference.vertices_m[reference.triangles] if reference else None
        self.stops = [self._stop(*pair, corners) for pair in zip(estimate.scans, estimate.associations, strict=True)]

    def _stop(self, scan, association, corners):
        """What is held of one stop: its beams, from the file, and the planes that they meet."""
        rows = scan.rows(self.estimate.values, association)
        kept = np.flatnonzero(rows.usable)
        read = scan.recording.scan(scan.index)
        flat = np.hypot(*read.xyz_m[:, :2].T)
        azimuth = np.arctan2(read.xyz_m[:, 1], read.xyz_m[:, 0]) - np.arcsin(rigs.BEAM_ORIGIN_M[1] / flat)
        c, s, H, B = np.cos(azimuth), np.sin(azimuth), *rigs.BEAM_ORIGIN_M
        origin = np.stack([H * c - B * s, H * s + B * c, 0 * c], axis=1)
        reach = read.xyz_m - origin
        range_m = np.linalg.norm(reach, axis=1)
        a, b, d = np.moveaxis(corners[association[kept]], 1, 0)
        normal = np.cross(b - a, d - a)
        normal /= np.linalg.norm(normal, axis=1)[:, None]
        beam = {"origin": origin, "direction": reach / range_m[:, None], "range_m": range_m, "ring": read.ring}
        return {n: x[kept] for n, x in beam.items()} | {
            "name": scan.name,
            "point": a,
            "normal": normal,
            "surface": rows.view["surface"][kept],
            "patch": rows.view["patch"][kept],
            "sigma": rows.sigma_m[kept],
            "scale": rows.scale,
        }

    def values(self, x):
        """The state a tangent x (P,) away."""
        found = self.estimate.values
        return {
            v.name: rigs.retract(v.kind, found[v.name], x[self.at[v.name]]) for v in self.variables
        }

    def rows(self, x, robust):
        """Priors, tracker, targets, beams; beams as sqrt(2 rho), or else plain."""
        values = self.values(x)
        z = [self._beams(stop, values) for stop in self.stops]
        if robust:
            z = [self._root_of_loss(one, stop["scale"]) for one, stop in zip(z, self.stops, strict=True)]
        return np.concatenate([*self._priors(values), *self._bodies(values), *self._targets(values), *z])

    def weights(self):
        """Square roots of the robust weights of `rows`, at the values found."""
        values = self.values(np.zeros(self.size))
        z = [self._beams(stop, values) / (TUKEY * stop["scale"]) for stop in self.stops]
        root = np.maximum(1.0 - np.square(np.concatenate(z)), 0.0) if z else np.zeros(0)
        others = len(self.rows(np.zeros(self.size), True)) - len(root)
        return np.append(np.ones(others), root)

    def jacobian(self, x, robust, step=1e-6):
        at = [self.rows(x + e, robust) - self.rows(x - e, robust) for e in step * np.eye(self.size)]
        return np.stack(at, axis=1) / (2 * step)

    def _hardware(self, values):
        rig = self.source.rig
        hardware = rigs.Hardware()
        for name, sigma in rig.frame_sigma.items():
            hardware.frames[name] = np.zeros(6)
            if name in values:
                hardware.frames[name][sigma > 0] = values[name]
        hardware.link_m = values["arm_link_length"]
        hardware.joint = values["arm_joint_offset"]
        hardware.ring_m = values["ring_range_offset"]
        return hardware

    def _place(self, frame, stop, values):
        location, joints = rigs.STOPS[stop]
        root = RigidTransform.from_matrix(values[f"root@{location}"])
        joints = np.add(joints, values[f"joints@{stop}"])
        return root * rigs.placed(frame, joints, self._hardware(values))

    def _beams(self, stop, values):
        T = self._place("lidar", stop["name"], values)
        if "faro" in values:
            T = RigidTransform.from_matrix(values["faro"]).inv() * T
        origin, direction = T.apply(stop["origin"]), T.rotation.apply(stop["direction"])
        along = np.einsum("ni,ni->n", stop["normal"], direction)
        facing = -np.sign(along)[:, None] * stop["normal"]
        off = np.zeros(len(along))
        for column in ("surface", "patch"):
            name = f"0/reference_{column}"
            if name in values:
                parts = [int(dof.split("_")[-1]) for dof in self.estimate.graph.variables[name].dofs]
                off += values[name][np.searchsorted(parts, stop[column])]
        point = stop["point"] + off[:, None] * facing
        t = np.einsum("ni,ni->n", stop["normal"], point - origin) / along
        return (stop["range_m"] - values["ring_range_offset"][stop["ring"]] - t) / stop["sigma"]

    @staticmethod
    def _root_of_loss(z, scale):
        c = TUKEY * scale
        u = np.minimum(np.square(z / c), 1.0)
        # 1 - (1 - u)^3, without cancellation.
        return np.sign(z) * c * np.sqrt((u * (3 - 3 * u + u * u)) / 3)

    def _bodies(self, values):
        tracker, recording = self.source.rig.tracker, self.source.recording
        for body in tracker.bodies if tracker else ():
            for k, stop in enumerate(recording.stops):
                seen = recording.bodies[body][k]
                T = self._place(body, stop, values)
                turn = T.rotation.inv() * Rotation.from_quat(seen[3:], scalar_first=True)
                yield turn.as_rotvec() / tracker.sigma_rad
                yield T.rotation.inv().apply(seen[:3] - T.translation) / tracker.sigma_m

    def _targets(self, values):
        targets, spec = self.source.recording.targets, self.source.rig.target
        for m, name in enumerate(targets.names if "gravity" in values else ()):
            p, g = values[f"target:{name}"], values["gravity"]
            T_faro_opti = RigidTransform.from_matrix(values["faro"]).inv()
            yield (targets.lower_m[m] - p) / spec.sigma_marker_m
            yield np.cross(g, targets.upper_m[m] - p) / spec.sigma_marker_m
            centre = T_faro_opti.apply(p + rigs.BELOW_M * g)
            yield (targets.faro_m[m] - centre) / spec.sigma_sphere_m

    def _priors(self, values):
        for v in self.variables:
            if v.kind == "pose":
                apart = RigidTransform.from_matrix(v.mean).inv() * RigidTransform.from_matrix(values[v.name])
                yield apart.as_exp_coords() / v.sigma
            elif v.kind == "direction":
                yield np.cross(v.mean, values[v.name]) / v.sigma[0]
            else:
                yield (values[v.name] - v.mean) / v.sigma


def fitted(folder, **kwargs):
    source = Source.open(folder)
    problem = build([source], kwargs.pop("model", Model()))
    return source, problem, solve(problem, tolerance=1e-11, **kwargs)


CASES = {
    "everything": {},
    "no errors of the reference": {"reference": {"frame": "faro", "mesh": "reference/mesh.ply", "sigma_m": 0}},
    "no tracker": {"tracker": None, "target": None},
}


@pytest.mark.parametrize("case", CASES)
def test_the_solution_is_that_of_a_dense_least_squares(case, tmp_path):
    source, problem, estimate = fitted(rigs.write(tmp_path / "box", seed=3, **CASES[case]))
    assert estimate.converged
    dense = Dense(source, problem.variables, estimate)
    J = dense.weights()[:, None] * dense.jacobian(np.zeros(dense.size), robust=False)
    information = J.T @ J
    size = np.sqrt(np.diag(information))
    covariance = np.linalg.inv(information / np.outer(size, size)) / np.outer(size, size)
    sigma = np.sqrt(np.diag(covariance))
    import time; t=time.time()
    found = least_squares(
        lambda y: dense.rows(sigma * y, robust=True),
        np.zeros(dense.size),
        lambda y: dense.jacobian(sigma * y, robust=True) * sigma,
        xtol=1e-9, ftol=None, gtol=None, max_nfev=10,
    )
    print(case, dense.size, len(J), "time", time.time()-t, found.nfev, found.njev, np.abs(found.x).max(), np.argmax(np.abs(found.x)))
    at = np.concatenate([np.arange(dense.size)[dense.at[name]] for name in problem.calibration])
    expected = covariance[np.ix_(at, at)]
    print(np.abs((estimate.covariance - expected) / np.outer(sigma[at], sigma[at])).max())
    assert np.abs(found.x).max() < 1e-6
