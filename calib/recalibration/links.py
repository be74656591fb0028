"""What became of each link since an earlier run, and how `summary.json` holds it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from calib.blunders.chance import at_least
from calib.results.outstanding import freedoms


@dataclass(frozen=True)
class Link:
    """One link (a frame or an effect) then and now.

    Args:
        name: the variable.
        moved: whether it moved, as chance hardly makes such a change beside all others that moved.
        p_value: of the change, if it had not; None where the new data say nothing of it.
        change: (n,) now minus then, per parameter, m or rad, if those that moved are the ones.
        sigma: (n,) of the change where it moved, else of the estimate now; the same holds.
        parameters: (n,) names.
        units: (n,).
        freed: by how many of CAD's sigmas the fit let it go from the earlier value; 0 where held.
        instead: links of which one may have moved in its place: the data cannot tell.
        of_mean: of what is one quantity of several rings or labels, and has changed alike, the
            change of their mean and the sigma of that; else empty.
        shown_by: of one that moved, the parameter that explains most had it alone moved; else
            empty.
        alone: by how much that did then, and the sigma of that; else empty.
        told_from: (n,) of one that has not moved, how far each parameter would have to move by
            itself to be told; else empty. See `calib.recalibration.newer.told_from`.
        unchecked: parameters of one that has not moved, of which a move as large as CAD's sigma
            would not be told, and would leave that parameter more than 3 of its sigmas off; none of
            a frame of which CAD says nothing, as the scanner's.
    """

    name: str
    moved: bool
    p_value: float | None
    change: np.ndarray
    sigma: np.ndarray
    parameters: tuple[str, ...]
    units: tuple[str, ...]
    freed: float = 0.0
    instead: tuple[str, ...] = ()
    of_mean: tuple[float, ...] = ()
    shown_by: str = ""
    alone: tuple[float, ...] = ()
    told_from: np.ndarray | tuple[float, ...] = ()
    unchecked: tuple[str, ...] = ()

    def document(self) -> dict[str, Any]:
        """As summary.json holds it."""
        return {
            "name": self.name,
            "moved": self.moved,
            "p_value": None if self.p_value is None else at_least(self.p_value),
            "parameters": self.parameters,
            "units": self.units,
            "change": self.change,
            "sigma": self.sigma,
            "freed": self.freed,
            "instead": self.instead,
            "of_mean": self.of_mean,
            "shown_by": self.shown_by,
            "alone": self.alone,
            "unchecked": self.unchecked,
            "told_from": [float(x) if np.isfinite(x) else None for x in self.told_from],
        }


def since(links: Sequence[Link], earlier: Mapping[str, Any]) -> dict[str, Any]:
    """What became of each link since an earlier run, and since CAD, as summary.json holds it.

    Args:
        links: as a fit from that run found them.
        earlier: the summary of that run.
    """
    far = moved_since_cad(earlier)
    for link in (link for link in links if link.freed):
        far[link.name] = float(np.hypot(link.freed, far.get(link.name, 0.0)))
    return {"links": [link.document() for link in links], "moved_since_cad": far}


def moved_since_cad(summary: Mapping[str, Any]) -> dict[str, float]:
    """The links that were let go by any run, from one to the next, since the one that knew CAD
    alone, each with by how many of its sigmas: it does not tell where they are now. Earlier
    versions told of the last run alone."""
    return dict(summary.get("moved_since_cad", freedoms(summary)))
