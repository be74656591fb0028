"""The groups of rows that a mishap could spoil, each with its rows at the solution of a fit."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib.effects import Effect, FrameOffset
from calib.forward import NOISE, Stops
from calib.linear.layout import Layout, key_of
from calib.linear.own import body_rows
from calib.linear.system import Linearisation, Values
from calib.problem.model import labels
from calib.problem.problem import Block, Problem
from calib.problem.unknowns import Role
from calib.problem.without import ROD, of_the_arm
from calib.residuals.groups import (
    ABOUT_AXES,
    ALONG_BEAMS,
    ALONG_NORMAL,
    CAD,
    JOINTS,
    MESH,
    REGION_PART,
    SURFACE,
    Group,
    part_of_mesh,
)
from calib.residuals.scan import ScanStop
from calib.residuals.seen import BodiesTogether, SeenBody
from calib.residuals.targets import HangingTarget
from calib.residuals.tracker import TWIST_NAMES
from calib.rig import Rig
from calib.solve.reweight import unweighted

SCAN_SHIFT = (*TWIST_NAMES, ALONG_BEAMS)  # of a scan
SCAN_UNITS = ("rad",) * 3 + ("m",) * 4
SEVERAL_SCANS = 3  # scans, for most of them to say that the range zero of one is not theirs
# Block (none for a prior), whitened derivative by each unknown, and right side: see `Graph`.
GraphRows = Sequence[tuple[Block | None, Mapping[str, np.ndarray], np.ndarray]]


@dataclass(frozen=True)
class GroupRows:
    """Rows, and the groups that some of them make.

    Args:
        A: (m, n) whitened derivatives, columns: (n,) by which unknowns; of sums the products of a
            shift with them.
        b: (m,) minus the residuals; of sums the score of that shift.
        weight: (m,) robust.
        sigma: (m,) of each row.
        axes, units: (m,) of each row.
        groups: group -> (m, r) the directions in these rows in which it may be off.
        turn: (m, m) from the rows' axes to those in which an offset is told.
        information: (m, m) of the shift, where rows come as sums: a twist of the LiDAR and a range
            zero that a scan alone has, or readings of exact encoders; None of rows.
    """

    A: np.ndarray
    columns: np.ndarray
    b: np.ndarray
    weight: np.ndarray
    sigma: np.ndarray
    axes: Sequence[str]
    units: Sequence[str]
    groups: Mapping[Group, np.ndarray]
    turn: np.ndarray | None = None
    information: np.ndarray | None = None

    @property
    def of_ranges(self) -> bool:
        """Whether they are of a range zero, and not of a place."""
        return list(self.axes) == [ALONG_BEAMS]

    @property
    def own_information(self) -> np.ndarray:
        """(m, m) what they say of an offset, all else being known."""
        return np.eye(len(self.A)) if self.information is None else self.information

    @property
    def like(self) -> tuple[object, ...]:
        """What rows that make the same groups have in common."""
        own = ((group.kind, each.shape, each.tobytes()) for group, each in self.groups.items())
        turned, summed = self.turn is None, self.information is None
        return (tuple(self.axes), tuple(self.units), turned, summed, *own)

    @property
    def at(self) -> tuple[str, str]:
        """Recording, and place: groups of one place may contradict each other alone."""
        return next(iter(self.groups)).place


def group_rows(
    whole: Linearisation, problem: Problem, graph_rows: GraphRows
) -> Iterator[GroupRows]:
    """All of them.

    Args:
        whole: the linearisation there, with its scans.
        problem: that was fitted.
        graph_rows: those of the linearisation's kept unknowns that are not in it.
    """
    yield from _bodies(whole)
    yield from _targets(whole, graph_rows)
    yield from _paper(whole, problem)
    yield from _mesh(whole, problem)
    yield from scan_rows(whole, problem)
    yield from _exact_joints(whole, problem)


def _bodies(whole: Linearisation) -> Iterator[GroupRows]:
    """Every body at every stop where it was seen, by the tracker or as a level."""
    layout = whole.layout
    blocks = _seen(layout)
    plain = [unweighted(b) for b in blocks]
    weight = {id(p): b.weight for p, b in zip(plain, blocks, strict=True)}
    for together in BodiesTogether.of(plain):
        every = zip(*body_rows(layout, together, whole.values), strict=True)
        for block, (A, b, columns) in zip(together.blocks, every, strict=True):
            per = len(block.axes)
            weights = weight[id(block)]
            weights = np.ones(len(block.measured)) if weights is None else weights
            for k, group in enumerate(block.groups):
                here = slice(per * k, per * (k + 1))
                yield GroupRows(
                    A=A[here],
                    columns=columns,
                    b=b[here],
                    weight=np.full(per, weights[k]),
                    sigma=block.sigma,
                    axes=block.axes,
                    units=block.units,
                    groups={group: np.eye(per)},
                    turn=block.turn(k),
                )


def _seen(layout: Layout) -> list[SeenBody]:
    own = [b for together in layout.bodies for b in together.blocks]
    return own + [b for b in layout.others if isinstance(b, SeenBody)]


def _targets(whole: Linearisation, graph_rows: GraphRows) -> Iterator[GroupRows]:
    """Parts of targets, and whole rods."""
    for block, by, b in graph_rows:
        if not isinstance(block, HangingTarget):
            continue
        weight = block.weights
        root = np.sqrt(np.where(weight > 0, weight, 1.0))
        every = np.split(_off_rod(block, whole.values), np.cumsum([3, 2]), axis=1)
        parts = {
            g: d
            for i, (g, d) in enumerate(zip(block.groups, every, strict=True))
            if weight[3 * i] > 0
        }
        rod = {replace(block.groups[0], what=ROD): np.hstack(list(parts.values()))}
        yield GroupRows(
            A=np.hstack(list(by.values())) / root[:, None],
            columns=whole.layout.columns(list(by)),
            b=b / root,
            weight=np.square(root),
            sigma=block.sigmas_m,
            axes=("x", "y", "z") * 3,
            units=("m",) * 9,
            groups=parts | rod if len(parts) > 1 else parts,
        )


def _off_rod(block: HangingTarget, values: Values) -> np.ndarray:
    """Directions (9, 8) in which a target's rows may be off: its upper marker only across the rod,
    since how far apart markers are is not used."""
    out = np.zeros((9, 8))
    out[:3, :3] = out[6:, 5:] = np.eye(3)
    out[3:6, 3:5] = np.linalg.svd(values[block.gravity][None])[2][1:].T
    return out


def _paper(whole: Linearisation, problem: Problem) -> Iterator[GroupRows]:
    """What is known beforehand: joint readings at a stop, frames, the URDF."""
    layout, geometry = whole.layout, _geometry(problem)
    stops = _stop_names(layout, problem)
    for name, unknown in layout.unknowns.items():
        if name in layout.unbounded or unknown.kind != "vector":
            continue
        groups: dict[Group, np.ndarray] = {}
        each = np.split(np.eye(unknown.dim), unknown.dim, axis=1)
        if unknown.role is Role.JOINTS:
            for stop in layout.touched.get(name, ()):  # of a stop without any row there is none
                groups = _joints(unknown.dofs, each, *stops[stop])
        elif name in geometry:
            groups = _geometric(unknown.dofs, each, geometry[name])
        if groups:
            yield GroupRows(
                A=np.diag(1.0 / unknown.sigma),
                columns=layout.columns([name]),
                b=(unknown.mean - whole.values[name]) / unknown.sigma,
                weight=np.full(unknown.dim, unknown.weight),
                sigma=-unknown.sigma,  # a prior's row is what is estimated less what was said
                axes=unknown.dofs,
                units=unknown.units,
                groups=groups,
            )


def _mesh(whole: Linearisation, problem: Problem) -> Iterator[GroupRows]:
    """Surfaces of the mesh, and parts of them: a wall that has moved, and one that is warped or
    turned. The only region of a surface, or its only patch, is that surface."""
    layout, tilts = whole.layout, _tilts(problem)
    known = {name: layout.unknowns[name] for name in problem.cells}
    columns = {name: layout.columns([name]) for name in known}
    for name, cells in problem.cells.items():
        if not cells.of_mesh or cells.axis is not None:
            continue
        alone = np.bincount(cells.surface)[cells.surface] == 1
        for k, part in enumerate(cells.parts.tolist()):
            if cells.column != SURFACE and alone[k]:
                continue
            mine = {(name, k): ALONG_NORMAL} | tilts.get((cells.room, cells.column, part), {})
            sigma = np.array([known[n].sigma[i] for n, i in mine])
            off = np.array([whole.values[n][i] for n, i in mine])
            yield GroupRows(
                A=np.diag(1.0 / sigma),
                columns=np.array([columns[n][i] for n, i in mine]),
                b=-off / sigma,
                weight=np.array([known[n].weight for n, _ in mine]),
                sigma=-sigma,
                axes=list(mine.values()),
                units=[known[n].units[i] for n, i in mine],
                groups={Group("surface", MESH, part_of_mesh(cells.column, part)): np.eye(len(off))},
            )


def _tilts(problem: Problem) -> dict[tuple[object, str, int], dict[tuple[str, int], str]]:
    """Room, kind and number of a region or surface -> the components of unknowns that tilt it, and
    what such a tilt is called; the tilts of a region that is its whole surface are that one's."""
    whole = (c for c in problem.cells.values() if c.column == REGION_PART and c.axis is None)
    regions = {cells.room: np.bincount(cells.surface) for cells in whole}
    found: dict[tuple[object, str, int], dict[tuple[str, int], str]] = {}
    for name, cells in problem.cells.items():
        if cells.axis is None:
            continue
        for k, (part, surface) in enumerate(zip(cells.parts, cells.surface, strict=True)):
            one = cells.column == SURFACE or regions[cells.room][surface] == 1
            of = (SURFACE, int(surface)) if one else (REGION_PART, int(part))
            found.setdefault((cells.room, *of), {})[name, k] = ABOUT_AXES[cells.axis]
    return found


def _joints(
    dofs: Sequence[str], each: Sequence[np.ndarray], where: str, recording: str
) -> dict[Group, np.ndarray]:
    """All joints of a stop, and each."""
    groups = {Group("joints", where, JOINTS, recording): np.hstack(each)}
    if len(dofs) > 1:
        groups |= {Group("joints", where, d, recording): e for d, e in zip(dofs, each, strict=True)}
    return groups


def _geometric(
    dofs: Sequence[str], each: Sequence[np.ndarray], effect: Effect
) -> dict[Group, np.ndarray]:
    """A frame as a whole; a length or a joint's zero, each."""
    if isinstance(effect, FrameOffset):
        return {Group("frame", CAD, effect.name): np.hstack(each)}
    names = (Group("frame", CAD, f"{effect.name}.{dof}") for dof in dofs)
    return dict(zip(names, each, strict=True))


def _geometry(problem: Problem) -> dict[str, Effect]:
    """Unknown -> its effect, of frames and of what the URDF says of the arm."""
    known = {effect.name for effect in of_the_arm()}
    return {
        term.variable: term.effect
        for terms in problem.terms
        for term in terms
        if isinstance(term.effect, FrameOffset) or term.effect.name in known
    }


def scan_rows(whole: Linearisation, problem: Problem) -> Iterator[GroupRows]:
    """Every scan: through the place of its LiDAR, and through a range zero of its own."""
    for scan in problem.scans:
        sums = whole.scans[whole.layout.stops[key_of(scan)]]
        several = len(problem.scans) >= SEVERAL_SCANS
        for at in (slice(6), slice(6, len(sums.score) if several else 6)):
            if count := len(sums.score[at]):
                yield GroupRows(
                    A=sums.cross[at],
                    columns=sums.columns,
                    b=sums.score[at],
                    weight=np.ones(count),
                    sigma=np.ones(count),
                    axes=SCAN_SHIFT[at],
                    units=SCAN_UNITS[at],
                    groups={scan.group: np.eye(count)},
                    information=sums.information[at, at],
                )


def _exact_joints(whole: Linearisation, problem: Problem) -> Iterator[GroupRows]:
    """Joint readings of arms whose encoders count as exact, through all that hangs from them."""
    layout, names = whole.layout, _stop_names(whole.layout, problem)
    found: dict[int, list[_JointSums]] = {}
    rigs: dict[int, Rig] = {}
    for block in _seen(layout):
        if _is_exact(block.stops):
            for key, sums in zip(block.stop_names, _JointSums.of_body(block, whole), strict=True):
                rigs[layout.stops[key]] = block.stops.rig
                found.setdefault(layout.stops[key], []).append(sums)
    for scan in (s for s in problem.scans if _is_exact(s.stops)):
        stop = layout.stops[key_of(scan)]
        if stop in whole.scans:
            rigs[stop] = scan.stops.rig
            found.setdefault(stop, []).append(_JointSums.of_scan(scan, whole, stop))
    for stop, parts in found.items():
        where, recording = names[stop]
        dofs, count = rigs[stop].joint_names, len(rigs[stop].joint_names)
        yield GroupRows(
            A=np.hstack([part.cross for part in parts]),
            columns=np.concatenate([part.columns for part in parts]),
            b=sum(part.score for part in parts),
            weight=np.ones(count),
            sigma=np.ones(count),
            axes=dofs,
            units=tuple(rigs[stop].joint_units.values()),
            groups=_joints(dofs, np.split(np.eye(count), count, axis=1), where, recording),
            information=sum(part.information for part in parts),
        )


def _is_exact(stops: Stops) -> bool:
    return stops.noise is None and bool(stops.rig.joint_names)


@dataclass(frozen=True)
class _JointSums:
    """What some rows of a stop say of its joint readings (J,).

    Args:
        information: (J, J), score: (J,) of them.
        cross: (J, n) products with unknowns, columns: (n,) which.
    """

    information: np.ndarray
    score: np.ndarray
    cross: np.ndarray
    columns: np.ndarray

    @classmethod
    def of_body(cls, block: SeenBody, whole: Linearisation) -> Iterator[_JointSums]:
        """The rows of a body at each of its stops."""
        noisy = replace(block, weight=None, stops=block.stops.with_joint_noise(NOISE))
        count = len(block.stops.rig.joint_names)
        residual, d = noisy.whitened({**whole.values, NOISE: np.zeros(count)}, True)
        names = [name for name in d if name != NOISE]
        columns, (A, _) = whole.layout.columns(names), d.table(names)
        for Z, A_k, r in zip(d[NOISE], A, residual, strict=True):
            yield cls(Z.T @ Z, -Z.T @ r, Z.T @ A_k, columns)

    @classmethod
    def of_scan(cls, scan: ScanStop, whole: Linearisation, stop: int) -> _JointSums:
        """The beams of a stop, through the twist of their LiDAR."""
        rig, sums = scan.stops.rig, whole.scans[stop]
        values = {**whole.values, NOISE: np.zeros(len(rig.joint_names))}
        stops = scan.stops.with_joint_noise(NOISE)
        P = stops.in_reference(rig.lidar_frame, values).d[NOISE][0]
        twist = slice(len(P))
        cross, score = sums.cross[twist], sums.score[twist]
        return cls(P.T @ sums.information[twist, twist] @ P, P.T @ score, P.T @ cross, sums.columns)


def _stop_names(layout: Layout, problem: Problem) -> dict[int, tuple[str, str]]:
    """Name of each stop, and of its recording where there are several."""
    return {
        layout.stops[s.recording.folder, k]: (stop, label)
        for s, label in zip(problem.sources, labels(problem.sources), strict=True)
        for k, stop in enumerate(s.recording.stops)
        if (s.recording.folder, k) in layout.stops
    }
