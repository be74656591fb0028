"""What the data could not tell: found from the joint covariance, said in a roboticist's words."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.linalg import qr

from calib.graph import Variable

UNTOLD = 0.98  # of the prior's variance left: the data said next to nothing
PARTNER = 0.1  # of the leading parameter's share, in units of the priors
MOST_PARTNERS = 6


def not_estimated(
    variables: Sequence[Variable], covariance: np.ndarray, effects: frozenset[str]
) -> list[dict[str, str]]:
    """Parameters whose estimate is the prior's doing, and why.

    In units of the priors the covariance is ``(I + information)^-1``, so directions in which its
    eigenvalue is near 1 are those the data say nothing about, gauges included. They are brought to
    echelon form, one leading parameter each, an effect's rather than a frame's.

    Args:
        variables: those of the covariance, in order.
        covariance: (P, P) joint marginal.
        effects: names of those that are effects, not frames.

    Returns:
        A `name` and a `why` for each.
    """
    names = [f"{v.name}.{dof}" for v in variables for dof in v.dofs]
    sigma = np.concatenate([v.sigma for v in variables])
    values, vectors = np.linalg.eigh(covariance / np.outer(sigma, sigma))
    untold = vectors[:, values > UNTOLD]
    if not untold.shape[1]:
        return []
    owner = np.repeat([v.name for v in variables], [v.dim for v in variables])
    preference = np.where(np.isin(owner, list(effects)), 1.0, 0.3)
    _, _, order = qr((untold * preference[:, None]).T, mode="economic", pivoting=True)
    leading = order[: untold.shape[1]]
    directions = untold @ np.linalg.inv(untold[leading])
    alone: dict[str, list[str]] = {}
    tied = []
    for column, lead in sorted(zip(directions.T, leading, strict=True), key=lambda pair: pair[1]):
        share = np.abs(column) * preference
        partners = [i for i in np.argsort(-share) if share[i] > PARTNER * share[lead] and i != lead]
        if partners:
            tied.append(_tied(names[lead], [names[i] for i in partners]))
        else:
            alone.setdefault(owner[lead], []).append(names[lead].split(".", 1)[1])
    whole = {v.name: v.dim for v in variables}
    return [_alone(n, dofs, len(dofs) == whole[n]) for n, dofs in alone.items()] + tied


def _alone(variable: str, dofs: list[str], whole: bool) -> dict[str, str]:
    name = variable if whole else f"{variable}.{dofs[0]}" if len(dofs) == 1 else f"{variable} ({', '.join(dofs)})"
    return {
        "name": name,
        "why": "nothing measured here depends on it, so it stays as well known as before",
    }


def _tied(name: str, partners: list[str]) -> dict[str, str]:
    listed = ", ".join(partners[:MOST_PARTNERS])
    more = f" and {len(partners) - MOST_PARTNERS} more" if len(partners) > MOST_PARTNERS else ""
    return {
        "name": name,
        "why": f"all that is measured changes just as with {listed}{more}: only their combination "
        f"is estimated, and the priors share it out; measure one of them directly to split it",
    }
