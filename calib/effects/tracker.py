"""How a tracker lies, and what hangs for it to see. Its z axis is taken to point up."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from calib.effects.base import Effect, Param, Site, View
from calib.effects.basis import Creeps, Settles
from calib.effects.rig import MountCreep, MountSlip, mount_edges
from calib.rig import Rig
from chains import se3

VOLUME_M = 3.0  # half the width of a usual volume


class OptitrackScale(Effect):
    """The tracker's metre is too long or too short: ``measured = true * (1 + s)``. Markers of
    targets are measured by it as well."""

    name = "optitrack_scale"
    site = Site.TRACKER
    of_volume = True
    unit = "1"
    formula = "position of a body or marker = true + s * true, tracker frame"
    typical = "100 to 1000 ppm, size assumed"
    covariates = ("tracked",)
    confounded_with = ("optitrack_distortion", "faro_scale", "range_scale")
    source = "wand calibration: docs.optitrack.com; Merriaux et al. 2017, Sensors 17:1591"

    def params(self, rig: Rig) -> tuple[Param, ...]:
        return (Param("scale", "1", 0.0005),) if rig.tracker else ()

    def basis(self, view: View) -> np.ndarray:
        return _in_body(view, lambda at_m: at_m[..., None])


class OptitrackDistortion(Effect):
    """The tracked volume is bent: a quadratic field of the position, about the tracker's origin.
    It moves bodies and the markers of targets alike."""

    name = "optitrack_distortion"
    site = Site.TRACKER
    of_volume = True
    unit = "m"
    formula = (
        "position p of a body or marker = true + sum of c_ijk p_j p_k / (3 m)^2, tracker frame"
    )
    typical = "0.2 to 2 mm at 3 m, size assumed"
    covariates = ("tracked",)
    confounded_with = ("optitrack_scale", "mount_slip")
    source = "calibration of the volume: docs.optitrack.com; size assumed"

    def params(self, rig: Rig) -> tuple[Param, ...]:
        names = [f"{i}.{j}{k}" for i in "xyz" for j, k in ("xx", "xy", "xz", "yy", "yz", "zz")]
        return tuple(Param(name, "m", 0.001) for name in names) if rig.tracker else ()

    def basis(self, view: View) -> np.ndarray:
        j, k = np.triu_indices(3)

        def field(at_m: np.ndarray) -> np.ndarray:
            p = at_m / VOLUME_M
            return np.kron(np.eye(3), (p[:, j] * p[:, k])[:, None, :])

        return _in_body(view, field)


class BodySlip(MountSlip):
    """A tracked body beyond the arm slips once. It was knocked or taped anew, and stays there.

    Without an arm, any body. Not one that is itself what `mount_slip` moves.
    """

    name = "body_slip"
    site = Site.TRACKER
    unit = "rad, m"
    formula = "T_parent_body = T_cad exp(theta) where t > t*, t since the first stop"
    typical = "0.2 to 5 mm, 0.2 to 5 mrad, size assumed"
    covariates = ("elapsed_s", "tracked")
    confounded_with = ("mount_slip", "mount_creep", "optitrack_distortion")
    source = "size assumed"

    def bodies(self, rig: Rig) -> tuple[str, ...]:
        """The bodies that it is about."""
        tree, mount = rig.tree, mount_edges(rig)
        bodies = rig.tracker.bodies if rig.tracker else ()
        alone = (b for b in bodies if not mount or tree.edges[mount[0]].child != b)
        return tuple(b for b in alone if rig.joints_to(b) or not rig.arm_edges)

    def params(self, rig: Rig) -> tuple[Param, ...]:
        each = self.moves()
        return tuple(
            replace(move, name=f"{body}.{move.name}") for body in self.bodies(rig) for move in each
        )

    def moved(self, view: View, by: np.ndarray) -> np.ndarray:
        """The basis where so much (K,) of each motion has happened at each stop."""
        bodies = view.rig.tracker.bodies
        own = [bodies.index(body) for body in self.bodies(view.rig)]
        basis = np.zeros((len(by), len(bodies), 6, 6 * len(own)))
        for i, b in enumerate(own):
            basis[:, b, :, 6 * i : 6 * (i + 1)] = by[:, None, None] * np.eye(6)
        return basis


class BaseSlip(BodySlip):
    """A tracked body before the arm slips once. Or the arm does, on the base; either
    stays there."""

    name = "base_slip"
    confounded_with = ("arm_base", "mount_creep", "optitrack_distortion")

    def bodies(self, rig: Rig) -> tuple[str, ...]:
        bodies = rig.tracker.bodies if rig.tracker and rig.arm_edges else ()
        return tuple(body for body in bodies if not rig.joints_to(body))


class TrackerSlip(MountSlip):
    """The tracker, or what the base stands on, moves once. These data cannot tell which of the two
    moved.

    All bodies are seen to move together. Where the base stands elsewhere at every stop, only a
    LiDAR in a scanned room shows it.
    """

    name = "tracker_slip"
    site = Site.TRACKER
    formula = "T_opti_body as seen = exp(theta) T_opti_body where t > t*, t since the first stop"
    typical = "0.2 to 5 mm, 0.2 to 2 mrad, size assumed"
    covariates = ("elapsed_s", "tracked")
    confounded_with = ("mount_slip", "base_slip", "tracker_creep")
    of_lidar = False

    def params(self, rig: Rig) -> tuple[Param, ...]:
        """None where nothing but the tracker tells where the base stands."""
        told = rig.moves != "stop" or rig.lidar is not None
        return self.moves() if rig.tracker and told else ()

    def moved(self, view: View, by: np.ndarray) -> np.ndarray:
        """The tracker's frame moves by the twist, and each body in its own axes.

        Column ``tracked`` (K, B, 4, 4) says where bodies are, tracker frame; NaN where not seen.
        """
        T_body_opti = se3.inverse(np.nan_to_num(view["tracked"]))
        return by[:, None, None, None] * se3.adjoint(T_body_opti)


class TrackerCreep(Creeps, TrackerSlip):
    """The tracker, or what the base stands on, creeps: evenly in time, per hour. These data cannot
    tell which of the two moves."""

    name = "tracker_creep"
    formula = "T_opti_body as seen = exp(theta * t / 1 h) T_opti_body, t since the first stop"
    typical = "0.05 to 0.5 mm per hour, size assumed; tripods and tyres settle"
    confounded_with = ("mount_creep", "tracker_slip", "warmup_drift")
    unit, sigma = MountCreep.unit, MountCreep.sigma


class TrackerSettle(Settles, TrackerSlip):
    """The tracker, or what the base stands on, settles: fast at first, then ever more slowly. These
    data cannot tell which of the two moves."""

    name = "tracker_settle"
    formula = "T_opti_body as seen = exp(theta * (1 - exp(-t / tau))) T_opti_body"
    typical = "0.1 to 1 mm, 0.05 to 0.5 mrad, size assumed; tripods and tyres settle"
    confounded_with = ("tracker_creep", "tracker_slip", "warmup_drift")


def _in_body(view: View, field: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """The twists (K, B, 6, P) of shifts (N, 3, P) that depend on where (N, 3) a body is.

    Column ``tracked`` (K, B, 4, 4) says where bodies are, tracker frame; NaN where not seen.
    """
    T = np.nan_to_num(view["tracked"])
    shift = field(T[..., :3, 3].reshape(-1, 3))
    shift = np.swapaxes(T[..., :3, :3], -1, -2) @ shift.reshape(*T.shape[:2], *shift.shape[1:])
    return np.concatenate([np.zeros_like(shift), shift], axis=2)


class TargetRodTilt(Effect):
    """Rods hang askew, all alike: friction, a bent hook, or a tracker's floor that is not level."""

    name = "target_rod_tilt"
    site = Site.TARGET
    unit = "rad"
    formula = "sphere = hung + L * (tilt_x, tilt_y, 0), tracker frame, L below the lower marker"
    typical = "5 to 10 mrad: 0.5 degrees over 0.2 m are 1.7 mm, size assumed"
    confounded_with = ("faro",)
    source = "size assumed"

    def params(self, rig: Rig) -> tuple[Param, ...]:
        return tuple(Param(n, "rad", 0.008) for n in "xy") if rig.target else ()

    def basis(self, view: View) -> np.ndarray:
        return view.rig.target.sphere_below_lower_marker_m * np.eye(3)[None, :, :2]


class TargetSphereOffset(Effect):
    """Spheres sit lower on their rods than drawn, all alike."""

    name = "target_sphere_offset"
    site = Site.TARGET
    unit = "m"
    formula = "sphere = hung - (0, 0, d), tracker frame"
    typical = "0.2 to 1 mm, as printed"
    confounded_with = ("faro",)
    source = "Pushing the Limits of LiDAR: Accurate Performance Analysis of Indoor 3D LiDARs"

    def params(self, rig: Rig) -> tuple[Param, ...]:
        return (Param("lower", "m", 0.001),) if rig.target else ()

    def basis(self, view: View) -> np.ndarray:
        return -np.eye(3)[None, :, 2:]
