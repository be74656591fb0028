"""What a report is made from: runs, recordings, residuals and derivatives, read when asked."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np

from calib.forward import Values
from calib.linear.parallel import over_stops
from calib.problem import Problem
from calib.problem.beams import same_mesh
from calib.problem.model import Source
from calib.recalibration.links import moved_since_cad
from calib.report.budget import Budget, budget
from calib.report.statistics import (
    AZIMUTHS,
    COARSE,
    MOST_BINS,
    PLACE_COLUMNS,
    Axis,
    Statistics,
    StopMap,
    StopMaps,
    StopResiduals,
    coarse_map,
    residual_statistics,
    stop_map,
)
from calib.report.walls import Box, Ends, Face, faces, yaw_of
from calib.residuals.scan import ScanStop
from calib.runs.asked.factors import estimate_of
from calib.runs.estimates import VariableEstimate, variable_estimates
from calib.runs.ladder import Rung, ladder
from calib.runs.reopen import problem_of, reopened, start_of, state_of
from calib.runs.residual_table import UNSEEN_FOLDER, beam_ends, residual_table, table_path
from calib.runs.run import RESIDUALS, SUMMARY, Run
from calib.solve.estimate import Estimate, Start, values_of
from calib.solve.fit import Progress
from chains import se3
from chains.errors import InputError
from sensors.recording import read_table

FEWEST_BINS = 4  # bins of a stop's covariate, at least
TABLES_SAMPLED = 8  # tables from which the bins of covariates are taken
# Columns of a table that are no covariate: they name a place, or are what is explained.
NOT_OF_TABLES = {*PLACE_COLUMNS, "region", "patch", "column", "residual_m", "sigma_m", "weight"}
NEEDED = {"ring", "column", "azimuth_rad", "range_m", "incidence_rad"}
SUMMARY_KEYS = {"rms_mm", "misfit", "misfit_by", "converged", "residual", "stops", "points"}
NEEDED |= {"residual_m", "sigma_m", "weight"}
FIRST = ("incidence_rad", "range_m", "ring", "azimuth_rad", "elevation_rad", "intensity", "label")


@dataclass(frozen=True)
class Evidence:
    """A run, the rungs below it, and all that a report may ask of them.

    Args:
        rungs: of the ladder, or the runs given where none grew from another; the last is reported.
        sources: the recordings of that one.
        progress: called with what is being done, and how far it is.
    """

    rungs: Sequence[Rung]
    sources: Sequence[Source]
    progress: Progress = field(repr=False)

    @classmethod
    def of(
        cls, runs: Sequence[Run], progress: Progress = lambda what, done, total: None
    ) -> Evidence:
        """Read what runs are about.

        Raises:
            InputError: a recording is not where or what it was.
        """
        climbed = ladder(runs)
        for run in runs:
            _check(run)
        known = {rung.run.folder for rung in climbed}
        rungs = [*(Rung(run, None) for run in runs if run.folder not in known), *climbed]
        last = rungs[-1].run
        return cls(rungs, reopened(last), progress)

    @property
    def run(self) -> Run:
        """The run that is reported."""
        return self.rungs[-1].run

    @property
    def below(self) -> Run | None:
        """The run that it is compared with."""
        return self.rungs[-1].below or (self.rungs[-2].run if len(self.rungs) > 1 else None)

    @property
    def before(self) -> str:
        """What the residuals before are those of."""
        return f"before, {folder_name(self.below.folder)}" if self.below else "before, as in CAD"

    @cached_property
    def diagnosis(self) -> Mapping[str, Any] | None:
        """diagnosis.json; None where the run has not been diagnosed."""
        return self.run.diagnosis()

    @cached_property
    def estimates(self) -> list[VariableEstimate]:
        """Links and effects of the run, as plain rows."""
        return variable_estimates(self.run)

    @cached_property
    def problem(self) -> Problem:
        """The run's variables, blocks and scans."""
        return problem_of(self.run, self.sources)

    @cached_property
    def values(self) -> dict[str, np.ndarray]:
        """The state in which the fit was left."""
        return values_of(self.problem, state_of(self.run, self.problem))

    @cached_property
    def start(self) -> Start:
        """That state, and what the beams met there."""
        return start_of(self.run, self.sources)

    @cached_property
    def estimate(self) -> Estimate:
        """The fit, as it was left."""
        return estimate_of(self.run, self.progress)

    @cached_property
    def prior_sigma(self) -> dict[str, float]:
        """``variable.parameter`` of the calibration -> how sure CAD was of it, rad or m; less sure
        where it has moved since."""
        known = self.problem.loosened(moved_since_cad(self.run.summary)).variables
        variables = (known[name] for name in self.problem.calibration)
        return {
            f"{v.name}.{dof}": float(s)
            for v in variables
            for dof, s in zip(v.dofs, v.sigma, strict=True)
        }

    @cached_property
    def budget(self) -> Budget:
        """What each link and effect contributes."""
        found = self.problem, self.values, self.run.solution
        return budget(*found, self.progress, self.start.met)

    # ----------------------------------------------------------------------------------- residuals

    @cached_property
    def has_beams(self) -> bool:
        """Whether there are scans, and so residuals of beams."""
        return self.run.summary["residual"] == "range"

    @cached_property
    def axes(self) -> list[Axis]:
        """The covariates of points and stops, those of the catalogue first, cut into bins."""
        scans = self.problem.scans
        chosen = np.unique(np.linspace(0, len(scans) - 1, TABLES_SAMPLED).round().astype(int))
        sample: dict[str, list[np.ndarray]] = {}
        for i in chosen.tolist():
            for name, column in self._columns(self.run, scans[i]).items():
                if name not in NOT_OF_TABLES - {"label"}:
                    sample.setdefault(name, []).append(column)
        points = {name: np.concatenate(parts) for name, parts in sample.items()}
        stops = [self._stop(scan, k) for k, scan in enumerate(scans)]
        per_stop = {n: np.array([s.get(n, np.nan) for s in stops]) for s in stops for n in s}
        names = dict.fromkeys([*(n for n in FIRST if n in points), "stop", *per_stop, *points])
        wanted = (self._axis(n, points[n] if n in points else per_stop[n]) for n in names)
        return [axis for axis in wanted if len(axis.edges)]

    def _axis(self, name: str, values: np.ndarray) -> Axis:
        if name == "ring":
            return Axis.of_things(name, range(self.rings))
        if name == "stop":
            several, scans = len(self.sources) > 1, self.problem.scans
            names = [f"{s.stops.rig.name}.{s.name}" if several else s.name for s in scans]
            return Axis.of_things(name, range(len(names)), names)
        if name == "recording":
            names = [s.rig.name for s in self.sources]
            return Axis.of_things(name, range(len(names)), names)
        if name == "label":
            known = {n: text for s in self.sources for n, text in s.rig.labels.items()}
            numbers = sorted({*known, *np.unique(values).astype(int).tolist()})
            return Axis.of_things(name, numbers, [known.get(n, str(n)) for n in numbers])
        if len(values) == len(self.problem.scans):  # a value per stop: several stops in each bin
            return Axis.of_values(name, values, min(MOST_BINS, max(FEWEST_BINS, len(values) // 3)))
        return Axis.of_values(name, values)

    @cached_property
    def joint_units(self) -> dict[str, tuple[str, float]]:
        """Joint -> the unit in which its angle or length is shown, and by what it is multiplied."""
        kinds = {
            joint: kind
            for source in self.sources
            for joint, kind in zip(source.rig.joint_names, source.rig.joint_kinds, strict=True)
        }
        return {
            joint: ("deg", 180.0 / np.pi) if kind == "revolute" else ("mm", 1e3)
            for joint, kind in kinds.items()
        }

    @property
    def rings(self) -> int:
        """How many rings the LiDARs have at most."""
        return max(scan.lidar.rings for scan in self.problem.scans)

    @cached_property
    def azimuths(self) -> int:
        """In how many parts of a turn beams can be told apart on a map."""
        columns = self._columns(self.run, self.problem.scans[0])["column"]
        return int(min(AZIMUTHS, len(np.unique(columns))))

    @cached_property
    def after(self) -> Statistics:
        """The residuals of the run."""
        return residual_statistics(
            self._tables(self.run, "residuals"), self.axes, self.rings, self.azimuths
        )

    @cached_property
    def earlier(self) -> Statistics:
        """The residuals of the run below, or where there is none with everything as in CAD."""
        what = "residuals before"
        return residual_statistics(
            self._tables(self.below, what), self.axes, self.rings, self.azimuths
        )

    @cached_property
    def held_out(self) -> Statistics | None:
        """The residuals of stops that were held out, in a fit without them; None where none were
        kept."""
        scans = [scan for scan in self.problem.scans if self._unseen(scan).is_file()]
        if not scans:
            return None
        tables = self._tables(self.run, "held-out residuals", scans, self._unseen)
        return residual_statistics(tables, self.axes, self.rings, self.azimuths)

    @cached_property
    def unseen(self) -> list[StopMaps]:
        """Stops that were held out, the one furthest off first; none where none were."""
        found = []
        for scan in self.problem.scans:
            path = self._unseen(scan)
            if path.is_file():
                tables = [self._columns(r, scan) for r in (self.below, self.run)]
                tables.append(_checked(path))
                maps = [stop_map(each, self.rings, self.azimuths) for each in tables]
                found.append(StopMaps(path.stem, *zip(*maps, strict=True)))
        return sorted(found, key=lambda stop: -stop.rms_m[-1])

    @cached_property
    def stops(self) -> list[StopMap]:
        """Every stop in the fit, and beside it as held out where it was, the one furthest off
        first."""
        rings, azimuths = self.rings, min(self.azimuths, COARSE)
        pairs = []
        for k, scan in enumerate(self.problem.scans):
            self.progress("stop by stop", k, len(self.problem.scans))
            unseen = self._unseen(scan)
            tables = {True: _checked(unseen)} if unseen.is_file() else {}
            tables[False] = self._columns(self.run, scan)
            pair = [
                StopMap(unseen.stem, *coarse_map(table, rings, azimuths), held_out=held_out)
                for held_out, table in tables.items()
            ]
            pairs.append(pair)
        pairs.sort(key=lambda pair: -pair[0].rms_m)
        return [each for pair in pairs for each in pair]

    def _unseen(self, scan: ScanStop) -> Path:
        """Where a stop's residuals are kept that a fit without it left."""
        return table_path(self.run.folder / RESIDUALS / UNSEEN_FOLDER, scan, self.sources)

    @cached_property
    def walls(self) -> list[tuple[float, list[Face]]]:
        """Of each mesh its sigma, and the residuals on the sides of its room; none of planes."""
        meshes = [source.reference for source in self.sources]
        found = []
        for i, mesh in enumerate(meshes):
            if mesh is None or any(same_mesh(mesh, other) for other in meshes[:i]):
                continue
            scans = [s for s in self.problem.scans if same_mesh(meshes[self._source(s)], mesh)]
            if not scans:
                continue
            chosen = scans[:: -(-len(scans) // TABLES_SAMPLED)]
            ends = [self._ends(scan) for scan in chosen]
            beams = sum(len(each.weight) for each in ends) * len(scans) // len(chosen)
            box = Box.of(yaw_of(mesh), ends, beams)
            found.append((scans[0].reference_sigma_m, faces(box, map(self._ends, scans))))
        return found

    def _ends(self, scan: ScanStop) -> Ends:
        """Where a stop's beams end."""
        columns = self._columns(self.run, scan)
        at_m = beam_ends(columns, scan.lidar.beam_origin_m)
        return Ends(
            se3.apply(scan.pose(self.values), at_m),
            columns["residual_m"].astype(float),
            weight=columns["weight"].astype(float),
        )

    def _tables(
        self,
        run: Run | None,
        what: str,
        scans: Sequence[ScanStop] | None = None,
        kept: Callable[[ScanStop], Path] | None = None,
    ) -> Iterator[StopResiduals]:
        """Tables of some scans, all if none are given: those of a run, or those that are kept."""
        meshes = [source.reference for source in self.sources]
        rooms = [next(i for i, m in enumerate(meshes) if same_mesh(m, mesh)) for mesh in meshes]
        scans = self.problem.scans if scans is None else scans
        if kept:
            tables = (_checked(kept(scan)) for scan in scans)
        elif run is None:
            tables = over_stops(partial(_as_in_cad, self.problem.initial), scans)
        else:
            tables = (self._columns(run, scan) for scan in scans)
        for k, (scan, columns) in enumerate(zip(scans, tables, strict=True)):
            self.progress(what, k, len(scans))
            yield StopResiduals(
                columns=columns,
                stop=self._stop(scan, self.problem.scans.index(scan)),
                room=rooms[self._source(scan)],
                sigma_angle_rad=scan.lidar.sigma_angle_rad,
                sigma_reference_m=scan.reference_sigma_m,
            )

    def _columns(self, run: Run | None, scan: ScanStop) -> dict[str, np.ndarray]:
        """The residuals of a stop: as a run left them, or with everything as in CAD."""
        if run is None:
            return _as_in_cad(self.problem.initial, scan)
        path = table_path(run.folder / RESIDUALS, scan, self.sources)
        if not path.is_file():
            raise InputError(f"{path} is missing; the run is incomplete, fit it again")
        return _checked(path)

    def _source(self, scan: ScanStop) -> int:
        return next(i for i, s in enumerate(self.sources) if s.recording is scan.recording)

    def _stop(self, scan: ScanStop, number: int) -> dict[str, float]:
        """Covariates of a stop: when, where and how it was, and what its recording says of it."""
        source = self.sources[self._source(scan)]
        out = {"stop": float(number)}
        if len(self.sources) > 1:
            out["recording"] = float(self._source(scan))
        for name, column in source.columns.items():
            told = name in source.recording.covariates or name == "elapsed_s"
            if (told or name in source.rig.joint_names) and np.ndim(column) == 1:
                out[name] = float(column[scan.index])
        return out


def _as_in_cad(initial: Values, scan: ScanStop) -> dict[str, np.ndarray]:
    """The residuals of a stop with everything as in CAD."""
    return residual_table(scan.rows(initial))


def _checked(path: Path) -> dict[str, np.ndarray]:
    """The columns of a table of residuals, which may be of another version."""
    columns = read_table(path)
    lacking = NEEDED - columns.keys()
    if lacking:
        raise InputError(
            f"{path} has no column {min(lacking)}: written by another version of rigcal, or "
            f"edited; fit the run again"
        )
    return columns


def _check(run: Run) -> None:
    """A run of another version may lack what a report tells."""
    lacking = sorted(SUMMARY_KEYS - run.summary.keys())
    if lacking:
        raise InputError(
            f"{run.folder / SUMMARY} has no '{lacking[0]}': written by another version of rigcal, "
            f"or edited; fit the run again"
        )


def folder_name(path: Path) -> str:
    """A run's name as people see it."""
    return path.name or str(path)
