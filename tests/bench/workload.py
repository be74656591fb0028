"""What the benchmarks fit: scans of an OS0-128 in the simulated lab; and steps of the fit."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

from calib.problem import Problem, build
from calib.problem.model import Model, Source
from calib.residuals.beams import Association, CompressedScan, SharedSum
from calib.residuals.scan import ScanStop
from calib.simulation import Spec, room, simulate
from calib.solve.graph import Graph
from sensors.recording import Recording, Scan
from sensors.reference import Reference

Values = dict[str, np.ndarray]
BEAMS = 128 * 1024  # of an OS0-128 per turn
CELL_M = 0.106  # of the mesh: 50,000 triangles


@dataclass(frozen=True)
class Held(Recording):
    """A recording whose scans stay in memory."""

    scans: dict[int, Scan] = field(default_factory=dict)

    def scan(self, stop: int) -> Scan:
        """The scan of one stop."""
        return self.scans[stop]


@dataclass(frozen=True)
class Work:
    """A problem, where trackers and targets alone lead to, and what beams meet there."""

    source: Source
    problem: Problem
    start: Values
    associations: Sequence[Association]

    @classmethod
    def of(cls, source: Source) -> Work:
        """The default model on a recording."""
        problem = build([source], Model())
        graph = Graph(list(problem.variables.values()), problem.blocks)
        start = graph.solve(problem.initial)[0]
        associations = [s.associate(start, near_edges=True) for s in problem.scans]
        return cls(source, problem, start, associations)

    @property
    def rows(self) -> int:
        """How many rows there are."""
        return sum(len(a.part) for a in self.associations)

    def thinned(self, rows: int) -> Work:
        """About so many of the rows, evenly over the stops."""
        every = max(1, self.rows // rows)
        recording = self.source.recording
        thin = {k: _every(scan, every) for k, scan in recording.scans.items()}
        return Work.of(replace(self.source, recording=replace(recording, scans=thin)))

    def step(self, values: Values, compressed: Callable[[int, ScanStop], CompressedScan]) -> Values:
        """One Gauss-Newton step of a fit: every stop compressed, then the graph solved."""
        poses, shared = [], SharedSum()
        for i, scan in enumerate(self.problem.scans):
            rows = compressed(i, scan)
            poses.append(rows.pose)
            shared.add(rows)
        blocks = [*self.problem.blocks, *poses, *shared.rows()]
        return Graph(list(self.problem.variables.values()), blocks).step(values)

    def frozen_step(self) -> Values:
        """A step from the start; what beams meet is kept."""
        kept = self.associations
        return self.step(self.start, lambda i, scan: scan.compress(self.start, kept[i]))

    def whole_step(self) -> Values:
        """A step from the start, casts included."""
        return self.step(self.start, lambda i, scan: scan.compress(self.start))


def _every(scan: Scan, n: int) -> Scan:
    fields = dict(vars(scan))
    extra = {name: values[::n] for name, values in fields.pop("extra").items()}
    return Scan(**{name: values[::n] for name, values in fields.items()}, extra=extra)


def recorded(folder: Path, rows: int, stops: int) -> Path:
    """A simulated recording with about so many rows at so many stops."""
    spec = Spec(
        lidar="ouster_os0_128_rev7",
        locations=stops // 2,
        stops_per_location=2,
        column_step=max(1, stops * BEAMS // rows),
        occluded_share=0,
    )
    with mock.patch.object(room, "CELL_M", CELL_M):
        simulate(spec, folder / "recording", seed=0)
    return folder / "recording"


def held(folder: Path) -> Source:
    """A recording with its scans in memory."""
    source = Source.open(folder)
    scans = {int(k): source.recording.scan(k) for k in np.flatnonzero(source.recording.has_scan)}
    return replace(source, recording=Held(**vars(source.recording), scans=scans))


def one_thread() -> Any:
    """Rays on one thread, as numpy is; Open3D takes all otherwise."""
    first_triangle = Reference.first_triangle

    def alone(self, origins_m, directions, nthreads=0):
        return first_triangle(self, origins_m, directions, nthreads=1)

    return mock.patch.object(Reference, "first_triangle", alone)


def timed(run: Callable[[], Any], repeats: int = 1) -> tuple[Any, float]:
    """What it returns, and the median of its CPU seconds, which a busy machine changes little."""
    seconds = []
    for _ in range(repeats):
        start = time.process_time()
        found = run()
        seconds.append(time.process_time() - start)
    return found, float(np.median(seconds))
