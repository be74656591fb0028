"""Serial correlation of what seems to scatter from stop to stop: whether stops that follow each
other err alike, as where something drifts, or was changed in between and changed back.

With r_k the errors of the k-th stop in time, ``S = sum r_k . r_(k+1)``. Where errors are random,
each might as well have the other sign, and then S has the mean 0 and the variance ``sum (r_k .
r_(k+1))^2``, however widely any of them scatters (the serial correlation of von Neumann 1941, by
signs as in `jackknife`). Errors are taken against a fit of all other rows, which leaves next to
nothing in common between those of neighbours. What is fixed to a body keeps its direction in the
body's axes, and what is fixed to the tracker keeps it in the tracker's: both are asked.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from scipy import special

from calib.blunders.chance import at_least
from calib.blunders.judged import Blunder
from calib.blunders.others import Others
from calib.diagnosis.suggest import all_of
from calib.effects import Scatter, Site
from calib.problem import Problem
from calib.problem.model import labels
from sensors.stops import in_time

ALPHA_SERIAL = 0.01  # share of random errors that are said not to be: a choice, it names nothing
FEWEST_IN_SERIES = 10  # stops: S over its sd is at most the root of their number, 3 for p = 0.001
OF_ROWS = {Site.TRACKER: "body", Site.JOINTS: "joints"}  # where widened -> kind of its groups


def p_serial(effect: Scatter, others: Others, blunders: list[Blunder]) -> float:
    """How often chance makes errors that follow each other so much alike; 1 where nothing tells.

    Args:
        effect: what seems to scatter; it is in the model.
        others: all rows of the fit of that model.
        blunders: all groups of them, as `judge` has them.
    """
    if effect.widens:
        return _p_of_rows(others.problem, OF_ROWS.get(effect.site, ""), blunders)
    turn = _turns(others.problem)
    return _least(_of_values(effect, others, turn)) if effect.per == "stop" else 1.0


def _turns(problem: Problem) -> dict[tuple[str, str], int]:
    """Recording and stop -> its place in the order of time."""
    named = zip(problem.sources, labels(problem.sources), strict=True)
    return {
        (of, stop): at
        for source, of in named
        for at, stop in enumerate(in_time(source.recording.stops, source.recording.time_s))
    }


def _least(series: Iterator[np.ndarray]) -> float:
    """The least p-value of some series, how many there are being paid for."""
    p = [_alike(errors) for errors in series if len(errors) >= FEWEST_IN_SERIES]
    return min(1.0, len(p) * min(p)) if p else 1.0


def drifting(problem: Problem, blunders: list[Blunder], names: Sequence[str]) -> Iterator[str]:
    """What is said where tracked poses of stops that follow each other err alike beside all that a
    search found; a sentence, or none.

    Args:
        problem: of the last fit.
        blunders: of its rows, as `judge` has them.
        names: of effects that go with time and were found; a step, say.
    """
    p = _p_of_rows(problem, "body", blunders)
    if p < ALPHA_SERIAL:
        looks = all_of(names)
        beside, mistaken = "", ""
        if names:
            beside = f"even with {looks} in the model "
            mistaken = f" Noise that is correlated in time can look like {looks}."
        yield (
            f"Tracked poses of stops that follow each other err alike {beside}(p = "
            f"{at_least(p):.1g}): something drifts, the tracker's noise is correlated in time, or "
            f"the error goes with the pose and poses follow a path.{mistaken} Sigmas may be too "
            "small; the same stops in a random order would tell."
        )


def _p_of_rows(problem: Problem, kind: str, blunders: list[Blunder]) -> float:
    return _least(_of_rows(kind, blunders, _turns(problem)))


def _of_rows(
    kind: str, blunders: list[Blunder], turn: dict[tuple[str, str], int]
) -> Iterator[np.ndarray]:
    """Errors (K, r) of each body, or each joint, in its sigmas, in the order of time; of bodies in
    the axes in which people are told, and in those of the rows."""
    found: dict[tuple[str, str, int, bool], list[tuple[int, np.ndarray]]] = {}
    for shift in (b.shift for b in blunders if b.group.kind == kind and not b.found):
        at = turn.get((shift.group.recording, shift.group.where))
        if at is not None and shift.dof == len(shift.offset):
            for R in (None,) if shift.turn is None else (None, shift.turn):
                offset, C = shift.offset, shift.covariance
                if R is not None:
                    offset, C = R.T @ offset, R.T @ C @ R
                key = shift.group.recording, shift.group.what, shift.dof, R is None
                found.setdefault(key, []).append((at, offset / np.sqrt(np.diag(C))))
    for some in found.values():
        yield np.stack([error for _, error in sorted(some, key=lambda each: each[0])])


def _of_values(
    effect: Scatter, others: Others, turn: dict[tuple[str, str], int]
) -> Iterator[np.ndarray]:
    """Values (K, r) of the stops of each recording, in their spreads, in the order of time."""
    named = zip(others.problem.terms, labels(others.problem.sources), strict=True)
    for term, label in ((t, label) for some, label in named for t in some):
        if term.effect.name == effect.name:
            known = {
                f"{term.effect.label}{stop}": at for (of, stop), at in turn.items() if of == label
            }
            sd = others.problem.variables[term.variable].sigma
            values = (others.whole.values[term.variable] / sd).reshape(len(term.effect.members), -1)
            mine = [k for k, member in enumerate(term.effect.members) if member in known]
            yield values[sorted(mine, key=lambda k: known[term.effect.members[k]])]


def _alike(errors: np.ndarray) -> float:
    """One-sided p-value of S for errors (K, r) in the order of time."""
    products = np.einsum("ki,ki->k", errors[:-1], errors[1:])
    sd = float(np.sqrt(np.square(products).sum()))
    return float(special.ndtr(-products.sum() / max(sd, 1e-300)))
