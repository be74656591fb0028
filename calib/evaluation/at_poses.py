"""How far off an arm is at any pose, and how well that is known: ``rigcal evaluate RUN --at``.

The error is where the arm truly brings a body less where the arm as drawn would, both standing and
holding it as fitted. Its sigma is that of the true place under the run's covariance, the place of
the base included where nothing else tells it. It covers what is in the model.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from calib import outputs
from calib.effects import FrameOffset
from calib.evaluation.poses import loads_felt, pose_columns, to_give
from calib.forward import Placed, place
from calib.linear.parallel import one_blas_thread
from calib.problem import Problem
from calib.results.intervals import Intervals, intervals
from calib.results.reach import (
    Beyond,
    bodies_beyond,
    body_beyond,
    columns_at,
    far_beyond,
    joint_range,
    placed,
)
from calib.runs.asked.factors import estimate_of, prior_of
from calib.runs.reopen import model_of
from calib.runs.run import Run
from calib.solve.estimate import Estimate
from calib.solve.fit import Progress, shapes_freed
from chains import se3
from chains.errors import InputError, NoColumnError
from sensors.stops import CsvTable, write_columns

AXES = ("x", "y", "z")
WORKSPACE_POSES = 800  # that are drawn: enough to see where an arm is off, in a picture of 10 cm


@dataclass(frozen=True)
class Predicted:
    """What is predicted of a body at K poses, in the axes of the base, or else of the tracker.

    Args:
        body: whose place.
        frame: in whose axes, a tracked body before the joints, or the tracker's frame.
        names: of the poses.
        place_m: (K, 3) where it truly is, in the axes of the arm's foot.
        error: (K, 6) rotation rad, then m: true less drawn.
        covariance: (K, 6, 6) of the true place.
        warnings: what is to stand above everything that is shown of the run.
        beyond: joint -> at how many poses it is beyond all angles that were measured.
    """

    body: str
    frame: str
    names: Sequence[str]
    place_m: np.ndarray
    error: np.ndarray
    covariance: np.ndarray
    warnings: Sequence[str] = ()
    beyond: Mapping[str, int] = field(default_factory=dict)

    @property
    def error_m(self) -> np.ndarray:
        """(K,) how far off the place is as drawn."""
        return np.linalg.norm(self.error[:, 3:], axis=1)

    @property
    def sigma_m(self) -> np.ndarray:
        """(K,) of the place: root mean square over directions in space, added."""
        return np.sqrt(np.trace(self.covariance[:, 3:, 3:], axis1=1, axis2=2))

    def columns(self) -> dict[str, Any]:
        """As the CSV holds it, a row a pose."""
        sigma = np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2))
        out: dict[str, Any] = {"pose": list(self.names)}
        out["error_mm"] = 1e3 * self.error_m
        out["sigma_mm"] = 1e3 * self.sigma_m
        for name, values in (("error", self.error), ("sigma", sigma)):
            out |= {f"{name}_{a}_mm": 1e3 * values[:, 3 + i] for i, a in enumerate(AXES)}
            out |= {f"{name}_r{a}_mrad": 1e3 * values[:, i] for i, a in enumerate(AXES)}
        return out

    def document(self) -> dict[str, Any]:
        """In short, as ``--json`` prints it."""
        told = {"error_mm": self.error_m, "sigma_mm": self.sigma_m}
        return {
            "warnings": list(self.warnings),
            "body": self.body,
            "frame": self.frame,
            "poses": len(self.names),
            "beyond_measured": dict(self.beyond),
            **{n: {"mean": 1e3 * v.mean(), "max": 1e3 * v.max()} for n, v in told.items()},
        }


@one_blas_thread
def evaluate_at(
    run: Run,
    poses: Path | str,
    out: Path | str | None = None,
    progress: Progress = lambda what, done, total: None,
    body: str | None = None,
) -> Predicted:
    """Predict the arm's error at poses of a CSV file.

    Args:
        run: of an arm and a tracker.
        poses: a row a pose: `stop`, the joints by name, and the covariates that effects ask for.
        out: the CSV file to write; none where None.
        progress: called with what is being done, and how far it is.
        body: whose place, of the tracked bodies that the arm carries; the last of them where None.

    Raises:
        InputError: the file lacks a joint or a covariate, or no tracked body hangs from the arm, or
            none of this name.
    """
    estimate = estimate_of(run, progress)
    problem = estimate.problem
    if not (there := bodies_beyond(problem)):
        raise InputError(
            f"{run.folder}: no tracked body hangs from an arm in its recordings, so there is no "
            f"place to predict"
        )
    beyond = body_beyond(problem, body)
    if beyond is None:
        raise InputError(
            f"the arm of {run.folder} carries no body '{body}', but: {', '.join(there)}"
        )
    if not says_where_the_base_is(problem):
        raise InputError(
            f"{run.folder}: the base moves and no body on it is tracked, so nothing tells where it "
            f"is at these poses"
        )
    told = _known(run, estimate, progress)
    read = _read(Path(poses), problem)
    try:
        found = _predicted(run, beyond, *told, *read)
    except NoColumnError as error:
        raise InputError(
            f"{poses}: an effect of the model looks at '{error.column}'; add the column "
            f"{to_give(error.column)}, with a value for each pose"
        ) from None
    if out is not None:
        if Path(out).suffix != ".csv":
            raise InputError(f"{out}: the poses are written as a table; give FILE.csv")
        with outputs.file(out, [run.folder, *run.inputs, poses]) as file:
            write_columns(file, found.columns())
    source = problem.sources[0]
    outside = far_beyond(source.recording.joints[beyond.stops], read[1]).sum(axis=0)
    counts = zip(source.rig.joint_names, outside.tolist(), strict=True)
    return replace(found, beyond={name: count for name, count in counts if count})


def says_where_the_base_is(problem: Problem) -> bool:
    """Whether a body that the arm carries can be placed at poses that were not measured: from
    another before the joints, or where the base never moves."""
    beyond = body_beyond(problem)
    return beyond is not None and (beyond.base or problem.sources[0].rig.moves == "never")


def _known(run: Run, estimate: Estimate, progress: Progress) -> tuple[Estimate, Intervals]:
    """The estimate with shapes among its unknowns, and the intervals of all, as the run reports
    them."""
    freed = shapes_freed(estimate, model_of(run), prior_of(run, estimate.problem))
    wider = run.summary["sigmas_widened_by"], run.summary.get("cad_widened_by", 1.0)
    return freed, intervals(freed, progress).at_least(*wider)


def _predicted(
    run: Run,
    beyond: Beyond,
    estimate: Estimate,
    known: Intervals,
    names: Sequence[str],
    joints: np.ndarray,
    columns: Mapping[str, np.ndarray],
) -> Predicted:
    """Where the arm of the first recording truly brings a tracked body, and as drawn, at K poses
    with these joints (K, J) and covariates (K,); see the module."""
    problem, rig = estimate.problem, estimate.problem.sources[0].rig
    stops = place(rig, problem.terms[0], joints, columns, beyond.root, None)
    true = placed(stops, beyond.body, beyond.base, estimate.values)
    bends = {t.variable for t in problem.terms[0] if not isinstance(t.effect, FrameOffset)}
    still = {name: 0 * v if name in bends else v for name, v in estimate.values.items()}
    drawn = placed(stops, beyond.body, beyond.base, still)
    T_base = placed(stops, rig.arm_base, beyond.base, estimate.values).T
    return Predicted(
        body=beyond.body,
        frame=beyond.base or rig.world,
        names=names,
        place_m=(se3.inverse(T_base) @ true.T)[:, :3, 3],
        error=_apart(drawn.T, true.T),
        covariance=_covariance(true, known.together(estimate, list(true.d))),
        warnings=run.before_use,
    )


def over_workspace(
    run: Run,
    estimate: Estimate,
    progress: Progress = lambda what, done, total: None,
) -> tuple[Predicted, Predicted]:
    """The same at poses that were measured, and at joints drawn over all that they can turn, where
    all else is as it was at one of those.

    Args:
        run: as fitted, estimate: of it; the arm is that of its first recording.
        progress: called with what is being done, and how far it is.
    """
    problem = estimate.problem
    source, beyond = problem.sources[0], body_beyond(problem)
    stops = beyond.stops
    rng, measured = np.random.default_rng(0), source.recording.joints
    some = np.sort(rng.choice(stops, min(len(stops), WORKSPACE_POSES), replace=False))
    at_stop = rng.choice(stops, WORKSPACE_POSES)
    drawn = rng.uniform(
        *joint_range(source.rig, measured[stops]), (len(at_stop), measured.shape[1])
    )
    told, found = _known(run, estimate, progress), []
    for at, joints in ((some, measured[some]), (at_stop, drawn)):
        columns = columns_at(source, at, joints)
        names = [source.recording.stops[i] for i in at.tolist()]
        found.append(_predicted(run, beyond, *told, names, joints, columns))
    return found[0], found[1]


def _read(path: Path, problem: Problem) -> tuple[list[str], np.ndarray, dict[str, np.ndarray]]:
    """Names, joints (K, J) and per-stop covariates of a table of poses."""
    if not path.is_file():
        raise InputError(f"{path} does not exist; give a table with a row for every pose")
    source = problem.sources[0]
    table = CsvTable(path, key="stop", text=("location",))
    names = table.names()
    joints, times = table.joints(source.rig.joint_names), table.times("time_s")
    felt = loads_felt(source, [term.effect for term in problem.terms[0]])
    try:
        return names, joints, pose_columns(source, joints, table.rest(), felt, times)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def _apart(drawn: np.ndarray, true: np.ndarray) -> np.ndarray:
    """(K, 6) what brings the drawn pose to the true one: a turn, rad, and a shift, m, in the axes
    of the frame that both are in."""
    turn = se3.so3_log(true[:, :3, :3] @ drawn[:, :3, :3].mT)
    return np.hstack([turn, true[:, :3, 3] - drawn[:, :3, 3]])


def _covariance(true: Placed, covariance: np.ndarray) -> np.ndarray:
    """(K, 6, 6) of the true poses, in the same axes."""
    R, d = true.T[:, :3, :3], true.by(true.d)
    d = np.concatenate([R @ d[:, :3], R @ d[:, 3:]], axis=1)
    return d @ covariance @ d.mT
