"""How what drives and reads an arm's joints errs: encoders, gears, screws, play."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from calib.effects.base import Effect, Param, Site, View
from calib.rig import Rig
from chains.frames import Edge


class ArmJointScale(Effect):
    """An encoder counts too many steps a turn: ``true joint = reported * (1 + k)``."""

    name = "arm_joint_scale"
    site = Site.JOINTS
    unit = "1"
    formula = "q_i = reported_i + k_i * reported_i"
    typical = "up to 0.1 percent, size assumed"
    covariates = ("joints",)
    confounded_with = ("arm_joint_offset", "arm_joint_eccentricity")
    source = "size assumed"

    def params(self, rig: Rig) -> tuple[Param, ...]:
        return tuple(Param.of_joint(joint, "1", 0.001) for joint in rig.joint_names)

    def basis(self, view: View) -> np.ndarray:
        return view.joints[:, :, None] * np.eye(view.joints.shape[1])


class ArmJointCoupling(Effect):
    """A joint goes with another: what drives it passes through the joints before it.

    Wrists are driven through each other by shafts and bevel gears, later joints by belts and levers
    from the base, and the nut of a ball screw slides a shaft that a second nut turns. Whoever reads
    the motors allows for that, by a ratio that may be off. Each joint may go with the two before
    it, and one that slides with one that turns after it.
    """

    name = "arm_joint_coupling"
    site = Site.JOINTS
    unit = "1"
    formula = "q_i = reported_i + c_ik * reported_k, k the two joints before i"
    typical = "up to 0.1 percent, size assumed; 1 where it is left out, as of joint 5 in joint 6"
    covariates = ("joints",)
    confounded_with = ("arm_joint_scale", "arm_joint_offset", "arm_backlash")
    source = "coupling matrix of Staubli RX arms: softMC wiki, PUMA robot model; size assumed"
    sigma = 0.001

    def params(self, rig: Rig) -> tuple[Param, ...]:
        unit = rig.joint_units
        return tuple(
            Param.of_joint(joint, _over(unit[joint], unit[other]), self.sigma, f"by_{other}")
            for joint, other in _coupled(rig)
        )

    def basis(self, view: View) -> np.ndarray:
        names, pairs = view.rig.joint_names, _coupled(view.rig)
        basis = np.zeros((*view.joints.shape, len(pairs)))
        for p, (joint, other) in enumerate(pairs):
            basis[:, names.index(joint), p] = view.joints[:, names.index(other)]
        return basis


class ArmMimicRatio(Effect):
    """A joint follows another further than drawn, or less: the multiplier of its URDF is off."""

    name = "arm_mimic_ratio"
    joint_kind = "mimic"
    site = Site.EDGE
    unit = "1"
    formula = "q of a joint that mimics = (multiplier + dm) * reported + offset"
    typical = "up to 1 percent, size assumed: a pulley, a belt that stretches"
    covariates = ("joints",)
    confounded_with = ("arm_joint_scale", "arm_joint_coupling")
    source = "mimic: https://wiki.ros.org/urdf/XML/joint; size assumed"
    sigma = 0.01

    def params(self, rig: Rig) -> tuple[Param, ...]:
        return tuple(
            Param(edge.name, _over(edge.joint.unit, rig.joint_units[edge.joint.name]), self.sigma)
            for edge in _followers(rig)
        )

    def basis(self, view: View) -> np.ndarray:
        tree, followers = view.rig.tree, _followers(view.rig)
        basis = np.zeros((len(view.joints), len(tree.edges), 6, len(followers)))
        for p, edge in enumerate(followers):
            # The twist sits before the motion and is along the same screw, so the two add up.
            q = view.joints[:, view.rig.joint_names.index(edge.joint.name)]
            basis[:, tree.edge_names.index(edge.name), :, p] = np.outer(q, edge.joint.along)
        return basis


class ArmJointEccentricity(Effect):
    """A joint's encoder disc sits off its axis: the angle errs once a turn."""

    name = "arm_joint_eccentricity"
    joint_kind = "revolute"
    site = Site.JOINTS
    unit = "rad"
    formula = "q_i = reported_i + a_i * sin(reported_i) + b_i * cos(reported_i)"
    typical = "0.1 to 1 mrad, size assumed"
    covariates = ("joints",)
    confounded_with = ("arm_gravity_sag", "arm_joint_offset", "arm_joint_scale")
    source = "Judd and Knasinski 1990, IEEE Trans. Robotics and Automation 6(1)"
    sigma = 0.001
    shape = 1.0

    def params(self, rig: Rig) -> tuple[Param, ...]:
        mine = [joint for joint, unit in rig.joint_units.items() if unit == self.unit]
        each = [(joint, wave) for joint in mine for wave in ("sin", "cos")]
        return tuple(Param.of_joint(joint, self.unit, self.sigma, wave) for joint, wave in each)

    def basis(self, view: View) -> np.ndarray:
        mine = [j for j, unit in enumerate(view.rig.joint_units.values()) if unit == self.unit]
        basis = np.zeros((*view.joints.shape, 2 * len(mine)))
        for p, j in enumerate(mine):
            turn = self.turn(view.joints[:, j])
            basis[:, j, 2 * p], basis[:, j, 2 * p + 1] = np.sin(turn), np.cos(turn)
        return basis

    def turn(self, joint: np.ndarray) -> np.ndarray:
        """How far what is uneven has turned, rad, where a joint is."""
        return self.shape * joint


class ArmGearError(ArmJointEccentricity):
    """A joint's gear is uneven: the angle errs N times a turn, N the gear's ratio or twice it."""

    name = "arm_gear_error"
    formula = "q_i = reported_i + a_i * sin(N * reported_i) + b_i * cos(N * reported_i)"
    typical = "0.1 to 0.5 mrad, size assumed"
    confounded_with = ("arm_backlash", "arm_joint_eccentricity")
    source = "harmonic drives: Mechanism and Machine Theory 2021, 104122"
    sigma = 0.0005
    shape_name, shape, whole = "ratio", 100.0, True
    repeats = True

    def shapes(self, stops: View) -> tuple[float, ...]:
        """Every low order, as of shafts and teeth, and ratios usual in arms, singly and doubled."""
        high = (24, 32, 34, 50, 51, 80, 100, 101, 120, 160, 161, 200)
        return tuple(map(float, (*range(2, 21), *high))) if stops.rig.joint_names else ()


class ArmScrewError(ArmJointEccentricity):
    """A linear joint's screw, rack or pinion is uneven. The travel errs once in each lead of the
    screw, tooth of the rack or turn of the pinion."""

    name = "arm_screw_error"
    joint_kind = "prismatic"
    unit = "m"
    formula = "q_i = reported_i + a_i * sin(w) + b_i * cos(w), w = 2 pi * reported_i / L"
    typical = "0.005 to 0.1 mm, size assumed"
    confounded_with = ("arm_joint_scale", "arm_backlash")
    source = "leads: ISO 3408-2; size assumed"
    sigma = 0.00005
    shape_name, shape = "lead", 0.01
    repeats = True

    def shapes(self, stops: View) -> tuple[float, ...]:
        """Usual leads in mm and inches, and teeth by their module; and longer, half a period after
        the other over the travel, down to a 20th of it."""
        if not self.params(stops.rig) or not len(stops.joints):
            return ()
        linear = np.array([kind == "prismatic" for kind in stops.rig.joint_kinds])
        travel_mm = 1e3 * np.ptp(stops.joints[:, linear], axis=0).max()
        mm = [1, 2, 2.5, 3, 4, 5, 6, 8, 10, 12, 16, 20, 25, 32, 40]
        mm += [25.4 * inch for inch in (0.2, 0.25, 0.5, 1)]
        mm += [np.pi * module for module in (1, 1.5, 2, 3, 4)]
        mm += [each for k in range(3, 41) if (each := 2 * travel_mm / k) > max(mm)]
        return tuple(round(1e-3 * each, 8) for each in sorted(mm))

    def turn(self, joint: np.ndarray) -> np.ndarray:
        return 2 * np.pi * joint / self.shape


class ArmBacklash(Effect):
    """A joint lies half its play behind the way it came: ``true = reported + h * (+1 or -1)``."""

    name = "arm_backlash"
    site = Site.JOINTS
    unit = "rad"
    formula = "q_i = reported_i + h_i * (sign of joint i's last move)"
    typical = "0.1 to 1 mrad, size assumed"
    covariates = ("joints", "time_s")
    confounded_with = ("arm_joint_lag", "arm_joint_offset", "arm_gear_error")
    source = "size assumed"
    column = "moved"

    def params(self, rig: Rig) -> tuple[Param, ...]:
        return tuple(Param.of_joint(joint, unit, 0.0005) for joint, unit in rig.joint_units.items())

    def basis(self, view: View) -> np.ndarray:
        way = np.stack([view[f"{self.column}.{joint}"] for joint in view.rig.joint_names], axis=1)
        return way[:, :, None] * np.eye(way.shape[1])


class ArmJointLag(ArmBacklash):
    """A joint is read before it has come to rest. Where it rests is off its reading by a share of
    the distance that it went.

    The share depends on how long the arm waits before it is read; here each joint has one, as where
    the arm always waits as long.
    """

    name = "arm_joint_lag"
    unit = "1"
    formula = "q_i = reported_i + k_i * (how far joint i went since the stop before)"
    typical = "0.01 to 0.2 percent of the distance, size assumed"
    confounded_with = ("arm_backlash", "arm_joint_scale")
    column = "travel"

    def params(self, rig: Rig) -> tuple[Param, ...]:
        return tuple(Param.of_joint(joint, "1", 0.0005) for joint in rig.joint_names)


class ArmJointLagDecay(ArmJointLag):
    """A joint is nearer to rest the longer it waits. It is read before it has come to rest, and
    what is left of its way falls with the time since the stop before.

    Where the arm waits alike before all readings this is `ArmJointLag`.
    """

    name = "arm_joint_lag_decay"
    formula = (
        "q_i = reported_i + k_i * (how far joint i went) * exp(-wait / tau), "
        "wait since the stop before"
    )
    typical = "0.1 to 1 percent of the distance as the arm stops, tau 0.3 to 5 s, size assumed"
    confounded_with = ("arm_joint_lag", "arm_backlash", "arm_joint_scale")
    covariates = ("joints", "waited.s", "time_s")
    shape_name, shape = "tau_s", 30.0  # where nobody chooses: stops are simulated a minute apart

    def params(self, rig: Rig) -> tuple[Param, ...]:
        return tuple(replace(param, sigma=0.005) for param in super().params(rig))

    def shapes(self, stops: View) -> tuple[float, ...]:
        """A grid: from where a thousandth is left after the shortest wait, to where a fifth less is
        left after the longest."""
        if not self.params(stops.rig) or "waited.s" not in stops.columns:
            return ()
        waits = stops["waited.s"][stops["waited.s"] > 0]
        if not len(waits):
            return ()
        least_s, most_s = waits.min() / -np.log(0.001), np.ptp(waits) / -np.log(0.8)
        taus = np.geomspace(least_s, most_s, 6) if most_s > least_s else ()
        return tuple(float(f"{tau:.3g}") for tau in taus)

    def basis(self, view: View) -> np.ndarray:
        left = np.exp(-view["waited.s"] / self.shape)
        return left[:, None, None] * super().basis(view)


def _coupled(rig: Rig) -> tuple[tuple[str, str], ...]:
    """Joints, and those that each may go with, both of them read."""
    slides = {joint.name for joint in rig.joints} - rig.turning
    pairs: dict[tuple[str, str], None] = {}
    for chain in rig.chains:
        joints = (rig.edge(name).joint for name in chain)
        names = list(dict.fromkeys(joint.name for joint in joints if joint is not None))
        names = [name for name in names if name not in rig.passive]
        for i, name in enumerate(names):
            after = [
                other for other in names[i + 1 : i + 2] if name in slides and other not in slides
            ]
            pairs |= dict.fromkeys((name, other) for other in (*names[max(i - 2, 0) : i], *after))
    return tuple(pairs)


def _followers(rig: Rig) -> list[Edge]:
    """The edges of joints that follow one that is read."""
    return [edge for edge in rig.followers if edge.joint.name not in rig.passive]


def _over(unit: str, other: str) -> str:
    """The unit of how far a joint goes for each unit of another."""
    return "1" if unit == other else f"{unit}/{other}"
