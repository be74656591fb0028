"""How a rig differs from its drawing."""

from __future__ import annotations

import numpy as np

from calib.effects.base import Effect, Param, Site, View
from calib.effects.basis import Creeps, Settles, Slips
from calib.rig import Rig

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


class MountSlip(Slips):
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
    of_lidar = True
    sigma = np.repeat([0.001, 0.001], 3)

    def params(self, rig: Rig) -> tuple[Param, ...]:
        return self.moves() if self.edge(rig) is not None else ()

    def edge(self, rig: Rig) -> int | None:
        """The edge that moves; None of a rig that has none such."""
        return next(iter(mount_edges(rig)), None)

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
        basis[:, self.edge(view.rig)] = by[:, None, None] * np.eye(6)
        return basis


class MountCreep(Creeps, MountSlip):
    """The mount gives way little by little, evenly in time; per hour."""

    name = "mount_creep"
    unit = "rad/h, m/h"
    formula = "T_tip_mount = T_cad exp(theta * t / 1 h), t since the first stop"
    typical = "0.05 to 0.5 mm per hour, size assumed; printed resin relaxes"
    confounded_with = ("mount_slip", "warmup_drift", "mount")
    sigma = np.repeat([0.002, 0.001], 3)


class MountSettle(Settles, MountSlip):
    """The mount settles: it moves fast at first, then ever more slowly, to where it stays."""

    name = "mount_settle"
    formula = "T_tip_mount = T_cad exp(theta * (1 - exp(-t / tau))), t since the first stop"
    typical = "0.1 to 1 mm, 0.1 to 1 mrad, size assumed; printed resin and rubber relax"
    confounded_with = ("mount_creep", "mount_slip", "warmup_drift")


class LidarSlip(MountSlip):
    """The LiDAR slips once on its mount.

    It stays where it slipped to; or its azimuth is counted from elsewhere from then on. Tracked
    bodies on the mount stay where they are. Where there are none it is `MountSlip`.
    """

    name = "lidar_slip"
    needs_lidar = True
    formula = "T_mount_lidar = T_cad exp(theta) where t > t*, t since the first stop"
    confounded_with = ("mount_slip", "body_slip", "ring_azimuth_offset")

    def edge(self, rig: Rig) -> int | None:
        mount, lidar = super().edge(rig), rig.lidar_frame
        bodies = rig.tracker.bodies if rig.tracker else ()
        if mount is None or not lidar or not rig.tree.path(lidar):
            return None
        own = rig.tree.path(lidar)[-1]
        beside = (b for b in bodies if mount in rig.tree.path(b) and own not in rig.tree.path(b))
        return own if own != mount and any(beside) else None


class StandSlip(MountSlip):
    """What the rig stands on moves once. A tripod is kicked, or a wheel gives way, where the rig is
    taken to stand still over several stops; it stays there.

    A LiDAR in its room, or a level, tells it from a move of the tracker.
    """

    name = "stand_slip"
    site = Site.ROOT
    needs_standing = True
    formula = "T_world_root = T_stood exp(theta) where t > t*, t since the first stop"
    typical = "0.5 to 50 mm, 0.5 to 20 mrad, size assumed"
    confounded_with = ("tracker_slip", "arm_joint_slip", "mount_slip")

    def params(self, rig: Rig) -> tuple[Param, ...]:
        """None where every stop has a place of its own."""
        shows = rig.lidar or (rig.levels and rig.levels.frames)
        return self.moves() if rig.moves != "stop" and shows else ()

    def moved(self, view: View, by: np.ndarray) -> np.ndarray:
        return by[:, None, None] * np.eye(6)


class StandCreep(Creeps, StandSlip):
    """What the rig stands on gives way evenly in time. Per hour."""

    name = "stand_creep"
    unit, sigma = MountCreep.unit, MountCreep.sigma
    formula = "T_world_root = T_stood exp(theta * t / 1 h), t since the first stop"
    typical = "0.05 to 0.5 mm per hour, size assumed; tripods and tyres settle"
    confounded_with = ("tracker_creep", "mount_creep", "stand_slip")


class StandSettle(Settles, StandSlip):
    """What the rig stands on settles. It moves fast at first, then ever more slowly."""

    name = "stand_settle"
    formula = "T_world_root = T_stood exp(theta * (1 - exp(-t / tau))), t since the first stop"
    typical = "0.1 to 1 mm, 0.05 to 0.5 mrad, size assumed; tripods and tyres settle"
    confounded_with = ("stand_creep", "stand_slip", "tracker_settle")


def mount_edges(rig: Rig) -> tuple[int, ...]:
    """The edges beyond a tip of the arm, or beyond the root without one, on the way to the LiDAR.

    Without a LiDAR, on the way to the first tracked body there; none where nothing hangs there.
    """
    bodies = rig.tracker.bodies if rig.tracker else ()
    ends = rig.tips or (rig.tree.root,)
    for frame in (rig.lidar_frame, *bodies):
        path = rig.tree.path(frame) if frame else ()
        at = [i for i, edge in enumerate(path) if rig.tree.edges[edge].parent in ends]
        if at:
            return path[at[0] :]
    return ()
