"""Corrected clouds: copies of files and of recordings, without what a run knows to be wrong.

Scans of a recording are corrected stop by stop, by whoever works on stops.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from calib import outputs
from calib.diagnosis.formulas.seen import ColumnRanges
from calib.evaluation.correction import Correction, correct
from calib.linear.parallel import one_blas_thread, over_stops
from calib.linear.rows import State
from calib.problem.model import Source
from calib.residuals.scan import ScanStop
from calib.rig import Rig, load_rig
from calib.runs.reopen import identity, problem_of, reopened, state_of
from calib.runs.run import Run
from calib.solve.estimate import values_of
from calib.solve.fit import Progress
from chains.errors import InputError
from sensors.lidar import Beams
from sensors.meshes import read_cloud, write_cloud
from sensors.recording import digest, read_table, table_bytes, write_table


@dataclass(frozen=True)
class Applied:
    """A cloud or recording that was corrected: where, how many points, by how much, what was left
    out, which effects went beyond where they were seen, and what else is to be known, a sentence
    each."""

    path: Path
    points: int
    rms_m: float
    left_out: dict[str, str]
    extrapolated: Sequence[str] = ()
    remarks: Sequence[str] = ()


@one_blas_thread
def apply(
    run: Run,
    clouds: outputs.Paths,
    out: Path | str,
    rig: str | None = None,
    progress: Progress = lambda what, done, total: None,
    force: bool = False,
) -> list[Applied]:
    """Write corrected copies of clouds, every field and every point kept.

    Args:
        run: whose model's effects on beams are taken off, at their estimates.
        clouds: a PCD, PLY or Parquet file with x y z in m in the LiDAR's frame, as its driver gives
            them, or a recording folder; or several. Of the run's own recordings the mesh tells
            range, incidence and label of what was met.
        out: the folder to write to; files keep their names, and earlier clouds there stay.
        rig: whose LiDAR it was, where the run has several.
        progress: called with what is being done, and how far it is.
        force: whether a run that has not converged is used.

    Raises:
        InputError: a cloud cannot be read, or would be written over, or the run has not converged;
            or two clouds have one name; or a recording's LiDAR is another model than the run's.
    """
    run.refuse_unconverged(force)
    out, done, clouds = Path(out), [], outputs.each(clouds)
    names = [cloud.resolve().name for cloud in clouds]
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"{out}: two clouds are called {name}; correct them one by one")
    with outputs.folder(out, outputs.CLOUDS, [*clouds, run.folder, *run.inputs]) as folder:
        (folder / outputs.CLOUDS_MARK).write_text("corrected by rigcal\n", encoding="utf-8")
        correction = Correction.of(run, rig)
        recordings = {n: digest(c) for n, c in zip(names, clouds, strict=True) if c.is_dir()}
        asked = {**identity(run), "rig": rig, "recordings": recordings}
        kept = outputs.kept(folder, asked)
        for i, (cloud, name) in enumerate(zip(clouds, names, strict=True)):
            if cloud.is_dir():
                remarks = tuple(_of_another_rig(correction.rig, cloud, run))
                stops = _of_recording(run, cloud)
                one = _apply_recording(correction, stops, cloud, folder / name, kept, progress)
                one = replace(one, remarks=remarks)
            else:
                progress("correcting", i, len(clouds))
                one = _apply_file(correction, cloud, folder / name)
            done.append(replace(one, path=out / name))
    return done


def _apply_file(correction: Correction, cloud: Path, target: Path) -> Applied:
    parquet = cloud.suffix.lower() == ".parquet"
    columns = read_table(cloud) if parquet else read_cloud(cloud)
    reach = ColumnRanges(e for e, _ in correction.effects)
    rms_m, left_out = correct(correction, cloud, columns, reach)
    (write_table if parquet else write_cloud)(target, columns)
    return Applied(target, len(columns["x"]), rms_m, left_out, extrapolated=reach.sentences())


def _of_another_rig(mine: Rig, folder: Path, run: Run) -> Iterator[str]:
    """That a recording is of another rig than the run's, where its name, its joints or the origin
    of its LiDAR's beams say so."""
    theirs = load_rig(folder)
    if theirs.lidar is None or theirs.lidar.name != mine.lidar.name:
        has = f"has {theirs.lidar.name}" if theirs.lidar else "has no LiDAR"
        raise InputError(
            f"{folder} {has}, and {run.folder} is of {mine.lidar.name}; give a run of its LiDAR"
        )
    if not np.array_equal(theirs.lidar.beam_origin_m, mine.lidar.beam_origin_m):
        differ = f"has beams with another origin (beam_origin_m) than that of {run.folder}"
    elif theirs.name != mine.name:
        differ = f"is of rig {theirs.name}, and {run.folder} of {mine.name}"
    elif theirs.joint_names != mine.joint_names:
        differ = f"is of an arm with other joints than that of {run.folder}"
    else:
        return
    yield f"{folder} {differ}: its scans are corrected rightly only if it has the same LiDAR"


@dataclass(frozen=True)
class _Stop:
    """A stop of a recording whose scan is corrected.

    Args:
        name, path: of its scan.
        columns: of the stop, which are known (1,) of all its points.
        met: its beams against the mesh, of a recording that the run was fitted to, and where that
            stands.
    """

    name: str
    path: Path
    columns: Mapping[str, np.ndarray]
    met: tuple[ScanStop, State] | None = None

    def known(self, ray: Beams) -> Mapping[str, np.ndarray]:
        """What is known of beams beside what their points say."""
        if self.met is None:
            return self.columns
        scan, state = self.met
        return scan.what_meets(ray, state.values)


def _apply_recording(
    correction: Correction,
    stops: Sequence[_Stop],
    folder: Path,
    target: Path,
    kept: outputs.Kept,
    progress: Progress,
) -> Applied:
    """A recording's copy with its scans corrected."""
    corrected = {stop.path for stop in stops}
    shutil.copytree(
        folder, target, ignore=lambda at, names: {n for n in names if Path(at, n) in corrected}
    )
    reach = ColumnRanges(e for e, _ in correction.effects)
    parts = kept.each(
        f"scans of {target.name}",
        len(stops),
        lambda some: over_stops(partial(_of_stop, correction), [stops[i] for i in some]),
        partial(progress, "correcting"),
    )
    points, squares, left_out = 0, 0.0, {}
    for stop, part in zip(stops, parts, strict=True):
        part.put(target / stop.path.relative_to(folder))
        points, left_out = points + part.told["points"], left_out | part.told["left_out"]
        squares += part.told["points"] * part.told["rms_m"] ** 2
        reach.include(part.told["seen"])
    rms_m = float(np.sqrt(squares / max(points, 1)))
    return Applied(target, points, rms_m, left_out, extrapolated=reach.sentences())


def _of_stop(correction: Correction, stop: _Stop) -> outputs.Finished:
    columns, reach = read_table(stop.path), ColumnRanges(e for e, _ in correction.effects)
    rms_m, left_out = correct(correction, stop.path, columns, reach, stop.known)
    told = {"points": len(columns["x"]), "rms_m": rms_m, "left_out": left_out}
    return {**told, "seen": reach.ends}, table_bytes(columns)


def _of_recording(run: Run, folder: Path) -> list[_Stop]:
    """Its stops with a scan; of one that the run was fitted to with what beams meet on the mesh,
    but where a scan was left out, or set aside."""
    met, source = _met(run, folder), Source.open(folder)
    columns = {n: c for n, c in source.columns.items() if c.ndim == 1}
    return [
        _Stop(
            name=stop,
            path=folder / "scans" / f"{stop}.parquet",
            columns={n: c[[k]] for n, c in columns.items()},
            met=met.get(stop),
        )
        for k, stop in enumerate(source.recording.stops)
        if source.recording.has_scan[k]
    ]


def _met(run: Run, folder: Path) -> dict[str, tuple[ScanStop, State]]:
    """Scans of a recording that the run was fitted to, by their stop, and where the run stands;
    none where it has no mesh, or is another."""
    if folder.resolve() not in [path.resolve() for path in run.recordings]:
        return {}
    sources = [source.of_beams(None) for source in reopened(run)]
    wanted = next(s for s in sources if s.recording.folder.resolve() == folder.resolve())
    if wanted.reference is None:
        return {}
    problem = problem_of(run, sources)
    state = State(values_of(problem, state_of(run, problem)))
    scans = [scan for scan in problem.scans if scan.recording is wanted.recording]
    return {scan.name: (scan, state) for scan in scans}
