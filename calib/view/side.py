"""The beams of one run, in its room and in its plot; those of another run may stand beside them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from calib.runs.run import Run
from calib.view.scene import Points, Scene
from calib.view.shown import brush, colours, plot, sizes
from calib.view.shown.area import Area
from calib.view.shown.columns import LOCATION, gathered, kept, location_names
from calib.view.stage import Drawing
from chains.errors import InputError

Ends = tuple[float, float]


@dataclass(frozen=True)
class Chosen:
    """What is shown of the beams of all sides, on the same scales.

    Args:
        colour, up, over: columns: as colour, and in the plot up and across.
        size: a column as the size of dots; None where all are alike.
        colour_ends, size_ends: of their scales; None where there is no such scale.
        below_m: height up to which beams are drawn in the room.
        between: values of `over`, beams between which are lit.
        area: a part of the room whose beams are lit.
    """

    colour: str
    up: str
    over: str
    size: str | None
    colour_ends: Ends | None
    size_ends: Ends | None
    below_m: float
    between: Ends | None = None
    area: Area | None = None

    @property
    def lights(self) -> bool:
        """Whether some beams are lit."""
        return self.between is not None or self.area is not None


@dataclass
class Side:
    """A run at a stop.

    Args:
        stage: where its room is drawn.
        name: of the run.
    """

    stage: Drawing
    name: str = ""
    kept: np.ndarray = field(default_factory=lambda: np.zeros(0, bool))
    colours: np.ndarray = field(default_factory=lambda: np.zeros((0, 3), np.uint8))
    scale: colours.Scale | None = None
    clicked: int | None = None
    drawn: int = 0
    at: int = 0
    _known: tuple[Any, ...] = ()

    @property
    def points(self) -> Points | None:
        """Its beams; None where the stop was not scanned."""
        return self.stage.points

    @property
    def scene(self) -> Scene | None:
        """Its run and where that puts everything."""
        return self.stage.scene

    def open(self, scene: Scene, name: str, at: int) -> None:
        """Take another run, or another of its recordings.

        Raises:
            InputError: nothing was measured at any stop.
        """
        self.name, self.at, self._known = name, at, ()
        self.stage.scene = scene
        if not scene.stops(at):
            raise InputError(f"{scene.names[at]}: nothing was measured at any of its stops")
        self.stage.open(scene, at)

    def go(
        self, stop: str, stops: Sequence[str], other: Run | Literal["as in CAD"] | None
    ) -> Points | None:
        """Stand at a stop, with the beams of some stops; arguments as of `gathered`.

        Raises:
            InputError: as there, or nothing was measured at the stop.
        """
        known = (self.scene.run.folder, self.at, tuple(stops), other)
        points = self.points
        if known != self._known:
            self._known = ()
            points = gathered(self.scene, self.at, stops, other)
            self._known = known
        self.stage.show(self.at, stop, points)
        self.clicked = None
        return points

    def keep(self, text: str) -> str:
        """Look at the beams that a formula keeps, and at all where it is wrong; what is wrong."""
        try:
            self.kept, wrong = kept(self.points, text), ""
        except InputError as error:
            self.kept, wrong = kept(self.points, ""), str(error)
        return wrong

    def lit(self, chosen: Chosen) -> np.ndarray | None:
        """Which beams (N,) are lit; None where all of them are shown alike."""
        if chosen.area is not None:
            return chosen.area.holds(self.points.xyz_m)
        if chosen.between is not None:
            return brush.within(self.points, chosen.over, chosen.between)
        return None

    def paint(self, chosen: Chosen) -> None:
        """Draw the beams in the room, in colours that `scale` says the meaning of."""
        points, name = self.points, chosen.colour
        self.colours, self.scale = colours.coloured(
            points, name, self.names(name), chosen.colour_ends
        )
        lit = self.lit(chosen)
        if lit is not None:
            self.colours[~lit] = brush.UNLIT
        self.drawn = self.stage.paint(
            self.colours, chosen.below_m, self.kept, lit, self._steps(chosen)
        )

    def chart(self, chosen: Chosen) -> plot.Chart:
        """The plot of the same beams."""
        beside = {"lit": self.lit(chosen), "marked": self.clicked, "steps": self._steps(chosen)}
        rows = np.flatnonzero(self.kept)
        return plot.chart(self.points, rows, chosen.up, chosen.over, self.colours, **beside)

    def _steps(self, chosen: Chosen) -> np.ndarray | None:
        if chosen.size is None:
            return None
        return sizes.steps(self.points, chosen.size, chosen.size_ends)

    def names(self, column: str) -> dict[int, str]:
        """What the numbers of a column stand for."""
        if column == LOCATION:
            return location_names(self.scene, self.at)
        mesh = self.scene.sources[self.at].reference
        return mesh.label_names if mesh and column == "label" else {}


class Sides:
    """The run that is looked at, and beside it another, if there is one.

    Args:
        client: viser's, of the browser.
        window_px: width and height of its window, the panels included.
        camera: as of `Drawing`.
    """

    def __init__(
        self, client: Any, window_px: tuple[int, int], camera: tuple[float, ...] | None
    ) -> None:
        self._client, self._window_px = client, window_px
        self.first = Side(Drawing(client, window_px, camera))
        self.second: Side | None = None

    def __iter__(self) -> Iterator[Side]:
        yield self.first
        if self.second is not None:
            yield self.second

    @property
    def shift_m(self) -> tuple[float, ...]:
        """By how much (3,) the second room stands elsewhere; nothing where there is none."""
        return tuple(self.second.stage.shift_m.tolist()) if self.second else ()

    @property
    def with_beams(self) -> list[Side]:
        """Those whose stop was scanned; none where that of the first was not."""
        return [s for s in self if s.points is not None] if self.first.points is not None else []

    def open_second(self, scene: Scene, name: str, at: int, shift_m: Sequence[float] = ()) -> None:
        """Show another run, in a room that stands elsewhere by so much (3,); as it stands where
        there is one, and where not as the eye sees them side by side."""
        if self.second is None:
            if not len(shift_m):
                shift_m = self.first.stage.step_aside()
            stage = Drawing(self._client, self._window_px, shift_m=np.array(shift_m))
            stage.hidden = set(self.first.stage.hidden)
            self.second = Side(stage)
        self.second.open(scene, name, at)
        for side in self:
            side.stage.call(side.name)

    def follow(self, stop: str, stops: Sequence[str]) -> str:
        """Have the second run stand where the first does; why it cannot."""
        if self.second is None:
            return ""
        try:
            self.second.go(stop, stops, self.first.scene.run)
        except InputError as error:
            self.second.stage.show_no_points()
            return f"{self.second.name}: {error}"
        return ""

    def close_second(self) -> None:
        """Show the first alone."""
        if self.second is not None:
            if self.first.scene is not None:
                self.first.stage.step_back()
            self.second.stage.remove()
            self.second = None
        self.first.stage.call("")

    def turn(self, path: str, seen: bool) -> None:
        """Have what stands under a path seen, or not."""
        if seen == (path in self.first.stage.hidden):
            self.toggle(path)

    def toggle(self, name: str) -> None:
        """Hide a part of both rooms, or show it again."""
        for side in self:
            side.stage.toggle(name)

    def area(self, corners: Sequence[Sequence[float]]) -> Area:
        """The part of the room that is seen between two corners of the picture: of the room in
        which there are more beams."""
        seen = self.first.stage.area(corners)
        areas = [seen.moved(-side.stage.shift_m) for side in self]
        counts = [
            np.count_nonzero(area.holds(side.points.xyz_m)) if side.points is not None else 0
            for side, area in zip(self, areas, strict=True)
        ]
        return areas[int(np.argmax(counts))]

    def picked(self, origin_m: np.ndarray, direction: np.ndarray) -> Side | None:
        """The side one of whose beams was clicked, which is marked; None where the click met
        none."""
        for side in self:
            index = side.stage.pick(origin_m, direction)
            if index is not None:
                side.clicked = index
                return side
        return None
