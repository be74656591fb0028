"""What gives way under its load: joints, links, the base, the mount, a tracked body.

The weights are those of the URDF's links, and what stops say each tip of the arm carries. Up
is where levels say; without any, the root's z axis is taken to point up.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from calib.effects.base import Effect, Param, Site, View
from calib.effects.basis import finite
from calib.effects.rig import DOF, mount_edges
from calib.rig import Rig
from calib.rig.columns import PAYLOAD, load_columns
from chains import se3
from chains.arm import UPRIGHT, Mass, gravity_moment, gravity_torque

PER_TORQUE = {"revolute": "rad/(N m)", "prismatic": "m/N"}
# m and rad: a beam that sags by 1 mm turns by 1.5 mm over its length.
BENT_M, BENT_RAD = 0.001, 0.005
OF_SYMMETRIC = tuple(zip(*np.triu_indices(3), strict=True))  # rows and columns
SOFT = 2e-4  # rad/(N m): a soft gear, as of a small collaborative arm


class ArmGravitySag(Effect):
    """A joint gives way under the arm's weight. It turns by so much per unit of gravity's torque.

    The payload counts as the links do. ``c > 0`` droops.
    """

    name = "arm_gravity_sag"
    site = Site.JOINTS
    unit = "rad/(N m)"
    formula = "q_i = reported_i + c_i * torque of gravity about joint i"
    typical = "0.2 to 2 mrad at full reach: 0.00002 to 0.0002 rad/(N m), size assumed"
    covariates = ("joints",)
    confounded_with = ("arm_joint_eccentricity", "base_flex", "arm_joint_offset")
    source = "stiffness of arms: Klimchik et al.; size assumed"
    needs_masses = True

    def params(self, rig: Rig) -> tuple[Param, ...]:
        return _per_joint(rig) if rig.masses else ()

    def basis(self, view: View) -> np.ndarray:
        return self.torque(view)[:, :, None] * np.eye(len(view.rig.joint_names))

    def torque(self, view: View) -> np.ndarray:
        """What each joint (K, J) gives way to, N m or N."""
        return gravity_torque(view.rig.tree, masses(view), view.joints, up(view))


class ArmPayloadSag(ArmGravitySag):
    """A joint gives way under the payload.

    It gives way more, or less, than under the arm's own weight. So it seems where the payload hangs
    elsewhere than at the tip, where it weighs other than stated, or where the URDF's masses are
    wrong.
    """

    name = "arm_payload_sag"
    formula = "q_i = reported_i + p_i * torque of the payloads, at the tips, about joint i"
    covariates = ("joints", "payload_kg")
    confounded_with = ("arm_gravity_sag", "arm_torque_sag")

    def params(self, rig: Rig) -> tuple[Param, ...]:
        return _per_joint(rig)

    def torque(self, view: View) -> np.ndarray:
        """What each joint (K, J) gives way to, N m or N."""
        payloads = _payloads(view) or view[PAYLOAD]  # which says that there is no such column
        return gravity_torque(view.rig.tree, payloads, view.joints, up(view))


class ArmPayloadOffset(Effect):
    """The payload's centre of mass lies beside the tip. Joints give way to the torque of that.

    All revolute joints are taken to be as soft as each other: an amount is their compliance times
    how far the centre lies from the tip, along the tip's axes. Beside `arm_gravity_sag`, which
    tells the compliance, it tells that distance.
    """

    name = "arm_payload_offset"
    site = Site.JOINTS
    unit = "rad/N"
    formula = "q_i = reported_i + o . torque about joint i of the payload, 1 m along each axis"
    typical = "0.2 m at 0.00003 rad/(N m): 0.000006 rad/N, size assumed"
    covariates = ("joints", "payload_kg")
    confounded_with = ("arm_gravity_sag", "arm_payload_sag", "arm_payload_moment")
    source = "stiffness of arms: Klimchik et al.; size assumed"

    def params(self, rig: Rig) -> tuple[Param, ...]:
        centres = self.centres(rig) if rig.turning else ()
        return tuple(Param(name, self.unit, 0.2 * SOFT) for name in centres)

    def centres(self, rig: Rig) -> list[str]:
        """Where the centre of what each tip carries lies, along the tip's axes."""
        of = {tip: f"{tip}." if len(rig.tips) > 1 else "" for tip in rig.tips}
        return [f"{of[tip]}centre_{axis}" for tip in rig.tips for axis in "xyz"]

    def basis(self, view: View) -> np.ndarray:
        rig, payloads = view.rig, _payloads(view) or view[PAYLOAD]
        turning = np.array([kind == "revolute" for kind in rig.joint_kinds], float)
        basis = np.zeros((len(view.joints), len(turning), len(self.centres(rig))))

        def torque(payload: Mass, centre_m: np.ndarray) -> np.ndarray:
            moved = replace(payload, centre_m=centre_m)
            return gravity_torque(rig.tree, [moved], view.joints, up(view))

        for payload in payloads if turning.any() else ():
            first = 3 * rig.tips.index(payload.frame)
            there = torque(payload, np.zeros(3))
            for k, axis in enumerate(np.eye(3)):
                basis[:, :, first + k] = turning * (torque(payload, axis) - there)
        return basis


class ArmPayloadMoment(ArmPayloadOffset):
    """Each joint gives way to a payload beside the tip. It does so by a compliance of its own, as
    wrists are softer than shoulders.

    An amount is the joint's compliance times how far the payload's centre lies from the tip.
    """

    name = "arm_payload_moment"
    formula = "q_i = reported_i + o_i . torque about joint i of the payload, 1 m along each axis"
    confounded_with = ("arm_payload_offset", "arm_gravity_sag", "arm_payload_sag")

    def params(self, rig: Rig) -> tuple[Param, ...]:
        return tuple(
            Param.of_joint(joint, self.unit, 0.2 * SOFT, centre)
            for joint in rig.joint_names
            if joint in rig.turning
            for centre in self.centres(rig)
        )

    def basis(self, view: View) -> np.ndarray:
        of_all, names = super().basis(view), view.rig.joint_names
        mine = [j for j, joint in enumerate(names) if joint in view.rig.turning]
        basis = np.zeros((*of_all.shape[:2], len(mine), of_all.shape[2]))
        basis[:, mine, np.arange(len(mine))] = of_all[:, mine]
        return basis.reshape(*of_all.shape[:2], len(mine) * of_all.shape[2])


class ArmTorqueSag(ArmGravitySag):
    """A joint gives way to its measured torque.

    Friction is part of it. Column ``<joint>.torque`` of a stop is that torque, N m, or a force, N;
    positive where it turns the joint on. A joint without that column is taken to bear none.
    """

    name = "arm_torque_sag"
    formula = "q_i = reported_i + k_i * torque of joint i as measured"
    covariates = ("joints", "torques")
    confounded_with = ("arm_gravity_sag", "arm_payload_sag")
    source = "Albu-Schaeffer, Ott, Hirzinger 2007, Int. J. Robotics Research 26(1): flexible joints"

    def params(self, rig: Rig) -> tuple[Param, ...]:
        return _per_joint(rig)

    def torque(self, view: View) -> np.ndarray:
        """What each joint (K, J) gives way to, N m or N."""
        return finite(view["torques"])


class ArmLinkBending(Effect):
    """Links bend across the joints' axes.

    Links and bearings give way there, where no encoder sees it. At each joint the arm turns with
    the moment of the weight beyond it, but for the part about the joint's axis, which is
    `arm_gravity_sag`. It gives way alike to both sides.
    """

    name = "arm_link_bending"
    site = Site.EDGE
    unit = "rad/(N m)"
    formula = "origin of joint i -> origin * exp(b_i * m_i), m_i the moment across its axis"
    typical = "a fifth of arm_gravity_sag, as bearings and links are stiffer than gears"
    covariates = ("joints",)
    confounded_with = ("arm_gravity_sag", "base_flex", "arm_geometry")
    source = "stiffness of arms: Klimchik et al.; size assumed"
    needs_masses = True

    def params(self, rig: Rig) -> tuple[Param, ...]:
        joints = rig.joint_names if rig.masses else ()
        return tuple(Param.of_joint(joint, self.unit, SOFT / 5) for joint in joints)

    def basis(self, view: View) -> np.ndarray:
        tree, joints = view.rig.tree, view.rig.joint_names
        leading = {e.joint.name: e for e in tree.edges if e.joint is not None and e.joint.leads}
        edges = [leading[joint] for joint in joints]
        names = [edge.name for edge in edges]
        moment = gravity_moment(tree, masses(view), names, view.joints, up(view))
        axes = np.stack([edge.joint.axis for edge in edges])
        moment -= np.einsum("kni,ni,nj->knj", moment, axes, axes)
        basis = np.zeros((len(moment), len(tree.edges), 6, len(joints)))
        for p, name in enumerate(names):
            basis[:, tree.edge_names.index(name), :3, p] = moment[:, p]
        return basis


class BaseFlex(Effect):
    """What carries the arm tilts under it: tyres, a plate, the first link's foot."""

    name = "base_flex"
    site = Site.EDGE
    unit = "rad/(N m)"
    formula = "the arm's base turns by (c_x m_x, c_y m_y), m the moment of the arm's weight there"
    typical = "0.1 to 2 mrad at full reach: 0.00002 to 0.0002 rad/(N m), size assumed"
    covariates = ("joints",)
    confounded_with = ("arm_gravity_sag", "arm_joint_offset", "arm_base")
    source = "size assumed"
    needs_masses = True

    def params(self, rig: Rig) -> tuple[Param, ...]:
        return tuple(Param(n, "rad/(N m)", 5e-5) for n in "xy") if rig.masses else ()

    def basis(self, view: View) -> np.ndarray:
        """At the edge that leads to the arm's base; at the arm's first where there is none."""
        tree, first = view.rig.tree, view.rig.edge(view.rig.chains[0][0])
        edge = next((edge for edge in tree.edges if edge.child == first.parent), first)
        moment = gravity_moment(tree, masses(view), [edge.name], view.joints, up(view))[:, 0]
        basis = np.zeros((len(moment), len(tree.edges), 6, 2))
        for axis in (0, 1):
            basis[:, tree.edge_names.index(edge.name), axis, axis] = moment[:, axis]
        return basis


class MountBending(Effect):
    """The mount bends under the LiDAR's weight. It gives way alike to all sides.

    The lever points from the mount to the LiDAR as CAD has it.
    """

    name = "mount_bending"
    site = Site.EDGE
    unit = "rad"
    formula = "the mount turns by c * (lever x gravity), both as unit vectors in its axes"
    typical = "0.05 to 0.5 mrad, size assumed"
    covariates = ("joints",)
    confounded_with = ("arm_gravity_sag", "mount")
    source = "size assumed"
    of_lidar = True

    def params(self, rig: Rig) -> tuple[Param, ...]:
        carries = rig.arm_edges and rig.lidar and mount_edges(rig)
        return (Param("amount", "rad", 0.0005),) if carries else ()

    def basis(self, view: View) -> np.ndarray:
        tree = view.rig.tree
        edge = mount_edges(view.rig)[0]
        T_root_mount = tree.place(tree.edges[edge].child, view.joints).Ts_root_frame
        T_root_lidar = tree.place(view.rig.lidar_frame, view.joints).Ts_root_frame
        lever_m = (se3.inverse(T_root_mount) @ T_root_lidar)[:, :3, 3]
        length_m = np.linalg.norm(lever_m, axis=1, keepdims=True)
        lever = np.where(length_m > 1e-9, lever_m / np.maximum(length_m, 1e-9), [0.0, 0.0, 1.0])
        basis = np.zeros((len(lever), len(tree.edges), 6, 1))
        down = -np.matvec(T_root_mount[:, :3, :3].mT, up(view))
        basis[:, edge, :3, 0] = np.cross(lever, down)
        return basis


class BodyBending(Effect):
    """What a tracked body beyond the arm hangs on gives way under its weight: a mast or a bracket
    bends. Like the base's height, what all poses share of it is not told by the tracker alone.

    A mast along the unit vector n has ``K = k (1 - n n^T)``, and turns by ``c`` along n.
    """

    name = "body_bending"
    site = Site.TRACKER
    unit = "m, rad"
    formula = "the body shifts by K g and turns by c x g, gravity g a unit vector in its axes"
    typical = "0.1 to 2 mm of a mast or a printed bracket, size assumed"
    covariates = ("joints",)
    confounded_with = ("arm_gravity_sag", "mount_bending", "arm_link_bending")
    source = "a body on springs: K symmetric (Maxwell's reciprocity), c of its beam; size assumed"

    def params(self, rig: Rig) -> tuple[Param, ...]:
        each = [Param("xyz"[i] + "xyz"[j], "m", BENT_M) for i, j in OF_SYMMETRIC]
        each += [Param(name, "rad", BENT_RAD) for name in DOF[:3]]
        return tuple(replace(p, name=f"{b}.{p.name}") for b in rig.carried for p in each)

    def basis(self, view: View) -> np.ndarray:
        own, tree = view.rig.carried, view.rig.tree
        every = view.rig.tracker.bodies
        basis = np.zeros((len(view.joints), len(every), 6, 9 * len(own)))
        for at, body in enumerate(own):
            T_root_body = tree.place(body, view.joints).Ts_root_frame
            down = -np.matvec(T_root_body[:, :3, :3].mT, up(view))
            mine = basis[:, every.index(body), :, 9 * at : 9 * (at + 1)]
            for k, (i, j) in enumerate(OF_SYMMETRIC):
                mine[:, 3 + i, k], mine[:, 3 + j, k] = down[:, j], down[:, i]
            mine[:, :3, 6:] = -se3.skew(down)
        return basis


def masses(view: View) -> list[Mass]:
    """What weighs on the arm at the view's stops: its links, and the payload at each tip."""
    return [*view.rig.masses, *_payloads(view)]


def up(view: View) -> np.ndarray:
    """The unit vector (3,), or (K, 3) by stop, that points up in the root's frame."""
    return view["up"] if "up" in view.columns else UPRIGHT


def _payloads(view: View) -> list[Mass]:
    """What the tips carry: the first ``payload_kg``, any other ``<tip>.payload_kg``."""
    return [
        Mass(tip, finite(view[column]), np.zeros(3))
        for tip, column in load_columns(view.rig).items()
        if column in view.columns
    ]


def _per_joint(rig: Rig) -> tuple[Param, ...]:
    """How much each joint gives way."""
    each = zip(rig.joint_names, rig.joint_kinds, strict=True)
    return tuple(Param.of_joint(joint, PER_TORQUE[kind], SOFT) for joint, kind in each)
