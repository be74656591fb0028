"""How an arm lies."""

from __future__ import annotations

import numpy as np

from calib.effects.base import Effect, Param, Site, View
from calib.rig import Rig


class ArmLinkLength(Effect):
    """A URDF joint origin is longer than drawn: ``t -> t + dL * t / |t|``."""

    name = "arm_link_length"
    site = Site.EDGE
    formula = "|origin of joint i| = nominal + dL_i, along the nominal direction"
    typical = "0.1 to 5 mm"
    covariates = ("joints",)
    confounded_with = ("arm_base", "mount", "arm_joint_offset")
    source = "circle-point analysis: Mooring, Roth, Driels 1991, Manipulator Calibration"

    def params(self, rig: Rig) -> tuple[Param, ...]:
        return tuple(Param(n, "m", 0.005 if _length_m(rig, n) else 0.0) for n in rig.arm_edges)

    def basis(self, view: View) -> np.ndarray:
        tree = view.rig.tree
        basis = np.zeros((1, len(tree.edges), 6, len(view.rig.arm_edges)))
        for p, name in enumerate(view.rig.arm_edges):
            e = tree.edge_names.index(name)
            T_parent_child = tree.edges[e].T_parent_child
            if length_m := _length_m(view.rig, name):
                basis[0, e, 3:, p] = T_parent_child[:3, :3].T @ T_parent_child[:3, 3] / length_m
        return basis


def _length_m(rig: Rig, edge: str) -> float:
    """Length of a joint's origin; exactly 0 where it has none to speak of."""
    T_parent_child = rig.tree.edges[rig.tree.edge_names.index(edge)].T_parent_child
    length_m = float(np.linalg.norm(T_parent_child[:3, 3]))
    return length_m if length_m > 1e-9 else 0.0


class ArmJointOffset(Effect):
    """An encoder's zero is off: ``true joint = reported + offset``."""

    name = "arm_joint_offset"
    site = Site.JOINTS
    formula = "q_i = reported_i + offset_i"
    typical = "0.1 to 5 mrad"
    covariates = ("joints",)
    confounded_with = ("arm_base", "mount", "arm_joint_eccentricity")
    source = "Mooring, Roth, Driels 1991, Fundamentals of Manipulator Calibration"

    def params(self, rig: Rig) -> tuple[Param, ...]:
        units = {"revolute": "rad", "prismatic": "m"}
        return tuple(
            Param(joint, units[kind], 0.005)
            for joint, kind in zip(rig.joint_names, rig.joint_kinds, strict=True)
        )

    def basis(self, view: View) -> np.ndarray:
        return np.eye(len(view.rig.joint_names))[None]


class ArmAxisTilt(Effect):
    """A joint's axis leans from where the URDF draws it: two small turns across the axis."""

    name = "arm_axis_tilt"
    site = Site.EDGE
    formula = (
        "origin of joint i -> origin * exp(a_i * x_i + b_i * y_i), x_i and y_i across the axis"
    )
    typical = "0.1 to 2 mrad"
    covariates = ("joints",)
    confounded_with = ("arm_joint_offset", "arm_gravity_sag")
    source = "Hayati and Mirmirani 1985, J. Robotic Systems 2(4): parallel axes need a tilt"

    def params(self, rig: Rig) -> tuple[Param, ...]:
        return tuple(Param(f"{j}.{side}", "rad", 0.003) for j in rig.joint_names for side in "ab")

    def basis(self, view: View) -> np.ndarray:
        tree = view.rig.tree
        basis = np.zeros((1, len(tree.edges), 6, 2 * len(view.rig.joint_names)))
        for e, edge in enumerate(tree.edges):
            if edge.joint is not None:
                p = 2 * view.rig.joint_names.index(edge.joint.name)
                basis[0, e, :3, p : p + 2] = np.linalg.svd(edge.joint.axis[None])[2][1:].T
        return basis
