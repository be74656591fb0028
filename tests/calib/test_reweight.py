"""Robust weights of what is no beam: closed forms, where nothing is off, one wild row, and the
optimum of Huber's loss by another solver."""

import numpy as np
import pytest
from scipy import stats
from scipy.optimize import least_squares

from calib.problem import build
from calib.problem.model import Model, Source
from calib.problem.unknowns import Role
from calib.problem.without import leave_out
from calib.residuals.robust import huber_weight
from calib.solve import loop
from calib.solve.fit import solve

from . import broken, rigs
from .linear.dense import away

ARM = Model(("arm_link_length", "arm_joint_offset"))
BY_STOP = {"base": {"moves": "stop"}}


# ---------------------------------------------------------------------------------------- functions


def test_a_group_loses_weight_where_chance_puts_one_in_ten_thousand():
    """Of two rows the norm's square is exponential: it exceeds -2 log(p) with chance p."""
    k = np.sqrt(-2 * np.log(1e-4))
    norm = np.array([0.0, 0.999 * k, 2 * k])
    np.testing.assert_allclose(huber_weight(norm, np.full(3, 2)), [1.0, 1.0, 0.5], rtol=1e-12)
    for dof in (1, 3, 6):
        k = np.sqrt(stats.chi2(dof).isf(1e-4))
        found = huber_weight(np.array([4 * k]), np.array([dof]))
        np.testing.assert_allclose(found, 0.25, rtol=1e-9)
    assert len(huber_weight(np.zeros(0), np.zeros(0))) == 0


def test_where_all_of_a_kind_are_off_none_is_wild():
    """Of four groups or more the bulk is told by their median: of two rows, 2 log 2."""
    typical, k = np.sqrt(2 * np.log(2)), np.sqrt(-2 * np.log(1e-4))
    norm = 7 * np.array([typical, typical, typical, 0.9 * typical, 3 * k])
    expected = [1.0, 1.0, 1.0, 1.0, 1 / 3]
    np.testing.assert_allclose(huber_weight(norm, np.full(5, 2)), expected, rtol=1e-12)
    few = huber_weight(norm[-3:], np.full(3, 2))
    np.testing.assert_allclose(few, np.minimum(1.0, k / norm[-3:]), rtol=1e-12)
    narrow = huber_weight(np.append(np.full(9, 0.1), 1.5 * k), np.full(10, 2))
    np.testing.assert_allclose(narrow[-1], 1 / 1.5, rtol=1e-12, err_msg="never below its sigmas")


# -------------------------------------------------------------------------------- nothing, and one


@pytest.mark.parametrize("changes", [BY_STOP, {"lidar": None, **BY_STOP}], ids=["scans", "bodies"])
def test_where_nothing_is_off_no_bit_changes(tmp_path, monkeypatch, changes):
    source = Source.open(rigs.write(tmp_path / "box", seed=5, **changes))
    robust = solve(build([source], Model()))
    monkeypatch.setattr(loop, "reweighted", lambda problem, *others: problem)
    plain = solve(build([source], Model()))
    assert all(getattr(block, "weight", None) is None for block in robust.problem.blocks)
    assert all(unknown.weight == 1.0 for unknown in robust.problem.variables.values())
    assert robust.values.keys() == plain.values.keys()
    for name, value in plain.values.items():
        np.testing.assert_array_equal(robust.values[name], value, err_msg=name)
    np.testing.assert_array_equal(robust.covariance, plain.covariance)


def test_one_wild_row_of_300_moves_no_estimate_by_a_sigma(shared):
    """Of an arm by the independent simulator: x of one row is half a metre off."""
    source = Source.open(shared / "recordings" / "arm_one_wild_row")
    robust = solve(build([source], ARM))
    (block,) = robust.problem.blocks
    wild = int(np.argmin(block.weight))
    assert block.weight[wild] < 1e-3 and np.delete(block.weight, wild).min() == 1.0
    clean = solve(build(leave_out([source], [block.groups[wild].token]), ARM))
    assert robust.converged and clean.converged
    moved = np.concatenate(
        [v.difference(clean.values[v.name], robust.values[v.name]) for v in clean.variables]
    )
    sigma = np.sqrt(np.diag(clean.covariance))
    assert np.abs(moved / sigma).max() < 1.0


# ------------------------------------------------------------------------------------ other solver


def test_the_fit_is_at_the_optimum_of_hubers_loss(tmp_path, monkeypatch):
    """With a body, a joint, a sphere and a frame that are off: against scipy's least squares of
    rows whose square is twice Huber's loss of each group's norm."""
    turns = np.random.default_rng(3).uniform(-1, 1, (7, 3)) * [2.0, 0.6, 0.1]
    monkeypatch.setattr(rigs, "STOPS", {f"s{k}": ("a", tuple(q)) for k, q in enumerate(turns)})
    box = rigs.write(tmp_path / "box", seed=5, lidar=None)
    broken.cells("stops.csv", r"base_markers\.x", lambda x: x + 0.05, row=1)(box)
    broken.cells("stops.csv", "lift", lambda q: q + 0.005, row=2)(box)
    broken.cells("targets.csv", "faro_y", lambda y: y + 0.03, row=1)(box)
    broken.rig("frames", "mount_markers", "xyz_m", value=[0.06, 0.02, 0.05])(box)
    problem = build([Source.open(box)], Model(("arm_joint_offset",), ("arm_base", "mount")))
    found = solve(problem)
    light = {b.name for b in found.problem.blocks if b.weight is not None and b.weight.min() < 0.9}
    light |= {n for n, u in found.problem.variables.items() if u.weight < 0.9}
    assert light >= {"base_markers at s1", "target t1", "mount_markers"}
    oracle = Huber(problem, found.values)
    best = least_squares(oracle.rows, np.zeros(oracle.size), x_scale=oracle.sigma, xtol=1e-12)
    assert np.sum(np.square(oracle.rows(best.x))) <= np.sum(np.square(oracle.rows(0 * best.x)))
    sigma = np.sqrt(np.diag(np.linalg.inv(best.jac.T @ best.jac)))
    assert np.abs(best.x / sigma).max() < 0.1, "from the fit's state it is nowhere to go"


class Huber:
    """All rows of a problem without scans, at tangents about the values of a fit; where its weights
    begin is taken from what each group of rows is off there."""

    def __init__(self, problem, values):
        self.problem, self.values = problem, values
        self.unknowns = problem.variables.values()
        self.sigma = np.concatenate([np.minimum(u.sigma, 1e-2) for u in self.unknowns])
        self.size = len(self.sigma)
        self.reach = {}
        found = self._groups(values)
        for kind in {kind for kind, _, dof in found if dof}:
            some = [(r, dof) for k, r, dof in found if k == kind and dof]
            norm, dof = np.array([np.linalg.norm(r) for r, _ in some]), [dof for _, dof in some]
            wide = np.median(norm / np.sqrt(stats.chi2(dof).median())) if len(some) > 3 else 1.0
            begin = {d: np.sqrt(stats.chi2(d).isf(1e-4)) for d in dof}
            self.reach |= {(kind, d): max(1.0, wide) * k for d, k in begin.items()}

    def rows(self, x):
        values, start = {}, 0
        for u in self.unknowns:
            values[u.name] = rigs.retract(u.kind, self.values[u.name], x[start : start + u.dim])
            start += u.dim
        out = []
        for kind, r, dof in self._groups(values):
            k, norm = self.reach.get((kind, dof), np.inf), np.linalg.norm(r)
            out.append(r if norm <= k else r * np.sqrt(2 * k * norm - k * k) / norm)
        return np.concatenate(out)

    def _groups(self, values):
        """Kind, rows and degrees of freedom of every group; 0 of what has a plain square."""
        out = []
        for block in self.problem.blocks:
            rows = block.evaluate(values, False)[0]
            target = block.kind == "target"
            for i, part in enumerate(np.split(rows, len(block.groups))):
                dof = (3, 2, 3)[i] if target else len(part)
                out.append(("target" if target else block.body, part, dof))
        for u in self.unknowns:
            kind = "joints" if u.role is Role.JOINTS else "paper"
            known = u.role is Role.JOINTS or u.name in self.problem.calibration
            robust = known and u.kind == "vector"
            out.append((kind, away(u, values[u.name]) / u.sigma, u.dim if robust else 0))
        return out
