"""What a run has learnt of its LiDAR, taken off what that measures.

A point is a beam that starts where the sensor's beams do; its effects say by how much it was read
long, and turned. Effects look at the range and incidence of the surface, which a cloud does not
know: the range is the measured one, corrected and looked at again, and the incidence that of the
plane through a point's neighbours.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from calib.diagnosis.formulas.seen import ColumnRanges
from calib.effects import Effect, LazyColumn, Site, View
from calib.linear.symmetric import eigh
from calib.problem.model import Source
from calib.residuals.beams import site_error
from calib.residuals.store import common_median
from calib.rig import Rig, load_rig
from calib.runs.reopen import effects_that_may_run
from calib.runs.run import Run
from chains import remote
from chains.errors import InputError
from sensors.documents import nearest
from sensors.lidar import Beams, beams
from sensors.recording import check_ranges

Columns = dict[str, np.ndarray]
KnownOfBeams = Callable[
    [Beams], Mapping[str, np.ndarray]
]  # beams of points -> what else is known of them
NEIGHBOURS = 24, 12  # of a point, through which its plane is laid; nearer ones where that is none
SUPPORT = 200_000  # points among which neighbours are sought
# How thick a plane may be: so many sigmas of the range, and so much of its width. A choice: what is
# as thick turns a normal by 0.05 rad.
THICKEST_SIGMAS, THICKEST = 3.0, 0.05
# Of a normal, by the noise of its neighbours, which tell it less the nearer they are to one line. A
# choice: at 60 degrees 1 / cos is then known to a fifth.
DIRECTION_KNOWN_RAD = 0.1
FLATTEST_BEAM_RAD = np.radians(85.0)  # flatter beams are corrected as these are
# Looks at the range: a correction changes by a millionth of itself from each to the next.
CORRECTION_PASSES = 3
_SEEN = ("range_m", "azimuth_rad", "elevation_rad", "incidence_rad")  # of any cloud


@dataclass(frozen=True)
class Correction:
    """What a run takes off the clouds of one of its LiDARs.

    Args:
        rig: as on paper.
        effects: the model's effects on beams, and the estimate (P,) of each.
        closed: effects that are not known here, as their Python file may not run -> that sentence.
        median_intensity: to which effects hold others, in the unit of the run's recordings; NaN
            where no effect asks.
    """

    rig: Rig
    effects: Sequence[tuple[Effect, np.ndarray]]
    closed: Mapping[str, str] = field(default_factory=dict)
    median_intensity: float = float("nan")

    @classmethod
    def of(cls, run: Run, rig_name: str | None = None) -> Correction:
        """That of a run's LiDAR, of the rig named where there are several.

        Raises:
            InputError: the run has several rigs and none is named, or its recording is gone.
        """
        rig = _rig(run, rig_name)
        part = run.solution.part(rig.name)
        effects, why = effects_that_may_run(run)
        known = {e.name: e for e in effects if e.name in part.effects}
        of_beams = [e for e in known.values() if e.site is Site.BEAM and not e.by_chance]
        closed = {
            name: f"is not known: {why}" for name in part.effects if why and name not in known
        }
        chance = (e.name for e in known.values() if e.by_chance)
        closed |= {name: "is another one each time, by chance" for name in chance}
        asked = any("intensity" in e.covariates for e in of_beams)
        return cls(
            rig,
            [(e, part.effects[e.name].estimate) for e in of_beams],
            closed=closed,
            median_intensity=_median_intensity(run, rig) if asked else float("nan"),
        )

    def usable(self, columns: Collection[str]) -> tuple[Correction, dict[str, str]]:
        """What can be corrected where these columns are known, and what of it not, and why."""
        known = {*columns, *_SEEN}
        lacking = {e.name: sorted({*e.covariates} - known) for e, _ in self.effects}
        kept = [(e, theta) for e, theta in self.effects if not lacking[e.name]]
        why = {name: f"needs {', '.join(missing)}" for name, missing in lacking.items() if missing}
        return replace(self, effects=kept), {**why, **self.closed}

    def apply(self, xyz_m: np.ndarray, columns: Mapping[str, LazyColumn]) -> np.ndarray:
        """Corrected points (N, 3) of points as the driver gives them, in the LiDAR's frame.

        Args:
            xyz_m: (N, 3), each a return.
            columns: (N,) or (1,) of what effects may look at, beside what points say themselves;
                ``range_m`` is NaN where a point's own is to be taken.
        """
        ray = beams(xyz_m, self.rig.lidar.beam_origin_m)
        error = np.zeros((len(xyz_m), 3))
        if "intensity" in columns:
            columns = {**columns, "intensity": columns["intensity"] / self.median_intensity}
        met_m = columns.get("range_m", np.full(1, np.nan))
        for _ in range(CORRECTION_PASSES):
            range_m = np.where(np.isnan(met_m), ray.range_m - error[:, 0], met_m)
            there = {**_angles(ray), **columns, "range_m": range_m}
            view = View(self.rig, len(xyz_m), there, np.zeros((1, 0)))
            each = (site_error(e.basis(view), theta) for e, theta in self.effects)
            error = sum(each, np.zeros((len(xyz_m), 3)))
        back = ray.turned(-error[:, 1], -error[:, 2]) if error[:, 1:].any() else ray
        return back.origin_m + (ray.range_m - error[:, 0])[:, None] * back.direction


def correct(
    correction: Correction,
    path: Path,
    columns: Columns,
    reach: ColumnRanges,
    known: KnownOfBeams = lambda ray: {},
) -> tuple[float, dict[str, str]]:
    """Correct a cloud's columns x y z in place, and show `reach` what effects look at; by how much,
    rms in m, and what was left out."""
    lacking = [axis for axis in "xyz" if axis not in columns]
    if lacking:
        raise InputError(f"{path}: column {lacking[0]} is missing; a cloud has x, y and z in m")
    xyz_m = np.stack([columns[axis] for axis in "xyz"], axis=-1).astype(float)
    seen = np.flatnonzero(np.isfinite(xyz_m).all(axis=1) & xyz_m.any(axis=1))
    _check_rings(correction.rig, path, columns, seen)
    numbers = {n: c for n, c in columns.items() if c.ndim == 1 and c.dtype.kind in "fiu"}
    ray = beams(xyz_m[seen], correction.rig.lidar.beam_origin_m)
    if len(seen):
        check_ranges(path, ray.range_m)
    told = known(ray)
    there = {n: c[seen] for n, c in numbers.items()} | told
    if "ring" in there:  # some formats hold it as a float
        there["ring"] = there["ring"].astype(np.int64)
    usable, left_out = correction.usable(there)
    if any("incidence_rad" in e.covariates for e, _ in usable.effects):
        met = _incidence(xyz_m[seen], usable.rig, there.get("incidence_rad"))
        blind, there["incidence_rad"] = np.isnan(met), np.nan_to_num(met)
        needy = [e.name for e, _ in usable.effects if "incidence_rad" in e.covariates]
        if blind.any():
            why = (
                f"needs incidence, at {blind.mean():.1%} of the points, which lie on no plane that "
                "their neighbours show; all others are corrected"
            )
            left_out |= dict.fromkeys(needy, why)
    reach.look({"range_m": ray.range_m, **_angles(ray), **there})
    corrected_m = usable.apply(xyz_m[seen], there)
    moved_m = np.linalg.norm(corrected_m - xyz_m[seen], axis=1)
    for k, axis in enumerate("xyz"):
        columns[axis] = columns[axis].copy()
        columns[axis][seen] = corrected_m[:, k]
    return float(np.sqrt(np.mean(moved_m**2))) if len(seen) else 0.0, left_out


def _incidence(xyz_m: np.ndarray, rig: Rig, met_rad: np.ndarray | None) -> np.ndarray:
    """Incidence (N,) on what the beams are known to meet, or else on their neighbours' planes."""
    if met_rad is None:
        incidence_rad = incidence(xyz_m, rig)
    elif np.isnan(met_rad).any():
        incidence_rad = np.where(np.isnan(met_rad), incidence(xyz_m, rig), met_rad)
    else:
        incidence_rad = met_rad
    return np.minimum(incidence_rad, FLATTEST_BEAM_RAD)


def incidence(xyz_m: np.ndarray, rig: Rig) -> np.ndarray:
    """Incidence (N,) rad of beams on the planes through each point's nearest neighbours.

    The plane's normal is the direction in which the neighbours spread least. NaN where they spread
    much further along it than ranges err, as at an edge; where they are so near to a line that
    their noise turns the plane; and where it goes through the LiDAR, as it does where all of them
    are of one column of a thin scan.
    """
    from scipy.spatial import cKDTree

    if len(xyz_m) < NEIGHBOURS[-1]:
        return np.full(len(xyz_m), np.nan)
    ray = beams(xyz_m, rig.lidar.beam_origin_m)
    some = xyz_m[:: max(1, len(xyz_m) // SUPPORT)]
    _, near = cKDTree(some).query(xyz_m, k=min(NEIGHBOURS[0], len(some)), workers=-1)
    out = np.full(len(xyz_m), np.nan)
    for rows in np.array_split(np.arange(len(xyz_m)), 1 + len(xyz_m) // SUPPORT):
        for count in NEIGHBOURS:
            left = rows[np.isnan(out[rows])]
            around_m = some[near[left, :count]]
            out[left] = _on_planes(around_m, ray.direction[left], rig.lidar.sigma_range_m)
    return out


def _on_planes(around_m: np.ndarray, direction: np.ndarray, sigma_m: float) -> np.ndarray:
    """Incidence (N,) of beams of a direction (N, 3) on the plane of points (N, K, 3) around."""
    count = around_m.shape[1]
    away_m = around_m - around_m.mean(axis=1, keepdims=True)
    variance, axes = eigh(np.einsum("nki,nkj->nij", away_m, away_m))
    along = np.abs(np.einsum("ni,ni->n", axes[:, :, 0], direction))
    thick_m, wide_m = np.sqrt(np.maximum(variance[:, :2], 0.0) / count).T
    plane = thick_m < THICKEST_SIGMAS * sigma_m + THICKEST * wide_m
    plane &= sigma_m < DIRECTION_KNOWN_RAD * np.sqrt(count) * wide_m
    plane &= along > np.cos(FLATTEST_BEAM_RAD)
    return np.where(plane, np.arccos(np.minimum(along, 1.0)), np.nan)


def _angles(ray: Beams) -> Columns:
    return {"azimuth_rad": ray.azimuth_rad, "elevation_rad": ray.elevation_rad}


def _check_rings(rig: Rig, path: Path, columns: Columns, seen: np.ndarray) -> None:
    """Rings of the cloud are those of the LiDAR, counted from 0."""
    if "ring" not in columns or not len(seen):
        return
    ring = columns["ring"][seen].astype(np.int64)
    if ring.min() < 0 or ring.max() >= rig.lidar.rings:
        raise InputError(
            f"{path}: ring {ring.min()} to {ring.max()}, but {rig.lidar.name} has 0 to "
            f"{rig.lidar.rings - 1}; count from 0, or give a run of this LiDAR"
        )


def _median_intensity(run: Run, rig: Rig) -> float:
    """As of `Correction`."""
    mine = [remote.here(r["path"]) for r in run.model["recordings"] if r["rig"] == rig.name]
    return common_median([Source.open(path).store for path in mine])


def _rig(run: Run, name: str | None) -> Rig:
    """The rig whose LiDAR is meant."""
    folders = {r["rig"]: remote.here(r["path"]) for r in run.model["recordings"]}
    if name is None and len(folders) > 1:
        raise InputError(
            f"{run.folder} has several rigs: say whose LiDAR with --rig, {', '.join(folders)}"
        )
    if name is not None and name not in folders:
        raise InputError(
            f"--rig {name}: {run.folder} has no such rig{nearest(name, list(folders))}"
        )
    path = folders[name] if name else next(iter(folders.values()))
    if not path.is_dir():
        raise InputError(
            f"{path}, which {run.folder} was fitted to, is no longer there; put it back"
        )
    rig = load_rig(path)
    if rig.lidar is None:
        raise InputError(f"{path}: this rig has no LiDAR, so there are no clouds to correct")
    return rig
