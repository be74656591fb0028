"""A problem: all unknowns of a model on its recordings, and all rows that depend on them."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np

from calib.effects import Site
from calib.forward import Derivatives, Term, Values
from calib.problem.model import Source, labels
from calib.problem.unknowns import Unknown
from calib.residuals.beams import CellNumbers
from calib.residuals.scan import ScanStop
from calib.residuals.seen import SeenBody
from calib.residuals.surfaces import Meeting
from calib.residuals.targets import HangingTarget
from calib.residuals.tracker import TrackedBody


class Block(Protocol):
    """Whitened rows of one kind that should be zero but for unit noise.

    ``evaluate`` gives residuals (m,) and, when asked, the derivative by each unknown: (m, n) for a
    vector, (m, 6) for a pose by its right increment.
    """

    name: str
    kind: str
    variables: tuple[str, ...]
    rows: int

    def evaluate(
        self, values: Values, derivatives: bool
    ) -> tuple[np.ndarray, Derivatives | None]: ...


@dataclass(frozen=True)
class SourceStops:
    """One recording in a problem.

    Args:
        number: which of the problem's sources it is.
        source: the recording.
        terms: the model's effects on its rig.
        chosen: (K,) bool, which stops take part.
        prefix: before the names of its own unknowns; empty where it is the only recording.
        label: what it is called beside others, see `labels`.
    """

    number: int
    source: Source
    terms: Sequence[Term]
    chosen: np.ndarray
    prefix: str
    label: str

    @property
    def has_lidar(self) -> bool:
        """Whether any of those stops was scanned."""
        scanned = self.source.recording.has_scan[self.chosen]
        return self.source.rig.lidar is not None and bool(scanned.any())


@dataclass(frozen=True)
class SurfaceCells:
    """Parts of a mesh, or of planes, that stand off the room, each by an unknown way along its
    normal, or by an unknown tilt.

    Args:
        column: what kind of part: surface, region or patch.
        kind: of all those with one spread; see `calib.problem.surfaces.kinds_of`.
        parts: (P,) those that any beam meets, ascending.
        surface: (P,) the surface that each is of.
        room: the mesh, or the recording whose planes these are.
        axis: along which they tilt, as of `calib.residuals.beams.Association.from_middle_m`; None
            where they stand off as a whole.
        width_m: (P,) how wide those that tilt are along it.
    """

    column: str
    kind: str
    parts: np.ndarray
    surface: np.ndarray
    room: int | str
    axis: int | None = None
    width_m: np.ndarray | None = None

    @property
    def of_mesh(self) -> bool:
        """Whether they are parts of a mesh."""
        return isinstance(self.room, int)


@dataclass
class Problem:
    """Unknowns, their start, and blocks; `calibration` names what a user wants to know.

    Args:
        sources: the recordings.
        terms: per source, the model's effects.
        variables: the unknowns, by name.
        initial: values to start from.
        calibration: unknowns that describe the hardware, in the order in which they are shown.
        blocks: rows of trackers, levels and targets.
        scans: one per stop with a scan.
        meetings: per source, what its beams meet.
        cells: unknowns of surfaces, once what beams meet is settled.
        aside: scans that a fit has set aside, as they contradict all others; bodies that it has
            weigh nothing.
    """

    sources: Sequence[Source]
    terms: list[list[Term]]
    variables: dict[str, Unknown] = field(default_factory=dict)
    initial: dict[str, np.ndarray] = field(default_factory=dict)
    calibration: list[str] = field(default_factory=list)
    blocks: list[Block] = field(default_factory=list)
    scans: list[ScanStop] = field(default_factory=list)
    meetings: dict[int, Meeting] = field(default_factory=dict)
    cells: Mapping[str, SurfaceCells] = field(default_factory=dict)
    aside: Sequence[ScanStop] = ()

    @property
    def bodies(self) -> list[TrackedBody]:
        """The blocks of tracked bodies."""
        return [block for block in self.blocks if isinstance(block, TrackedBody)]

    @property
    def seen(self) -> list[SeenBody]:
        """The blocks of bodies at stops, whatever instrument sees them."""
        return [block for block in self.blocks if isinstance(block, SeenBody)]

    @property
    def of_noise(self) -> list[Unknown]:
        """The unknowns of effects on the noise, by which rows are weighed."""
        terms = {t.variable: t for some in self.terms for t in some}.values()
        return [self.variables[t.variable] for t in terms if t.effect.site is Site.NOISE]

    @property
    def set_aside(self) -> frozenset[str]:
        """Tokens of the scans, and of the bodies at stops, that a fit has set aside."""
        weights = ((b.groups, b.weight) for b in self.seen if b.weight is not None)
        bodies = (g for groups, w in weights for g, x in zip(groups, w, strict=True) if x == 0)
        return frozenset(g.token for g in (*(scan.group for scan in self.aside), *bodies))

    def setting_aside(self, tokens: Collection[str]) -> Problem:
        """The problem with these scans and bodies, and no others, set aside; see `Group.token`."""
        if self.set_aside == set(tokens):
            return self
        order = {source.recording.folder: i for i, source in enumerate(self.sources)}
        every = [*self.scans, *self.aside]  # in the order of their stops, as when built
        every.sort(key=lambda scan: (order[scan.recording.folder], scan.index))
        kept = [scan for scan in every if scan.group.token not in tokens]
        gone = [scan for scan in every if scan.group.token in tokens]
        blocks = [
            block.setting_aside(tokens) if isinstance(block, SeenBody) else block
            for block in self.blocks
        ]
        return replace(self, scans=kept, aside=gone, blocks=blocks)

    def resting_on(self, known: Collection[str], held: Collection[str]) -> Problem:
        """The problem for a fit from an earlier one: of targets that the earlier fit rests on, the
        spheres weigh nothing. What these say is known from there. They count where the model has an
        unknown of targets that the earlier fit did not have, as nothing else would tell of it.

        Args:
            known: digests, as of `Source.measured_targets`.
            held: unknowns that the earlier fit tells of.
        """
        gone = {
            (label, target)
            for label, source in zip(labels(self.sources), self.sources, strict=True)
            for target, digest in source.measured_targets.items()
            if digest in known
        }
        if not gone:
            return self

        def rests(block: Block) -> bool:
            there = isinstance(block, HangingTarget) and block.groups[0].place in gone
            return there and {block.reference, *block.of_effects}.issubset(held)

        blocks = [block.without_sphere() if rests(block) else block for block in self.blocks]
        return replace(self, blocks=blocks)

    def add(self, unknown: Unknown, value: np.ndarray | None = None) -> str:
        """Add an unknown once; it starts at `value`, or at its mean."""
        if unknown.name not in self.variables:
            self.variables[unknown.name] = unknown
            self.initial[unknown.name] = unknown.mean if value is None else value
        return unknown.name

    def loosened(self, moved: Mapping[str, float]) -> Problem:
        """The problem where unknowns have moved since CAD told of them; see `Model.moved`."""
        known = self.variables.items()
        return replace(self, variables={n: u.loosened(moved.get(n, 0.0)) for n, u in known})

    def with_cells(self, unknowns: Sequence[Unknown], cells: Mapping[str, SurfaceCells]) -> Problem:
        """The problem with unknowns of its surfaces; its scans know which of these moves what."""
        numbers = {
            name: CellNumbers.of(some.column, some.parts, some.axis) for name, some in cells.items()
        }

        def numbered(scan: ScanStop) -> ScanStop:
            felt = {n: numbers[n] for n, some in cells.items() if some.room == scan.room}
            return replace(scan, cells=felt if scan.reference_sigma_m else {})

        return replace(
            self,
            scans=[numbered(scan) for scan in self.scans],
            variables=self.variables | {u.name: u for u in unknowns},
            initial=self.initial | {u.name: u.mean for u in unknowns},
            cells=cells,
        )
