"""What an effect is: one way the hardware lies, as a site and a basis.

Instruments (BEAM, TRACKER) add to the truth, ``measured = true + basis(view) @ theta``; geometry
(JOINTS, EDGE, ROOT, TARGET, REFERENCE) adds to what encoder, URDF, CAD or mesh say,
``true = nominal + basis(view) @ theta``. ``theta = 0`` switches an effect off.
"""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import Enum
from types import MappingProxyType
from typing import Any, ClassVar, Self

import numpy as np

from calib.rig import Rig
from chains import se3
from chains.errors import NoColumnError

SHAPE_STEP = 0.01  # relative, to either side, for the derivative by a shape


class Site(Enum):
    """Where on the path from the room to the number the hardware lies.

    The comment gives the shape of the error at one row of the site, and what a row is.
    """

    BEAM = "beam"  # (3,) range m, azimuth rad, elevation rad; a row per point
    JOINTS = "joints"  # (J,) rad or m, what each encoder reports; a row per stop
    EDGE = "edge"  # (E, 6) twist of every edge of the frame tree; a row per stop
    ROOT = "root"  # (6,) twist of the rig's root from where it stood; a row per stop
    TRACKER = "tracker"  # (B, 6) twist of every tracked body as seen; a row per stop. Of what is
    # `of_volume` also (2, 6), of the lower and the upper marker of targets; a row per target
    TARGET = "target"  # (3,) m, sphere centre on its rod, tracker frame; a row per target
    REFERENCE = "reference"  # (3,) m, where the surface is, reference frame; a row per point, and
    # per sphere of what hangs on the place alone: the scanner's error, which scanned both
    NOISE = "noise"  # (1,) log sigma of the range; a row per point


@dataclass(frozen=True)
class Param:
    """One unknown of an effect: name, unit, and how large it may plausibly be; 0 holds it. A fit
    begins at `start`: where that is far out, beams are judged by it. One about a `joint` that moves
    names it."""

    name: str
    unit: str
    sigma: float
    start: float = 0.0
    joint: str = ""

    @classmethod
    def of_joint(cls, joint: str, unit: str, sigma: float, part: str = "") -> Self:
        """The unknown of a joint, or that `part` of what it has."""
        return cls(f"{joint}.{part}" if part else joint, unit, sigma, joint=joint)


LazyColumn = np.ndarray | Callable[[], np.ndarray]


@dataclass(frozen=True)
class View:
    """What an effect may look at: the rig, and named columns at the rows of its site.

    Columns of a point are those of its stop too. Range and incidence are those *predicted* by the
    model, never the measured ones: noise common to a column and its residual looks like an effect.
    Likewise `tracked` has the body that is asked about where the model has it; others as measured.
    Intensity is that over the median of all recordings by one LiDAR, so that no unit matters.

    Args:
        rig: the rig as built on paper.
        rows: how many rows the site has here.
        columns: name -> (rows, ...), or (1, ...) where one value holds for all rows; or a
            function that gives it, for what is costly and seldom asked.
        joints: (rows, J) or (1, J) reported joint values, rad or m.
    """

    rig: Rig
    rows: int
    columns: Mapping[str, LazyColumn]
    joints: np.ndarray

    def __getitem__(self, name: str) -> np.ndarray:
        if name not in self.columns:
            known = ", ".join(sorted(self.columns))
            said = f"column '{name}' is not in {self.rig.folder}, which has {known}."
            raise NoColumnError(said, name)
        column = self.columns[name]
        return column() if callable(column) else column

    @classmethod
    def of_places(cls, rig: Rig, places_m: np.ndarray) -> View:
        """What the effects of a tracker's volume look at: M places (K, M, 3) in its frame, as if a
        body were there whose axes are those of the frame."""
        T = se3.from_xyz_rpy(places_m, np.zeros(3))
        return cls(rig, len(T), {"tracked": T}, np.zeros((len(T), 0)))


@dataclass(frozen=True)
class OneHot:
    """A basis in which every row touches the parameters of one group only.

    Args:
        index: (rows,) group of each row; -1 touches none.
        values: (rows, D) error at the site per unit of the group's parameter.
        size: number of groups, which is the number of parameters.
    """

    index: np.ndarray
    values: np.ndarray
    size: int


Basis = np.ndarray | OneHot


class Effect(ABC):
    """One way the hardware lies. A subclass says what it is and gives its basis; all else follows.

    An effect that is not linear in one more number (a wavelength, a time constant) is linear once
    that number, its shape, is chosen: `shapes` lists those worth trying, `at` chooses one.

    Attributes:
        name: as in commands and files; with a chosen shape ``family@shape``.
        site: where it acts.
        covariates: columns of the view that its basis looks at; "joints" are the reported joints.
            Where a recording lacks one, the effect cannot be tested. The basis of one that looks at
            "tracked", at the tracker's site, is computed anew wherever a fit has the body.
        unit: of its parameters, of all of them if they differ; of revolute joints.
        formula, typical, confounded_with, source: the catalogue's page.
        twin: what else does the very same to all that is measured, and is no effect of the
            catalogue; as a sentence names it.
        shape_name: what the shape is, with its unit (``wavelength_m``); empty where there is none.
        shape: the one chosen.
        whole: True where a shape is a whole number.
        jumps: True where the basis jumps with the shape, as at the time when something slipped.
        repeats: True where a rig may have it several times, each with a shape of its own: what
            slips once may slip again, and a gear may err in more than one order.
        refinements: how often finer shapes are tried between the two of a grid beside the best one.
        origin: the Python file and class of a user's effect; None for one of the catalogue.
        joint_kind: "revolute", "prismatic" or "mimic" of an effect that is about such joints alone.
        needs_lidar: True of an effect that is about a LiDAR, though it does not act on its beams.
        needs_standing: True of one about rigs that stand still over several stops.
        needs_masses: True of one that the weight of an arm's links makes.
        of_members: True where its parameters are one quantity of several rings or labels, whose
            mean is a quantity as well: before any data it is as uncertain as each is about it.
        of_volume: True where it is the tracker's error at a place, which markers of targets have as
            well.
        of_lidar: True when the effect belongs to the mounted LiDAR, so that rigs do not share it.
        by_chance: True where its parameters are drawn by chance, and their spread is estimated.
        widens: of those, True where the rows that it acts on get a wider sigma instead of values.
        seen: column -> its least and largest value where the effect was found, of one that only
            describes; empty of one that rests on how the hardware is made.
    """

    name: str
    site: ClassVar[Site]
    unit: ClassVar[str] = ""
    formula: ClassVar[str] = ""
    typical: ClassVar[str] = ""
    covariates: ClassVar[tuple[str, ...]] = ()
    confounded_with: ClassVar[tuple[str, ...]] = ()
    source: ClassVar[str] = ""
    twin: ClassVar[str] = ""
    shape_name: ClassVar[str] = ""
    shape: float = 0.0
    whole: ClassVar[bool] = False
    jumps: ClassVar[bool] = False
    repeats: ClassVar[bool] = False
    refinements: ClassVar[int] = 1
    joint_kind: ClassVar[str] = ""
    needs_lidar: ClassVar[bool] = False
    needs_standing: ClassVar[bool] = False
    needs_masses: ClassVar[bool] = False
    of_members: ClassVar[bool] = False
    of_volume: ClassVar[bool] = False
    by_chance: ClassVar[bool] = False
    widens: ClassVar[bool] = False
    seen: Mapping[str, tuple[float, float]] = MappingProxyType({})
    origin: Mapping[str, Any] | None = None

    @property
    def of_scanner(self) -> bool:
        """Whether it is the scanner's error at a place, which its spheres' centres have as well."""
        return self.site is Site.REFERENCE and self.covariates == ("point_m",)

    @property
    def goes_by_place(self) -> bool:
        """Whether its basis looks at where a tracked body is."""
        return "tracked" in self.covariates

    @property
    def goes_with_time(self) -> bool:
        """Whether it is of the day, as a drift, and not of the rig. The order of readings in time,
        which a gear's play depends on, is no drift."""
        return "elapsed_s" in self.covariates or "time_s" in self.seen

    @property
    def has_derivative_by_shape(self) -> bool:
        """Whether its shape can be estimated like a parameter, once it is near."""
        return bool(self.shape_name) and not self.whole and not self.jumps

    @property
    def family(self) -> str:
        """The name without a shape."""
        return self.name.partition("@")[0]

    def shapes(self, stops: View) -> tuple[float, ...]:
        """The shapes worth trying on a recording; empty where there is nothing to choose.

        Args:
            stops: its stops, with their columns.
        """
        return ()

    def beside(self, stops: View) -> tuple[float, ...]:
        """Of an effect that jumps, the shapes next to its own with which it acts otherwise on a
        recording; empty where these are not known.

        Args:
            stops: as of `shapes`.
        """
        return ()

    def at(self, shape: float) -> Self:
        """The effect with this shape chosen."""
        chosen = copy.copy(self)
        chosen.shape, chosen.name = shape, f"{self.family}@{shape:.6g}"
        return chosen

    def document(self) -> str | dict[str, Any]:
        """How a model's file spells it; `calib.effects.read` is the inverse."""
        if self.origin is None:
            return self.name
        return {**self.origin, **({"shape": self.shape} if self.family != self.name else {})}

    @property
    def of_lidar(self) -> bool:
        return self.site in (Site.BEAM, Site.NOISE)

    @abstractmethod
    def params(self, rig: Rig) -> tuple[Param, ...]:
        """The unknowns of this effect on this rig; empty where it has nothing to act on."""

    @abstractmethod
    def basis(self, view: View) -> Basis:
        """Error at the site per unit of each parameter. A row depends on what the view has of that
        row alone, as rows come in any order and number.

        Returns:
            (rows, *shape of the site, P), or a `OneHot`. One row stands for all where the basis
            depends on nothing that changes.
        """


class ShapeStep(Effect):
    """What an effect of a model would do more were its shape larger: its derivative, per unit of
    the shape's logarithm; or in another shape, less what it does.

    Args:
        effect: in the model, with a shape.
        theta: rig's name -> (P,) its parameters as estimated.
        sigma: of the logarithm, before any data.
        to: the other shape, if it is that.
    """

    typical = "derivative"

    def __init__(
        self,
        effect: Effect,
        theta: Mapping[str, np.ndarray],
        sigma: float = 1.0,
        to: float | None = None,
    ) -> None:
        self.effect, self.theta, self.sigma, self.site = effect, theta, sigma, effect.site
        self.name, self.shape, self.to = self.name_of(effect), effect.shape, to
        if to is not None:
            self.name, self.shape = f"{self.name} to {to:.6g}", to

    @staticmethod
    def name_of(effect: Effect) -> str:
        """What it is called, of an effect."""
        return f"shape of {effect.name}"

    @property
    def family(self) -> str:
        """Each is one by itself: two slips may both go to a time between them."""
        return self.name

    @property
    def of_lidar(self) -> bool:
        return self.effect.of_lidar

    @property
    def of_volume(self) -> bool:
        return self.effect.of_volume

    @property
    def goes_by_place(self) -> bool:
        return self.effect.goes_by_place

    def params(self, rig: Rig) -> tuple[Param, ...]:
        there = rig.name in self.theta and bool(self.effect.params(rig))
        return (Param("log", "1", self.sigma),) if there else ()

    def basis(self, view: View) -> np.ndarray:
        own, by = self.effect.shape, 1 + SHAPE_STEP
        ends = (own * by, own / by) if self.to is None else (self.to, own)
        sides = (self.effect.at(end) for end in ends)
        after, before = (_times(side.basis(view), self.theta[view.rig.name]) for side in sides)
        return (after - before)[..., None] / (2 * np.log1p(SHAPE_STEP) if self.to is None else 1.0)


def _times(basis: Basis, theta: np.ndarray) -> np.ndarray:
    """Error (rows, *shape of the site) that parameters (P,) make."""
    if not isinstance(basis, OneHot):
        return basis @ theta
    of_row = np.where(basis.index < 0, 0.0, theta[basis.index])
    return basis.values * of_row.reshape(-1, *[1] * (basis.values.ndim - 1))
