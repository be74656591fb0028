"""The part of the page that shows beams: the room at a stop, and a plot of the same beams."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from calib.problem.model import recording_names
from calib.results.outstanding import of_stop
from calib.runs.run import Run
from calib.view import panels
from calib.view.plans.ghosts import PLANNED_PATH
from calib.view.scene import Points, Scene
from calib.view.shown import brush, colours, look, plot, sizes, taken
from calib.view.shown.columns import AS_IN_CAD, comparable, gathered
from calib.view.shown.menu import NOTHING, RoomMenu, fill
from calib.view.shown.panel import ALL_STOPS, THIS, PlotPanel
from calib.view.side import Chosen, Ends, Sides
from calib.view.stage import AXES_PATH, MOVES_PATH, NARROW_PX, RIG_PATH, ROOM_PATH, Drawing
from chains.errors import InputError

FREE = "free"


class Picture:
    """What one browser shows of a run's beams, and the widgets that choose it.

    Args:
        client: viser's.
        window_px: width and height of its window, the panels included.
        guarded: makes a callback of what a widget does.
        asks: what the browser's address asks for, by `look.KEYS`.
        scene_of: what a run shows.
    """

    def __init__(
        self,
        client: Any,
        window_px: tuple[int, int],
        guarded: Callable[..., Callable[..., Any]],
        asks: Mapping[str, str],
        scene_of: Callable[[Run], Scene],
    ) -> None:
        camera = look.numbers(asks.get("camera", ""), 6)
        self._sides = Sides(client, window_px, camera)
        self._client, self._guarded, self._asks = client, guarded, dict(asks)
        self._scene_of = scene_of
        self._columns: dict[str, str] = {}  # heading -> column
        self._others: dict[str, Run] = {}
        self._scales = look.read_scales(asks.get("scales", ""))
        self.menu = RoomMenu(client.gui, asks)
        locked = asks.get("scales") != FREE
        self.panel = PlotPanel(client.gui, asks, locked, window_px[0] < NARROW_PX)
        self._wire()
        self._on_moves()
        client.scene.on_click()(guarded(self._on_point, of=lambda event: event))
        client.scene.on_rect_select(modifier="shift")(
            guarded(self._on_area, of=lambda event: (event.screen_min, event.screen_max))
        )
        for key, step, name in (("N", 1, "Next stop"), ("P", -1, "Previous stop")):
            command = client.gui.add_command(name, hotkey=key)
            command.on_trigger(guarded(lambda step=step: self._step(step)))

    @property
    def stage(self) -> Drawing:
        """Where the room of the run is drawn that is looked at."""
        return self._sides.first.stage

    # ------------------------------------------------------------------------------------ widgets

    def _wire(self) -> None:
        """Have every widget call what it is used for."""
        menu, panel, value = self.menu, self.panel, {"of": lambda event: event.target.value}
        for widget, use in (
            (menu.recording, self._on_recording),
            (menu.stop, self._on_stop),
            (menu.colour, self._paint),
            (menu.size, self._paint),
            (menu.below, self._paint),
            (menu.moves, self._on_moves),
            (menu.planned, self._on_planned),
            (panel.stops, self._on_stop),
            (panel.other, self._on_other),
            (panel.beside, self._on_other),
            (panel.only, self._on_only),
            (panel.lock, self._on_lock),
            (panel.up, self._draw_plot),
            (panel.over, self._on_over),
            (panel.light, self._on_light),
        ):
            widget.on_update(self._guarded(use))
        panel.light_all.on_click(self._guarded(self._on_light_all))
        panel.take.on_click(self._guarded(self._on_take, **value))
        menu.what.on_click(self._guarded(self._on_what, **value))
        go = {"next": 1, "previous": -1}
        menu.go.on_click(self._guarded(lambda way: self._step(go[way]), **value))

    # ------------------------------------------------------------------------------ what is shown

    def look(self) -> dict[str, str]:
        """What is shown now, by `look.KEYS`, but for the run."""
        if self.stage.scene is None:
            return {}
        column, panel = self._columns.get, self.panel
        told = self._others or panel.other.value != NOTHING  # of several, none may be chosen
        return {
            "recording": self.menu.recording.value if self.menu.recording.visible else "",
            "stop": self.menu.stop.value,
            "stops": "" if panel.stops.value == THIS else panel.stops.value,
            "other": panel.other.value if panel.other.visible and told else "",
            "beside": ",".join(f"{x:.3f}" for x in self._sides.shift_m),
            "colour": column(self.menu.colour.value, ""),
            "size": column(self.menu.size.value, ""),
            "scales": look.write_scales(self._scales) if panel.lock.value else FREE,
            "only": panel.only.value,
            "up": column(panel.up.value, ""),
            "over": column(panel.over.value, ""),
            "lit": panel.light.value,
            "area": panel.area.write() if panel.area else "",
            "moves": "1" if self.menu.moves.value else "",
            "below": f"{self.menu.below.value:.2f}",
            "camera": ",".join(f"{x:.6g}" for x in np.round(self.stage.camera(), 3) + 0.0),
        }

    def show(self, scene: Scene, others: Mapping[str, Run], below: str | None = None) -> None:
        """Show a run.

        Args:
            scene: of the run.
            others: by name, those that its residuals may be compared with.
            below: which of them it is compared with at first.

        Raises:
            InputError: nothing can be shown, or the address asks for what is not here.
        """
        self._fill(self.menu.recording, scene.names, "recording")
        self.menu.recording.visible = len(scene.names) > 1
        self._others = {n: run for n, run in others.items() if comparable(scene.run, run)}
        other, at = self.panel.other, self._number(scene)
        meshed = scene.sources[at].reference is not None and bool(scene.run.summary["points"])
        first = [NOTHING, AS_IN_CAD] if meshed else [NOTHING]
        other.visible = meshed or bool(self._others)
        other.value = below if below in self._others else NOTHING
        self._fill(other, [*first, *self._others], "other")
        self.stage.scene = scene
        self._on_recording()
        asked = {"recording": "recording", "stop": "stop", "other": "other run"}
        gone = [f"{what} '{self._asks[k]}'" for k, what in asked.items() if self._asks.get(k)]
        self._asks = {}
        if gone:
            raise InputError(f"the address asks for {', '.join(gone)}, which is not here")

    def beams(self) -> Points:
        """Some beams of all stops.

        Raises:
            InputError: there are none.
        """
        if self.stage.scene is None:
            raise InputError("nothing of this run can be shown, so nothing can be tried")
        at = self._number(self.stage.scene)
        points = gathered(self.stage.scene, at, self.stage.scene.stops(at))
        if points is None:
            raise InputError("this run has no beams, which is what a formula here acts on")
        return points

    def clear(self) -> None:
        """Show nothing."""
        self._sides.close_second()
        self.stage.clear()
        for menu in (self.menu.recording, self.menu.stop, self.menu.colour, self.menu.size):
            fill(menu, [NOTHING])
        self.menu.scan.content = ""
        self.menu.show(False)
        self.panel.show(False)

    # ---------------------------------------------------------------------------- runs and stops

    def _on_recording(self) -> None:
        scene, run, room = self.stage.scene, self.stage.scene.run, self.stage.room
        try:
            self._sides.first.open(scene, run.folder.name, self._number(scene))
        except InputError:
            self.clear()
            raise
        self.menu.lines_why(self.stage.lines_why)
        if room not in (None, self.stage.room):
            self.panel.area = None  # it is of another room
        self._fill(self.menu.stop, scene.stops(self._sides.first.at), "stop")
        shift_m = look.numbers(self._asks.pop("beside", ""), 3)
        if shift_m is not None:
            self.panel.beside.value = True
        self._on_other(shift_m or ())

    def _on_other(self, shift_m: Sequence[float] = ()) -> None:
        """Compare with another run, in a room beside this one where that is ticked."""
        run = self._others.get(self.panel.other.value)
        self.panel.beside.visible = run is not None
        if run is None or not self.panel.beside.value:
            self._sides.close_second()
        else:
            scene = self._scene_of(run)
            name, at = self.panel.other.value, self._number(scene)
            self._sides.open_second(scene, name, at, shift_m)
        self._on_stop()

    def _step(self, step: int) -> None:
        """Go to the next stop, or one back; after the last comes the first."""
        stops = list(self.menu.stop.options)
        self.menu.stop.value = stops[(stops.index(self.menu.stop.value) + step) % len(stops)]
        self._on_stop()

    def _on_stop(self) -> None:
        stop, stops, chosen = self.menu.stop.value, self._chosen_stops(), self.panel.other.value
        other = AS_IN_CAD if chosen == AS_IN_CAD else self._others.get(chosen)
        points = self._sides.first.go(stop, stops, other)
        wrong = self._sides.follow(stop, stops)
        self.menu.moved.content = panels.moves(self.stage.moves)
        self.menu.planned.visible = bool(self.stage.ghosts)
        self.menu.show(points is not None)
        self.panel.show(points is not None)
        if points is None:
            self._tell_scan()
            return
        self._offer_columns(points)
        low, high, free = self.stage.ceiling_m()
        below = self.menu.below
        below.min, below.max = np.floor(low * 100) / 100, np.ceil(high * 100) / 100
        asked = look.numbers(self._asks.pop("below", ""), 1)
        below.value = float(np.clip(asked[0] if asked else free, below.min, below.max))
        self._on_only()
        if wrong:
            raise InputError(wrong)

    def show_planned(self) -> None:
        """Draw the plan beside the run."""
        self._on_stop()
        self.menu.planned.value = True
        self._sides.turn(PLANNED_PATH, True)

    def _chosen_stops(self) -> list[str]:
        here, wanted = self._sides.first, self.panel.stops.value
        if wanted == THIS:
            return [self.menu.stop.value]
        stops, recording = here.scene.stops(here.at), here.scene.sources[here.at].recording
        if wanted == ALL_STOPS:
            return stops
        place = dict(zip(recording.stops, recording.location, strict=True))
        return [name for name in stops if place[name] == place[self.menu.stop.value]]

    def _offer_columns(self, points: Points) -> None:
        offered = colours.choices(points)
        self._columns = {colours.column(n).heading: n for n in offered}
        numbers = [colours.column(n).heading for n in sizes.choices(offered)]
        for menu, key, options, default in (
            (self.menu.colour, "colour", list(self._columns), None),
            (self.menu.size, "size", [NOTHING, *numbers], NOTHING),
            (self.panel.up, "up", numbers, None),
            (self.panel.over, "over", numbers, colours.column("range_m").heading),
        ):
            asked = self._asks.pop(key, None)
            wanted = colours.column(asked).heading if asked in offered else None
            fill(menu, options, wanted or (default if menu.value == NOTHING else None))

    # -------------------------------------------------------------------------- columns and scales

    def _on_only(self) -> None:
        """Keep the beams that the formula keeps; one that is wrong is told of, and keeps all."""
        wrong = ""
        for side in reversed(self._sides.with_beams):
            wrong = side.keep(self.panel.only.value)
        said = self.panel.wrong
        said.content, said.visible = panels.note(wrong, bad=True), bool(wrong)
        self._paint()

    def _on_lock(self) -> None:
        self._scales = {}
        self._paint()

    def _ends(self, name: str) -> Ends:
        """Ends of a column's scale: as they were, where scales are kept."""
        ends = colours.limits(self.stage.points, name)
        if not self.panel.lock.value:
            return ends
        return self._scales.setdefault(colours.scale_key(name), ends)

    def _chosen(self) -> Chosen:
        column, panel = self._columns, self.panel
        colour, size = column[self.menu.colour.value], column.get(self.menu.size.value)
        return Chosen(
            colour=colour,
            up=column[panel.up.value],
            over=column[panel.over.value],
            size=size,
            colour_ends=None if colour in colours.NAMES else self._ends(colour),
            size_ends=self._ends(size) if size else None,
            below_m=self.menu.below.value + 0.01,
            between=brush.ends(panel.light.value),
            area=panel.area,
        )

    def _paint(self) -> None:
        sides = self._sides.with_beams
        if not sides:
            return
        chosen = self._chosen()
        for side in sides:
            side.paint(chosen)
        size = panels.size_key(*sizes.key(chosen.size, chosen.size_ends)) if chosen.size else ""
        self.menu.explain(panels.legend(self._sides.first.scale), size)
        self._tell_scan()
        self._draw_plot()

    def _draw_plot(self) -> None:
        sides = self._sides.with_beams
        if not sides:
            return
        chosen = self._chosen()
        charts, axes = self._charts(chosen)
        said = []
        for side in sides:
            told = panels.plotted(side.points, np.flatnonzero(side.kept), chosen.up, axes)
            said.append(told + panels.lit(side.points, side.kept, side.lit(chosen), up=chosen.up))
        with self._client.atomic():
            names = [side.name for side in sides]
            self.panel.draw(list(zip(names, charts, said, strict=True)), axes)
            self.panel.light_all.visible = chosen.lights

    def _charts(self, chosen: Chosen) -> tuple[list[plot.Chart], dict[str, Any]]:
        """The plots of all sides, and the axes that they share."""
        charts = [side.chart(chosen) for side in self._sides.with_beams]
        known = [chart[0][0] for chart in charts if chart is not plot.EMPTY]
        return charts, plot.axes(known, *self._ends(chosen.up))

    # ------------------------------------------------------------------------ what is lit and told

    def _on_over(self) -> None:
        if self.panel.lit_over != self._columns[self.panel.over.value]:
            self.panel.light.value = ""  # a range of another column
        self._paint()

    def _on_light(self) -> None:
        """Light up a range of the plot, in the place of a part of the room."""
        self.panel.area, self.panel.lit_over = None, self._columns.get(self.panel.over.value, "")
        self._paint()

    def _on_area(self, corners: Sequence[Sequence[float]]) -> None:
        """Light up a part of the room, in the place of a range of the plot."""
        if self._sides.with_beams:
            self.panel.area, self.panel.light.value = self._sides.area(corners), ""
            self._paint()

    def _on_light_all(self) -> None:
        self.panel.area, self.panel.light.value = None, ""
        self._paint()

    def _on_take(self, kind: str) -> None:
        sides = self._sides.with_beams
        if not sides:
            raise InputError("there are no beams here, so there is no plot to take away")
        chosen, run = self._chosen(), self.stage.scene.run
        content = taken.plot_file(sides, chosen, *self._charts(chosen), kind)
        name = f"{run.folder.name}-{chosen.up}-over-{chosen.over}.{kind.lower()}"
        self._client.send_file_download(name, content, save_immediately=True)

    def _tell_scan(self) -> None:
        side, stop = self._sides.first, self.menu.stop.value
        names = recording_names(side.scene.sources)
        label = f"{names[side.at]}.{stop}" if len(names) > 1 else stop
        found = side.scene.run.summary.get("misfit_by", {"stop": {}})["stop"].get(label, {})
        self.menu.scan.content = panels.scan(side.points, side.drawn, stop, of_stop(found))

    def _on_what(self, part: str) -> None:
        self._sides.toggle({"room": ROOM_PATH, "rig": RIG_PATH, "frames": AXES_PATH}[part])

    def _on_moves(self) -> None:
        self._sides.turn(MOVES_PATH, self.menu.moves.value)
        self.menu.moved.visible = self.menu.moves.value

    def _on_planned(self) -> None:
        self._sides.turn(PLANNED_PATH, self.menu.planned.value)

    def _on_point(self, event: Any) -> None:
        side = self._sides.picked(np.array(event.ray_origin), np.array(event.ray_direction))
        if side is not None:
            names = {name: side.names(name) for name in colours.NAMES}
            self.menu.point.content = panels.point(side.points, side.clicked, names)
            self._draw_plot()

    def _number(self, scene: Scene) -> int:
        """Number of the chosen recording."""
        return scene.names.index(self.menu.recording.value)

    def _fill(self, menu: Any, options: Sequence[str], key: str = "") -> None:
        """Give a menu other options; chosen is what the address asks for, or what was, or the
        first."""
        if fill(menu, options, self._asks.get(key)):
            del self._asks[key]
