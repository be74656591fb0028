"""A rig of which nothing was measured yet: what is known of it is what paper says."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from calib.diagnosis.stand import Stand
from calib.problem import build
from calib.problem.model import Model, Source
from calib.problem.unknowns import pose_unknown
from calib.rig import load_rig
from calib.solve.estimate import Estimate
from chains.errors import InputError
from sensors.recording import RecordedStops
from sensors.reference import Reference
from sensors.stops import read_targets


def nothing_measured(folder: Path | str) -> Stand:
    """The default model of a rig, fitted to no stop at all.

    Args:
        folder: with rig.yaml and the URDF, mesh and targets.csv that there are.

    Raises:
        InputError: it is none, or it is a recording with stops.
    """
    folder = Path(folder)
    if (folder / "stops.csv").exists():
        raise InputError(
            f"{folder} is a recording with stops; fit it with 'rigcal fit', and plan for the run"
        )
    rig = load_rig(folder)
    spec = rig.reference
    mesh = Reference.read(spec.mesh, spec.faces, spec.labels) if spec and spec.mesh else None
    none = np.zeros(0)
    recording = RecordedStops(
        folder=folder,
        stops=[],
        location=none.astype(str),
        time_s=none,
        joints=np.zeros((0, len(rig.joint_names))),
        bodies={body: np.zeros((0, 7)) for body in (rig.tracker.bodies if rig.tracker else ())},
        base_guess=np.zeros((0, 7)),
        covariates={},
        targets=read_targets(folder / "targets.csv"),
        has_scan=none.astype(bool),
        rings=rig.lidar.rings if rig.lidar else None,
        joint_names=rig.joint_names,
        levels={frame: np.zeros((0, 3)) for frame in (rig.levels.frames if rig.levels else ())},
    )
    model, source = Model(), Source(rig, recording, mesh)
    problem = build([source], model)
    if rig.tracker and mesh is not None and rig.reference_frame not in problem.variables:
        problem.add(pose_unknown(rig.reference_frame, np.eye(4)))
        problem.calibration.append(rig.reference_frame)
    estimate = Estimate(
        problem=problem,
        values=dict(problem.initial),
        variables=tuple(problem.variables[name] for name in problem.calibration),
        covariance=np.zeros((0, 0)),
        associations=[],
        iterations=0,
        converged=True,
        graph=None,
        linear=None,
        seen={},
    )
    return Stand([source], model, problem, estimate)
