"""One candidate judged by leaving out cluster after cluster.

The scatter of the clusters' scores judges a candidate. A true effect widens that scatter itself,
and one odd cluster can make a candidate that acts in few clusters look certain. So each cluster is
compared with what the others predict: with the whitened score ``s = sum s_c`` and information
``sum I_c = 1``, its part is ``(1 - I_c)^-1 (s_c - I_c s)``. This is the cluster jackknife
(MacKinnon, Nielsen and Webb 2022, CV3), by stops and by surfaces. It needs each cluster's own share
of the information, so it is one more pass over the rows, for one candidate.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from calib.linear.clusters import ClusteredRows

WHOLE = 0.999  # of a direction's information: a cluster that has more of it is alone with it


@dataclass
class Shares:
    """Each cluster's share of a candidate's whitened score and of its information."""

    cells: dict[tuple[int, int], list[np.ndarray]] = field(default_factory=dict)

    def add(self, rows: ClusteredRows) -> None:
        """Add rows along the candidate's directions, projected off the model and whitened."""
        order = np.lexsort([rows.place, rows.stop])
        stop, place = rows.stop[order], rows.place[order]
        bounds = np.flatnonzero((np.diff(stop) != 0) | (np.diff(place) != 0)) + 1
        for some in np.split(order, bounds):
            mine, right = rows.A[some], rows.b[some]
            cell = int(rows.stop[some[0]]), int(rows.place[some[0]])
            self._sum(self.cells, cell, mine.T @ right, mine.T @ mine)

    @staticmethod
    def _sum(to: dict, key: object, score: np.ndarray, information: np.ndarray) -> None:
        if key in to:
            to[key][0] += score
            to[key][1] += information
        else:
            to[key] = [score.copy(), information.copy()]

    def covariance(self) -> np.ndarray:
        """Covariance (r, r) of the whitened score: by stops, plus by places, less by both."""
        total = sum(score for score, _ in self.cells.values())
        ways = {"stop": {}, "place": {}, "both": {}}
        for (stop, place), (score, information) in self.cells.items():
            if stop >= 0:
                self._sum(ways["stop"], stop, score, information)
            if place >= 0:
                self._sum(ways["place"], place, score, information)
            if stop >= 0 and place >= 0:
                self._sum(ways["both"], (stop, place), score, information)
        stop, place, both = (_spread(cells.values(), total) for cells in ways.values())
        return max(stop + place - both, stop, place, key=np.trace)


def _spread(cells: Sequence[list[np.ndarray]], total: np.ndarray) -> np.ndarray:
    """Sum over clusters of the squares of ``(1 - I_c)^-1 (s_c - I_c s)``; see the module."""
    out = np.zeros((len(total), len(total)))
    for score, information in cells:
        values, axes = np.linalg.eigh(information)
        left = 1.0 - np.clip(values, 0.0, WHOLE)
        beyond = axes @ ((axes.T @ (score - information @ total)) / left)
        out += np.outer(beyond, beyond)
    return out
