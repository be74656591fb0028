"""Effects that no physics is claimed for: an error of its own for every bin of a covariate, or of a
pair; one that a single ring has; directions of beams, joints and poses by functions of a column."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Self

import numpy as np

from calib.effects import Effect, OneHot, Param, Site, View
from calib.effects.basis import AZIMUTH, ELEVATION, RANGE, beam, finite
from calib.effects.rig import MountSlip
from calib.rig import Rig


class Binned(Effect):
    """Range has an error of its own in every bin of some covariates; empirical.

    Args:
        edges: covariate -> (B - 1,) ascending values between its bins.
        centres: covariate -> (B,) mean of its values in each bin.
        seen: covariate -> its least and largest value.
    """

    site = Site.BEAM
    formula = "range = true + a_bin"
    typical = "empirical"

    def __init__(
        self,
        edges: Mapping[str, np.ndarray],
        centres: Mapping[str, np.ndarray],
        seen: Mapping[str, tuple[float, float]],
    ) -> None:
        self.edges, self.centres, self.seen = edges, centres, seen
        self.covariates = tuple(edges)
        self.name = "structure:" + ",".join(edges)

    @property
    def bins(self) -> tuple[int, ...]:
        """How many of each covariate."""
        return tuple(len(e) + 1 for e in self.edges.values())

    def params(self, rig: Rig) -> tuple[Param, ...]:
        count = int(np.prod(self.bins))
        return tuple(Param(f"bin_{i}", "m", 0.01) for i in range(count if rig.lidar else 0))

    def basis(self, view: View) -> OneHot:
        index, known = np.zeros(view.rows, int), np.ones(view.rows, bool)
        for name, edges in self.edges.items():
            column = np.broadcast_to(view[name], view.rows)
            index = index * (len(edges) + 1) + np.searchsorted(edges, column)
            known &= np.isfinite(column)
        along = np.zeros(3)
        along[RANGE] = 1.0
        size = int(np.prod(self.bins))
        return OneHot(np.where(known, index, -1), np.broadcast_to(along, (view.rows, 3)), size)


class EachAlone(Effect):
    """Structure of which each parameter is tested by itself, as shapes of one family are: one of
    many that errs alone is lost among all. What is alone has the parameters and the basis of the
    whole still, which a look has the columns of.

    Attributes:
        only: number of the parameter that is tested; None of the whole.
        one_of: all of it; None of the whole.
    """

    only: int | None = None
    one_of: Self | None = None

    def alone(self, number: int) -> Self:
        """One of its parameters."""
        one = copy.copy(self)
        one.name, one.only, one.one_of = f"{self.name}@{number}", number, self
        return one


class RingSlope(EachAlone):
    """Range errs in proportion to a column, in each ring by a factor of its own; empirical.

    Args:
        column: which.
        seen: the least and largest value of it.
    """

    site = Site.BEAM
    typical = "empirical"
    formula = "range = true + a_ring * (column - its middle) / half its span"

    def __init__(self, column: str, seen: tuple[float, float]) -> None:
        self.column, self.seen = column, {column: seen}
        self.covariates = ("ring", column)
        self.name = f"structure:ring,{column}"

    def params(self, rig: Rig) -> tuple[Param, ...]:
        rings = range(rig.lidar.rings if rig.lidar else 0)
        return tuple(Param(f"ring_{k:03d}", "m", 0.01) for k in rings)

    def basis(self, view: View) -> OneHot:
        middle, half = middle_and_half(*self.seen[self.column])
        u = np.broadcast_to((view[self.column] - middle) / half, view.rows)
        along = np.zeros((view.rows, 3))
        along[:, RANGE] = finite(u)
        return OneHot(np.where(np.isfinite(u), view["ring"], -1), along, view.rig.lidar.rings)


def middle_and_half(low: float, high: float) -> tuple[float, float]:
    """The middle of a span, and half its length."""
    return (low + high) / 2, (high - low) / 2


class DirectionShape(Effect):
    """Beams point higher, or to the side, by a smooth function of azimuth; empirical.

    Args:
        what: "elevation" or "azimuth", which errs.
        seen: the least and largest azimuth.
        orders: how often a turn the last of its waves comes.
    """

    site = Site.BEAM
    typical = "empirical"
    covariates = ("azimuth_rad",)
    formula = "angle = true + sum over m of a_m sin(m azimuth) + b_m cos(m azimuth)"

    def __init__(self, what: str, seen: tuple[float, float], orders: int) -> None:
        self.what, self.seen, self.orders = what, {"azimuth_rad": seen}, orders
        self.name = f"structure:{what} of beams,azimuth_rad"

    def params(self, rig: Rig) -> tuple[Param, ...]:
        count = len(self.waves()) if rig.lidar else 0
        return tuple(Param(f"wave_{i}", "rad", 0.003) for i in range(count))

    def waves(self) -> list[str]:
        """The functions, as a formula has them."""
        orders = range(1, self.orders + 1)
        return [f"{f}({m} * azimuth_rad)" for m in orders for f in ("sin", "cos")]

    def basis(self, view: View) -> np.ndarray:
        turns = [m * view["azimuth_rad"] for m in range(1, self.orders + 1)]
        waves = [f(turn) for turn in turns for f in (np.sin, np.cos)]
        return beam(ELEVATION if self.what == "elevation" else AZIMUTH, *waves)


class JointShape(Effect):
    """A joint turns by a smooth function of itself, or of another joint beside; empirical.

    Args:
        joint: which turns.
        other: of which it is a function.
        seen: the least and largest value of that.
    """

    site = Site.JOINTS
    typical = "empirical"
    formula = "q_i = reported_i + sum over m = 1..3 of a_m sin(m q_k) + b_m cos(m q_k)"

    def __init__(self, joint: str, other: str, seen: tuple[float, float]) -> None:
        self.joint, self.other, self.seen = joint, other, {other: seen}
        self.covariates = ("joints",)
        self.name = f"structure:{joint}" + (f",{other}" if other != joint else "")

    def params(self, rig: Rig) -> tuple[Param, ...]:
        unit = dict(zip(rig.joint_names, rig.joint_kinds, strict=True)).get(self.joint)
        count = 6 if unit == "revolute" else 0
        return tuple(Param(f"wave_{i}", "rad", 0.003) for i in range(count))

    def basis(self, view: View) -> np.ndarray:
        i, k = (view.rig.joint_names.index(n) for n in (self.joint, self.other))
        q = view.joints[:, k]
        waves = [f(m * q) for m in (1, 2, 3) for f in (np.sin, np.cos)]
        out = np.zeros((len(q), view.joints.shape[1], len(waves)))
        out[:, i] = np.stack(waves, axis=1)
        return out


class OfPose(Effect):
    """Something is moved by a function of a column of the stops; empirical.

    Args:
        slips: the effect that moves it once: the mount, a tracked body, or the tracker.
        column: of the stops.
        seen: its least and largest value.
    """

    typical = "empirical"

    def __init__(self, slips: MountSlip, column: str, seen: tuple[float, float]) -> None:
        self.slips, self.site = slips, slips.site
        self.column, self.seen = column, {column: seen}
        self.covariates = (column,)
        self.name = f"structure:{self.what},{column}"

    @property
    def of_lidar(self) -> bool:
        return self.slips.of_lidar

    @property
    def goes_by_place(self) -> bool:
        return self.slips.goes_by_place

    @property
    def what(self) -> str:
        """What is moved: mount, lidar, body, base, tracker or stand."""
        return self.slips.family.removesuffix("_slip")


class PoseShape(OfPose):
    """It is moved by a smooth function.

    Args:
        slips, column, seen: as of `OfPose`.
        waves: how many cosines there are of each motion.
    """

    formula = "moved by exp(sum over m = 1..M of a_m cos(pi m u)), u = 0 to 1 over the column"

    def __init__(
        self, slips: MountSlip, column: str, seen: tuple[float, float], waves: int
    ) -> None:
        super().__init__(slips, column, seen)
        self.waves = waves

    def params(self, rig: Rig) -> tuple[Param, ...]:
        each = self.slips.params(rig)
        return tuple(
            replace(move, name=f"{move.name}.{m}") for m in range(self.waves) for move in each
        )

    def basis(self, view: View) -> np.ndarray:
        low, high = self.seen[self.column]
        u = (view[self.column] - low) / (high - low)
        known = np.isfinite(u)
        waves = (np.where(known, np.cos(np.pi * m * u), 0.0) for m in range(1, self.waves + 1))
        return np.concatenate([self.slips.moved(view, wave) for wave in waves], axis=-1)


class PoseSlope(OfPose, EachAlone):
    """It is moved in proportion to the column, one way alone. Of stops that are too few for a
    `PoseShape`.

    Args:
        slips, column, seen: as of `OfPose`.
        formulas: where a formula for each parameter acts, and the parameter; empty where none can.
    """

    formula = "moved by exp(a * (column - its middle) / half its span)"

    def __init__(
        self,
        slips: MountSlip,
        column: str,
        seen: tuple[float, float],
        formulas: Sequence[tuple[str, Param]],
    ) -> None:
        super().__init__(slips, column, seen)
        self.formulas = formulas

    def params(self, rig: Rig) -> tuple[Param, ...]:
        return self.slips.params(rig)

    def basis(self, view: View) -> np.ndarray:
        middle, half = middle_and_half(*self.seen[self.column])
        return self.slips.moved(view, finite((view[self.column] - middle) / half))
