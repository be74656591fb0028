"""What data hardly determine: where a fit leans on paper, where one name may be another's."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from calib.diagnosis.everywhere import CANCELS, STANDS_IN, Everywhere
from calib.diagnosis.score import projection
from calib.diagnosis.stand import Look
from calib.diagnosis.suggest import what_separates
from calib.effects import Effect
from calib.linear.symmetric import eigh
from calib.problem.unknowns import Key
from calib.results.observability import UNTOLD, echelon
from calib.results.solution import Solution

# Of the prior's variance left in a direction that the data hardly determine: they say less of it
# than the prior.
LEANS = 0.5
# Of a direction of unit length, in priors' sigmas, for a parameter to be named: a choice; one that
# is left out holds 4 % of its square at most.
NAMED_SHARE = 0.2
MOST_DIRECTIONS = 8  # that are told, the weakest: a choice, as nobody reads more


def weak_directions(solution: Solution, look: Look) -> list[dict[str, Any]]:
    """Directions in which a solution leans on paper, then effects that may stand for others.

    Returns:
        For each its `parameters`, `sigma_mm` (of a length, or of an angle one metre out; none for
        effects), and what it `needs`.
    """
    return [*leaning(solution, look), *standing_in(look)]


def to_be_told_apart(
    candidates: Sequence[Mapping[str, Any]], weak: Sequence[Mapping[str, Any]]
) -> list[str]:
    """The effects, of which other stops would say which it is; none where nothing is open.

    Args:
        candidates: of a diagnosis; of those confirmed the first that has rivals counts, though
            it may stand in for residual structure: other stops would say that too.
        weak: its weak directions; of effects that may stand for each other the first.
    """
    confirmed = (c for c in candidates if c["step"])
    for each in sorted(confirmed, key=lambda c: c["step"]):
        if names := to_be_planned(each):
            return names
    return next((list(w["parameters"]) for w in weak if w["sigma_mm"] is None), [])


def group(candidate: Mapping[str, Any]) -> list[str]:
    """A candidate of a diagnosis and its rivals, as commands have them."""
    return [candidate["add"], *(rival["add"] for rival in candidate["rivals"])]


def to_be_planned(candidate: Mapping[str, Any]) -> list[str]:
    """A candidate of a diagnosis and those of its rivals that stops can tell it from; none where
    there are none. A diagnosis of an earlier version does not say which are alike."""
    rivals = [rival["add"] for rival in candidate["rivals"] if not rival.get("alike")]
    return [candidate["add"], *rivals] if rivals else []


def leaning(solution: Solution, look: Look) -> list[dict[str, Any]]:
    """The weakest directions of a run's solution, in units of what was known before."""
    problem = look.stand.problem
    prior: dict[Key, float] = {}
    for variable in (problem.variables[name] for name in problem.calibration):
        prior |= dict(zip(variable.keys, variable.sigma.tolist(), strict=True))
    known = np.array([prior.get(key, np.nan) for key in solution.keys])
    usable = np.flatnonzero(np.isfinite(known))
    if not len(usable):
        return []
    known, keys = known[usable], [solution.keys[i] for i in usable]
    graph = solution.covariance if solution.graph is None else solution.graph
    everywhere = Everywhere.of(look.stand)
    return hardly_known(keys, graph[np.ix_(usable, usable)], known, everywhere)


def hardly_known(
    keys: Sequence[Key],
    covariance: np.ndarray,
    known: np.ndarray,
    everywhere: Everywhere | None = None,
) -> list[dict[str, Any]]:
    """The directions that data hardly determine, the weakest first; after them those that no stops
    of the arm determine, of which `alike` names what moves all that is seen alike.

    Args:
        keys: (P,) of the parameters.
        covariance: (P, P) of them.
        known: (P,) their sigmas before any data.
        everywhere: what they move that is seen, at any pose of the arm; None where nobody says.
    """
    still, rest = np.zeros((len(known), 0)), np.eye(len(known))
    if everywhere is not None:
        still, rest = everywhere.split(keys, known)
    values, axes = eigh(rest.T @ (covariance / np.outer(known, known)) @ rest)
    untold, axes = values > UNTOLD, rest @ axes
    weak = [(1.0, axis, False) for axis in _of_space(axes[:, untold])]
    told = sorted(zip(values[~untold], axes.T[~untold], strict=True), key=lambda pair: -pair[0])
    weak += [(value, axis, False) for value, axis in told if value >= LEANS]
    weak += [(1.0, axis, True) for axis in _of_space(still)]
    out = []
    for value, axis, nowhere in weak[:MOST_DIRECTIONS]:
        named = [int(i) for i in np.argsort(-np.abs(axis)) if abs(axis[i]) > NAMED_SHARE]
        if named:
            moved = np.sqrt(value) * np.abs(axis * known)[named]
            part = np.where(np.abs(axis) > CANCELS, axis, 0.0) * known
            alike = everywhere.movers(keys, part, NAMED_SHARE) if nowhere else []
            out.append(
                {
                    "parameters": [keys[i].name for i in named],
                    "sigma_mm": float(1e3 * moved.max()),
                    "needs": _alike(alike) if alike else _needs([keys[i] for i in named]),
                    "alike": alike,
                }
            )
    return out


def _of_space(space: np.ndarray) -> np.ndarray:
    """Directions (r, P) of unit length that span a space (P, r)."""
    directions = echelon(space, np.ones(len(space)))[0].T
    return directions / np.linalg.norm(directions, axis=1)[:, None]


def _alike(names: Sequence[str]) -> str:
    """Of one alone it is the base that could as well stand elsewhere."""
    moved = "they move all that is seen alike"
    if len(names) == 1:
        moved = "it moves all that is seen as another place of the base would"
    return (
        f"a measurement of {' or '.join(names)} itself; no stops tell, as at every pose of the arm "
        f"{moved}"
    )


def _needs(keys: Sequence[Key]) -> str:
    owners = list(dict.fromkeys(key.unknown for key in keys))
    if len(owners) > 1:
        return f"stops at which {' and '.join(owners)} act differently; only their sum is seen"
    one = len(keys) == 1
    stops = "that it moves more" if one else "at which they act differently; only their sum is seen"
    return f"a measurement of {' or '.join(key.name for key in keys)} itself, or stops {stops}"


def standing_in(look: Look) -> list[dict[str, Any]]:
    """Effects of the model that could as well be a candidate: on this data they do the same.

    A candidate that the model absorbs almost wholly, and would not without one of its effects, may
    be what that effect's estimate is made of.
    """
    linear, stand = look.linear, look.stand
    ours = {t.effect.name: (t.effect, t.variable) for terms in stand.problem.terms for t in terms}
    ours = {n: v for n, v in ours.items() if n in stand.model.names and not v[0].by_chance}
    out = []
    for name, (effect, variable) in ours.items():
        theirs, model, taken = projection(linear, [*linear.candidates, variable])
        cross = linear.information[np.ix_(model, theirs)]
        without = np.diag(linear.information)[theirs] - np.sum(cross * taken, axis=0)
        for candidate in look.named.candidates:
            own = candidate.test.columns
            left = np.diag(look.named.scores.information)[own].sum()
            if left < (1.0 - STANDS_IN) * without[own].sum():
                out.append(_stand_in(name, effect, candidate.effect))
    return out


def _stand_in(name: str, effect: Effect, other: Effect) -> dict[str, Any]:
    return {
        "parameters": [name, other.family],
        "sigma_mm": None,
        "alike": [],
        "needs": f"{what_separates(effect, other)}: on these data {name} absorbs {other.family}",
    }
