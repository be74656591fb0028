"""What simpler ways would have named, from the same linearised rows.

All take the sigmas as stated. The naive F test and the lasso take every row for a fact of its own:
they know the stops' poses as unknowns, and no error of the mesh. The others project off what the
diagnosis does. The oracle, which knows the effect, is in the results of a case: the test of that
effect alone. Boosted trees would need scikit-learn, which nothing here depends on.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy import stats

from calib.diagnosis.candidates import known_effects
from calib.diagnosis.score import GAUGE, Scores, project, score_test
from calib.diagnosis.stand import Look, Stand
from calib.effects import Effect

MOST_NAMES = 4  # names that a selection goes on to
LEVEL = 0.05
PATH = np.geomspace(0.9, 0.02, 14)  # of the smallest penalty that leaves nothing
STEPS = 150

Columns = Mapping[Effect, np.ndarray]
NAMES = ("naive F with BIC", "stop-clustered", "leave-location-out", "LASSO")


def answers(look: Look) -> dict[str, list[str]]:
    """Baseline -> families that it would add, in its order."""
    scores, stand = look.named.scores, look.stand
    known = known_effects(stand.model, stand.sources, stand.carried.everywhere)
    at = {e: np.r_[scores.at[e.name]] for e in known if e.name in scores.at}
    at = {e: columns for e, columns in at.items() if score_test(scores, columns).dof}
    rows = sum(len(a.part) for a in stand.estimate.associations)
    naive = without_mesh_errors(stand, list(at))
    bare = {e: np.r_[naive.at[e.name]] for e in at}
    found = (
        forward(naive, bare, rows),
        stop_clustered(scores, at),
        leave_location_out(scores, at, look),
        lasso(naive, bare, rows),
    )
    return dict(zip(NAMES, found, strict=True))


def without_mesh_errors(stand: Stand, effects: Sequence[Effect]) -> Scores:
    """The scores as they are where no error of the mesh is an unknown; not by clusters."""
    fit = stand.estimate
    bare = replace(
        fit,
        # What the mesh's errors took on is in the residual again.
        problem=replace(fit.problem, cells={}, scans=[replace(s, cells={}) for s in fit.scans]),
    )
    linear, _, _ = replace(stand, estimate=bare).linearise(effects, silent)
    none = np.full(1, -1)
    whole = linear.gradient.sum(axis=0)[None]
    return project(replace(linear, gradient=whole, stop=none, place=none), linear.candidates)


def silent(what: str, done: int, total: int) -> None:
    """No progress is shown."""


def forward(scores: Scores, at: Columns, rows: int) -> list[str]:
    """Forward selection by BIC, rows as independent."""
    chosen, columns, before = [], np.zeros(0, int), 0.0
    while len(chosen) < MOST_NAMES:
        best, gain = None, 0.0
        for effect, own in at.items():
            if effect.family in chosen:
                continue
            found = score_test(scores, np.concatenate([columns, own]))
            net = found.statistic - before - len(own) * np.log(rows)
            if net > gain:
                best, gain = effect, net
        if best is None:
            break
        chosen.append(best.family)
        columns = np.concatenate([columns, at[best]])
        before = score_test(scores, columns).statistic
    return chosen


def stop_clustered(scores: Scores, at: Columns) -> list[str]:
    """Wald's test with stops as the clusters, Bonferroni over all; most significant first."""
    found: dict[str, float] = {}
    for effect, columns in at.items():
        whiten = score_test(scores, columns).whiten
        share = scores.by_stop[:, columns] @ whiten
        clusters = int((np.abs(share).max(axis=1) > 0).sum())
        q = whiten.shape[1]
        if 2 * q > clusters:
            continue
        score = whiten.T @ scores.score[columns]
        square = float(score @ np.linalg.pinv(share.T @ share) @ score)
        ratio = square * (clusters - q) / (q * (clusters - 1))
        p = float(stats.f.sf(ratio, q, clusters - q))
        found[effect.family] = min(p, found.get(effect.family, 1.0))
    named = [family for family, p in found.items() if p * len(at) < LEVEL]
    return sorted(named, key=found.get)


def leave_location_out(scores: Scores, at: Columns, look: Look) -> list[str]:
    """The effect that, fitted without a location, lowers the error there most, over all of them.

    Linearised; every location is taken to hold an equal part of the information.
    """
    scans = look.stand.problem.scans
    location = np.array([scan.recording.location[scan.index] for scan in scans])
    places = np.unique(location)
    gains: dict[str, float] = {}
    for effect, columns in at.items():
        share = scores.by_stop[: len(scans), columns] @ score_test(scores, columns).whiten
        by_place = np.stack([share[location == p].sum(axis=0) for p in places])
        n = len(places)
        theta = (by_place.sum(axis=0) - by_place) * n / (n - 1)
        gain = float(np.sum(2 * theta * by_place - theta**2 / n))
        gains[effect.family] = max(gain, gains.get(effect.family, -np.inf))
    best = max(gains, key=gains.get)
    return [best] if gains[best] > 0 else []


def lasso(scores: Scores, at: Columns, rows: int) -> list[str]:
    """The lasso over all candidates' columns, its penalty by BIC; what explains most first."""
    columns = np.concatenate(list(at.values()))
    family = np.repeat([e.family for e in at], [len(c) for c in at.values()])
    seen = np.diag(scores.information)[columns] > GAUGE * scores.felt[columns]
    columns, family = columns[seen], family[seen]
    size = np.sqrt(np.diag(scores.information)[columns])
    gram = scores.information[np.ix_(columns, columns)] / np.outer(size, size)
    score = scores.score[columns] / size
    steepest = float(np.linalg.eigvalsh(gram)[-1])
    b, best, least = np.zeros(len(score)), np.zeros(len(score)), 0.0
    for penalty in PATH * np.abs(score).max():
        b = _shrunk(gram, score, penalty, steepest, b)
        cost = b @ gram @ b - 2 * score @ b + np.log(rows) * np.count_nonzero(b)
        if cost < least:
            best, least = b, cost
    explains = {f: float((best * score)[family == f].sum()) for f in np.unique(family[best != 0])}
    return sorted(map(str, explains), key=lambda f: -explains[f])


def _shrunk(
    gram: np.ndarray, score: np.ndarray, penalty: float, steepest: float, b: np.ndarray
) -> np.ndarray:
    """Minimum of ``b'Gb / 2 - s'b + penalty |b|`` from a start (Beck and Teboulle 2009)."""
    ahead, t = b, 1.0
    for _ in range(STEPS):
        moved = ahead - (gram @ ahead - score) / steepest
        after = np.sign(moved) * np.maximum(np.abs(moved) - penalty / steepest, 0.0)
        later = (1 + np.sqrt(1 + 4 * t * t)) / 2
        ahead, b, t = after + (t - 1) / later * (after - b), after, later
    return b
