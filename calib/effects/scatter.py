"""What chance does anew at every stop or place: random effects, whose spread is what is estimated.

Each member of a group (a stop, a location) has a value of its own about zero, ``a ~ N(0, sd^2)``.
The values are unknowns of the graph with that prior; or, where each is seen by rows of its own
only, those rows have a wider sigma. The sd is estimated (see `calib.solve.components`). Values of
one stop say nothing of the next: they correct no other recording, but without them errors that rows
share count as so many independent ones.
"""

from __future__ import annotations

import copy
from collections.abc import Iterable, Mapping
from typing import ClassVar, Self

import numpy as np

from calib.effects.base import Effect, OneHot, Param, Site, View
from calib.effects.basis import RANGE
from calib.effects.rig import DOF
from calib.rig import Rig

OF_POSE = dict(zip(DOF, ("rad",) * 3 + ("m",) * 3, strict=True))  # with their units


class Scatter(Effect):
    """A value by chance for every member of a group.

    Attributes:
        per: column of the stops that says which member each belongs to.
        sigma: sd to start from.
        what: in what its members scatter, as people read it; of values.
        members: names of all members; unknown until `among` says so, and then taken for one.
        label: before the names of the members of this recording, where there are several.
    """

    by_chance = True
    per: ClassVar[str]
    sigma: ClassVar[float]
    what: ClassVar[str] = ""
    members: tuple[str, ...] = ()
    label: str = ""

    @property
    def leading(self) -> str:
        """The unit in which its size is told; of bodies that of a position."""
        return self.unit.rpartition(", ")[2]

    def among(self, members: Iterable[str], label: str = "") -> Self:
        """The effect with a parameter for each of these members."""
        chosen = copy.copy(self)
        chosen.members, chosen.label = tuple(dict.fromkeys(members)), label
        return chosen

    def params(self, rig: Rig) -> tuple[Param, ...]:
        members = self.members or ("each",)
        return tuple(Param(m, self.unit, self.sigma) for m in members if rig.lidar)

    def params_of_each(self, units: Mapping[str, str]) -> tuple[Param, ...]:
        """For every member a parameter for each of these names, which have these units."""
        return tuple(
            Param(f"{member}.{name}", unit, self.sigma)
            for member in self.members or ("each",)
            for name, unit in units.items()
        )

    def member(self, view: View) -> np.ndarray:
        """Number (rows,) or (1,) of the member that a row belongs to, -1 for none."""
        names = np.atleast_1d(view[self.per])
        if not self.members:
            return np.zeros(len(names), int)
        at = {name: i for i, name in enumerate(self.members)}
        return np.array([at.get(f"{self.label}{name}", -1) for name in names.tolist()])

    def one_each(self, view: View, along: np.ndarray) -> OneHot:
        """The basis in which a row is off by its own member's value, along (3,) or (rows, 3)."""
        index = np.broadcast_to(self.member(view), view.rows)
        return OneHot(index, np.broadcast_to(along, (view.rows, 3)), max(1, len(self.members)))

    def several(self, view: View, size: int) -> np.ndarray:
        """The basis (rows, size, members * size) in which a row has so many values, each off by its
        own member's."""
        member, count = self.member(view), max(1, len(self.members))
        basis = np.zeros((len(member), size, count, size))
        rows = np.flatnonzero(member >= 0)
        basis[rows, :, member[rows], :] = np.eye(size)
        return basis.reshape(len(member), size, -1)


class StopRangeScatter(Scatter):
    """Every stop has a range zero of its own, by chance: power cycles, settling, the hour."""

    name = "stop_range_scatter"
    site = Site.BEAM
    unit, sigma = "m", 0.0003
    per = "stop"
    what = "in range"
    covariates = ("stop",)
    formula = "range = true + a_stop, a_stop by chance with a spread of sd"
    typical = "sd of 0.1 to 1 mm, size assumed"
    confounded_with = ("location_range_scatter", "temperature_drift", "warmup_drift")
    source = "variance components: Searle, Casella and McCulloch 1992; size assumed"

    def basis(self, view: View) -> OneHot:
        return self.one_each(view, np.eye(3)[RANGE])


class LocationRangeScatter(StopRangeScatter):
    """Every location has a range zero of its own, by chance: each has its own air and day."""

    name = "location_range_scatter"
    per = "location"
    covariates = ("location",)
    formula = "range = true + a_location, a_location by chance with a spread of sd"
    confounded_with = ("stop_range_scatter", "temperature_drift", "warmup_drift")


class StopPoseScatter(Scatter):
    """The LiDAR sits elsewhere at every stop, by chance: a mount that gives way or settles. What it
    turns by and what it shifts by have a spread each."""

    name = "stop_pose_scatter"
    site = Site.EDGE
    unit, sigma = "rad, m", 0.0003
    per = "stop"
    of_lidar = True
    what = "in where the LiDAR sits on what carries it"
    covariates = ("stop",)
    formula = "T_parent_lidar = T_cad exp(a_stop), a_stop by chance with two spreads, an axis"
    typical = "sd of 0.1 to 1 mm and mrad, size assumed"
    confounded_with = ("tracker_scatter", "joint_scatter", "mount_slip")
    source = "variance components: Searle, Casella and McCulloch 1992; size assumed"

    def params(self, rig: Rig) -> tuple[Param, ...]:
        hangs = rig.lidar and rig.tree.path(rig.lidar_frame)
        return self.params_of_each(OF_POSE) if hangs else ()

    def basis(self, view: View) -> np.ndarray:
        tree, each = view.rig.tree, self.several(view, len(DOF))
        basis = np.zeros((len(each), len(tree.edges), *each.shape[1:]))
        basis[:, tree.path(view.rig.lidar_frame)[-1]] = each
        return basis


class TrackerScatter(Scatter):
    """The tracker scatters more than rig.yaml says: from stop to stop, in how bodies are turned or
    where they are, by glints, cameras that were bumped, markers that are hidden one by one."""

    name = "tracker_scatter"
    site = Site.TRACKER
    unit, sigma = "rad, m", 0.0003
    per = "stop"
    widens = True
    covariates = ("stop",)
    formula = "T_body = true exp(a_stop), a_stop by chance with a spread of sd, beyond its sigma"
    typical = "as much as the sigma on paper, size assumed"
    confounded_with = ("optitrack_distortion", "body_slip", "base_slip")
    source = "variance components of groups of observations: Foerstner 1979; size assumed"

    def params(self, rig: Rig) -> tuple[Param, ...]:
        bodies = rig.tracker.bodies if rig.tracker else ()
        return self.params_of_each({f"{b}.{dof}": u for b in bodies for dof, u in OF_POSE.items()})

    def basis(self, view: View) -> np.ndarray:
        bodies = len(view.rig.tracker.bodies)
        basis = self.several(view, 6 * bodies)
        return basis.reshape(len(basis), bodies, 6, -1)


class JointScatter(Scatter):
    """Joint readings scatter more than rig.yaml says: from stop to stop, as brakes let go, loose
    couplings, readings rounded on their way."""

    name = "joint_scatter"
    site = Site.JOINTS
    unit, sigma = "rad", 0.0002
    per = "stop"
    widens = True
    covariates = ("stop", "joints")
    formula = "q_i = reported_i + a_stop,i, by chance with a spread of sd, beyond its sigma"
    typical = "as much as the sigma on paper, size assumed"
    confounded_with = ("tracker_scatter", "arm_backlash", "arm_gear_error")
    source = "variance components of groups of observations: Foerstner 1979; size assumed"

    def params(self, rig: Rig) -> tuple[Param, ...]:
        """None where the joints count as exact."""
        return self.params_of_each(rig.joint_units if rig.sigma_joint_rad else {})

    def basis(self, view: View) -> np.ndarray:
        return self.several(view, view.joints.shape[1])


class TargetScatter(Scatter):
    """Targets are found worse than rig.yaml says: spheres, or the markers above them, as rods swing
    or are bent, or spheres are fitted to few points."""

    name = "target_scatter"
    site = Site.TARGET
    unit, sigma = "m", 0.001
    per = "target"
    widens = True
    formula = "sphere = hung + a_target, a_target by chance with a spread of sd, beyond its sigma"
    typical = "as much as the sigma on paper, size assumed"
    confounded_with = ("target_rod_tilt", "optitrack_scale", "faro_scale")
    source = "variance components of groups of observations: Foerstner 1979; size assumed"

    def params(self, rig: Rig) -> tuple[Param, ...]:
        return self.params_of_each(dict.fromkeys("xyz", "m")) if rig.target else ()

    def basis(self, view: View) -> np.ndarray:
        return self.several(view, 3)


class ReferenceScatter(Scatter):
    """The mesh is less exact than rig.yaml says: each surface is off by an amount of its own, where
    scans were registered badly or a mesh was made too coarse."""

    name = "reference_scatter"
    site = Site.REFERENCE
    unit, sigma = "m", 0.0005
    per = "surface"
    widens = True
    covariates = ("surface",)
    formula = "surface = mesh + a_surface * normal, a_surface by chance with a spread of sd"
    typical = "as much as the sigma on paper, size assumed"
    confounded_with = ("moved_surface", "faro_scale")
    source = "variance components of groups of observations: Foerstner 1979; size assumed"

    def params(self, rig: Rig) -> tuple[Param, ...]:
        return super().params(rig) if rig.reference and rig.reference.mesh else ()

    def basis(self, view: View) -> OneHot:
        return self.one_each(view, view["normal"])
