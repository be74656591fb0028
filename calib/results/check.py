"""What a recording holds, what is wrong with it, and what can be estimated from it."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from calib import problem as problems
from calib.forward import Values
from calib.linear.parallel import one_blas_thread
from calib.problem.model import Model, Source
from calib.problem.without import ROD, leave_out
from calib.residuals.groups import CAD, SCAN
from calib.residuals.scan import ScanStop
from calib.results.reach import Reach, reach
from calib.results.solution import solution_of
from calib.rig import Rig, inventory, load_rig
from calib.rig.inventory import PlacedScan
from calib.rig.recording import recorded
from calib.rig.scale import odd_mesh, odd_targets
from calib.rig.scanned import ScanSums, odd_scans, of_scans
from calib.rig.suspect import Suspect
from calib.rig.tracked import odd_bodies
from calib.solve.estimate import Estimate
from calib.solve.fit import Progress, preview
from calib.solve.otherwise.axes import OtherAxes, axes_of
from calib.solve.otherwise.orientations import lidars_turned
from calib.solve.otherwise.readings import readings_of
from calib.solve.otherwise.rooms import rooms_turned
from chains import remote, se3
from chains.errors import InputError, UntiedError
from sensors.recording import RecordedStops, read_scan
from sensors.reference import Reference
from sensors.stops import read_targets

MOST_SCANS = 20  # of which one linearisation tells what can be estimated
LEFT_SIGMA = 0.99  # of the prior's sigma left: less than that, and the data say something

T = TypeVar("T")


@dataclass(frozen=True)
class Check:
    """What was found in a recording.

    Args:
        folder: of the recording.
        contents: what is there: its name, and how much of it.
        problems: what is wrong and keeps a fit from running, a sentence each.
        odd: what is no error and yet worth a look, a sentence each.
        suspects: those of them that are likely a mishap, with the keys of a diagnosis's blunders;
            `without` is None where what is wrong cannot be left out, or is one of several things.
        expected: link -> unit -> rough sigma of its best and its worst known parameter, of those
            that the data tell.
        cannot: a `name` and a `why` for what the data could not tell.
        predicted: of an arm under a tracker alone, how well it will be known; else empty.
    """

    folder: Path
    contents: list[tuple[str, str]] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)
    odd: list[str] = field(default_factory=list)
    suspects: list[dict[str, Any]] = field(default_factory=list)
    expected: dict[str, dict[str, tuple[float, float]]] = field(default_factory=dict)
    cannot: list[dict[str, str]] = field(default_factory=list)
    predicted: list[Reach] = field(default_factory=list)

    @property
    def command(self) -> str:
        """What fits the recording without the suspects, ready to be typed; empty where none of them
        can be left out."""
        tokens = dict.fromkeys(each["without"] for each in self.suspects if each["without"])
        without = [part for token in tokens for part in ("--without", token)]
        return shlex.join(["rigcal", "fit", str(self.folder), "-o", "RUN", *without]) * bool(tokens)

    @property
    def can(self) -> list[str]:
        """What can be estimated and about how well, a line each."""
        lines = [
            f"{link}: {', '.join(_about(*sigma, unit) for unit, sigma in by_unit.items())}"
            for link, by_unit in self.expected.items()
        ]
        return lines + [reached.sentence for reached in self.predicted]

    def document(self) -> dict[str, Any]:
        """As ``--json`` prints it."""
        return {
            "contents": dict(self.contents),
            "problems": self.problems,
            "odd": self.odd,
            "suspects": self.suspects,
            "command": self.command or None,
            "can": self.can,
            "expected_sigma": self.expected,
            "cannot": self.cannot,
            "predicted_mm": self.predicted[0].document() if self.predicted else None,
        }


@one_blas_thread
def check(
    folder: Path | str,
    progress: Progress = lambda what, done, total: None,
    graph: bool = True,
) -> Check:
    """Read all of a recording, each part apart, and try its graph, unless told not to.

    What can be estimated comes from the joint marginals of one linearisation at the start, of the
    default model and at most 20 of the scans.

    Raises:
        InputError: there is no such folder.
    """
    folder = remote.here(folder, anew=True)
    if not folder.is_dir():
        raise InputError(f"{folder}: there is no such folder; a recording is one, with a rig.yaml")
    found = Check(folder)
    _Checker(folder, found, progress, graph).run()
    return found


@dataclass
class _Checker:
    """Fills a check, part by part."""

    folder: Path
    found: Check
    progress: Progress
    graph: bool

    def run(self) -> None:
        """Look at every part; at the graph, if those it is made of are all right."""
        found, folder = self.found, self.folder
        rig = self._attempt(load_rig, folder)
        recording = self._attempt(_open, folder, rig)
        targets = (
            recording.targets if recording else self._attempt(read_targets, folder / "targets.csv")
        )
        if rig:
            found.contents.extend(inventory.of_rig(rig))
            found.odd.extend(inventory.odd_rig(rig))
        if rig and recording:
            found.contents.extend(inventory.of_stops(rig, recording))
            found.odd.extend(inventory.odd_stops(rig, recording))
            found.odd.extend(inventory.odd_copies(recording))
            found.odd.extend(inventory.odd_numbers(rig, recording))
            found.odd.extend(inventory.odd_levels(recording))
            found.odd.extend(inventory.odd_joints(rig, recording))
            self._tell(odd_bodies(rig, recording))
        scans = self._read_scans(rig)
        if rig and recording:
            self._tell(odd_scans(rig, recording, scans))
        if targets:
            found.contents.extend(inventory.of_targets(targets))
        if targets and rig and rig.target:
            self._tell(odd_targets(targets, rig.target))
        reference = self._read_mesh(rig)
        if reference and scans.points:
            self._tell(odd_mesh(reference, scans.reach_m))
        if self.graph and rig and recording and (reference or not rig.reference):
            self._try_graph(Source(rig, recording, reference), scans)
        for suspect in found.suspects:
            suspect["without"] = _token(suspect, rig, recording)

    def _tell(self, odd: Iterable[str | Suspect]) -> None:
        """Note what looks odd, as sentences and, what is likely a mishap, as entries."""
        for one in odd:
            suspect = isinstance(one, Suspect)
            self.found.odd.append(one.sentence if suspect else one)
            self.found.suspects.extend(one.documents() if suspect else ())

    def _attempt(self, function: Callable[..., T], *args: Any) -> T | None:
        """What the function returns, or None where it found a problem, which is noted once."""
        try:
            return function(*args)
        except UntiedError:  # which a fit from an earlier run does not mind
            raise
        except InputError as error:
            if str(error) not in self.found.problems:
                self.found.problems.append(str(error))
            return None

    def _read_scans(self, rig: Rig | None) -> ScanSums:
        paths = sorted(remote.files(self.folder / "scans", "*.parquet"))
        rings = rig.lidar.rings if rig and rig.lidar else None
        scans = ScanSums(rig.lidar if rig else None)
        for i, path in enumerate(paths):
            self.progress("reading scans", i, len(paths))
            scan = self._attempt(read_scan, path, rings)
            if scan is not None:
                scans.add(path.stem, scan)
        if scans.points:
            self.found.contents.extend(of_scans(scans))
        return scans

    def _read_mesh(self, rig: Rig | None) -> Reference | None:
        if rig is None or rig.reference is None:
            return None
        spec = rig.reference
        self.progress("reading the mesh", 0, 1)
        reference = self._attempt(Reference.read, spec.mesh, spec.faces, spec.labels)
        if reference is not None:
            self.found.contents.extend(inventory.of_mesh(reference))
        return reference

    def _try_graph(self, source: Source, scans: ScanSums) -> None:
        """Build the graph and linearise it once, without scans that are a problem already."""
        model = Model.of(None, (), (), [source.recording.folder])
        build = partial(problems.build, progress=self.progress)
        try:
            problem = self._attempt(build, [source], model)
        except UntiedError as error:
            self.found.odd.append(str(error))
            return
        if problem is None:
            return
        readable = [scan for scan in problem.scans if scan.name in scans.points]
        problem.scans = readable[:: -(-len(readable) // MOST_SCANS) or 1]
        values = problem.initial
        turned = lidars_turned(problem, values)
        # What bodies say of each other, or joints of a body, is said already.
        known = any(s["kind"] == "body" and s["stop"] is None for s in self.found.suspects)
        if written := [] if known else [*readings_of(problem, values, turned)]:
            self._tell(written)
        else:
            if turned:
                values = {**values, **turned}
                self._tell([_turned(problem.scans[0], problem.initial, values)])
            rooms = [*rooms_turned(problem, values)]
            self._tell(room.sentence for room in rooms)
            if not any(room.is_better for room in rooms):
                self._tell(map(_other_axes, axes_of(problem, values, turned)))
        kept, placed = [], []
        for i, scan in enumerate(problem.scans):
            self.progress("placing scans", i, len(problem.scans))
            at = self._attempt(_place, scan, values)
            if at is not None:
                kept.append(scan)
                placed.append(at)
        problem.scans = kept
        if placed:
            self.found.contents.extend(inventory.of_beams(placed))
            self.found.odd.extend(inventory.odd_beams(placed))
        estimate = self._attempt(preview, problem, self.progress)
        if estimate is not None:
            self.found.expected.update(_expected(estimate))
            self.found.cannot.extend(solution_of(problem, estimate).not_estimated)
            reached = reach(problem, estimate)
            if reached is not None:
                self.found.predicted.append(reached)
                if reached.is_small:
                    self.found.odd.append(reached.warning)


def _turned(scan: ScanStop, before: Values, after: Values) -> Suspect:
    """That the scans want the LiDAR's frame turned, as this one of them has it after."""
    tree = scan.stops.rig.tree
    edge = tree.edges[tree.path(scan.stops.rig.lidar_frame)[-1]]
    turn = se3.inverse(scan.pose(before)) @ scan.pose(after)
    rpy_rad = np.round(se3.to_rpy(edge.T_parent_child @ turn), 2) + 0.0  # no -0
    angle = float(np.linalg.norm(se3.so3_log(turn[:3, :3])))
    return Suspect(
        kind="frame",
        name=edge.child,
        size=angle,
        unit="rad",
        sentence=f"the scans fit the mesh with {edge.child} turned by {np.degrees(angle):.0f} deg "
        f"from CAD; check its rpy_rad in rig.yaml, which would be about {rpy_rad.tolist()}",
    )


def _other_axes(found: OtherAxes) -> str:
    """That coordinates want to be read with other axes."""
    if found.read is None:
        return (
            f"the scans of '{found.frame}' fit the mesh as a mirror would show them: are x and y "
            "exchanged, or does the azimuth count the other way round?"
        )
    signs, at = found.read.sum(axis=1), np.abs(found.read).argmax(axis=1)
    read = ", ".join(f"{'-' if s < 0 else ''}{'xyz'[i]}" for s, i in zip(signs, at, strict=True))
    of = {"mesh": "the mesh's vertices", "tracker": "the bodies' poses"}[found.whose]
    mirrored = np.linalg.det(found.read) < 0
    asked = "are they mirrored?" if mirrored else "is another axis up there than elsewhere?"
    return f"the scans would fit the mesh with {read} of {of} in place of x, y, z: {asked}"


def _token(
    suspect: Mapping[str, Any], rig: Rig | None, recording: RecordedStops | None
) -> str | None:
    """How ``--without`` names what a suspect is about, if it has a name for it."""
    kind, stop, name = (suspect[key] for key in ("kind", "stop", "name"))
    known = {"scan": f"{stop}:{SCAN}", "target": f"{name}:{ROD}", "frame": f"{CAD}:{name}"}
    token = known.get(kind, f"{stop}:{name}")
    if rig is None or recording is None:
        return None
    try:
        leave_out([Source(rig, recording, None)], [token])
    except InputError:
        return None
    return token


def _open(folder: Path, rig: Rig | None) -> RecordedStops:
    """The recording, its joints and bodies included where the rig says which they are."""
    if rig is None:
        return RecordedStops.open(folder, (), ())
    return recorded(rig)


def _place(scan: ScanStop, values: Values) -> PlacedScan:
    rows = scan.rows(values)
    met = rows.weight > 0
    meant_m = rows.view["range_m"][rows.usable]
    measured_m = meant_m + rows.residual_m[rows.usable]
    return PlacedScan(
        name=scan.name,
        T=scan.pose(values),
        share=float(rows.usable.mean()),
        range_m=rows.view["range_m"][met],
        incidence_rad=rows.view["incidence_rad"][met],
        residual_m=rows.median_m,
        further=float(np.median(meant_m / measured_m)) if len(meant_m) else 1.0,
    )


def _expected(estimate: Estimate) -> dict[str, dict[str, tuple[float, float]]]:
    """Per link and unit, the sigmas (least, largest) that data tell; in mm for m, mrad for rad."""
    sigma = np.sqrt(np.diag(estimate.covariance))
    shown = {"m": ("mm", 1e3), "rad": ("mrad", 1e3)}
    out: dict[str, dict[str, tuple[float, float]]] = {}
    start = 0
    for v in estimate.variables:
        now, units = sigma[start : start + v.dim], np.array(v.units)
        for unit in dict.fromkeys(v.units):
            told = now[(units == unit) & (now < LEFT_SIGMA * v.sigma)]
            if len(told):
                name, scale = shown.get(unit, (unit, 1.0))
                least, largest = (float(scale * f(told)) for f in (np.min, np.max))
                out.setdefault(v.name, {})[name] = (least, largest)
        start += v.dim
    return out


def _about(least: float, largest: float, unit: str) -> str:
    low, high = f"{least:.2g}", f"{largest:.2g}"
    return f"{low if low == high else f'{low} to {high}'} {unit}".rstrip()
