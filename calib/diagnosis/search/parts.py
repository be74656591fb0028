"""What of an effect explains most: all of it, or what one joint of the arm does.

Joints wear, and are wired and zeroed, one by one: an effect with parameters for each of them is
often that of one. At the price of all its parameters it would then lose against any function of
that joint, of fewer.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib.blunders.chance import log_tail
from calib.diagnosis.score import score_test
from calib.diagnosis.screen import Candidate
from calib.diagnosis.stand import Look


@dataclass(frozen=True)
class Part:
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
        return -log_tail(self.statistic / max(common, 1e-300), self.dof) - self.price


def likeliest_part(look: Look, candidate: Candidate, common: float) -> Part:
    """Of a candidate of a look all of it, or the joint of most evidence.

    Args:
        look: at which it was tested.
        candidate: which.
        common: as of `ScoreTest.evidence`.
    """
    test = candidate.test
    whole = Part(test.statistic, test.dof)
    rig = look.stand.sources[0].rig
    of = np.array([p.name.partition(".")[0] for p in candidate.effect.params(rig)])
    joints = [name for name in rig.joint_names if name in of]
    if len(of) != len(test.columns) or len(joints) < 2:
        return whole
    price = float(np.log(len(joints)))
    each = (score_test(look.named.scores, test.columns[of == name]) for name in joints)
    parts = [Part(own.statistic, own.dof, price) for own in each if own.dof]
    return max([whole, *parts], key=lambda part: part.evidence(common))
