"""The columns of a linearisation: where each unknown stands, and which are eliminated.

Unknowns are of three kinds. *Own* unknowns of a stop (where the rig stands, what its encoders
misreport) are touched by that stop alone, or by nothing but their prior. *Cells* say how far parts
of the mesh stand off the room; no row touches cells of two surfaces, so their block of the normal
equations falls apart by surface. All others are *kept*: they go to the factor graph.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from calib.problem.model import labels
from calib.problem.problem import Block, Problem
from calib.problem.unknowns import Role, Unknown
from calib.residuals.scan import ScanStop
from calib.residuals.seen import BodiesTogether, SeenBody

StopKey = tuple[object, int]
# Least change of a whitened row by a prior sigma of an unknown: rounding of 1 m is 2e-16 m, which
# in rows with a sigma of 1 um is 2e-10.
ROUNDED_ROW = 1e-9
CELLS_AT_ONCE = 64  # blocks of fewer take longer to call for than to factor


@dataclass(frozen=True)
class Layout:
    """The columns of U unknowns.

    Args:
        unknowns: all, by name.
        at: unknown -> its columns.
        sigma: (U,) how well each was known before, which is its unit; 1 where there is no prior.
        stops: recording's folder and number of a stop -> its number here.
        own: stop -> columns of its own unknowns.
        owner: (U,) the stop whose own unknown stands in a column, -1 for those of no stop.
        cells: columns (n,) of the cells of each surface, or of a few surfaces that have few.
        kept: (S,) columns that are not eliminated, ascending.
        bodies: the problem's blocks of seen bodies that depend on stops' own unknowns.
        others: the problem's other blocks; the graph takes them as they are.
        unbounded: unknowns that have no prior.
        scanned, measured: how many stops have beams, and beams or tracked bodies: their numbers are
            the first.
        touched: unknown -> numbers of the stops whose place, or tracked bodies, depend on it; -1
            for a target.
        asked: names of unknowns -> their columns, of those that were asked for.
    """

    unknowns: Mapping[str, Unknown]
    at: Mapping[str, slice]
    sigma: np.ndarray
    stops: Mapping[StopKey, int]
    own: Mapping[int, np.ndarray]
    owner: np.ndarray
    cells: Sequence[np.ndarray]
    kept: np.ndarray
    bodies: Sequence[BodiesTogether]
    others: Sequence[Block]
    unbounded: frozenset[str]
    scanned: int
    measured: int
    touched: Mapping[str, frozenset[int]]
    asked: dict[tuple[str, ...], np.ndarray] = field(default_factory=dict)

    @classmethod
    def of(
        cls, problem: Problem, kept: Collection[str] = (), unbounded: Collection[str] = ()
    ) -> Layout:
        """The layout of a problem.

        Args:
            problem: its unknowns, blocks and scans.
            kept: unknowns that are not to be eliminated, as a prior ties them to others.
            unbounded: unknowns that have no prior here, whose columns are not scaled.
        """
        unknowns = problem.variables
        ends = np.cumsum([0, *(u.dim for u in unknowns.values())]).tolist()
        at = {n: slice(i, k) for n, i, k in zip(unknowns, ends, ends[1:], strict=False)}
        sigma = [np.ones(u.dim) if n in unbounded else u.sigma for n, u in unknowns.items()]
        stops: dict[StopKey, int] = {}
        touched: dict[str, set[int]] = {}
        for scan in problem.scans:
            stop = stops.setdefault(key_of(scan), len(stops))
            for name in scan.stops.variables:
                touched.setdefault(name, set()).add(stop)
        for block in problem.blocks:
            seen = {stops.setdefault(key, len(stops)) for key in keys_of(block)}
            for name in block.variables:
                touched.setdefault(name, set()).update(seen or {-1})
        measured = len(stops)
        owner = {n: next(iter(s)) for n, s in touched.items() if len(s) == 1 and _own(unknowns[n])}
        for name, key in _untouched(problem, touched):
            owner[name] = stops.setdefault(key, len(stops))
        owner = {name: stop for name, stop in owner.items() if name not in kept}
        own: dict[int, list[np.ndarray]] = {}
        for name in (n for n in unknowns if owner.get(n, -1) >= 0):
            own.setdefault(owner[name], []).append(np.r_[at[name]])
        cells = _cells(problem, at)
        inner = [*own.values(), cells, [np.zeros(0, int)]]
        whose = np.full(ends[-1], -1)
        for stop, columns in own.items():
            whose[np.concatenate(columns)] = stop
        eliminated = np.concatenate([c for part in inner for c in part]).astype(int)
        about_own = [any(n in owner for n in block.variables) for block in problem.blocks]
        bodies = [b for b, its in zip(problem.blocks, about_own, strict=True) if its]
        others = [b for b, its in zip(problem.blocks, about_own, strict=True) if not its]
        return cls(
            unknowns=unknowns,
            at=at,
            sigma=np.concatenate(sigma),
            stops=stops,
            own={stop: np.concatenate(columns) for stop, columns in own.items()},
            owner=whose,
            cells=cells,
            kept=np.setdiff1d(np.arange(ends[-1]), eliminated),
            bodies=BodiesTogether.of(bodies),
            others=others,
            unbounded=frozenset(unbounded),
            scanned=len({key_of(scan) for scan in problem.scans}),
            measured=measured,
            touched={name: frozenset(seen) for name, seen in touched.items()},
        )

    @property
    def size(self) -> int:
        """How many columns there are."""
        return len(self.sigma)

    def columns(self, names: Sequence[str]) -> np.ndarray:
        """Columns of some unknowns, in the order given; not to be written to, as it is kept."""
        wanted = tuple(names)
        if wanted not in self.asked:
            self.asked[wanted] = _join(self.at, wanted)
            self.asked[wanted].flags.writeable = False
        return self.asked[wanted]

    def columns_of_each(self, names: Sequence[str]) -> np.ndarray:
        """Columns (K, n) of K unknowns that have as many components each."""
        first = np.array([self.at[name].start for name in names])
        return first[:, None] + np.arange(self.unknowns[names[0]].dim)

    def inner(self) -> Iterator[str]:
        """Unknowns that are eliminated before the graph is solved."""
        gone = np.ones(self.size, bool)
        gone[self.kept] = False
        return (name for name, at in self.at.items() if gone[at.start])

    def moves(self, A: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """Whether rows (..., m, n) of measurements depend on unknowns that stand in columns
        (..., n) at all: by more than rounding makes of it."""
        largest = np.maximum(A.max(axis=-2, initial=0.0), -A.min(axis=-2, initial=0.0))
        return largest * self.sigma[columns] > ROUNDED_ROW

    def outer(self) -> dict[str, Unknown]:
        """Unknowns that the graph solves for."""
        gone = set(self.inner())
        return {name: u for name, u in self.unknowns.items() if name not in gone}


def positions(size: int, columns: np.ndarray) -> np.ndarray:
    """Where each of so many columns (size,) stands among some of them (n,); -1 for the others."""
    at = np.full(size, -1)
    at[columns] = np.arange(len(columns))
    return at


def key_of(scan: ScanStop) -> StopKey:
    """Which stop a scan is of."""
    return scan.recording.folder, scan.index


def _own(unknown: Unknown) -> bool:
    """Whether a stop may have it for itself."""
    return unknown.role in (Role.PLACE, Role.JOINTS)


def _untouched(problem: Problem, touched: Collection[str]) -> Iterator[tuple[str, StopKey]]:
    """Unknowns of a stop that no row but their prior depends on, and which stop that is."""
    known = {
        (label, stop): (source.recording.folder, k)
        for source, label in zip(problem.sources, labels(problem.sources), strict=True)
        for k, stop in enumerate(source.recording.stops)
    }
    for name, unknown in problem.variables.items():
        of = unknown.owner.recording, unknown.owner.where
        if _own(unknown) and name not in touched and of in known:
            yield name, known[of]


def keys_of(block: Block) -> Sequence[StopKey]:
    """Which stops a block speaks of; none for a target."""
    return block.stop_names if isinstance(block, SeenBody) else ()


def _cells(problem: Problem, at: Mapping[str, slice]) -> list[np.ndarray]:
    """Columns of the cells of each surface, of small ones together with those of the next."""
    if not problem.cells:
        return []
    room = {some.room: i for i, some in enumerate(problem.cells.values())}
    columns = np.concatenate([np.r_[at[name]] for name in problem.cells])
    rooms = np.concatenate([np.full(len(c.parts), room[c.room]) for c in problem.cells.values()])
    surface = np.concatenate([some.surface for some in problem.cells.values()])
    order = np.lexsort([surface, rooms])
    new = np.diff(rooms[order]) | np.diff(surface[order])
    starts = np.append(0, np.flatnonzero(new) + 1)  # of each surface's
    first = np.flatnonzero(np.diff(starts // CELLS_AT_ONCE, prepend=-1))
    return np.split(columns[order], starts[first[1:]])


def _join(at: Mapping[str, slice], names: Sequence[str]) -> np.ndarray:
    first = np.array([at[name].start for name in names], int)
    size = np.array([at[name].stop for name in names], int) - first
    before = np.cumsum(size) - size
    return np.repeat(first - before, size) + np.arange(size.sum())
