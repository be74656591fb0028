"""Gradients by cluster: what rows that err together say together."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.sparse import csr_array


@dataclass
class Gradients:
    """``J^T W b`` of clusters of rows: beams of a stop on a surface, bodies at a stop, ...

    Args:
        size: number of columns, U.
    """

    size: int
    places: dict[object, int] = field(default_factory=dict)
    _rows: list[tuple[np.ndarray, np.ndarray]] = field(default_factory=list)
    _clusters: list[np.ndarray] = field(default_factory=list)

    def place(self, key: object) -> int:
        """Number of a part of the room, or of anything else that errs alike for several stops."""
        return self.places.setdefault(key, len(self.places))

    def add(
        self, gradient: np.ndarray, columns: np.ndarray, stop: np.ndarray, place: np.ndarray
    ) -> None:
        """Add clusters (C, n) over some columns (n,), of stops and places (C,), -1 for none."""
        self._rows.append((gradient, columns))
        self._clusters.append(np.stack([stop, place]))

    def add_beams(
        self,
        parts: np.ndarray,
        gradient: np.ndarray,
        columns: np.ndarray,
        stop: int,
        room: object,
    ) -> None:
        """Add the beams of a stop, by what they meet: parts (C,) of a room."""
        place = np.array([self.place((room, part)) for part in parts.tolist()])
        self.add(gradient, columns, np.full(len(parts), stop), place)

    def add_rows(
        self, A: np.ndarray, b: np.ndarray, columns: np.ndarray, stop: np.ndarray, place: np.ndarray
    ) -> None:
        """Add whitened rows (m, n), of stops and places (m,)."""
        pairs, cell = np.unique([stop, place], axis=1, return_inverse=True)
        pick = csr_array((b, cell, np.arange(len(b) + 1)), shape=(len(b), pairs.shape[1]))
        self.add(pick.T @ A, columns, *pairs)

    def table(self) -> tuple[csr_array, np.ndarray, np.ndarray]:
        """All clusters (C, U), sparse; the stop and the place (C,) of each."""
        stop, place = np.concatenate(self._clusters, axis=1)
        data = np.concatenate([g.ravel() for g, _ in self._rows])
        indices = np.concatenate([np.tile(c, len(g)) for g, c in self._rows])
        length = np.concatenate([np.full(len(g), len(c)) for g, c in self._rows])
        indptr = np.append(0, np.cumsum(length))
        table = csr_array((data, indices, indptr), shape=(len(stop), self.size))
        return table, stop, place
