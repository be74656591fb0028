"""An unknown: what it is, what was known of it before, and whose it is."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import Literal, NamedTuple

import numpy as np

from calib.effects.rig import DOF
from chains import se3

UnknownKind = Literal["vector", "pose"]
# What is known of a pose before any data: the room it is in.
UNKNOWN_POSE = np.repeat([3.0, 10.0], 3)
POSE_UNITS = ("rad",) * 3 + ("m",) * 3
UNREAD = 1.0  # rad or m: a joint that nothing reads at a stop
WIDEST_READ = 0.5 * UNREAD  # by which joint readings may scatter, with any sigma of their own
EXACT = 1e-7  # rad or m: an encoder without error beside one that is left out


class Role(Enum):
    """What an unknown stands for."""

    CALIBRATION = "calibration"  # what a user wants to know: frames, effects, the reference's place
    PLACE = "place"  # where the rig's root stands at a stop, at a location, or always
    JOINTS = "joints"  # what the encoders misreport at one stop
    TARGET = "target"  # a rod's marker
    GRAVITY = "gravity"  # which way is down
    ZERO = "zero"  # what the axes of a level read where they feel nothing
    PLANE = "plane"  # planes found in the scans
    SURFACE = "surface"  # how far parts of the mesh, or of planes, stand off the room
    SCATTER = "scatter"  # what chance does anew to each stop or location


class Key(NamedTuple):
    """One parameter: its unknown, and its name among those of that. Either may have dots in it."""

    unknown: str
    dof: str

    @property
    def name(self) -> str:
        """As files and people have it."""
        return f"{self.unknown}.{self.dof}"


@dataclass(frozen=True)
class Owner:
    """Whose an unknown is. What says nothing of it is empty.

    Args:
        effect: the effect, or the frame, whose parameters it holds.
        rig: of these, the one rig that they belong to, where there are several.
        recording: what a stop, a target or planes are of, by its label; see `calib.problem.model`.
        where: the stop or target; of a pose that several stops share, their location.
        room: of surfaces, the number of the mesh, or the recording whose planes they are.
    """

    effect: str = ""
    rig: str = ""
    recording: str = ""
    where: str = ""
    room: int | str | None = None


OF_ALL = Owner()  # of what all share


@dataclass(frozen=True)
class Unknown:
    """One unknown of a problem.

    Args:
        name: unique.
        kind: "vector" (n,), or "pose" (4, 4).
        mean: what was known before, in the shape of the kind.
        sigma: (dim,) how well it was known, per tangent direction; never zero.
        dofs: (dim,) a name per tangent direction.
        units: (dim,) "m" or "rad" or another unit, per tangent direction.
        role: what it stands for.
        owner: whose it is.
        of_members: whether its numbers are one quantity of several members, whose mean is one too:
            before any data it is known to their sigma, and they about it to that.
        weight: robust weight of what was known before, 0 to 1.
        scatter: of joint readings, joint -> how widely it scatters beyond what its sigma was at
            first.
    """

    name: str
    kind: UnknownKind
    mean: np.ndarray
    sigma: np.ndarray
    dofs: tuple[str, ...]
    units: tuple[str, ...]
    role: Role = Role.CALIBRATION
    owner: Owner = OF_ALL
    of_members: bool = False
    weight: float = 1.0
    scatter: Mapping[str, float] = field(default_factory=dict)

    @property
    def dim(self) -> int:
        return len(self.sigma)

    @property
    def told(self) -> int:
        """How many of its numbers rows can tell: of gravity's (3,), the length means nothing."""
        return self.dim - (self.role is Role.GRAVITY)

    @property
    def unread(self) -> int:
        """Of joint readings, how many there are not."""
        return int((self.sigma >= UNREAD).sum())

    @property
    def keys(self) -> tuple[Key, ...]:
        """(dim,) of its parameters."""
        return tuple(Key(self.name, dof) for dof in self.dofs)

    @property
    def prior_covariance(self) -> np.ndarray:
        """(dim, dim) by the rows that hold it to its mean: larger where these have less weight."""
        known = np.diag(np.square(self.sigma))
        if self.of_members and self.dim > 1:
            known += np.outer(self.sigma, self.sigma)
        return known / self.weight

    @property
    def prior_sigma(self) -> np.ndarray:
        """(dim,) of each of its numbers by these rows."""
        return np.sqrt(np.diag(self.prior_covariance))

    @property
    def prior_root(self) -> np.ndarray:
        """(dim, dim) these rows, whitened: a square root of the inverse of that covariance."""
        root = np.eye(self.dim)
        if self.of_members and self.dim > 1:
            # The symmetric root of inverse(I + 1 1^T), whose eigenvalue along 1 is 1 / (1 + dim).
            root -= (1.0 - 1.0 / np.sqrt(1.0 + self.dim)) / self.dim
        return root * (np.sqrt(self.weight) / self.sigma)

    def reads(self, joint: str, unit: str) -> np.ndarray:
        """Of joint readings, (dim,) bool, which are of a joint in this unit, and neither exact nor
        left out."""
        mine = zip(self.dofs, self.units, strict=True)
        return is_read(self.sigma) & [(dof, of) == (joint, unit) for dof, of in mine]

    def scattering(self, joint: str, unit: str, sd: float) -> Unknown:
        """Joint readings, that of one joint with another spread beyond its sigma, at most so wide
        that it still counts as read."""
        sigma, mine = self.sigma.copy(), self.reads(joint, unit)
        if not mine.any():
            return self
        sd = min(sd, WIDEST_READ)
        sigma[mine] = np.sqrt(sigma[mine] ** 2 - self.scatter.get(joint, 0.0) ** 2 + sd**2)
        return replace(self, sigma=sigma, scatter={**self.scatter, joint: sd})

    def loosened(self, by: float) -> Unknown:
        """The same, where it may have moved by as many of its sigmas since that was known."""
        return replace(self, sigma=np.hypot(1.0, by) * self.sigma)

    def moved(self, value: np.ndarray, step: np.ndarray) -> np.ndarray:
        """A value after a step (dim,) of its tangent: ``T exp(step)``, ``x + step``."""
        return value @ se3.exp(step) if self.kind == "pose" else value + step

    def difference(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """How a value b differs from a, as a tangent (dim,) at a."""
        return se3.log(se3.inverse(a) @ b) if self.kind == "pose" else b - a


def is_read(sigma: np.ndarray) -> np.ndarray:
    """Of joint readings of these sigmas (n,), which are neither exact nor left out."""
    return (sigma > EXACT) & (sigma < UNREAD)


def pose_unknown(
    name: str,
    mean: np.ndarray,
    sigma: np.ndarray = UNKNOWN_POSE,
    role: Role = Role.CALIBRATION,
    owner: Owner = OF_ALL,
) -> Unknown:
    """A pose known to `sigma` about `mean`."""
    return Unknown(
        name=name,
        kind="pose",
        mean=mean,
        sigma=sigma,
        dofs=DOF,
        units=POSE_UNITS,
        role=role,
        owner=owner,
    )


def vector_unknown(
    name: str,
    sigma: np.ndarray,
    dofs: Iterable[str],
    units: Iterable[str],
    mean: np.ndarray | float = 0.0,
    role: Role = Role.CALIBRATION,
    owner: Owner = OF_ALL,
    of_members: bool = False,
    weight: float = 1.0,
) -> Unknown:
    """Numbers (n,) known to `sigma` (n,) about `mean`."""
    return Unknown(
        name=name,
        kind="vector",
        mean=np.zeros(len(sigma)) + mean,
        sigma=sigma,
        dofs=tuple(dofs),
        units=tuple(units),
        role=role,
        owner=owner,
        of_members=of_members,
        weight=weight,
    )
