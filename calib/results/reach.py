"""How well an arm that a tracker alone has seen is known: where it was, and wherever it can go.

The covariance of the calibration is carried to the position of a tracked body beyond the joints, at
the poses of the recording and at joints drawn over all that they can turn. It covers what is in
the model: what the arm does elsewhere that no pose shows is in neither number.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from calib.forward import Placed, Stops, place
from calib.linear.symmetric import eigh
from calib.problem import Problem
from calib.problem.model import Source
from calib.residuals.tracker import TrackedBody
from calib.results.intervals import Intervals
from calib.results.sigmas import TOLERATED
from calib.rig import Rig
from calib.solve.estimate import Estimate
from chains import se3

DRAWN_POSES = 1000  # that are drawn: the quantile then stands to 1.4 % (measured, over ten seeds)
DRAWN_ERRORS = 400  # of the calibration that are drawn, the same for every pose
# From how many times worse elsewhere it is a warning. Measured on an arm of six joints: 300 poses
# all over the workspace are at 1.4; 40 of them in a box of 0.5 m at 2.1, 20 in one of 0.3 m at 2.6.
FAR_WORSE = 2.0
# Of the span of what was measured, from which something lies beyond it: a choice, as any new pose
# may lie a little beyond.
BEYOND_SPAN = 0.1
BEYOND_MODEL = (
    "a prediction covers only what the model knows: stops held out are off by {:.2f} mm rms, where "
    "{:.2f} mm is expected"
)
TOLD_SHARE = 0.95  # of errors that lie below what is told


@dataclass(frozen=True)
class Reach:
    """What a calibration predicts of a body's position; without the tracker's noise.

    Args:
        body: whose position.
        at_poses_m, anywhere_m: the error below which 95 % lie, at the poses of the recording, and
            at joints drawn evenly between their limits, or a whole turn where there are none.
        box_m: (3,) edges of the box that the poses fill, in the axes of the base or the tracker.
        box_share: how many of the drawn positions lie in it.
    """

    body: str
    at_poses_m: float
    anywhere_m: float
    box_m: np.ndarray
    box_share: float

    @property
    def is_small(self) -> bool:
        """Whether the poses lie so close together that they hardly tell of other places."""
        return self.anywhere_m > FAR_WORSE * self.at_poses_m

    @property
    def sentence(self) -> str:
        """How well the body's place is predicted."""
        return (
            f"'{self.body}' is predicted within the poses to {1e3 * self.at_poses_m:.2g} mm, "
            f"anywhere in the joints' range to {1e3 * self.anywhere_m:.2g} mm (95 %)"
        )

    @property
    def warning(self) -> str:
        """What small a part of the workspace the poses fill, and what would help."""
        x, y, z = self.box_m
        return (
            f"the poses of '{self.body}' fill a box of {x:.2f} x {y:.2f} x {z:.2f} m, which holds "
            f"{100 * self.box_share:.0f} % of where the joints can take it; elsewhere its place is "
            f"known {self.anywhere_m / self.at_poses_m:.1f} times worse: add poses out there"
        )

    def document(self, summary: Mapping[str, Any] | None = None) -> dict[str, Any]:
        """As summary.json, of a fit, holds it. Where stops held out are further off than they
        should be, the model lacks something, and what is predicted does not cover that."""
        told = [self.sentence, *([self.warning] if self.is_small else [])]
        rms_mm = summary["rms_mm"] if summary else {}
        held_out, expected = rms_mm.get("held_out"), rms_mm.get("noise_floor")
        if held_out and expected and held_out > TOLERATED * expected:
            told.insert(1, BEYOND_MODEL.format(held_out, expected))
        return {
            "body": self.body,
            "at_poses": 1e3 * self.at_poses_m,
            "anywhere": 1e3 * self.anywhere_m,
            "box": 1e3 * self.box_m,
            "box_share": self.box_share,
            "told": told,
        }


def reach(problem: Problem, estimate: Estimate, known: Intervals | None = None) -> Reach | None:
    """What an estimate predicts of the first rig's last tracked body beyond its joints.

    Args:
        problem: what was estimated.
        estimate: of that.
        known: its intervals; as the graph has them where None.

    Returns:
        None where there are scans, no arm, or no tracked body beyond it.
    """
    source, rig = problem.sources[0], problem.sources[0].rig
    beyond = None if problem.scans else body_beyond(problem)
    if beyond is None:
        return None
    body, root, base = beyond.body, beyond.root, beyond.base
    stops = beyond.stops
    rng, range_ = np.random.default_rng(0), joint_range(rig, source.recording.joints[stops])
    at_stop = rng.choice(stops, DRAWN_POSES)
    here = at_joints(problem, stops, source.recording.joints[stops], root)
    there = at_joints(
        problem, at_stop, rng.uniform(*range_, (DRAWN_POSES, len(rig.joint_names))), root
    )
    seen, drawn = (placed(each, body, base, estimate.values) for each in (here, there))
    names = list(seen.d)
    covariance = known.together(estimate, names) if known else estimate.covariance_of(names)
    errors = _errors(covariance, rng)
    low, high = seen.T[:, :3, 3].min(axis=0), seen.T[:, :3, 3].max(axis=0)
    at = drawn.T[:, :3, 3]
    return Reach(
        body=body,
        at_poses_m=_error(seen, names, errors),
        anywhere_m=_error(drawn, names, errors),
        box_m=high - low,
        box_share=float(np.mean(np.all((at >= low) & (at <= high), axis=1))),
    )


@dataclass(frozen=True)
class Beyond:
    """A tracked body that the arm carries.

    Args:
        body: its name.
        root: variable of T_world_root at the last of the stops that saw it.
        base: a tracked body before the joints, or None.
        stops: (n,) those that saw it.
    """

    body: str
    root: str
    base: str | None
    stops: np.ndarray


def bodies_beyond(problem: Problem) -> list[str]:
    """All tracked bodies beyond the joints of the first rig."""
    joints_to, blocks = problem.sources[0].rig.joints_to, _of_first(problem)
    return list(dict.fromkeys(b.body for b in blocks if joints_to(b.body)))


def body_beyond(problem: Problem, name: str | None = None) -> Beyond | None:
    """The last tracked body beyond the joints of the first rig, or that of a name; None where there
    is none."""
    rig, blocks = problem.sources[0].rig, _of_first(problem)
    beyond = [b for b in blocks if rig.joints_to(b.body) and name in (None, b.body)]
    if not beyond:
        return None
    body = beyond[-1].body
    return Beyond(
        body=body,
        root=beyond[-1].stops.root,
        base=next((b.body for b in blocks if not rig.joints_to(b.body)), None),
        stops=np.array([k for b in beyond if b.body == body for _, k in b.stop_names]),
    )


def _of_first(problem: Problem) -> list[TrackedBody]:
    """The tracked bodies of the first recording."""
    folder = problem.sources[0].recording.folder
    return [b for b in problem.bodies if b.stop_names[0][0] == folder]


def far_beyond(
    measured: np.ndarray, others: np.ndarray, least: float | np.ndarray = 0.0
) -> np.ndarray:
    """Which (K, ...) of other values lie beyond all measured ones (M, ...), by a share of the span
    of these, and by no less than that."""
    low, high = measured.min(axis=0), measured.max(axis=0)
    margin = np.maximum(BEYOND_SPAN * (high - low), least)
    return (others < low - margin) | (others > high + margin)


def at_joints(problem: Problem, at_stop: np.ndarray | None, joints: np.ndarray, root: str) -> Stops:
    """The first rig with these joints (n, J), all else as at one of its stops (n,); None where it
    has none."""
    source = problem.sources[0]
    columns = columns_at(source, at_stop, joints)
    return place(source.rig, problem.terms[0], joints, columns, root, None)


def columns_at(
    source: Source, at_stop: np.ndarray | None, joints: np.ndarray
) -> dict[str, np.ndarray]:
    """Columns (n, ...) that effects look at; arguments as of `at_joints`."""
    known = {} if at_stop is None else source.columns
    columns = {name: np.asarray(column)[at_stop] for name, column in known.items()}
    return columns | dict(zip(source.rig.joint_names, joints.T, strict=True))


def joint_range(rig: Rig, joints: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Least and largest value (J,) of each joint, rad or m, as the URDF says; a whole turn where
    it does not, and of a prismatic one what was seen of it in `joints` (K, J)."""
    turns = np.array(rig.joint_kinds) == "revolute"
    free = np.stack([np.where(turns, -np.pi, joints.min(0)), np.where(turns, np.pi, joints.max(0))])
    said = np.array([[j.lower, j.upper] for j in rig.joints]).T
    return tuple(np.where(np.isfinite(said), said, free))


def placed(stops: Stops, body: str, base: str | None, values: Mapping[str, np.ndarray]) -> Placed:
    """Where a body is: from a tracked one before the joints, or else in the tracker's frame."""
    if base is None:
        return stops.in_world(body, values)
    inner, outer = stops.in_root(body, values), stops.in_root(base, values)
    T = se3.inverse(outer.T) @ inner.T
    back = se3.adjoint(se3.inverse(T))
    return Placed(T, {name: d - back @ outer.d[name] for name, d in inner.d.items()})


def _errors(covariance: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Errors (P, n) of parameters with this covariance."""
    values, vectors = eigh(covariance)
    root = vectors * np.sqrt(np.maximum(values, 0.0)) @ vectors.T  # of like ones, alike
    return root @ rng.normal(size=(len(covariance), DRAWN_ERRORS))


def _error(placed: Placed, names: Sequence[str], errors: np.ndarray) -> float:
    """The length, m, below which 95 % of the errors of position lie."""
    d = placed.by(names)[:, 3:]
    return float(np.quantile(np.linalg.norm(d @ errors, axis=1), TOLD_SHARE))
