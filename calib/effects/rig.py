"""How a rig differs from its drawing."""

from __future__ import annotations

import numpy as np

from calib.effects.arm import masses
from calib.effects.base import Effect, Param, Site, View
from calib.effects.basis import step_times
from calib.rig import Rig
from chains import se3
from chains.arm import G

DOF = ("rx", "ry", "rz", "tx", "ty", "tz")


class FrameOffset(Effect):
    """A frame sits elsewhere than in CAD: ``T_parent_child = T_cad exp(theta)``.

    One per frame of ``rig.yaml``; a degree of freedom with a sigma of 0 is held.
    """

    site = Site.EDGE
    unit = "rad, m"
    formula = "T_parent_child = T_cad exp(theta), theta in the child's axes"
    typical = "0.2 to 2 mm, 1 to 5 mrad"

    def __init__(self, frame: str) -> None:
        self.name = frame

    def params(self, rig: Rig) -> tuple[Param, ...]:
        sigma = rig.frame_sigma[self.name]
        units = ("rad",) * 3 + ("m",) * 3
        return tuple(
            Param(dof, unit, float(s)) for dof, unit, s in zip(DOF, units, sigma, strict=True)
        )

    def basis(self, view: View) -> np.ndarray:
        tree = view.rig.tree
        basis = np.zeros((1, len(tree.edges), 6, 6))
        basis[0, tree.edge_names.index(self.name)] = np.eye(6)
        return basis


class BaseFlex(Effect):
    """What carries the arm tilts under it: tyres, a plate, the first link's foot.

    Weights as of `arm_gravity_sag`; the root's z axis is taken to point up.
    """

    name = "base_flex"
    site = Site.EDGE
    unit = "rad/(N m)"
    formula = "the arm's base turns by (c_x m_x, c_y m_y), m the moment of the arm's weight there"
    typical = "0.1 to 2 mrad at full reach: 0.00002 to 0.0002 rad/(N m), size assumed"
    covariates = ("joints",)
    confounded_with = ("arm_gravity_sag", "arm_joint_offset", "arm_base")
    source = "size assumed"

    def params(self, rig: Rig) -> tuple[Param, ...]:
        return tuple(Param(n, "rad/(N m)", 5e-5) for n in "xy") if rig.masses else ()

    def basis(self, view: View) -> np.ndarray:
        """At the edge that leads to the arm's base; at the arm's first where there is none."""
        tree = view.rig.tree
        first = tree.edge_names.index(view.rig.arm_edges[0])
        base = tree.edges[first].parent
        T_root_base = tree.place(base, view.joints).Ts_root_frame
        before = [e for e, edge in enumerate(tree.edges) if edge.child == base]
        if not before:
            T_root_base = T_root_base @ tree.edges[first].T_parent_child
        moment = np.zeros((len(view.joints), 3))
        for mass in masses(view):
            at = tree.place(mass.frame, view.joints).Ts_root_frame
            arm_m = at[:, :3, :3] @ mass.centre_m + at[:, :3, 3] - T_root_base[:, :3, 3]
            weight = np.reshape(mass.kg, (-1, 1)) * [[0.0, 0.0, -G]]
            moment += np.cross(arm_m, weight)
        moment = np.einsum("kji,kj->ki", T_root_base[:, :3, :3], moment)
        basis = np.zeros((len(moment), len(tree.edges), 6, 2))
        for axis in (0, 1):
            basis[:, (before or [first])[0], axis, axis] = moment[:, axis]
        return basis


class MountSlip(Effect):
    """The mount slips once, and stays where it slipped to.

    A step of the first frame beyond the arm's tip, or, without an arm, beyond the root.
    """

    name = "mount_slip"
    site = Site.EDGE
    unit = "rad, m"
    formula = "T_tip_mount = T_cad exp(theta) where t > t*, t since the first stop"
    typical = "0.1 to 2 mm, 0.1 to 2 mrad, size assumed"
    covariates = ("elapsed_s",)
    confounded_with = ("mount_creep", "mount", "optitrack_distortion")
    source = "size assumed"
    shape_name, shape = "t_s", 900.0
    of_lidar = True
    sigma = np.repeat([0.001, 0.001], 3)

    def shapes(self, stops: View) -> tuple[float, ...]:
        return step_times(stops) if self.params(stops.rig) else ()

    def params(self, rig: Rig) -> tuple[Param, ...]:
        return self.moves() if mount_edges(rig) else ()

    def moves(self) -> tuple[Param, ...]:
        """The six of one frame."""
        units = ("rad",) * 3 + ("m",) * 3
        each = zip(DOF, units, self.sigma, strict=True)
        return tuple(Param(dof, unit, float(sigma)) for dof, unit, sigma in each)

    def basis(self, view: View) -> np.ndarray:
        return self.moved(view, self.when(view["elapsed_s"]))

    def moved(self, view: View, by: np.ndarray) -> np.ndarray:
        """The basis where so much (K,) of each motion has happened at each stop."""
        basis = np.zeros((len(by), len(view.rig.tree.edges), 6, 6))
        basis[:, mount_edges(view.rig)[0]] = by[:, None, None] * np.eye(6)
        return basis

    def when(self, elapsed_s: np.ndarray) -> np.ndarray:
        """How much of the motion has happened (K,) at times since the first stop."""
        return (elapsed_s > self.shape).astype(float)


class MountCreep(MountSlip):
    """The mount gives way little by little, evenly in time; per hour."""

    name = "mount_creep"
    unit = "rad/h, m/h"
    formula = "T_tip_mount = T_cad exp(theta * t / 1 h), t since the first stop"
    typical = "0.05 to 0.5 mm per hour, size assumed; printed resin relaxes"
    confounded_with = ("mount_slip", "warmup_drift", "mount")
    shape_name, shape = "", 0.0
    sigma = np.repeat([0.002, 0.001], 3)

    def shapes(self, stops: View) -> tuple[float, ...]:
        return ()

    def params(self, rig: Rig) -> tuple[Param, ...]:
        return tuple(Param(p.name, f"{p.unit}/h", p.sigma) for p in super().params(rig))

    def when(self, elapsed_s: np.ndarray) -> np.ndarray:
        """How much of the motion has happened (K,) at times since the first stop."""
        return elapsed_s / 3600.0


class MountBending(Effect):
    """The mount bends under the LiDAR's weight. It gives way alike to all sides.

    The lever points from the mount to the LiDAR as CAD has it, gravity along -z of the root.
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
        basis[:, edge, :3, 0] = np.cross(lever, -T_root_mount[:, 2, :3])
        return basis


def mount_edges(rig: Rig) -> tuple[int, ...]:
    """The edges beyond the arm's tip, or beyond the root without an arm, on the way to the LiDAR.

    Without a LiDAR, on the way to the first tracked body there; none where nothing hangs there.
    """
    bodies = rig.tracker.bodies if rig.tracker else ()
    arm = {rig.tree.edge_names.index(name) for name in rig.arm_edges}
    for frame in (rig.lidar_frame, *bodies):
        path = rig.tree.path(frame) if frame else ()
        beyond = tuple(path[i] for i in range(len(path)) if arm <= set(path[:i]))
        if beyond:
            return beyond
    return ()
