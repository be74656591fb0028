"""The factor graph of a run, as its fit left it."""

from __future__ import annotations

from calib.linear.parallel import one_blas_thread
from calib.problem import Problem
from calib.problem.prior import JointPrior
from calib.recalibration.prior import earlier
from calib.results.outstanding import freedoms
from calib.runs.reopen import problem_of, reopened, start_of, state_of
from calib.runs.run import Run, solution_digest
from calib.solve.estimate import Estimate
from calib.solve.fit import Progress, resume
from calib.solve.graph import FactorGraph
from chains.errors import InputError


@one_blas_thread
def graph_of(run: Run, progress: Progress = lambda what, done, total: None) -> FactorGraph:
    """The factor graph of a run at its optimum, for those who go on in GTSAM.

    Surfaces, and what is of one stop alone (where the rig stands, what its encoders misreport), are
    eliminated: with them the graph would have thousands of unknowns.

    Args:
        run: the run; its recordings are read again.
        progress: called with what is being done, how many stops are done, and of how many.

    Raises:
        InputError: a recording is not where or what it was, or the run is of an earlier version.
    """
    return estimate_of(run, progress).handed_out()


def estimate_of(run: Run, progress: Progress = lambda what, done, total: None) -> Estimate:
    """The estimate of a run as its fit left it, linearised there; arguments as of `graph_of`."""
    sources = reopened(run)
    problem = problem_of(run, sources)
    state_of(run, problem)  # or it would be linearised elsewhere, unseen
    start, prior = start_of(run, sources), prior_of(run, problem)
    return resume(problem, start, progress, run.converged, prior, whole=True)


def prior_of(run: Run, problem: Problem) -> JointPrior | None:
    """What stood for CAD in a run's fit, less sure of what had moved; None where CAD did.

    Raises:
        InputError: the earlier run is gone, or has changed since.
    """
    if run.prior is None:
        return None
    before = Run.open(run.prior)
    if run.model.get("prior_sha256") not in (None, solution_digest(before.folder)):
        raise InputError(
            f"{before.folder} has changed since {run.folder} was fitted from it; fit that again"
        )
    return earlier(problem, before.solution, before.rests_on).loosened(freedoms(run.summary))
