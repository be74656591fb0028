"""What to measure next: the stops that tell most, and what will be known after them.

Candidates are random poses of the arm where its base stood. What each of them would tell is
linearised at a run's estimate by the residuals of the fit (`stops`, `information`), and those are
chosen that serve a purpose best (`purpose`, `criteria`). What is told of the chosen ones is one
linearisation of all stops together, measured and planned (`scene`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol, TypeVar

import numpy as np

from calib import outputs
from calib.linear.parallel import one_blas_thread
from calib.planning.alone import nothing_measured
from calib.planning.found import Found, effects_document, mishaps_document
from calib.planning.planner import Planner, Step
from calib.planning.purpose import ALL, Purpose, purpose_of
from calib.planning.room.places import in_region, where_it_stood
from calib.planning.room.unlike import Unlike, unlike
from calib.planning.room.ways import Leg, way_document
from calib.planning.scene import PlanningScene
from calib.planning.stops import Poses
from calib.planning.tolerance import purpose_until
from calib.planning.worth import Known, Pair
from calib.problem.unknowns import Key
from calib.results.stages import PLAN as STAGES
from calib.results.stages import staged
from calib.runs.asked.factors import prior_of
from calib.runs.reopen import problem_of, stand_of
from calib.runs.run import MODEL, Run
from calib.solve.fit import Progress
from chains import se3
from chains.errors import InputError
from sensors.stops import read_cameras, write_columns

__all__ = ["Plan", "is_rig", "plan", "planner_of"]

# Poses that are looked at. On the page's example 50, 200, 500, 1500 of them bring the smallest sag
# that is told from its rival to 0.071, 0.061, 0.060, 0.058 mrad/(N m) (mean of two seeds).
CANDIDATE_POSES = 500
# Stops that are planned where nobody says how many, and until sigmas are small.
USUAL_STOPS, MOST_PLANNED = 5, 30
WHEN = ("now", "after")
CAMERAS = "cameras.csv"  # of the tracker, in the recording's folder or the rig's


class Tabular(Protocol):
    """What has columns of a table."""

    def columns(self) -> Mapping[str, np.ndarray]:
        """Name -> values, a row each."""


Made = TypeVar("Made", bound=Tabular)


def silent(what: str, done: int, total: int) -> None:
    """Progress that nobody sees."""


def is_rig(folder: Path) -> bool:
    """Whether a folder is one of a rig, and no run."""
    return (folder / "rig.yaml").is_file() and not (folder / MODEL).is_file()


@dataclass(frozen=True)
class Plan:
    """Stops to measure next, and what they are worth.

    Args:
        run: the folder of the run, or of the rig.
        purpose: what they were chosen for.
        poses: of the stops, in the order in which to drive to them.
        measured: of the stops that were measured.
        places: location -> T_reference_root (4, 4) where the base stands at planned stops.
        joints: (J,) name and kind, revolute or prismatic, of each.
        keys, units: (P,) of the parameters of the calibration.
        now, after: what is known without and with them; sigmas as a run reports them.
        found: what would be found of what may be wrong, without and with them.
        unlike: in which way they are unlike all that was measured.
        effect_units: of the effects in `Known.smallest`.
        candidates: how many poses they were chosen among.
        endless: what is known with any number of stops of this arm.
        alike: an effect and a rival that does next to the same at all candidates -> the size from
            which the effect were told from it, had all of them been measured.
        curve: how far from their tolerances sigmas are with how many of them; empty without any.
        legs: how to get from each stop to the next, where its location is the same.
        tubes: of each link whose shapes are not in the recording, why; it is taken for a tube.
    """

    run: Path
    purpose: Purpose
    poses: Poses
    measured: Poses
    places: Mapping[str, np.ndarray]
    joints: Sequence[tuple[str, str]]
    keys: Sequence[Key]
    units: Sequence[str]
    now: Known
    after: Known
    endless: Known
    alike: Mapping[Pair, float]
    found: tuple[Found, Found]
    unlike: Sequence[Unlike]
    effect_units: Mapping[str, str]
    candidates: int
    curve: Sequence[Step] = ()
    legs: Sequence[Leg] = ()
    tubes: Sequence[str] = ()

    @property
    def untold(self) -> Sequence[Mapping[str, Any]]:
        """Directions that no stops of this arm determine, however many."""
        return self.endless.weak

    @property
    def names(self) -> list[str]:
        """(P,) of the parameters of the calibration."""
        return [key.name for key in self.keys]

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
            "way": way_document(self.poses, self._names, self.legs),
            "tubes": list(self.tubes),
            "places": {at: _pose(T) for at, T in self.places.items()},
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
                    "beside_model": _now_after(self, name, [name]),
                    "beside_rivals": _now_after(self, name, self.told_from(name)),
                    "beside": {
                        rival: _now_after(self, name, [rival])
                        for rival in self.now.smallest
                        if rival != name
                    },
                }
                for name in self.now.smallest
            },
            "never_told_apart": [
                {"effect": name, "from": rival, "smallest": size if np.isfinite(size) else None}
                for (name, rival), size in self.alike.items()
            ],
            "smallest_effect": effects_document(*self.found),
            "smallest_blunder": mishaps_document(*self.found),
            "unlike_measured": [each.document() for each in self.unlike],
            "unseen_blunder": {w: f.furthest() for w, f in zip(WHEN, self.found, strict=True)},
            "weak_directions": {
                "now": list(self.now.weak),
                "after": list(self.after.weak),
                "with_any_number": list(self.untold),
            },
            "learning_curve": [step.document() for step in self.curve],
            "reached": self.reached,
            "predicted_mm": {w: _mm(k) for w, k in zip(WHEN, (self.now, self.after), strict=True)},
            "observability": {"now": dict(self.now.indices), "after": dict(self.after.indices)},
        }

    def told_from(self, name: str) -> list[str]:
        """The rivals from which stops can tell an effect; all of them, where they can from none;
        itself, where it has none."""
        rivals = [rival for rival in self.now.smallest if rival != name]
        return [r for r in rivals if (name, r) not in self.alike] or rivals or [name]

    @property
    def reached(self) -> bool | None:
        """Whether every tolerance is kept; None where there is none."""
        last = (s.worst <= 1.0 for s in self.curve if s.stops == self.after.stops)
        return next(last, None)

    def columns(self) -> dict[str, np.ndarray]:
        """The stops as columns (n,): ``location``, and the joints by name."""
        joints = dict(zip(self._names, self.poses.joints.T, strict=True))
        return {"location": self.poses.location.astype(str), **joints}


def _places(scene: PlanningScene, poses: Poses) -> dict[str, np.ndarray]:
    """Where the base stands, in the reference's frame."""
    Ts = se3.inverse(scene.T_world_reference) @ poses.Ts_world_root
    return dict(zip(poses.location.astype(str).tolist(), Ts, strict=True))


def _mm(known: Known) -> float | None:
    return None if known.predicted_m is None else 1e3 * known.predicted_m


def _pose(T: np.ndarray) -> dict[str, list[float]]:
    return {"xyz_m": T[:3, 3].tolist(), "quat_wxyz": se3.to_quat_wxyz(T).tolist()}


def _diagnosed(run: Run) -> dict[str, float]:
    """Effect -> the size from which the run's diagnosis would have found it, if it had one."""
    found = run.diagnosis() or {"candidates": []}
    sizes = {c["effect"]: c["smallest_detectable"] for c in found["candidates"]}
    return {name: size for name, size in sizes.items() if size and np.isfinite(size)}


def _now_after(plan: Plan, name: str, rivals: Sequence[str]) -> dict[str, float | None]:
    """From which size an effect is found beside each of those."""
    known = {"now": plan.now, "after": plan.after, "with_any_number": plan.endless}
    sizes = {w: max(k.smallest[name][rival] for rival in rivals) for w, k in known.items()}
    return {when: size if np.isfinite(size) else None for when, size in sizes.items()}


@one_blas_thread
def plan(
    run: Run | Path | str,
    stops: int | None = None,
    purpose: str | None = None,
    until: str | None = None,
    region: Sequence[float] | None = None,
    candidates: int = CANDIDATE_POSES,
    seed: int = 0,
    out: Path | str | None = None,
    progress: Progress = silent,
) -> Plan:
    """The stops to measure next.

    Args:
        run: a fitted run, with its recordings where they were; stops are planned for the first.
            Or the folder of a rig of which nothing was measured yet: rig.yaml, URDF and mesh.
        stops: how many; at most so many where it is said until when.
        purpose: what they are for; see `calib.planning.purpose.purpose_of`.
        until: instead, how well what is to be known: the fewest stops that reach that are planned;
            see `calib.planning.tolerance.purpose_until`.
        region: x and y of two corners, m, in the reference's frame, between which the base may
            stand anywhere; without it where it stood.
        candidates: how many random poses they are chosen among.
        seed: of these.
        out: a CSV file to write, a row for each stop: ``location``, and the joints by name.
        progress: called with what is being done, and how far it is.

    Raises:
        InputError: the recordings are not what they were; nothing goes by a name in `purpose`; the
            rig has no arm, or scans without a mesh; or there are fewer poses than stops.
    """
    if until is not None and purpose is not None:
        raise InputError(
            "give --until or --for, not both: --until already says what the stops are for"
        )
    stops = (MOST_PLANNED if until else USUAL_STOPS) if stops is None else stops
    progress = staged(progress, STAGES)
    if stops < 1 or candidates < stops:
        raise InputError(
            f"{stops} stops out of {candidates} candidates: give at least 1, and no more"
        )

    def made() -> Plan:
        planner = planner_of(run, purpose, until, region, seed, progress)
        return _planned(planner, stops, candidates, seed)

    return written(made, run, out, "stops", "FILE.csv, or a folder")


def inputs_of(run: Run | Path | str) -> list[Path | str]:
    """What is read for a plan, and not to be written over."""
    return [run.folder, *run.inputs] if isinstance(run, Run) else [run]


def written(
    made: Callable[[], Made], run: Run | Path | str, out: Path | str | None, what: str, give: str
) -> Made:
    """A plan, in a table where there is to be one.

    Args:
        made: makes it, once it is known that the table can be written.
        run: what it is for.
        out: the CSV file; none where None.
        what: what is planned, give: what `out` may be, in words.
    """
    if out is None:
        return made()
    if Path(out).suffix != ".csv":
        raise InputError(f"{out}: the {what} are written as a table; give {give}")
    with outputs.file(out, inputs_of(run)) as file:
        found = made()
        write_columns(file, found.columns())
    return found


def _planned(planner: Planner, stops: int, candidates: int, seed: int) -> Plan:
    """As `plan`, and nothing is written."""
    poses, curve = planner.candidates(candidates, seed), []
    each = planner.look(poses, stops)
    if planner.aim.tolerance:
        some, curve = planner.enough(poses, each, stops)
    else:
        some = planner.choose(poses, each, stops)
    some, legs = planner.in_order(some, poses)
    scene, rig, after = planner.scene, planner.scene.source.rig, planner.after(some)
    return Plan(
        run=planner.folder,
        purpose=planner.aim,
        poses=some,
        measured=scene.measured,
        places=_places(scene, some),
        joints=list(zip(rig.joint_names, rig.joint_kinds, strict=True)),
        keys=planner.keys,
        units=planner.units,
        now=planner.now,
        after=after,
        alike=planner.alike(each),
        found=planner.found_now_and_after(after, some),
        unlike=unlike(scene.source, scene.measured, some),
        endless=planner.endless(each),
        effect_units={name: scene.unit_of(name) for name in planner.aim.rivals},
        candidates=len(poses.joints),
        curve=curve,
        legs=legs,
        tubes=planner.clear.lacking,
    )


def planner_of(
    run: Run | Path | str,
    purpose: str | None,
    until: str | None = None,
    region: Sequence[float] | None = None,
    seed: int = 0,
    progress: Progress = silent,
) -> Planner:
    """What plans stops; arguments and errors as of `plan`."""
    planner = planner_without_places(run, purpose, until, progress)
    scene, folder = planner.scene, planner.scene.source.recording.folder
    if planner.solution is None and region is None:
        raise InputError(
            f"{run}: nothing was measured with this rig, so say with --region x0 y0 x1 y1 where on "
            f"the floor its base may stand, m in the frame '{scene.source.rig.reference_frame}'"
        )
    if scene.stand.estimate.scans and not scene.scanned:
        raise InputError(
            f"{folder}: there is no mesh, so nothing says what the beams of a planned stop would "
            "meet; add reference/mesh.ply"
        )
    places = where_it_stood(scene.stand.estimate.problem, scene.values)
    if region is not None:
        rng = np.random.default_rng(seed)
        places = in_region(scene.source, region, places, scene.T_world_reference, rng)
    return replace(planner, places=places)


def planner_without_places(
    run: Run | Path | str, purpose: str | None, until: str | None, progress: Progress
) -> Planner:
    """The same, and nothing says where the base may stand."""
    fitted = run if isinstance(run, Run) else None
    stand = stand_of(run, progress) if fitted else nothing_measured(run)
    if until:
        aim = purpose_until(stand, until)
    else:
        aim = purpose_of(fitted, stand, purpose if fitted else purpose or ALL)
    prior = None
    if fitted and fitted.prior:
        prior = prior_of(fitted, problem_of(fitted, stand.sources))
    cameras = stand.sources[0].recording.folder / CAMERAS
    return Planner(
        cameras_m=read_cameras(cameras) if cameras.is_file() else None,
        folder=fitted.folder if fitted else Path(run),
        scene=PlanningScene(stand, aim.added, prior),
        aim=aim,
        places={},
        solution=fitted.solution if fitted else None,
        diagnosed=_diagnosed(fitted) if fitted else {},
        progress=progress,
    )
