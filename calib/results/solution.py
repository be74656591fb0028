"""An estimate in the words of the contract: frames, effects, and what could not be told."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from types import MappingProxyType
from typing import Any

import numpy as np

from calib.effects import FrameOffset, ShapeStep
from calib.effects.rig import DOF
from calib.forward import Term, named
from calib.problem import Problem
from calib.problem.bodies import GRAVITY
from calib.problem.model import Source
from calib.problem.prior import CommonErrors
from calib.problem.spread import names_of
from calib.problem.unknowns import POSE_UNITS, Key, Role
from calib.residuals.levels import down
from calib.results.intervals import Intervals
from calib.results.observability import not_estimated
from calib.rig import Rig
from calib.solve.components import spreads
from calib.solve.estimate import Estimate
from chains import se3


@dataclass(frozen=True)
class FrameEstimate:
    """T_parent_child (4, 4), with the sigma of its origin in the parent's axes (3,) m and of its
    orientation about the child's axes (3,) rad; 0 is exact."""

    parent: str
    T_parent_child: np.ndarray
    sigma_m: np.ndarray
    sigma_rad: np.ndarray


@dataclass(frozen=True)
class ShapeEstimate:
    """The shape of an effect, by its name with the unit (``tau_s``), with its sigma: how far it may
    be off, other parameters going along with it."""

    name: str
    value: float
    sigma: float


@dataclass(frozen=True)
class EffectEstimate:
    """An effect's parameters (P,), with their sigma; 0 is held.

    The unit is that of all, or a list with commas that has one for each, as `one_unit` writes it.
    A shape that was estimated stands beside them.
    """

    unit: str
    names: tuple[str, ...]
    estimate: np.ndarray
    sigma: np.ndarray
    shape: ShapeEstimate | None = None

    @property
    def units(self) -> tuple[str, ...]:
        """(P,) of each parameter."""
        each = tuple(self.unit.split(", "))
        return each if len(each) == len(self.names) else (self.unit,) * len(self.names)


@dataclass(frozen=True)
class Part:
    """Frames and effects of the shared hardware, or of one rig."""

    frames: dict[str, FrameEstimate] = field(default_factory=dict)
    effects: dict[str, EffectEstimate] = field(default_factory=dict)


@dataclass(frozen=True)
class Solution:
    """What a fit found.

    Args:
        shared: what holds for all recordings.
        recordings: rig name -> what belongs to it alone; empty where there is one rig.
        not_estimated: a `name` and a `why` for what the data could not tell.
        keys: (P,) calibration parameters.
        covariance: (P, P) joint covariance, m and rad; see `calib.results.intervals`.
        graph: (P, P) the same as the graph has it; None where that is no other.
        common: how they go with errors that another run may share; None where that is not known.
    """

    shared: Part
    recordings: dict[str, Part]
    not_estimated: list[dict[str, str]]
    keys: tuple[Key, ...]
    covariance: np.ndarray
    graph: np.ndarray | None = None
    common: CommonErrors | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """(P,) of the parameters, ``variable.parameter``."""
        return tuple(key.name for key in self.keys)

    @property
    def units(self) -> tuple[str, ...]:
        """(P,) of the parameters."""
        known = units_of(self.shared, self.recordings)
        return tuple(known[key] for key in self.keys)

    def part(self, rig: str | None) -> Part:
        """All frames and effects that hold for one rig."""
        own = self.recordings.get(rig, Part()) if rig else Part()
        return Part(self.shared.frames | own.frames, self.shared.effects | own.effects)

    def document(self) -> dict[str, Any]:
        """As written to solution.yaml."""
        out = _part_document(self.shared) | {"not_estimated": self.not_estimated}
        if self.recordings:
            out["recordings"] = {name: _part_document(p) for name, p in self.recordings.items()}
        return out


def _held_frames(rig: Rig) -> Iterator[tuple[str, FrameEstimate]]:
    """Frames with a sigma where CAD has them, as they are where a fit holds them."""
    for name, edge in zip(rig.tree.edge_names, rig.tree.edges, strict=True):
        if name in rig.frame_sigma:
            yield name, _pose(edge.parent, edge.T_parent_child, np.zeros((6, 6)))


def solution_of(
    problem: Problem,
    estimate: Estimate,
    known: Intervals | None = None,
    earlier: Mapping[str, tuple[float, float]] = MappingProxyType({}),
) -> Solution:
    """An estimate as frames and effects, with what it could not tell.

    Args:
        problem, estimate: what was estimated, and how it came out.
        known: the intervals of its variables, and of shapes; as the graph has them where None.
        earlier: spreads that an earlier run knew, as of `JointPrior`.
    """
    mine = known and known.of([v.name for v in estimate.variables])
    told = mine.covariance if mine else estimate.covariance
    ends = np.cumsum([v.dim for v in estimate.variables]).tolist()
    at = {v.name: slice(b - v.dim, b) for v, b in zip(estimate.variables, ends, strict=True)}
    shared, recordings, scatter = Part(), {}, spreads(estimate, earlier)
    for source, terms in zip(problem.sources, problem.terms, strict=True):
        rig = source.rig
        for term in terms:
            part = recordings.setdefault(term.rig, Part()) if term.rig else shared
            if term.effect.by_chance:
                part.effects[term.effect.name] = _spread(problem, term, scatter)
                continue
            theta = estimate.values[term.variable]
            covariance = told[at[term.variable], at[term.variable]]
            if isinstance(term.effect, FrameOffset):
                part.frames[term.effect.name] = _frame(source, term, theta, covariance)
            else:
                found = _effect(source, term, theta, covariance, _shape(term, known))
                part.effects[term.effect.name] = found
        if (frame := rig.reference_frame) in at:
            covariance = told[at[frame], at[frame]]
            shared.frames[frame] = _pose(rig.world, estimate.values[frame], covariance)
        there = shared.frames | recordings.get(rig.name, Part()).frames
        shared.frames.update((n, held) for n, held in _held_frames(rig) if n not in there)
    effects = frozenset(
        t.variable
        for terms in problem.terms
        for t in terms
        if not isinstance(t.effect, FrameOffset)
    )
    untold = not_estimated(
        estimate.variables,
        estimate.covariance,
        effects,
        touched=estimate.touched(),
        lost=estimate.not_trusted if known is not None else {},  # else nothing was fitted
    )
    return Solution(
        shared=shared,
        recordings=recordings,
        not_estimated=untold + _absent(problem),
        keys=tuple(key for v in estimate.variables for key in v.keys),
        covariance=told,
        graph=mine.graph if mine else told,
        common=mine and mine.common,
    )


def up_of(estimate: Estimate, known: Intervals) -> dict[str, Any] | None:
    """Which way is up in the world's frame, as levels and rods tell, as summary.json holds it; None
    where no rig has a level, and all that is known of up was given.

    Args:
        estimate: the solution.
        known: how well its unknowns are known.
    """
    problem = estimate.problem
    if GRAVITY not in problem.variables or not any(
        s.rig.levels and s.rig.levels.frames for s in problem.sources
    ):
        return None
    g, by_gravity = down(estimate.values[GRAVITY])
    C = by_gravity @ known.over(estimate, [GRAVITY]) @ by_gravity.T
    world, sigma_rad = problem.sources[0].rig.world, float(np.sqrt(np.trace(C) / 2))
    lean_mrad = 1e3 * np.arctan2(np.hypot(*g[:2]), -g[2])
    told = f"up lies {lean_mrad:.2f} mrad off z of '{world}', and is known to "
    told += f"{1e3 * sigma_rad:.2g} mrad"
    return {"frame": world, "xyz": -g, "sigma_rad": sigma_rad, "told": told}


def zeros_of(estimate: Estimate, known: Intervals) -> list[dict[str, Any]]:
    """What the axes of each level read where they feel nothing, over 1 g, as summary.json holds it.

    Args:
        estimate: the solution.
        known: how well its unknowns are known.
    """
    out = []
    for name in (n for n, u in estimate.problem.variables.items() if u.role is Role.ZERO):
        owner, xyz = estimate.problem.variables[name].owner, estimate.values[name]
        sigma = np.sqrt(np.diag(known.over(estimate, [name])))
        axes = zip("xyz", 1e3 * xyz, 1e3 * sigma, strict=True)
        told = ", ".join(f"{axis} {b:+.2f} ± {s:.2g}" for axis, b, s in axes)
        out.append(
            {"frame": owner.where, "recording": owner.recording, "xyz": xyz, "sigma_rad": sigma}
            | {"told": f"zeros of the level in '{owner.where}', mrad: {told}"}
        )
    return out


def _frame(source: Source, term: Term, theta: np.ndarray, covariance: np.ndarray) -> FrameEstimate:
    tree = source.rig.tree
    edge = tree.edges[tree.edge_names.index(term.effect.name)]
    xi, full = np.zeros(6), np.zeros((6, 6))
    xi[term.free] = theta
    full[np.ix_(term.free, term.free)] = covariance
    turn = se3.right_jacobian(xi)
    return _pose(edge.parent, edge.T_parent_child @ se3.exp(xi), turn @ full @ turn.T)


def _pose(parent: str, T: np.ndarray, covariance: np.ndarray) -> FrameEstimate:
    R = T[:3, :3]
    position = R @ covariance[3:, 3:] @ R.T
    return FrameEstimate(
        parent, T, np.sqrt(np.diag(position)), np.sqrt(np.diag(covariance[:3, :3]))
    )


def _effect(
    source: Source,
    term: Term,
    theta: np.ndarray,
    covariance: np.ndarray,
    shape: ShapeEstimate | None,
) -> EffectEstimate:
    params = term.effect.params(source.rig)
    estimate, sigma = np.zeros(len(params)), np.zeros(len(params))
    estimate[term.free] = theta
    sigma[term.free] = np.sqrt(np.diag(covariance))
    return EffectEstimate(
        unit=one_unit([p.unit for p in params]),
        names=tuple(p.name for p in params),
        estimate=estimate,
        sigma=sigma,
        shape=shape,
    )


def _shape(term: Term, known: Intervals | None) -> ShapeEstimate | None:
    """What is known of the shape of an effect, where that was among the unknowns."""
    effect, step = term.effect, named(ShapeStep.name_of(term.effect), term.rig)
    if known is None or step not in known.names:
        return None
    log = float(np.sqrt(known.of([step]).covariance[0, 0]))
    return ShapeEstimate(effect.shape_name, effect.shape, effect.shape * log)


def _spread(
    problem: Problem, term: Term, told: Mapping[str, tuple[float, float]]
) -> EffectEstimate:
    """What is known of an effect by chance: how widely it scatters; of several bodies, each."""
    names = names_of(problem, term)
    sd, sigma = np.array([told[key] for key in names]).T
    unit = one_unit([each.unit for each in names.values()])
    return EffectEstimate(unit, tuple(each.name for each in names.values()), sd, sigma)


def _absent(problem: Problem) -> list[dict[str, str]]:
    """Links of the whole chain that these recordings say nothing of; a LiDAR or a scanner that
    rig.yaml does not have is no link."""
    rigs, sources = [s.rig for s in problem.sources], problem.sources
    out = []
    scans = any(s.rig.lidar or s.recording.has_scan.any() for s in sources)
    scanner = scans or any(rig.reference or rig.target for rig in rigs)
    if scanner and not any(s.reference or s.recording.targets for s in sources):
        why = "neither mesh nor targets: the scanner saw nothing; add a mesh, or targets.csv"
        out.append({"name": rigs[0].reference_frame, "why": why})
    if not any(r.tracker for r in rigs):
        why = "no tracker, so poses are given in the reference's frame; add 'tracker' to rig.yaml"
        out.append({"name": "opti", "why": why})
    if not any(r.joint_names for r in rigs):
        out.append(
            {"name": "arm", "why": "the rig has no arm; add 'arm' to rig.yaml with its URDF"}
        )
    for joint in dict.fromkeys(joint for rig in rigs for joint in rig.passive):
        why = "nothing reads this joint, so its zero cannot be told from where it is; read it"
        out.append({"name": joint, "why": why})
    if scans and not problem.scans:
        why = (
            "no scans, so the LiDAR's place and its offsets are not seen; add scans/<stop>.parquet"
        )
        out.append({"name": "lidar", "why": why})
    return out


def units_of(shared: Part, recordings: Mapping[str, Part]) -> dict[Key, str]:
    """Every parameter of frames and effects -> its unit; arguments as of `Solution`."""
    found: dict[Key, str] = {}
    for rig, part in {"": shared, **recordings}.items():
        each = {frame: (DOF, POSE_UNITS) for frame in part.frames}
        each |= {name: (effect.names, effect.units) for name, effect in part.effects.items()}
        for name, (dofs, units) in each.items():
            unknown = named(name, rig)
            found |= {Key(unknown, dof): u for dof, u in zip(dofs, units, strict=True)}
    return found


def one_unit(units: Sequence[str]) -> str:
    """Units of an effect's parameters as one text: that of all, or a list with one for each."""
    return units[0] if len(set(units)) == 1 else ", ".join(units)


def frame_document(frame: FrameEstimate) -> dict[str, Any]:
    """A frame as the contract writes it."""
    return {
        "parent": frame.parent,
        "xyz_m": frame.T_parent_child[:3, 3],
        "quat_wxyz": se3.to_quat_wxyz(frame.T_parent_child),
        "sigma_m": frame.sigma_m,
        "sigma_rad": frame.sigma_rad,
    }


def effect_document(effect: EffectEstimate) -> dict[str, Any]:
    """An effect's parameters as the contract writes them."""
    shape = {} if effect.shape is None else {"shape": asdict(effect.shape)}
    return {
        "unit": effect.unit,
        "names": effect.names,
        "estimate": effect.estimate,
        "sigma": effect.sigma,
        **shape,
    }


def _part_document(part: Part) -> dict[str, Any]:
    return {
        "frames": {n: frame_document(f) for n, f in part.frames.items()},
        "effects": {n: effect_document(e) for n, e in part.effects.items()},
    }
