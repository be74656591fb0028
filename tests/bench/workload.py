"""What the benchmarks fit: scans of an OS0-128 in the simulated lab; and steps of the fit."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
from threadpoolctl import threadpool_limits

from calib.linear.layout import Layout
from calib.linear.linearise import linearise
from calib.linear.parallel import in_order, workers
from calib.problem import Problem, build
from calib.problem.model import Model, Source
from calib.residuals.beams import Association
from calib.simulation import Spec, room, simulate
from calib.solve.fit import preview
from calib.solve.graph import Graph, KeptRows
from sensors.recording import RecordedStops, Scan
from sensors.reference import Reference

Values = dict[str, np.ndarray]
BEAMS = 128 * 1024  # of an OS0-128 per turn
FIRST_TRIANGLE = Reference.first_triangle
CELL_M = 0.106  # of the mesh: 50,000 triangles


@dataclass(frozen=True)
class Held(RecordedStops):
    """A recording whose scans stay in memory."""

    scans: dict[int, Scan] = field(default_factory=dict)

    def scan(self, stop: int) -> Scan:
        """The scan of one stop."""
        return self.scans[stop]


@dataclass(frozen=True)
class Work:
    """A problem with its surfaces' unknowns, where trackers and targets alone lead to, and what
    beams meet there."""

    source: Source
    problem: Problem
    start: Values
    associations: Sequence[Association]

    @classmethod
    def of(cls, source: Source) -> Work:
        """The default model on a recording."""
        found = preview(build([source], Model()))
        return cls(source, found.problem, found.values, found.associations)

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

    def step(self, values: Values, associations: Sequence[Association]) -> Values:
        """One Gauss-Newton step of a fit: linearised, down to the graph, and back to all."""
        linear = linearise(self.problem, values, associations, layout=self.layout)
        outer, unknowns = self.layout.outer(), self.layout.unknowns
        blocks = [*self.layout.others, *KeptRows.of(linear)]
        after, moved, _ = Graph(list(outer.values()), blocks).step(values)
        inner = linear.step(np.concatenate([moved[name] for name in outer]))
        inner = {name: unknowns[name].moved(values[name], step) for name, step in inner.items()}
        return {**values, **after, **inner}

    @cached_property
    def layout(self) -> Layout:
        """As a fit makes it once."""
        return Layout.of(self.problem)

    def frozen_step(self) -> Values:
        """A step from the start; what beams meet is kept."""
        return self.step(self.start, self.associations)

    def whole_step(self) -> Values:
        """A step from the start, casts included; they meet the surfaces that they met before."""
        return self.step(self.start, list(in_order(self.cast, len(self.associations))))

    def cast(self, i: int) -> Association:
        """What the beams of a stop meet at the start, found anew."""
        found = self.problem.scans[i].associate(self.start, near_edges=False)
        return replace(found, patches=self.associations[i].patches)


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


@contextmanager
def threads(count: int) -> Iterator[None]:
    """So many stops at a time, and rays on so many threads; BLAS on one."""

    def cast(self, origins_m, directions, nthreads=0):
        return FIRST_TRIANGLE(self, origins_m, directions, nthreads=count)

    rays = mock.patch.object(Reference, "first_triangle", cast)
    with threadpool_limits(1), workers(count), rays:
        yield


def timed(
    run: Callable[[], Any],
    repeats: int = 1,
    clock: Callable[[], float] = time.process_time,
) -> tuple[Any, float]:
    """What it returns, and the median of its CPU seconds, which a busy machine changes little."""
    seconds = []
    for _ in range(repeats):
        start = clock()
        found = run()
        seconds.append(clock() - start)
    return found, float(np.median(seconds))
