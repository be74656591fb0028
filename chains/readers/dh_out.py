"""An arm's chain as a table of Denavit and Hartenberg, with Hayati's parameter where it is needed.

A row leads from one joint's axis, z of its frame, to the next one's:

    T = Rz(theta + q) Tz(d + q) Tx(a) Rx(alpha) Ry(beta)

with q in theta of a joint that turns and in d of one that slides. Where two axes are drawn parallel
d is 0 and beta takes its place, as their common normal could be anywhere (Hayati and Mirmirani
1985, J. Robotic Systems 2(4)); elsewhere beta is 0, and x lies along z_i cross z_{i+1}.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from chains import se3
from chains.frames import Edge
from chains.se3 import Array

# Sine of the angle between two axes, below which they count as drawn parallel.
PARALLEL = 0.02


@dataclass(frozen=True)
class DhLink:
    """From one joint's axis to the next one's: m and rad, in the order that they are applied."""

    joint: str
    kind: str
    theta_rad: float
    d_m: float
    a_m: float
    alpha_rad: float
    beta_rad: float

    def matrix(self, q: float = 0.0) -> Array:
        """Return T (4, 4) of the row at a joint value."""
        turns = self.kind == "revolute"
        parts = (
            ((0, 0, self.d_m + q * (not turns)), (0, 0, self.theta_rad + q * turns)),
            ((self.a_m, 0, 0), (self.alpha_rad, 0, 0)),
            ((0, 0, 0), (0, self.beta_rad, 0)),
        )
        T = np.eye(4)
        for xyz, rpy in parts:
            T = T @ se3.from_xyz_rpy(xyz, rpy)
        return T


@dataclass(frozen=True)
class DhTable:
    """A chain: ``T_base_first``, the n - 1 links between n axes, and the last axis's own motion
    before ``T_last_tip``."""

    T_base_first: Array
    links: list[DhLink]
    T_last_tip: Array


def table_of(edges: Sequence[Edge], drawn: Sequence[Edge]) -> DhTable:
    """Return the table of a chain with a joint or more.

    Args:
        edges: the chain.
        drawn: the same as drawn: of it is asked which axes are parallel, so that tables of the two
            have the same form.
    """
    axes, T_tip = _axes(edges)
    parallel = [
        float(np.linalg.norm(np.cross(a[:3, 2], b[:3, 2]))) < PARALLEL
        for a, b in zip(_axes(drawn)[0], _axes(drawn)[0][1:], strict=False)
    ]
    joints = [edge.joint for edge in edges if edge.joint is not None]
    T, links = axes[0], []
    for joint, following, to, level in zip(joints, joints[1:], axes[1:], parallel, strict=False):
        here = se3.inverse(T) @ to
        point = here[:3, 3] if following.kind == "revolute" else np.zeros(3)
        step = _parallel(here[:3, 2], point) if level else _skew(here[:3, 2], point)
        links.append(DhLink(joint=joint.name, kind=joint.kind, **step))
        T = T @ links[-1].matrix()
    return DhTable(axes[0], links, se3.inverse(T) @ T_tip)


def _skew(z: Array, point: Array) -> dict[str, float]:
    """Return theta, d, a, alpha, beta of a row to an axis of this direction through this point, in
    the frame of the row's own axis: feet of their common normal."""
    x = np.array([-z[1], z[0], 0.0]) / np.hypot(z[0], z[1])  # z_i cross z
    theta, a = np.arctan2(x[1], x[0]), float(point @ x)
    # The foot on the next axis lies a x above (0, 0, d).
    along = (point - a * x) @ np.array([x[1], -x[0], 0.0]) / (z @ np.array([x[1], -x[0], 0.0]))
    return {
        "theta_rad": theta,
        "d_m": float(point[2] - along * z[2]),
        "a_m": a,
        "alpha_rad": float(np.arctan2(np.hypot(*z[:2]), z[2])),
        "beta_rad": 0.0,
    }


def _parallel(z: Array, point: Array) -> dict[str, float]:
    """As `_skew`, to an axis that is nearly parallel: where it meets the plane of x and y."""
    foot = point - point[2] / z[2] * z
    theta, a = np.arctan2(foot[1], foot[0]), float(np.hypot(foot[0], foot[1]))
    if a < 1e-9:
        theta, a = 0.0, 0.0
    turned = se3.from_xyz_rpy([0, 0, 0], [0, 0, theta])[:3, :3].T @ z
    return {
        "theta_rad": theta,
        "d_m": 0.0,
        "a_m": a,
        "alpha_rad": float(np.arctan2(-turned[1], turned[2])),
        "beta_rad": float(np.arcsin(turned[0])),
    }


def _axes(edges: Sequence[Edge]) -> tuple[list[Array], Array]:
    """Return T_base_joint (4, 4) of every joint at zero, z along its axis, and T_base_tip."""
    T, found = np.eye(4), []
    for edge in edges:
        T = T @ edge.T_parent_child
        if edge.joint is not None:
            found.append(T @ _z_along(edge.joint.axis))
    return found, T


def _z_along(axis: Array) -> Array:
    """Return the least rotation (4, 4) that brings z to a unit vector (3,)."""
    R, v = np.eye(4), np.cross([0, 0, 1.0], axis)
    sine = np.linalg.norm(v)
    turn = np.arctan2(sine, axis[2])
    R[:3, :3] = se3.exp(np.r_[v / sine * turn if sine else [turn, 0, 0], 0, 0, 0])[:3, :3]
    return R
