"""How a rig differs from its drawing."""

from __future__ import annotations

import numpy as np

from calib.effects.base import Effect, Param, Site, View
from calib.effects.basis import nearest_times, step_times
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
    jumps = True
    of_lidar = True
    sigma = np.repeat([0.001, 0.001], 3)

    def shapes(self, stops: View) -> tuple[float, ...]:
        return step_times(stops) if self.params(stops.rig) else ()

    def beside(self, stops: View) -> tuple[float, ...]:
        return nearest_times(stops, self.shape) if self.params(stops.rig) else ()

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
    jumps = False
    sigma = np.repeat([0.002, 0.001], 3)

    def shapes(self, stops: View) -> tuple[float, ...]:
        return ()

    def params(self, rig: Rig) -> tuple[Param, ...]:
        return tuple(Param(p.name, f"{p.unit}/h", p.sigma) for p in super().params(rig))

    def when(self, elapsed_s: np.ndarray) -> np.ndarray:
        """How much of the motion has happened (K,) at times since the first stop."""
        return elapsed_s / 3600.0


class MountSettle(MountSlip):
    """The mount settles: it moves fast at first, then ever more slowly, to where it stays."""

    name = "mount_settle"
    formula = "T_tip_mount = T_cad exp(theta * (1 - exp(-t / tau))), t since the first stop"
    typical = "0.1 to 1 mm, 0.1 to 1 mrad, size assumed; printed resin and rubber relax"
    confounded_with = ("mount_creep", "mount_slip", "warmup_drift")
    shape_name, shape = "tau_s", 300.0
    jumps = False

    def shapes(self, stops: View) -> tuple[float, ...]:
        """Shares of the time measured in: after a longer one it would look like `mount_creep`."""
        lasted_s = float(stops["elapsed_s"].max(initial=0.0))
        known = bool(self.params(stops.rig)) and 0.0 < lasted_s < np.inf
        return tuple(float(f"{share * lasted_s:.3g}") for share in (0.05, 0.1, 0.2) if known)

    def when(self, elapsed_s: np.ndarray) -> np.ndarray:
        """How much of the motion has happened (K,) at times since the first stop."""
        return 1.0 - np.exp(-elapsed_s / self.shape)


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
