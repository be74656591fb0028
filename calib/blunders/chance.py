"""How unlikely something is by chance."""

from __future__ import annotations

import numpy as np
from scipy import special

# Chance that a diagnosis claims anything where nothing is missing: 5 % in all, a part for each sort
# of claim (Bonferroni, weighted). Half of what means have is for effects with a name: they cost
# least looks, and are what can be added.
LEVELS = {
    "effect": 0.02,
    "structure": 0.01,
    "effect on the scatter": 0.005,
    "scatter by chance": 0.005,
    "blunder": 0.005,
    "structure of what was rejected": 0.005,
}
# Power with which an effect, a spread or a blunder of the smallest detectable size is found: by
# convention (Cohen 1988).
POWER = 0.8
KNOWN = 1e6  # degrees of freedom of a scale that is taken as known
LEAST_P = 1e-6  # nobody knows a tail further out: no p-value is said to be smaller


def log_tail(x: float, q: float) -> float:
    """Log of the upper tail of chi-square with q degrees of freedom, however far out."""
    tail = special.chdtrc(q, x)
    if tail > 0.0:
        return float(np.log(tail))
    half = x / 2
    return float((q / 2 - 1) * np.log(half) - half - special.gammaln(q / 2))


def enough(own: float, known: float, limit: float) -> float:
    """Noncentrality from which a mean square of `own` degrees of freedom, against a scale that
    `known` of them tell, is beyond a limit with a power of `POWER`."""
    return float(special.ncfdtrinc(own, known, 1.0 - POWER, limit))


def at_least(p: float) -> float:
    """A p-value as it is told."""
    return max(float(p), LEAST_P)


def after_looks(p: np.ndarray | float, looks: float) -> np.ndarray | float:
    """Chance that the smallest of so many independent p-values is as small (Sidak 1967); no less
    than a p-value that is told. The p-value itself may be: however many looks there are, what is
    far enough out is found."""
    adjusted = -np.expm1(looks * np.log1p(-np.clip(p, 0.0, 1 - 1e-15)))
    return np.maximum(adjusted, LEAST_P)
