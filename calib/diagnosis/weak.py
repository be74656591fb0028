"""What the data hardly determine: directions in which a fit still leans on paper."""

from __future__ import annotations

from typing import Any

import numpy as np

from calib.diagnosis.stand import Stand
from calib.run import Run

LEANS = 0.5  # of the prior's variance left in a direction that the data hardly determine
SHARE = 0.35  # of a direction, for a parameter to be named
MOST = 8


def weak_directions(run: Run, stand: Stand) -> list[dict[str, Any]]:
    """The weakest directions of a run's solution, in units of what was known before.

    Returns:
        Per direction its `parameters`, `sigma_mm` (of a length, or of an angle one metre out), the
        `share` of the prior's variance that is left, and what it `needs`.
    """
    solution = run.solution
    prior = {}
    for name in stand.problem.calibration:
        variable = stand.problem.variables[name]
        prior |= {f"{name}.{d}": s for d, s in zip(variable.dofs, variable.sigma, strict=True)}
    known = np.array([prior.get(name, np.nan) for name in solution.names])
    usable = np.flatnonzero(np.isfinite(known))
    if not len(usable):
        return []
    scaled = solution.covariance[np.ix_(usable, usable)] / np.outer(known[usable], known[usable])
    scaled /= max(1.0, float(run.summary["sigmas_widened_by"])) ** 2
    values, axes = np.linalg.eigh(scaled)
    out = []
    for value, axis in zip(values[::-1], axes.T[::-1], strict=True):
        if value < LEANS or len(out) == MOST:
            break
        named = [i for i in np.argsort(-np.abs(axis)) if abs(axis[i]) > SHARE]
        moved = np.sqrt(value) * axis * known[usable]
        out.append(
            {
                "parameters": [solution.names[usable[i]] for i in named],
                "sigma_mm": float(1e3 * np.abs(moved[named]).max()) if named else 0.0,
                "share": float(min(value, 1.0)),
                "needs": _needs([solution.names[usable[i]] for i in named]),
            }
        )
    return [direction for direction in out if direction["parameters"]]


def _needs(names: list[str]) -> str:
    owners = list(dict.fromkeys(name.rpartition(".")[0] for name in names))
    if len(names) > 1:
        return f"stops at which {' and '.join(owners)} act differently; only their sum is seen"
    return f"a measurement of {names[0]} itself, or stops that it moves more"
