"""What is the same in whichever order unknowns are eliminated: the matrix that sums add up to."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from calib.linear.elimination import Eliminated, eliminate_apart, square
from calib.linear.layout import Layout, positions
from calib.linear.own import OwnRows
from calib.linear.rows import TWIST, OwnSums, StopSums
from calib.linear.system import Linearisation, Values
from calib.problem.unknowns import Role
from calib.residuals.compiled import add_at, add_sparse

# Most entries of the rows of stops that wait, over all columns: bounds the memory.
WAITING_ENTRIES = 2_000_000


@dataclass(frozen=True)
class KeptSums:
    """The Gram matrix of whitened rows about kept unknowns.

    Args:
        gram: (n + 1, n + 1) over the columns and, last, the right side.
        columns: (n,) by which.
    """

    gram: np.ndarray
    columns: np.ndarray

    @classmethod
    def of(cls, A: np.ndarray, b: np.ndarray, columns: np.ndarray) -> KeptSums:
        """Of rows (m, n), however many, with a right side (m,)."""
        return cls(square(np.column_stack([A, b])), columns)


@dataclass(frozen=True)
class Scanned:
    """A stop's beams, as far as they say something of where its LiDAR is.

    Args:
        stop: its number.
        information: (6, 6) of the twist.
        beside: (6, n) products of the twist with unknowns and, first, the right side, in units of
            sigmas; at: (n,) where these stand.
        chain: (6, m) derivative of the twist, in units of sigmas, by the columns (m,).
    """

    stop: int
    information: np.ndarray
    beside: np.ndarray
    at: np.ndarray
    chain: np.ndarray
    columns: np.ndarray


class Assembly(ABC):
    """Give it each stop's sums by `add`, those of other rows about kept unknowns by `add_kept`,
    then call ``done``.

    Its matrix is over ``[cells | others | b]``, in units of sigmas. Half of it is held: the whole
    is that and its transpose. So a product of two different columns is added once, below the
    diagonal where one of them is a cell; of two others it may stand on either side, or half of it
    on both.

    Args:
        layout: which column is what.
        own: rows about stops' own unknowns, those of priors last.
        raw: whether what rows tell of each kept unknown before eliminations is wanted.
        others: (n,) the columns that its matrix has beside those of cells.
    """

    def __init__(
        self, layout: Layout, own: Sequence[OwnRows], raw: bool, others: np.ndarray
    ) -> None:
        self.layout, self.rows = layout, own
        self.raw = {n: np.zeros((u.dim, u.dim)) for n, u in layout.outer().items()} if raw else None
        self.cells = np.concatenate([np.zeros(0, int), *layout.cells])
        self.columns = np.concatenate([self.cells, others, [layout.size]])
        self.at = positions(layout.size + 1, self.columns)
        self.half = np.zeros((len(self.columns), len(self.columns)))
        self.chi2 = sum(float(rows.b @ rows.b) for rows in own)
        self.touched = np.zeros(layout.size, bool)
        for rows in (rows for rows in own if rows.measured):
            shared = rows.shared.reshape(len(rows.b), -1)
            self.touched[rows.shared_columns] |= layout.moves(shared, rows.shared_columns)
            self.touched[rows.own_columns[layout.moves(rows.own, rows.own_columns)]] = True
        self.weight_m2 = self.beams_chi2 = 0.0
        self.eliminated: list[Eliminated] = []
        self.scans: dict[int, OwnSums] = {}
        self.scanned: list[Scanned] = []  # which wait
        widest = max(map(len, layout.own.values()), default=0) + 2 * TWIST
        self.together = max(WAITING_ENTRIES // (widest * len(self.columns)), 1)

    def add(self, sums: StopSums) -> None:
        """Add the beams of a stop."""
        self.weight_m2 += sums.weight_m2
        self.beams_chi2 += float(sums.dense[TWIST, TWIST])
        self.chi2 += float(sums.dense[TWIST, TWIST])
        seen = np.append(np.diag(sums.dense)[TWIST + 1 :], sums.own) > 0
        self.touched[sums.columns] |= seen
        # Twists are in m and rad, so rounding is less than in rows, which are in sigmas.
        self.touched[sums.chain_columns] |= self.layout.moves(sums.chain, sums.chain_columns)
        if self.raw is not None:
            self.scans[sums.stop] = sums.alone()
        sigma, width = self.layout.sigma, sums.dense.shape[1] - TWIST
        at = np.append(len(self.columns) - 1, self.at[sums.columns])
        unit = np.append(1.0, sigma[sums.columns])
        dense = sums.dense[TWIST:, TWIST:] * unit[:width] * unit[:width, None]
        with_dense = sums.with_dense.T * unit[width:]
        add_at(self.half, at[:width], at[:width], dense / 2)
        add_at(self.half, at[:width], at[width:], with_dense[TWIST:] * unit[:width, None])
        add_sparse(self.half, at[width:], unit[width:], sums.with_sparse, sums.own)
        by_twist = np.hstack([sums.dense[:TWIST, TWIST:] * unit[:width], with_dense[:TWIST]])
        found = Scanned(
            stop=sums.stop,
            information=sums.dense[:TWIST, :TWIST],
            beside=by_twist,
            at=at,
            chain=sums.chain * sigma[sums.chain_columns],
            columns=sums.chain_columns,
        )
        self.scanned.append(found)
        if len(self.scanned) >= self.together:
            self._finish_scanned()

    def _finish_scanned(self) -> None:
        beams, self.scanned = self.scanned, []
        if beams:
            self.add_twists(beams)

    @abstractmethod
    def add_twists(self, beams: Sequence[Scanned]) -> None:
        """Add what the beams of stops say of where their LiDARs are."""

    def add_through(self, beams: Sequence[Scanned]) -> tuple[np.ndarray, np.ndarray]:
        """Add what the twists of K stops say of the others that they depend on.

        With the twist ``t = T x``, its information A and what it has with all others B, a stop adds
        ``T' Z + Z' T - T' A T``, where ``Z = A T + B``.

        Returns:
            A (K, 6, 6), and Z (K, 6, N) by all columns.
        """
        first = len(self.cells)
        A = np.stack([each.information for each in beams])
        T = np.zeros((len(beams), TWIST, len(self.columns) - first - 1))
        Z = np.zeros((len(beams), TWIST, len(self.columns)))
        for i, each in enumerate(beams):
            at = self.at[each.columns]
            T[i][:, at[at >= 0] - first] = each.chain[:, at >= 0]
            Z[i][:, each.at] = each.beside
        moved = A @ T
        Z[:, :, first:-1] += moved
        used = np.flatnonzero(T.any(axis=(0, 1)))
        chain = T.reshape(-1, T.shape[2])[:, used]
        self.half[first + used] += chain.T @ Z.reshape(-1, Z.shape[2])
        both = chain.T @ moved.reshape(-1, T.shape[2])[:, used]
        self.half[np.ix_(first + used, first + used)] -= both / 2
        return A, Z

    def add_kept(self, sums: KeptSums) -> None:
        """Add the sums of whitened rows of scatter within holds, which are about kept unknowns."""
        self.chi2 += float(sums.gram[-1, -1])
        self.beams_chi2 += float(sums.gram[-1, -1])
        self.touched[sums.columns] |= np.diag(sums.gram)[:-1] > 0
        unit = np.append(self.layout.sigma[sums.columns], 1.0)
        at = np.append(self.at[sums.columns], len(self.columns) - 1)
        add_at(self.half, at, at, sums.gram * unit * unit[:, None] / 2)

    def done(self, values: Values) -> Linearisation:
        """Eliminate all but the kept."""
        self._finish_scanned()
        kept = self.eliminate(values)
        return Linearisation(
            layout=self.layout,
            values=values,
            kept=kept,
            raw=self.raw,
            chi2=self.chi2,
            touched=self.touched,
            eliminated=self.eliminated,
            scans=self.scans,
            weight_m2=self.weight_m2,
            beams_chi2=self.beams_chi2,
        )

    @abstractmethod
    def eliminate(self, values: Values) -> np.ndarray:
        """Add stops' own rows, eliminate, and give what is left (S + 1, S + 1) of the kept."""

    def tell_raw(self) -> None:
        """Keep what the matrix says of each kept unknown by itself."""
        for name, told in (self.raw or {}).items():
            first = self.at[self.layout.at[name].start]
            mine = slice(first, first + len(told))
            told += self.half[mine, mine] + self.half[mine, mine].T

    def without_cells(self, values: Values, sizes: Sequence[int]) -> np.ndarray:
        """What is left of the others and b when cells are eliminated, in sets of such sizes that
        are not tied to each other."""
        count = len(self.cells)
        rest = self.half[count:, count:] + self.half[count:, count:].T
        if not count:
            return rest
        prior = self._cell_priors(values)
        block, cross = self.half[:count, :count], self.half[count:, :count].T
        np.einsum("ii->i", block)[:] *= 2.0
        np.einsum("ii->i", block)[:] += 1.0
        cross[:, -1] += prior
        rest[-1, -1] += prior @ prior
        first = 0
        for factor, gain in eliminate_apart(block, cross, rest, sizes):
            columns = self.columns[first : first + len(factor)]
            over, first = np.flatnonzero(gain.any(axis=0)), first + len(factor)
            others = self.columns[count + over]
            self.eliminated.append(Eliminated(columns, others, factor, gain[:, over]))
        return rest

    def _cell_priors(self, values: Values) -> np.ndarray:
        """Right side (n,) of the priors of cells, in units of their sigmas: the derivative is 1."""
        whole = np.zeros(self.layout.size)
        for name, at in self.layout.at.items():
            if self.layout.unknowns[name].role is Role.SURFACE:
                whole[at] = -values[name] / self.layout.unknowns[name].sigma
        self.chi2 += float(whole[self.cells] @ whole[self.cells])
        return whole[self.cells]


def alone(layout: Layout, columns: np.ndarray) -> Iterator[tuple[str, slice, np.ndarray]]:
    """Each unknown that columns (n,) are of, with where its own, side by side, stand among these
    and among its own (k,)."""
    names, first = list(layout.at), np.array([at.start for at in layout.at.values()])
    of = np.searchsorted(first, columns, side="right") - 1
    ends = [0, *(np.flatnonzero(np.diff(of)) + 1).tolist(), len(columns)]
    for start, end in pairwise(ends if len(columns) else ()):
        yield names[of[start]], slice(start, end), columns[start:end] - first[of[start]]
