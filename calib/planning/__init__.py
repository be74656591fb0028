"""What to measure next: the stops that tell most, and what will be known after them.

Candidates are random poses of the arm where its base stood. What each of them would tell is
linearised at a run's estimate by the residuals of the fit (`stops`, `information`), and those are
chosen that serve a purpose best (`purpose`, `criteria`). What is told of the chosen ones is one
linearisation of all stops together, measured and planned (`scene`).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from calib import outputs
from calib.diagnosis.weak import hardly_known
from calib.linear.parallel import one_blas_thread
from calib.planning.criteria import (
    Apart,
    Criterion,
    Variance,
    Volume,
    chosen,
    indices,
    information_left,
    smallest,
)
from calib.planning.information import Information
from calib.planning.path import in_order_of_path
from calib.planning.poses import reachable, where_it_stood
from calib.planning.purpose import Purpose, purpose_of
from calib.planning.scene import Scene
from calib.planning.stops import Poses
from calib.problem.unknowns import Role
from calib.runs.diagnose import stand_of
from calib.runs.run import Run
from calib.solve.fit import Progress
from chains.errors import InputError
from sensors.stops import write_columns

__all__ = ["Plan", "plan"]

CANDIDATES = 500  # poses that are looked at; see docs/plan.md for what more of them gain
STOPS = 5  # that are planned where nobody says how many


@dataclass(frozen=True)
class Known:
    """What is known of a calibration, with some stops.

    Args:
        stops: how many.
        sigma: (P,) of each parameter, m or rad.
        smallest: effect -> root mean square size of its parameters, from which it is found beside
            the model, and beside the model and its rivals.
        weak: the directions that are hardly determined, as diagnosis.json has them.
        indices: the observability indices.
    """

    stops: int
    sigma: np.ndarray
    smallest: Mapping[str, tuple[float, float]]
    weak: Sequence[Mapping[str, Any]]
    indices: Mapping[str, float]


@dataclass(frozen=True)
class Plan:
    """Stops to measure next, and what they are worth.

    Args:
        run: the run's folder.
        purpose: what they were chosen for.
        poses: of the stops, in the order in which to drive to them.
        joints: (J,) name and kind, revolute or prismatic, of each.
        names, units: (P,) of the parameters of the calibration.
        now, after: what is known without and with them; sigmas as a run reports them.
        effect_units: of the effects in `Known.smallest`.
        candidates: how many poses they were chosen among.
    """

    run: Path
    purpose: Purpose
    poses: Poses
    joints: Sequence[tuple[str, str]]
    names: Sequence[str]
    units: Sequence[str]
    now: Known
    after: Known
    effect_units: Mapping[str, str]
    candidates: int

    @property
    def _names(self) -> list[str]:
        return [name for name, _ in self.joints]

    @property
    def stops(self) -> list[dict[str, Any]]:
        """A row for each stop: its location, and the joints by name, rad or m."""
        pairs = zip(self.poses.location.tolist(), self.poses.joints.tolist(), strict=True)
        return [
            {"location": str(at), **dict(zip(self._names, joints, strict=True))}
            for at, joints in pairs
        ]

    def document(self) -> dict[str, Any]:
        """As ``--json`` prints it."""
        return {
            "run": str(self.run),
            **self.purpose.document(),
            "candidates": self.candidates,
            "stops": self.stops,
            "number": {"now": self.now.stops, "after": self.after.stops},
            "sigma": {
                name: {"unit": unit, "now": now, "after": after}
                for name, unit, now, after in zip(
                    self.names,
                    self.units,
                    self.now.sigma.tolist(),
                    self.after.sigma.tolist(),
                    strict=True,
                )
            },
            "smallest_detectable": {
                name: {
                    "unit": self.effect_units[name],
                    "beside_model": _now_after(self, name, 0),
                    "beside_rivals": _now_after(self, name, 1),
                }
                for name in self.now.smallest
            },
            "weak_directions": {"now": list(self.now.weak), "after": list(self.after.weak)},
            "observability": {"now": dict(self.now.indices), "after": dict(self.after.indices)},
        }

    def columns(self) -> dict[str, np.ndarray]:
        """The stops as columns (n,): ``location``, and the joints by name."""
        joints = dict(zip(self._names, self.poses.joints.T, strict=True))
        return {"location": self.poses.location.astype(str), **joints}


def _now_after(plan: Plan, name: str, which: int) -> dict[str, float | None]:
    sizes = {"now": plan.now.smallest[name][which], "after": plan.after.smallest[name][which]}
    return {when: size if np.isfinite(size) else None for when, size in sizes.items()}


@one_blas_thread
def plan(
    run: Run,
    stops: int = STOPS,
    purpose: str | None = None,
    candidates: int = CANDIDATES,
    seed: int = 0,
    out: Path | str | None = None,
    progress: Progress = lambda what, done, total: None,
) -> Plan:
    """The stops to measure next.

    Args:
        run: a fitted run, with its recordings where they were; stops are planned for the first.
        stops: how many.
        purpose: what they are for; see `calib.planning.purpose.purpose_of`.
        candidates: how many random poses they are chosen among.
        seed: of these.
        out: a CSV file to write, a row for each stop: ``location``, and the joints by name.
        progress: called with what is being done, and how far it is.

    Raises:
        InputError: the recordings are not what they were; nothing goes by a name in `purpose`; the
            rig has no arm, or scans without a mesh; or there are fewer poses than stops.
    """
    if stops < 1 or candidates < stops:
        raise InputError(
            f"{stops} stops out of {candidates} candidates: give at least 1, and no more"
        )
    if out is None:
        return _planned(run, stops, purpose, candidates, seed, progress)
    if Path(out).suffix != ".csv":
        raise InputError(f"{out}: the stops are written as a table; give FILE.csv")
    with outputs.file(out, [run.folder, *run.inputs]) as file:
        found = _planned(run, stops, purpose, candidates, seed, progress)
        write_columns(file, found.columns())
    return found


def _planned(
    run: Run, stops: int, purpose: str | None, candidates: int, seed: int, progress: Progress
) -> Plan:
    """As `plan`, and nothing is written."""
    stand = stand_of(run, progress)
    aim = purpose_of(run, stand, purpose)
    scene = Scene(stand, aim.added)
    if stand.estimate.scans and not scene.scanned:
        raise InputError(
            f"{scene.source.recording.folder}: there is no mesh, so nothing says what the beams of "
            "a planned stop would meet; add reference/mesh.ply"
        )
    places = where_it_stood(stand.estimate.problem, scene.values)
    rng = np.random.default_rng(seed)
    poses = reachable(scene.source, places, scene.T_world_reference, candidates, rng)
    if len(poses.joints) < stops:
        raise InputError(
            f"--stops {stops}: only {len(poses.joints)} of the poses that were drawn are clear of "
            "the arm itself and of the mesh; ask for fewer stops, or draw more"
        )
    lasting = _lasting(scene)
    progress("looking at candidates", 0, 1)
    each = scene.each(poses, lasting.keys)
    found = chosen(
        _criterion(scene, aim, lasting), each, stops, lambda k, n: progress("choosing", k, n)
    )
    some = poses.some(found)
    order = in_order_of_path(some.joints, some.location, list(places))
    some = some.some(order)
    return _told(run, scene, aim, some, len(poses.joints))


def _lasting(scene: Scene) -> Information:
    """What is known now of all that planned stops speak of; targets hang where they hang."""
    roles = {name: u.role for name, u in scene.problem.variables.items()}
    keep = [i for i, (name, _) in enumerate(scene.now.keys) if roles[name] is not Role.TARGET]
    return scene.now.onto(np.array(keep))


def _criterion(scene: Scene, aim: Purpose, known: Information) -> Criterion:
    """By what stops are chosen: D of all, A of some components, T of rivals."""
    if aim.rivals:
        return Apart(known, [_rival(scene, known, name) for name in aim.rivals])
    model = known.without(scene.unbounded)
    if aim.components:
        wanted = set(aim.components)
        return Variance(model, np.array([i for i, k in enumerate(model.keys) if k in wanted]))
    return Volume(model, model.at(scene.calibration))


def _rival(scene: Scene, known: Information, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Where the components (q,) of an effect stand, and of what size they are taken to be."""
    variables = [term.variable for term in scene.terms_of(name)]
    size = np.concatenate([scene.problem.variables[v].sigma for v in variables])
    at = known.at(variables)
    return at, size / known.unit[at]


def _told(run: Run, scene: Scene, aim: Purpose, poses: Poses, candidates: int) -> Plan:
    """What is known now, and with the planned stops."""
    rig, count = scene.source.rig, len(scene.source.recording.stops)
    calibration = scene.calibration
    now, after = scene.now, scene.after(poses)
    keys = [now.keys[i] for i in now.at(calibration)]
    names = [".".join(key) for key in keys]
    reported = dict(zip(run.solution.names, np.sqrt(np.diag(run.solution.covariance)), strict=True))
    before = np.array([reported[name] for name in names])
    sigmas = [_sigma(each, scene) for each in (now, after)]
    variables = scene.problem.variables
    units = dict(u for name in calibration for u in _units(name, variables[name]))
    parts = (now, count, before), (after, count + len(poses.joints), before * sigmas[1] / sigmas[0])
    known = [_known(scene, aim, each, stops, sigma) for each, stops, sigma in parts]
    return Plan(
        run=run.folder,
        purpose=aim,
        poses=poses,
        joints=list(zip(rig.joint_names, rig.joint_kinds, strict=True)),
        names=names,
        units=[units[name] for name in names],
        now=known[0],
        after=known[1],
        effect_units={n: scene.unit_of(n) for n in aim.rivals},
        candidates=candidates,
    )


def _units(name: str, unknown: Any) -> Iterator[tuple[str, str]]:
    pairs = zip(unknown.dofs, unknown.units, strict=True)
    yield from ((f"{name}.{dof}", unit) for dof, unit in pairs)


def _sigma(known: Information, scene: Scene) -> np.ndarray:
    """Of the calibration (P,), as the graph has it."""
    model = known.without(scene.unbounded)
    return np.sqrt(np.diag(model.covariance(model.at(scene.calibration))))


def _known(scene: Scene, aim: Purpose, known: Information, stops: int, sigma: np.ndarray) -> Known:
    calibration = scene.calibration
    model = known.without(scene.unbounded)
    own = [n for n in calibration if n != scene.source.rig.reference_frame]
    at, every = model.at(own), model.at(calibration)
    names = [".".join(model.keys[i]) for i in at]
    rows = Apart(known, []).start
    least = {}
    for name in aim.rivals:
        of, _ = _rival(scene, known, name)
        own = np.outer(known.unit[of], known.unit[of])
        whole, others = known.data[np.ix_(of, of)] / own, known.at(scene.unbounded)
        least[name] = tuple(
            smallest(information_left(rows, of, without) / own, whole)
            for without in (np.setdiff1d(others, of), np.zeros(0, int))
        )
    return Known(
        stops=stops,
        sigma=sigma,
        smallest=least,
        weak=hardly_known(names, model.covariance(at), model.unit[at]),
        indices=indices(model, every, stops),
    )
