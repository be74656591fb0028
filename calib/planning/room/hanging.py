"""Plans of targets: where to hang the next ones, and what will be known with them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from calib.linear.parallel import one_blas_thread
from calib.planning import Planner, planner_without_places, silent, written
from calib.planning.criteria import chosen
from calib.planning.purpose import ALL, RELIABILITY, SCATTER, WORKSPACE, Purpose
from calib.planning.room.targets import each_target, hanging_places, known_with
from calib.planning.worth import Known, criterion
from calib.problem.unknowns import Key
from calib.runs.run import Run
from calib.solve.fit import Progress
from chains.errors import InputError
from sensors.reference import Hits

# Mean of the unit normals beside an edge, above which the surface goes on: they turn by less than
# 20 degrees, a choice for a drawing.
TURNS_LESS = float(np.cos(np.radians(10.0)))


@dataclass(frozen=True)
class TargetPlan:
    """Targets to hang, and what they are worth.

    Args:
        run: the folder of the run, or of the rig.
        purpose: what they were chosen for.
        spheres_m: (n, 3) centre of each sphere, in the reference's frame.
        keys, units: (P,) of the parameters of the calibration.
        now, after: what is known without and with them.
        candidates: how many places they were chosen among.
        hung_m: (M, 3) centre of each sphere that hangs already.
        room_m: (E, 2, 3) edges of the mesh; none where there is none.
    """

    run: Path
    purpose: Purpose
    spheres_m: np.ndarray
    keys: Sequence[Key]
    units: Sequence[str]
    now: Known
    after: Known
    candidates: int
    hung_m: np.ndarray
    room_m: np.ndarray

    @property
    def targets(self) -> list[dict[str, Any]]:
        """A row for each: its name, and x, y, z of its sphere, m, in the reference's frame."""
        each = enumerate(self.spheres_m.tolist(), start=1)
        return [{"target": f"P{k}", "x": x, "y": y, "z": z} for k, (x, y, z) in each]

    def columns(self) -> dict[str, Sequence]:
        """The same as columns (n,)."""
        rows = self.targets
        return {name: [row[name] for row in rows] for name in ("target", "x", "y", "z")}

    def document(self) -> dict[str, Any]:
        """As ``--json`` prints it."""
        numbers = zip(self.now.sigma.tolist(), self.after.sigma.tolist(), strict=True)
        rows = zip(self.keys, self.units, numbers, strict=True)
        return {
            "run": str(self.run),
            **self.purpose.document(),
            "candidates": self.candidates,
            "targets": self.targets,
            "sigma": {k.name: {"unit": u, "now": now, "after": to} for k, u, (now, to) in rows},
            "weak_directions": {"now": list(self.now.weak), "after": list(self.after.weak)},
        }


@one_blas_thread
def plan_targets(
    run: Run | Path | str,
    targets: int,
    purpose: str | None = None,
    region: Sequence[float] | None = None,
    candidates: int = 500,
    seed: int = 0,
    out: Path | str | None = None,
    progress: Progress = silent,
) -> TargetPlan:
    """Where the next targets should hang.

    Args:
        run: a fitted run; or the folder of a rig of which nothing was measured yet.
        targets: how many.
        purpose: what they are for, as of `calib.plan`; by default all of the calibration.
        region: x and y of two corners, m, in the reference's frame, between which they may hang;
            without it in the box in which the tracker saw anything.
        candidates: how many random places they are chosen among.
        seed: of these.
        out: a CSV file to write, a row for each: ``target``, and x, y, z of its sphere.
        progress: called with what is being done, and how far it is.

    Raises:
        InputError: as of `calib.plan`; or the rig has no targets, or they have no place.
    """
    if purpose in (RELIABILITY, SCATTER, WORKSPACE):
        raise InputError(f"--for {purpose}: it is about stops, of which targets tell nothing")
    if targets < 1 or candidates < targets:
        raise InputError(f"{targets} targets out of {candidates} candidates: give at least 1")

    def made() -> TargetPlan:
        planner = planner_without_places(run, purpose or ALL, None, progress)
        rng = np.random.default_rng(seed)
        places = hanging_places(planner.scene, region, candidates, rng, planner.cameras_m)
        if len(places) < targets:
            raise InputError(f"only {len(places)} places of so many drawn are clear of the mesh")
        return _planned(planner, places, targets)

    return written(made, run, out, "targets", "FILE.csv")


def _planned(planner: Planner, places: np.ndarray, targets: int) -> TargetPlan:
    """As `plan_targets`, and nothing is written."""
    scene = planner.scene
    known, each = each_target(scene, places)
    by, hung = criterion(scene, planner.aim, known), scene.source.recording.targets
    mesh = scene.source.reference
    best = chosen(by, each, targets, partial(planner.progress, "choosing"))
    some = places[best]
    return TargetPlan(
        run=planner.folder,
        purpose=planner.aim,
        spheres_m=some,
        keys=planner.keys,
        units=planner.units,
        now=planner.now,
        after=planner.known(known_with(scene, some), 0),
        candidates=len(places),
        hung_m=np.zeros((0, 3)) if hung is None else hung.faro_m,
        room_m=np.zeros((0, 2, 3)) if mesh is None else _edges(mesh),
    )


def _edges(mesh: Hits) -> np.ndarray:
    """Edges (E, 2, 3) of a mesh at which its surface turns, or ends: a room as it is drawn."""
    corners = mesh.triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    pairs, back = np.unique(np.sort(corners, axis=1), axis=0, return_inverse=True)
    a, b, c = np.moveaxis(mesh.vertices_m[mesh.triangles], 1, 0)
    normal = np.cross(b - a, c - a)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    total = np.zeros((len(pairs), 3))
    np.add.at(total, back.ravel(), np.repeat(normal, 3, axis=0))
    flat = np.linalg.norm(total, axis=1) > TURNS_LESS * np.bincount(back.ravel())
    two = np.bincount(back.ravel()) > 1
    return mesh.vertices_m[pairs[~(flat & two)]]
