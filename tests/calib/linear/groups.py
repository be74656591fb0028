"""Every group of rows of a dense problem, and by how much it is off what all others say.

With all rows ``A d = b`` whitened and Q an orthonormal basis of what A can reach, ``P = I - Q Q^T``
leaves of any right side what no unknown explains. Of a group that may be off along the columns of
D, ``D^T P D`` is how much of it others check.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib.effects import FrameOffset
from calib.problem.unknowns import Role
from calib.residuals.groups import CAD, MESH, Group
from calib.residuals.targets import HangingTarget
from calib.residuals.tracker import TrackedBody

from .dense import Dense

CHECKED = 1e-6  # of P, in units of its largest: what is less is held by the group alone


@dataclass
class Part:
    """Some rows (r,), the directions D (r, q) in which they may be off, and what takes a whitened
    right side of theirs to an offset as it is told (t, r)."""

    rows: np.ndarray
    D: np.ndarray
    told: np.ndarray


@dataclass
class Off:
    """By how much a group is off; see `calib.blunders.shifts.Shift`."""

    statistic: float
    dof: int
    offset: np.ndarray
    covariance: np.ndarray


def by_place(case: object) -> dict[str, Groups]:
    """Place -> the dense rows of a case, with their full weight there."""
    problem = case.start.problem
    where = {g.where for b in problem.blocks for g in b.groups}
    places = {*where, *(s.name for s in problem.scans), CAD, MESH}
    if not case.weighted:
        return dict.fromkeys(places, Groups(case.dense))
    return {place: Groups(case.dense, {place}) for place in places}


class Groups:
    """All groups of a dense problem.

    Args:
        dense: the problem.
        full: places (stops, targets, "cad") whose rows have their full weight.
    """

    def __init__(self, dense: Dense, full: Collection[str] = ()) -> None:
        self.dense, self.problem = dense, dense.problem
        self.several = len(self.problem.sources) > 1
        self.scale = np.ones(len(dense.b))
        self.parts: dict[Group, Part] = {}
        self.scans: dict[Group, int] = {}
        for i, block in enumerate(self.problem.blocks):
            self._block(self._rows(f"block {i}"), block, full)
        for name, unknown in self.problem.variables.items():
            for group, k in self._on_paper(name, unknown):
                rows, sigma = self._rows(f"prior:{name}"), unknown.sigma[k]
                if group.where in full:
                    self.scale[rows] = 1 / np.sqrt(unknown.weight)
                self.parts[group] = Part(rows[k], np.eye(len(k)), np.diag(sigma))
        for name, cells in self.problem.cells.items():
            if cells.of_mesh and cells.axis is not None:
                self._tilted(self._rows(f"prior:{name}"), name, cells)
        for i, scan in enumerate(self.problem.scans):
            recording = scan.recording.folder.name if self.several else ""
            self.scans[Group("scan", scan.name, "scan", recording)] = i
        self.A, self.b = self.scale[:, None] * dense.A, self.scale * dense.b
        self.Q = np.linalg.qr(self.A / np.linalg.norm(self.A, axis=0))[0]
        self.left = self.beyond(self.b)

    def beyond(self, right: np.ndarray) -> np.ndarray:
        """What no unknown explains of right sides (m, ...)."""
        return right - self.Q @ (self.Q.T @ right)

    def _rows(self, name: str) -> np.ndarray:
        return np.arange(len(self.dense.b))[self.dense.rows_of[name]]

    def _block(self, rows: np.ndarray, block: object, full: Collection[str]) -> None:
        weight = np.ones(len(block.groups)) if block.weight is None else block.weight
        split = np.split(rows, len(block.groups))
        for k, (group, mine) in enumerate(zip(block.groups, split, strict=True)):
            if group.where in full:
                self.scale[mine] = 1 / np.sqrt(weight[k])
            D = turn = np.eye(len(mine))
            if isinstance(block, TrackedBody):
                sigma = np.repeat([block.sigma_rad, block.sigma_m], 3)[-len(mine) :]
                turn[-3:, -3:] = block.measured[k][:3, :3]
                D = np.eye(len(mine))
            else:
                sphere = group.what == "sphere"
                sigma = np.full(3, block.sigma_sphere_m if sphere else block.sigma_marker_m)
                if group.what == "upper":  # nothing is told of it along the rod
                    g = self.dense.values[block.gravity]
                    D = np.linalg.eigh(np.outer(g, g))[1][:, :2]
            self.parts[group] = Part(mine, D, -turn * sigma)
        if isinstance(block, HangingTarget):
            every = [self.parts[group] for group in block.groups]
            whole = replace(block.groups[0], what="rod")
            self.parts[whole] = Part(
                rows, _diagonal(p.D for p in every), _diagonal(p.told for p in every)
            )

    def _tilted(self, rows: np.ndarray, name: str, cells: object) -> None:
        """Tilts are with their region or surface; or with the surface that is that region alone."""
        sigma = self.problem.variables[name].sigma
        for k, row in enumerate(rows):
            region = Group("surface", "mesh", f"{cells.column}_{cells.parts[k]}")
            surface = Group("surface", "mesh", f"surface_{cells.surface[k]}")
            group = region if region in self.parts else surface
            found = self.parts[group]
            told = np.diag([*np.diag(found.told), sigma[k]])
            self.parts[group] = Part(np.append(found.rows, row), np.eye(len(told)), told)

    def _on_paper(self, name: str, unknown: object) -> Iterator[tuple[Group, list[int]]]:
        """Groups of a prior's rows."""
        effects = {t.variable: t.effect for terms in self.problem.terms for t in terms}
        each = [(k, dof) for k, dof in enumerate(unknown.dofs)]
        every = list(range(unknown.dim))
        if unknown.role is Role.JOINTS:
            number, _, stop = name.rpartition("joints@")
            source = self.problem.sources[int(number.removesuffix("/") or 0)]
            recording = source.recording.folder.name if self.several else ""
            yield Group("joints", stop, "joints", recording), every
            yield from ((Group("joints", stop, dof, recording), [k]) for k, dof in each)
        elif (cells := self.problem.cells.get(name)) and isinstance(cells.room, int):  # a mesh
            if cells.axis is not None:
                return  # a tilt goes with no group
            single = np.bincount(cells.surface)[cells.surface] < 2  # that surface is its only patch
            for k, _ in each:
                what = f"{cells.column}_{cells.parts[k]}"
                if cells.column == "surface" or not single[k]:
                    yield Group("surface", "mesh", what), [k]
        elif isinstance(effects.get(name), FrameOffset):
            yield Group("frame", "cad", name), every
        elif name in ("arm_link_length", "arm_joint_offset"):
            yield from ((Group("frame", "cad", f"{name}.{dof}"), [k]) for k, dof in each)

    # ------------------------------------------------------------------------- what follows from it

    def statistics(self, group: Group, left: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """How far out a group would be, (n,), with each of the right sides (m, n) that are `beyond`
        all unknowns; and what takes these to offsets as they are told."""
        Z, told, _, axes = self._checked(group)
        along = axes.T @ (Z.T @ left[self._where(group)])
        return np.sum(np.square(along), axis=0), told @ axes @ along

    def shifted(self, group: Group, offset: np.ndarray) -> np.ndarray:
        """The right side (m,) of a group that is off by this and nothing else."""
        Z, told, _, _ = self._checked(group)
        out = np.zeros(len(self.b))
        out[self._where(group)] = Z @ np.linalg.lstsq(told, offset)[0]
        return out

    def off(self, group: Group) -> Off:
        """By how much a group is off what all others say."""
        (statistic,), offset = self.statistics(group, self.left[:, None])
        _, told, _, axes = self._checked(group)
        out = told @ axes
        return Off(float(statistic), axes.shape[1], offset[:, 0], out @ out.T)

    def well(self, group: Group) -> float:
        """The least share of what a group says in any direction that others check."""
        return float(self._checked(group)[2].min())

    def _checked(self, group: Group) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Columns Z of a group's rows along which it may be off, what takes those to an offset as
        it is told, how much of Z is left beyond the unknowns, and the axes of what is, each over
        the root of that."""
        if group in self.scans:
            Z = self.twist(group)[self._where(group)]
            size = np.linalg.norm(Z, axis=0)
            Z, told = Z / size, np.diag(1 / size)
        else:
            Z, told = self.parts[group].D, self.parts[group].told @ self.parts[group].D
        taken = self.Q[self._where(group)].T @ Z
        values, axes = np.linalg.eigh(Z.T @ Z - taken.T @ taken)
        seen = values > CHECKED
        return Z, told, values, axes[:, seen] / np.sqrt(values[seen])

    def _where(self, group: Group) -> np.ndarray:
        if group in self.scans:
            return self._rows(f"scan {self.scans[group]}")
        return self.parts[group].rows

    def directions(self, group: Group) -> np.ndarray:
        """Whitened rows (m, q) of a shift of a group."""
        Z = self._checked(group)[0]
        out = np.zeros((len(self.b), Z.shape[1]))
        out[self._where(group)] = Z
        return out

    def lengthened(self, group: Group) -> np.ndarray:
        """Derivative (m, 1) of all rows by a range zero that a scan alone has."""
        names = list(self.problem.variables)
        ends = np.cumsum([0, *(self.problem.variables[n].dim for n in names)])
        out, mine = np.zeros((len(self.b), 1)), self._where(group)
        out[mine, 0] = self.A[mine, ends[names.index("range_offset")]]
        return out

    def score(self, columns: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """Score (q,) and information (q, q) of shifts along columns (m, ...), all else being
        estimated."""
        Z = np.hstack(columns)
        taken = self.Q.T @ Z
        return Z.T @ self.left, Z.T @ Z - taken.T @ taken

    def together(self, columns: Sequence[np.ndarray]) -> float:
        """The statistic of some shifts together, in the directions that others check."""
        if not columns:
            return 0.0
        u, M = self.score(columns)
        size = np.sqrt(np.diag(M))
        values, axes = np.linalg.eigh(M / np.outer(size, size))
        seen = values > CHECKED
        return float(np.sum(np.square(axes[:, seen].T @ (u / size)) / values[seen]))

    def left_out(self, group: Group) -> Off:
        """The same of a group that others check well, from a solution without its rows; of a scan,
        from one in which its LiDAR stands where it will."""
        if group in self.scans:
            Z = np.hstack([self.A, self.twist(group)])
            found, covariance = _solved(Z, self.b)
            fall = np.sum(np.square(self.left)) - np.sum(np.square(self.b - Z @ found))
            return Off(float(fall), 6, found[-6:], covariance[-6:, -6:])
        part = self.parts[group]
        A, b = self.A.copy(), self.b.copy()
        A[part.rows] -= part.D @ (part.D.T @ A[part.rows])
        b[part.rows] -= part.D @ (part.D.T @ b[part.rows])
        found, covariance = _solved(A, b)
        mine = part.D.T @ self.A[part.rows]
        error = part.D.T @ self.b[part.rows] - mine @ found
        spread = np.eye(len(error)) + mine @ covariance @ mine.T
        told = part.told @ part.D
        statistic = float(error @ np.linalg.solve(spread, error))
        return Off(statistic, len(error), told @ error, told @ spread @ told.T)

    def twist(self, group: Group) -> np.ndarray:
        """Derivative (m, 6) of all rows by a twist of the LiDAR of a scan that it alone has."""
        number = self.scans[group]
        rows = self.problem.scans[number].rows(self.dense.values, self.dense.associations[number])
        out = np.zeros((len(self.b), 6))
        weight = np.sqrt(rows.weight_m2)
        out[self.dense.rows_of[f"scan {number}"]] = weight[:, None] * rows.by_twist
        return out


def _solved(A: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Least squares and its covariance; unknowns that nothing tells stay at 0 and count as known:
    no row is about them."""
    size = np.linalg.norm(A, axis=0)
    told = size > 0
    Q, R = np.linalg.qr(A[:, told] / size[told])
    inverse = np.linalg.inv(R) / size[told][:, None]
    found, covariance = np.zeros(len(size)), np.zeros((len(size), len(size)))
    found[told] = inverse @ (Q.T @ b)
    covariance[np.ix_(told, told)] = inverse @ inverse.T
    return found, covariance


def _diagonal(blocks: Iterator[np.ndarray]) -> np.ndarray:
    """Blocks beside and below each other."""
    blocks = list(blocks)
    out = np.zeros(np.sum([block.shape for block in blocks], axis=0))
    row = column = 0
    for block in blocks:
        out[row : row + block.shape[0], column : column + block.shape[1]] = block
        row, column = row + block.shape[0], column + block.shape[1]
    return out
