"""What of an effect explains most: all of it, or what one joint of the arm does.

Joints wear, and are wired and zeroed, one by one: an effect with parameters for each of them is
often that of one. At the price of all its parameters it would then lose against any function of
that joint, of fewer.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from calib.diagnosis.score import evidence, score_test
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
    """Of a candidate of a look all of it, or the joint of most evidence.

    Args:
        look: at which it was tested.
        candidate: which.
        common: as of `ScoreTest.evidence`.
    """
    test = candidate.test
    whole = Explained(test.statistic, test.dof)
    rig = look.stand.sources[0].rig
    of = np.array([rig.joint_of(param.name) for param in candidate.effect.params(rig)])
    joints = np.unique(of[of != ""])
    if len(of) != len(test.columns) or len(joints) < 2:
        return whole
    score = look.named.scores.score.copy()
    score[test.columns] = test.score  # in the shape that it was tested in
    scores, price = replace(look.named.scores, score=score), float(np.log(len(joints)))
    each = (score_test(scores, test.columns[of == joint]) for joint in joints)
    parts = [Explained(own.statistic, own.dof, price) for own in each if own.dof]
    return max([whole, *parts], key=lambda part: part.evidence(common))
