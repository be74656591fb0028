"""Where a room is, of which nothing but its scans tells that: neither targets nor a guess.

A fit from an earlier run begins where that had the room. Where the tracker, or the scanner, was set
up anew since, scans meet other walls than they saw, and a fit that begins there ends there.
"""

from __future__ import annotations

import numpy as np

from calib.problem.problem import Problem
from calib.solve.otherwise.rooms import JUDGED_BY, LAID_BY, NARROWED_M, LaidScans, laid, tied
from calib.solve.otherwise.sampled import Values, asked, sampled_by_recording
from chains import se3

TURNED_BY_DEG = 15.0  # between starts about the vertical, each of which is right within half of it
LAID_ANEW = 4  # of these starts, the best: a choice
# Share of a scan's beams within which a room's middle is that of what they see: a choice, so that
# what they see through a door does not count.
MIDDLE = (0.02, 0.98)
# Share of its beams by which a scan fits better elsewhere, on average, from which the room is
# there: where it had stayed they fitted 0.004 better, 60 mm off 0.2, and metres or half a turn off
# 0.3 to 1.0. What is 20 mm off, the fit finds by itself.
FITS_BETTER = 0.05


def room_elsewhere(problem: Problem, values: Values, frame: str) -> np.ndarray | None:
    """T_world_reference (4, 4) of a frame of which only scans tell where it is, where these fit the
    mesh notably better than at a state; None where they do not, or something else tells. It may be
    anywhere, and turned about its vertical by anything.

    Args:
        problem: with scans.
        values: the state.
        frame: of the mesh.
    """
    sources = [s for s in problem.sources if s.rig.reference_frame == frame]
    if any(tied(s) or s.recording.base_guess is not None for s in sources):
        return None
    tracked = {body.stops.root for body in problem.bodies}
    every = (each for some in sampled_by_recording(problem, values).values() for each in some)
    scans = [e for e in every if e.scan.stops.reference == frame and e.scan.stops.root in tracked]
    if not scans:
        return None
    scans = asked([each for each in scans if each.scan.room == scans[0].scan.room])
    together = np.zeros(len(scans), int)  # a tracker ties them to each other
    few, many = (LaidScans.of(scans, together, most) for most in (LAID_BY, JUDGED_BY))
    starts, costs = [], []
    for degrees in np.arange(0.0, 360.0, TURNED_BY_DEG):
        turned = few.about_middle(np.radians([0.0, 0.0, degrees, 0.0, 0.0, 0.0]))
        starts.append(few.centred(turned, MIDDLE))
        costs.append(few.cost(few.alike(starts[-1]), NARROWED_M[0]).mean())
    where, best = None, many.cost(many.alike(np.eye(4)), NARROWED_M[-1]).mean() - FITS_BETTER
    for start in (np.eye(4), *(starts[i] for i in np.argsort(costs)[:LAID_ANEW])):
        T, cost = laid(few, many, start)
        if cost.mean() < best:
            where, best = T[0], cost.mean()
    return None if where is None else values[frame] @ se3.inverse(where)
