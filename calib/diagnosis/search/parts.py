"""What of an effect explains most: all of it, or what one joint of the arm does, or a few; and what
structure would explain in place of names.

Joints wear, and are wired and zeroed, one by one: an effect with parameters for each of them is
often that of one or two. At the price of all its parameters it would then lose against any function
of these joints, of fewer.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from math import comb

import numpy as np

from calib.diagnosis.score import Scores, evidence, explained
from calib.diagnosis.screen import Candidate
from calib.diagnosis.stand import Look


@dataclass(frozen=True)
class Explained:
    """What some parameters of an effect explain.

    Args:
        statistic: in squared sigmas.
        dof: how many directions they have.
        price: log of how many such parts were looked at.
    """

    statistic: float
    dof: int
    price: float = 0.0

    def evidence(self, common: float) -> float:
        """As of `ScoreTest.evidence`, less the price."""
        return evidence(self.statistic, self.dof, common) - self.price

    def log_score(self, common: float) -> float:
        """By how much they are expected to raise the log-likelihood of rows that they are not
        fitted to: half of what they explain, less one for each (Akaike 1974; leaving rows out gives
        the same where there are many: Stone 1977, JRSS B 39). `common` is the rows' inflation."""
        return self.statistic / max(common, 1e-300) / 2.0 - self.dof


def likeliest_part(look: Look, candidate: Candidate, common: float) -> Explained:
    """Of a candidate of a look all of it, or the joints of most evidence: that which has most by
    itself, and with it one by one those that add most.

    Args:
        look: at which it was tested.
        candidate: which.
        common: as of `ScoreTest.evidence`.
    """
    test = candidate.test
    whole = Explained(test.statistic, test.dof)
    rig = look.stand.sources[0].rig
    of = np.array([param.joint for param in candidate.effect.params(rig)])
    joints = np.unique(of[of != ""]).tolist()
    if len(of) != len(test.columns) or len(joints) < 2:
        return whole
    score = look.named.scores.score.copy()
    score[test.columns] = test.score  # in the shape that it was tested in
    scores, count = replace(look.named.scores, score=score), len(joints)
    found, taken = [whole], []
    while len(joints) > 1:
        price = float(np.log(comb(count, len(taken) + 1)))
        each = [_explained(scores, test.columns[np.isin(of, [*taken, j])], price) for j in joints]
        best = int(np.argmax([part.evidence(common) if part.dof else -np.inf for part in each]))
        found, taken = [*found, each[best]], [*taken, joints.pop(best)]
    return max((p for p in found if p.dof), key=lambda part: part.evidence(common), default=whole)


def in_place(
    explained: float, before: Look, after: Look, common: float
) -> Iterator[tuple[Candidate, float]]:
    """Structure and its evidence in place of names: it explains no more than these do, and what
    they leave it.

    Args:
        explained: by the names, in squared sigmas.
        before, after: the looks without them and with them.
        common: as of `ScoreTest.evidence`.
    """
    left = {c.effect.family: c.test.statistic for c in after.unnamed.candidates}
    for candidate in before.unnamed.candidates:
        most = explained + left.get(candidate.effect.family, np.inf)
        statistic = min(candidate.test.statistic, most)
        yield candidate, evidence(statistic, candidate.test.dof, common)


def _explained(scores: Scores, columns: np.ndarray, price: float) -> Explained:
    """What some columns explain."""
    whiten, statistic = explained(scores, columns)
    return Explained(statistic, whiten.shape[1], price)
