"""How an arm lies."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from calib.effects.base import Effect, Param, Site, View
from calib.effects.basis import Creeps, Settles, Slips, warmer_k
from calib.rig import Rig
from chains.frames import Edge
from chains.minimal import Own, across, own_errors


class ArmLinkLength(Effect):
    """A URDF joint origin is longer than drawn: ``t -> t + dL * t / |t|``.

    Where a move of the base, the tool or a zero does nearly the same, only the part that these do
    not do is estimated. Of an origin 25 mm out and 400 mm up, on a base of unknown height, that is
    the part out: 0.7 mm of it would otherwise be told as 11 mm of length.
    """

    name = "arm_link_length"
    site = Site.EDGE
    unit = "m"
    formula = "|origin of joint i| = nominal + dL_i, along the nominal direction"
    typical = "0.1 to 5 mm"
    covariates = ("joints",)
    confounded_with = ("arm_base", "mount", "arm_joint_offset")
    source = "circle-point analysis: Mooring, Roth, Driels 1991, Manipulator Calibration"

    def params(self, rig: Rig) -> tuple[Param, ...]:
        told, moving = _own(rig).lengths, rig.joint_names
        sigma = {name: 0.005 if name in told else 0.0 for name in rig.arm_edges}
        return tuple(Param(n, "m", s, joint=n if n in moving else "") for n, s in sigma.items())

    def basis(self, view: View) -> np.ndarray:
        tree, lengths = view.rig.tree, _own(view.rig).lengths
        basis = np.zeros((1, len(tree.edges), 6, len(view.rig.arm_edges)))
        for p, name in enumerate(view.rig.arm_edges):
            if name in lengths:
                basis[0, tree.edge_names.index(name), 3:, p] = lengths[name]
        return basis


class ArmJointOffset(Effect):
    """An encoder's zero is off: ``true joint = reported + offset``."""

    name = "arm_joint_offset"
    site = Site.JOINTS
    unit = "rad"
    formula = "q_i = reported_i + offset_i"
    typical = "0.1 to 5 mrad"
    covariates = ("joints",)
    confounded_with = ("arm_base", "mount", "arm_joint_eccentricity")
    source = "Mooring, Roth, Driels 1991, Fundamentals of Manipulator Calibration"
    sigma = 0.005

    def params(self, rig: Rig) -> tuple[Param, ...]:
        return tuple(Param.of_joint(j, unit, self.sigma) for j, unit in rig.joint_units.items())

    def basis(self, view: View) -> np.ndarray:
        return np.eye(len(view.rig.joint_names))[None]


class ArmJointSlip(Slips, ArmJointOffset):
    """A joint's zero changes once, and stays changed: a belt jumped, a clutch slipped, or the
    encoder was referenced anew."""

    name = "arm_joint_slip"
    formula = "q_i = reported_i + offset_i where t > t*, t since the first stop"
    typical = "0.2 to 5 mrad, size assumed"
    covariates = ("joints", "elapsed_s")
    confounded_with = ("mount_slip", "base_slip", "arm_joint_offset")
    source = "size assumed"
    sigma = 0.001

    def basis(self, view: View) -> np.ndarray:
        return self.when(view["elapsed_s"])[:, None, None] * super().basis(view)


class ArmJointCreep(Creeps, ArmJointSlip):
    """A joint's zero drifts evenly in time, per hour: a belt stretches, or the joint still warms
    up when the last stop is measured."""

    name = "arm_joint_creep"
    unit = "rad/h"
    formula = "q_i = reported_i + offset_i * t / 1 h, t since the first stop"
    typical = "0.05 to 1 mrad per hour, size assumed"
    confounded_with = ("arm_joint_settle", "tracker_creep", "mount_creep")


class ArmJointSettle(Settles, ArmJointSlip):
    """A joint's zero drifts as the joint warms up: fast at first, then ever more slowly."""

    name = "arm_joint_settle"
    formula = "q_i = reported_i + offset_i * (1 - exp(-t / tau)), t since the first stop"
    typical = "0.05 to 1 mrad, size assumed; gears warm up"
    confounded_with = ("arm_joint_creep", "tracker_settle", "mount_settle")


class ArmAxisTilt(Effect):
    """A joint's axis leans from where the URDF draws it: two small turns across the axis."""

    name = "arm_axis_tilt"
    site = Site.EDGE
    unit = "rad"
    formula = (
        "origin of joint i -> origin * exp(a_i * x_i + b_i * y_i), x_i and y_i across the axis"
    )
    typical = "0.1 to 2 mrad"
    covariates = ("joints",)
    confounded_with = ("arm_joint_offset", "arm_gravity_sag")
    source = "Hayati and Mirmirani 1985, J. Robotic Systems 2(4): parallel axes need a tilt"

    def params(self, rig: Rig) -> tuple[Param, ...]:
        sides = [(joint, side) for joint in rig.joint_names for side in "ab"]
        return tuple(Param.of_joint(joint, "rad", 0.003, side) for joint, side in sides)

    def basis(self, view: View) -> np.ndarray:
        tree = view.rig.tree
        basis = np.zeros((1, len(tree.edges), 6, 2 * len(view.rig.joint_names)))
        for e, edge in enumerate(tree.edges):
            if edge.joint is not None and edge.joint.leads:
                p = 2 * view.rig.joint_names.index(edge.joint.name)
                basis[0, e, :3, p : p + 2] = across(edge.joint.axis)
        return basis


class ArmGeometry(Effect):
    """Axes lean and miss each other. With lengths and zeros this is all that geometry can be.

    A joint's axis can be off in four ways, a sliding joint's in two, and six numbers place the
    tool: 4 R + 2 P + 6. Of these the frames of ``rig.yaml`` hold the base and the tool,
    `arm_link_length` and `arm_joint_offset` theirs, and this effect the rest: tilts and shifts
    across each axis, for which none of the others can stand.
    """

    name = "arm_geometry"
    site = Site.EDGE
    unit = "rad, m"
    formula = "origin of joint i -> origin * exp(tilts, shifts), both across the axis"
    typical = "0.1 to 2 mrad, 0.1 to 2 mm"
    covariates = ("joints",)
    confounded_with = ("arm_link_length", "arm_axis_tilt")
    source = "He et al. 2010, IEEE Trans. Robotics 26(3): a complete and minimal local model"

    def params(self, rig: Rig) -> tuple[Param, ...]:
        sigma = {"rad": 0.003, "m": 0.005}  # of arm_axis_tilt and arm_link_length
        moving = {name: name for name in rig.joint_names}
        return tuple(
            Param(f"{s.edge}.{s.name}", s.unit, sigma[s.unit], joint=moving.get(s.edge, ""))
            for s in _own(rig).slips
        )

    def basis(self, view: View) -> np.ndarray:
        slips, names = _own(view.rig).slips, view.rig.tree.edge_names
        basis = np.zeros((1, len(names), 6, len(slips)))
        for p, slip in enumerate(slips):
            basis[0, names.index(slip.edge), :, p] = slip.twist
        return basis


def _own(rig: Rig) -> Own:
    """Where the tracker sees a body on the base and CAD is sure of all below the arm, the base is
    held by nothing; the tool where CAD is sure of all beyond the arm."""
    unsure = {name for name, sigma in rig.frame_sigma.items() if np.any(sigma)}
    bodies = rig.tracker.bodies if rig.tracker else ()
    base_held = bool(unsure - rig.beyond_arm) or all(rig.joints_to(body) for body in bodies)
    tips_held = tuple(bool(unsure & rig.beyond([tip])) for tip in rig.tips)
    return own_errors(rig.tree, rig.chains, base_held, tips_held)


class ArmRailBending(Effect):
    """The rail of a sliding joint is bent or twisted.

    It is an arc in either plane along it, and turns steadily about itself. Beams of gantries sag
    under what slides on them, and rails follow what they are screwed to. Where the joint has gone
    by q, the arc turns what slides by k q and shifts it by k q^2 / 2.
    """

    name = "arm_rail_bending"
    joint_kind = "prismatic"
    site = Site.EDGE
    unit = "rad/m"
    formula = (
        "T(q) -> T(q) * exp(shift k q^2 / 2 across the axis, turn k q about what is across both; "
        "turn t q about the axis)"
    )
    typical = "0.02 to 0.4 mrad per metre: a beam of 3 m that sags by 0.02 to 0.4 mm"
    covariates = ("joints",)
    confounded_with = ("arm_joint_scale", "optitrack_distortion", "arm_axis_tilt")
    source = "ISO 230-1: straightness and angular deviations of linear axes; size assumed"
    sigma = 0.0003

    def params(self, rig: Rig) -> tuple[Param, ...]:
        return tuple(
            Param.of_joint(edge.joint.name, self.unit, self.sigma, way)
            for edge in _rails(rig)
            for way in ("bend_a", "bend_b", "twist")
        )

    def basis(self, view: View) -> np.ndarray:
        rig, rails = view.rig, _rails(view.rig)
        basis = np.zeros((len(view.joints), len(rig.tree.edges), 6, 3 * len(rails)))
        for r, edge in enumerate(rails):
            e, axis = rig.tree.edge_names.index(edge.name), edge.joint.axis
            q = view.joints[:, rig.joint_names.index(edge.joint.name), None]
            for p, way in enumerate(across(axis).T, start=3 * r):
                # Seen from before the joint moves, the turn itself shifts, by q x turn.
                basis[:, e, :3, p] = q * np.cross(axis, way)
                basis[:, e, 3:, p] = -np.square(q) / 2 * way
            basis[:, e, :3, 3 * r + 2] = q * axis
        return basis


def _rails(rig: Rig) -> list[Edge]:
    """The edges of sliding joints that are read."""
    sliding = (e for e in rig.tree.edges if e.joint is not None and e.joint.kind == "prismatic")
    return [e for e in sliding if e.joint.leads and e.joint.name not in rig.passive]


class ArmJointThermal(ArmJointOffset):
    """A joint's zero goes with the temperature. Gear and housing grow unlike each other."""

    name = "arm_joint_thermal"
    unit = "rad/K"
    formula = "q_i = reported_i + k_i * (temperature - 20 degrees C)"
    typical = "0.01 to 0.1 mrad/K, size assumed"
    covariates = ("joints", "temperature_c")
    confounded_with = ("arm_thermal_growth", "arm_joint_creep", "arm_joint_offset")
    source = "size assumed"
    sigma = 0.0001

    def params(self, rig: Rig) -> tuple[Param, ...]:
        return tuple(replace(p, unit=f"{p.unit}/K") for p in super().params(rig))

    def basis(self, view: View) -> np.ndarray:
        return warmer_k(view)[:, None, None] * super().basis(view)


class ArmThermalGrowth(Effect):
    """The arm's links grow with the temperature. All have one coefficient."""

    name = "arm_thermal_growth"
    site = Site.EDGE
    unit = "1/K"
    formula = "|origin of joint i| = nominal * (1 + alpha * (temperature - 20 degrees C))"
    typical = "23 ppm/K for aluminium: 0.15 mm over 0.65 m and 10 K"
    covariates = ("temperature_c",)
    confounded_with = ("arm_link_length",)
    source = "expansion of aluminium, as in any handbook"

    def params(self, rig: Rig) -> tuple[Param, ...]:
        return (Param("alpha", "1/K", 5e-5),) if rig.arm_edges else ()

    def basis(self, view: View) -> np.ndarray:
        tree, warmer = view.rig.tree, warmer_k(view)
        basis = np.zeros((len(warmer), len(tree.edges), 6, 1))
        for name in view.rig.arm_edges:
            e = tree.edge_names.index(name)
            T_parent_child = tree.edges[e].T_parent_child
            origin_m = T_parent_child[:3, :3].T @ T_parent_child[:3, 3]
            basis[:, e, 3:, 0] = warmer[:, None] * origin_m
        return basis
