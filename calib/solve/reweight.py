"""Robust weights of what is no beam: bodies that are seen, targets, joint readings and paper.

A fit first takes all of them at their sigmas. If a group of rows is then further off than chance
puts one, it gets Huber's weight, and the fit goes on (iteratively reweighted least squares). So
one wild row has a bounded influence, and where nothing is wrong no number changes. Beams have
weights of their own, in `calib.residuals.robust`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from calib.problem.problem import Block, Problem
from calib.problem.spread import spread_of, with_spread
from calib.problem.unknowns import Role, Unknown
from calib.residuals.robust import huber_weight
from calib.residuals.seen import BodiesTogether, SeenBody
from calib.residuals.targets import TARGET_PARTS, HangingTarget

SETTLED_WEIGHT = 0.01  # relative change of a weight, and so of how hard a group pulls


class _Norms(NamedTuple):
    """Of some groups of one kind: what they belong to, their norms, and how many rows each has."""

    kind: str
    owner: Block | Unknown
    norm: np.ndarray
    dof: np.ndarray


def reweighted(
    problem: Problem,
    values: Mapping[str, np.ndarray],
    held: frozenset[str],
    settled: float = SETTLED_WEIGHT,
) -> Problem:
    """The problem with the weights that its residuals at a state ask for; itself, where these are
    what it has.

    Args:
        problem: as fitted.
        values: the state.
        held: unknowns without a prior of their own.
        settled: relative change of a weight that is none.
    """
    kinds: dict[str, list[_Norms]] = {}
    for found in (*_of_blocks(problem.blocks, values), *_of_priors(problem, values, held)):
        kinds.setdefault(found.kind, []).append(found)
    weights: dict[int, np.ndarray] = {}
    for some in kinds.values():
        norm, dof = (np.concatenate([getattr(s, name) for s in some]) for name in ("norm", "dof"))
        split = np.cumsum([len(s.norm) for s in some])[:-1]
        for each, weight in zip(some, np.split(huber_weight(norm, dof), split), strict=True):
            weights[id(each.owner)] = weight
    blocks = [_weighted(b, weights.get(id(b)), settled) for b in problem.blocks]
    unknowns = problem.variables.items()
    variables = {n: _weighted(v, weights.get(id(v)), settled) for n, v in unknowns}
    same = all(a is b for a, b in zip(blocks, problem.blocks, strict=True))
    if same and all(variables[n] is v for n, v in problem.variables.items()):
        return problem
    return replace(problem, blocks=blocks, variables=variables)


def weighted_as(problem: Problem, other: Problem) -> Problem:
    """A problem with the weights, and the spreads, of another of the same recordings."""
    of = {b.groups: b.weight for b in other.blocks}
    blocks = [replace(b, weight=of.get(b.groups, b.weight)) for b in problem.blocks]
    known = other.variables
    variables = {
        n: replace(v, weight=known[n].weight) if n in known else v
        for n, v in problem.variables.items()
    }
    weighted = replace(problem, blocks=blocks, variables=variables)
    return with_spread(weighted, spread_of(other))


def unweighted(block: Block) -> Block:
    """A block as its sigmas have it, bodies that were set aside as well; parts of targets that were
    left out stay so."""
    if getattr(block, "weight", None) is None:
        return block
    if isinstance(block, SeenBody):
        return replace(block, weight=None)
    whole = np.where(block.weight > 0, 1.0, 0.0)
    return replace(block, weight=None if whole.all() else whole)


def _of_blocks(blocks: Sequence[Block], values: Mapping[str, np.ndarray]) -> Iterator[_Norms]:
    plain = {id(b): unweighted(b) for b in blocks}
    for block in blocks:
        if isinstance(block, HangingTarget):
            rows = plain[id(block)].evaluate(values, False)[0].reshape(len(TARGET_PARTS), -1)
            dof = np.where(
                np.arange(len(TARGET_PARTS)) == TARGET_PARTS.index("upper"), 2, 3
            )  # across its rod
            yield _Norms("target", block, np.linalg.norm(rows, axis=1), dof)
    bodies = [b for b in blocks if isinstance(b, SeenBody)]
    owner = {id(plain[id(b)]): b for b in bodies}
    for together in BodiesTogether.of([plain[id(b)] for b in bodies]):
        for block, residual in zip(together.blocks, together.residuals(values), strict=True):
            rows = residual.reshape(len(block.measured), -1)
            dof = np.full(len(rows), rows.shape[1])
            kind = f"{block.kind} {block.body}"
            yield _Norms(kind, owner[id(block)], np.linalg.norm(rows, axis=1), dof)


def _of_priors(
    problem: Problem, values: Mapping[str, np.ndarray], held: frozenset[str]
) -> Iterator[_Norms]:
    """Of joint readings at a stop, and of all values on paper of one frame or effect."""
    for name, unknown in problem.variables.items():
        known = unknown.role is Role.JOINTS or name in problem.calibration
        if known and unknown.kind == "vector" and name not in held:
            norm = np.linalg.norm((values[name] - unknown.mean) / unknown.sigma)
            kind = "joints" if unknown.role is Role.JOINTS else "paper"
            yield _Norms(kind, unknown, np.array([norm]), np.array([unknown.dim]))


def _weighted(owner: Block | Unknown, weight: np.ndarray | None, settled: float) -> Block | Unknown:
    """With another weight, if it differs."""
    if weight is None:
        return owner
    now = np.ones(len(weight)) if owner.weight is None else np.atleast_1d(owner.weight)
    weight = np.where(now > 0, weight, 0.0)  # what was left out, or set aside, stays so
    if (np.abs(weight - now) <= settled * now).all():
        return owner
    return replace(owner, weight=float(weight[0]) if isinstance(owner, Unknown) else weight)
