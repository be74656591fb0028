"""Numbers as the size of dots, in a few steps: more could not be told apart."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from calib.view.scene import Points
from calib.view.shown import colours
from calib.view.shown.colours import column

FACTORS = (0.5, 1.0, 1.8, 3.0)  # of a dot's usual size, step by step
Ends = tuple[float, float]


def ends_of(name: str, ends: Ends) -> Ends:
    """Values of the smallest and the largest dots: of what is shown about 0, how far it is off."""
    return (0.0, ends[1]) if column(name).signed else ends


def steps(points: Points, name: str, ends: Ends) -> np.ndarray:
    """Step (N,) of each beam's dot, 0 the smallest; of one without a number, too.

    Args:
        points: the beams.
        name: a column of numbers.
        ends: of its scale, as `colours.limits` has them.
    """
    low, high = ends_of(name, ends)
    values = points.columns[name] * column(name).scale
    values = np.abs(values) if column(name).signed else values
    share = (values - low) / max(high - low, 1e-12)
    share = np.clip(np.where(np.isnan(share), 0.0, share), 0.0, 1.0)
    return np.minimum(share * len(FACTORS), len(FACTORS) - 1).astype(int)


def key(name: str, ends: Ends) -> tuple[str, list[str]]:
    """What sizes of dots mean: of what, and from where to where each step goes."""
    shown = column(name)
    of = f"absolute {shown.heading}" if shown.signed else shown.heading
    edges = np.linspace(*ends_of(name, ends), len(FACTORS) + 1)
    return of, [f"{low:.3g} to {high:.3g}" for low, high in pairwise(edges)]


def choices(offered: list[str]) -> list[str]:
    """Of columns that are offered, those that stand for no names."""
    return [name for name in offered if name not in colours.NAMES]
