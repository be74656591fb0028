"""What a model cannot absorb of a range error: off ring zeros and a rigid motion of every stop.

By least squares on all beams, from true normals; no code of the program.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd
from scipy.sparse import csr_array

NORMAL = ["normal_x", "normal_y", "normal_z"]


@dataclass(frozen=True)
class Absorbs:
    """What rings' zeros and stops' rigid motions can do to ranges.

    Args:
        columns: (N, P) per unit of each.
        inverse: (P, P) pseudo-inverse of its Gram matrix.
    """

    columns: csr_array
    inverse: np.ndarray

    @classmethod
    def of(cls, beams: pd.DataFrame) -> Absorbs:
        """Of beams with ``stop``, ``ring``, ``x y z`` m, and ``normal_*`` in the LiDAR's frame;
        where there are no normals, of rings alone."""
        ring = beams["ring"].to_numpy(int)
        rows, width = np.arange(len(ring)), ring.max() + 1
        data, where, at = [np.ones(len(ring))], [rows], [ring]
        if set(NORMAL) <= set(beams):
            stop = pd.factorize(beams["stop"])[0]
            point, normal = beams[["x", "y", "z"]].to_numpy(float), beams[NORMAL].to_numpy(float)
            facing = np.sum(point * normal, axis=1) / np.linalg.norm(point, axis=1)
            twist = np.hstack([normal, np.cross(point, normal)]) / facing[:, None]
            data += list(twist.T)
            where += [rows] * 6
            at += [width + 6 * stop + i for i in range(6)]
            width += 6 * (stop.max() + 1)
        entries = tuple(map(np.concatenate, (where, at)))
        columns = csr_array((np.concatenate(data), entries), shape=(len(ring), width))
        return cls(columns, np.linalg.pinv((columns.T @ columns).toarray(), hermitian=True))

    def off(self, error_m: np.ndarray) -> np.ndarray:
        """Errors (N,) or (N, M) m without what these explain of them."""
        return error_m - self.columns @ (self.inverse @ (self.columns.T @ error_m))


def rms(error: np.ndarray) -> float:
    """Root of the mean square."""
    return float(np.sqrt(np.mean(np.square(error))))
