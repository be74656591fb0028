"""The part of the page that shows beams: the room at a stop, and a plot of the same beams."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from calib.problem.model import recording_names
from calib.runs.run import Run
from calib.show.misfit import of_stop
from calib.view import panels
from calib.view.scene import Points, Scene
from calib.view.shown import brush, colours, look, plot
from calib.view.shown.columns import LOCATION, comparable, gathered, kept, location_names
from calib.view.shown.moves import SURE, TIMES_AS_LONG
from calib.view.shown.taken import beams_csv
from calib.view.stage import AXES_PATH, MOVES_PATH, NARROW_PX, PLOT_PX, RIG_PATH, ROOM_PATH, Drawing
from chains.errors import InputError

NO_VALUE = "—"
THIS, HERE, ALL_STOPS = "this stop", "its location", "all stops"
CLICK = "Click a point to read it. Keys: N next stop, P previous stop."
ONLY = "A formula, e.g. (range > 3) * (abs(residual) > 0.002); metres, radians. * is and"
PLOT_HEIGHT_PX = 300
FREE_SCALES = "free"
MOVES_LABEL = f"Moves x {TIMES_AS_LONG}"
MOVES_HINT = (
    f"How far each link stands from CAD, {TIMES_AS_LONG} times as long; "
    f"grey: less than {SURE:.0f} sigmas"
)


class Picture:
    """What one browser shows of a run's beams, and the widgets that choose it.

    Args:
        client: viser's.
        window_px: width and height of its window, the panels included.
        guarded: makes a callback of what a widget does.
        asks: what the browser's address asks for, by `look.KEYS`.
    """

    def __init__(
        self,
        client: Any,
        window_px: tuple[int, int],
        guarded: Callable[..., Callable[..., None]],
        asks: Mapping[str, str],
    ) -> None:
        self.stage = Drawing(client, window_px, look.numbers(asks.get("camera", ""), 6))
        self._client, self._guarded, self._asks = client, guarded, dict(asks)
        self._columns: dict[str, str] = {}  # heading -> column
        self._others: dict[str, Run] = {}
        self._scales = look.read_scales(asks.get("scales", ""))
        self._known: tuple[Any, ...] = ()  # what the points were gathered for
        self._kept = np.zeros(0, bool)
        self._clicked: int | None = None  # index of a beam
        self._add_menus()
        self._add_plot(window_px[0] < NARROW_PX)
        self._on_moves()
        client.scene.on_click()(guarded(self._on_point, with_event=True))
        for key, step, name in (("N", 1, "Next stop"), ("P", -1, "Previous stop")):
            command = client.gui.add_command(name, hotkey=key)
            command.on_trigger(guarded(lambda step=step: self._step(step)))

    # ------------------------------------------------------------------------------------ widgets

    def _add_menus(self) -> None:
        gui = self._client.gui
        self.recording = self._menu("Recording", self._on_recording)
        self.stop = self._menu("Stop", self._on_stop)
        self._go = gui.add_button_group("Go to", ("previous", "next"), hint="Keys: P and N")
        self._go.on_click(self._guarded(lambda: self._step(1 if self._go.value == "next" else -1)))
        self._colour = self._menu("Colour", self._paint)
        self._legend = gui.add_html("")
        self._below = gui.add_slider("Show up to, m", 0.0, 1.0, 0.01, 1.0, visible=False)
        self._below.on_update(self._guarded(self._paint))
        self._what = gui.add_button_group("Hide, show", ("room", "rig", "frames"))
        self._what.on_click(self._guarded(self._on_what))
        self._lines_why = gui.add_html("", visible=False)
        self._moves = gui.add_checkbox(MOVES_LABEL, bool(self._asks.get("moves")), hint=MOVES_HINT)
        self._moves.on_update(self._guarded(self._on_moves))
        self._moved = gui.add_html("", visible=False)
        self._scan = gui.add_html("")
        self._point = gui.add_html(panels.note(CLICK))

    def _add_plot(self, narrow: bool) -> None:
        gui = self._client.gui
        panel = gui.add_panel()
        with panel.add_tab("Beams"):
            stops = self._asks.get("stops")
            menu = (THIS, HERE, ALL_STOPS)
            self._stops = gui.add_dropdown(
                "Beams of", menu, initial_value=stops if stops in menu else THIS
            )
            self._stops.on_update(self._guarded(self._on_stop))
            self._other = self._menu("Other run", self._on_stop)
            self._only = gui.add_text("Only where", self._asks.get("only", ""), hint=ONLY)
            self._only.on_update(self._guarded(self._on_only))
            self._wrong = gui.add_html("", visible=False)
            locked = self._asks.get("scales") != FREE_SCALES
            self._lock = gui.add_checkbox("Keep scales", locked, hint="Off: as the beams are")
            self._lock.on_update(self._guarded(self._on_lock))
            self._up = self._menu("Plot", self._draw_plot)
            self._over = self._menu("Over", self._on_over)
            lit = self._asks.get("lit", "")
            self._light = gui.add_text(brush.LABEL, lit, hint=brush.BRUSH_HINT)
            self._light.on_update(self._guarded(self._paint))
            self._plot = gui.add_uplot(
                *plot.EMPTY,
                scales={"x": {"time": False}},
                cursor={"drag": {"setScale": False, "x": True}},
                legend={"show": False},
                height=PLOT_HEIGHT_PX,
            )
            self._told = gui.add_html("")
            self._take = gui.add_button("Plot as CSV", hint="The beams of the plot", color="gray")
            self._take.on_click(self._guarded(self._on_take))
        panel.dock_left()
        panel.set_width(PLOT_PX)
        if narrow:
            panel.minimize()

    def _menu(self, label: str, use: Callable[[], None]) -> Any:
        menu = self._client.gui.add_dropdown(label, [NO_VALUE])
        menu.on_update(self._guarded(use))
        return menu

    # ------------------------------------------------------------------------------ what is shown

    def look(self) -> dict[str, str]:
        """What is shown now, by `look.KEYS`, but for the run."""
        if self.stage.scene is None:
            return {}
        column = self._columns.get
        return {
            "recording": self.recording.value if self.recording.visible else "",
            "stop": self.stop.value,
            "stops": "" if self._stops.value == THIS else self._stops.value,
            "other": self._other.value if self._other.visible else "",
            "colour": column(self._colour.value, ""),
            "scales": look.write_scales(self._scales) if self._lock.value else FREE_SCALES,
            "only": self._only.value,
            "up": column(self._up.value, ""),
            "over": column(self._over.value, ""),
            "lit": self._light.value,
            "moves": "1" if self._moves.value else "",
            "below": f"{self._below.value:.2f}",
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
        self._fill(self.recording, scene.names, "recording")
        self.recording.visible = len(scene.names) > 1
        self._others = {n: run for n, run in others.items() if comparable(scene.run, run)}
        self._known = ()
        self._other.visible = bool(self._others)
        self._other.value = below if below in self._others else NO_VALUE
        self._fill(self._other, [NO_VALUE, *self._others], "other")
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
        points = gathered(self.stage.scene, self._at, self.stage.scene.stops(self._at))
        if points is None:
            raise InputError("this run has no beams, which is what a formula here acts on")
        return points

    def clear(self) -> None:
        """Show nothing."""
        self.stage.clear()
        self._below.visible = False
        for menu in (self.recording, self.stop, self._colour, self._up, self._over):
            self._fill(menu, [NO_VALUE])
        for html in (self._legend, self._scan, self._point, self._told):
            html.content = ""
        self._plot.visible = False

    def _on_recording(self) -> None:
        stops = self.stage.scene.stops(self._at)
        if not stops:
            name = self.recording.value
            self.clear()
            raise InputError(f"{name}: nothing was measured at any of its stops")
        self.stage.open(self.stage.scene, self._at)
        why = self.stage.lines_why
        self._lines_why.content, self._lines_why.visible = panels.note(why), bool(why)
        self._fill(self.stop, stops, "stop")
        self._on_stop()

    def _step(self, step: int) -> None:
        """Go to the next stop, or one back; after the last comes the first."""
        stops = list(self.stop.options)
        self.stop.value = stops[(stops.index(self.stop.value) + step) % len(stops)]
        self._on_stop()

    def _on_stop(self) -> None:
        scene, at, stop = self.stage.scene, self._at, self.stop.value
        stops = self._chosen_stops()
        known = (scene.run.folder, at, tuple(stops), self._other.value)
        if known != self._known:
            other = self._others.get(self._other.value)
            self._known = ()
            points = gathered(scene, at, stops, other)
            self._known = known
        else:
            points = self.stage.points
        self.stage.show(at, stop, points)
        self._moved.content = panels.moves(self.stage.moves)
        self._clicked = None
        for widget in (self._below, self._colour, self._up, self._over, self._plot):
            widget.visible = points is not None
        self._point.content = panels.note(CLICK) if points else ""
        if points is None:
            self._legend.content = self._told.content = ""
            self._tell_scan(None, 0)
            return
        self._offer_columns(points)
        low, high, free = self.stage.ceiling_m()
        self._below.min, self._below.max = np.floor(low * 100) / 100, np.ceil(high * 100) / 100
        asked = look.numbers(self._asks.pop("below", ""), 1)
        below = asked[0] if asked else free
        self._below.value = float(np.clip(below, self._below.min, self._below.max))
        self._on_only()

    def _chosen_stops(self) -> list[str]:
        if self._stops.value == THIS:
            return [self.stop.value]
        stops, recording = self.stage.scene.stops(self._at), self._source.recording
        if self._stops.value == ALL_STOPS:
            return stops
        place = dict(zip(recording.stops, recording.location, strict=True))
        return [name for name in stops if place[name] == place[self.stop.value]]

    def _offer_columns(self, points: Points) -> None:
        offered = colours.choices(points)
        self._columns = {colours.column(n).heading: n for n in offered}
        numbers = [h for h, n in self._columns.items() if n not in colours.NAME_COLUMNS]
        for menu, key, options, default in (
            (self._colour, "colour", list(self._columns), None),
            (self._up, "up", numbers, None),
            (self._over, "over", numbers, colours.column("range_m").heading),
        ):
            asked = self._asks.pop(key, None)
            first = colours.column(asked).heading if asked in offered else default
            if menu.value in (NO_VALUE, None) or asked:
                menu.options, menu.value = options, first if first in options else options[0]
            self._fill(menu, options)

    def _on_only(self) -> None:
        """Keep the beams that the formula keeps; one that is wrong is told of, and keeps all."""
        points = self.stage.points
        if points is None:
            return
        try:
            self._kept, wrong = kept(points, self._only.value), ""
        except InputError as error:
            self._kept, wrong = kept(points, ""), str(error)
        self._wrong.content, self._wrong.visible = panels.note(wrong, bad=True), bool(wrong)
        self._paint()

    def _on_lock(self) -> None:
        self._scales = {}
        self._paint()

    def _ends(self, name: str) -> tuple[float, float]:
        """Ends of a column's scale: as they were, where scales are kept."""
        ends = colours.limits(self.stage.points, name)
        if not self._lock.value:
            return ends
        return self._scales.setdefault(colours.scale_key(name), ends)

    def _paint(self) -> None:
        points = self.stage.points
        if points is None:
            return
        name = self._columns[self._colour.value]
        ends = None if name in colours.NAME_COLUMNS else self._ends(name)
        colour, scale = colours.coloured(points, name, self._names(name), ends)
        lit = self._lit
        if lit is not None:
            colour[~lit] = brush.UNLIT
        drawn = self.stage.paint(colour, self._below.value + 0.01, self._kept, lit)
        self._legend.content = panels.legend(scale)
        self._tell_scan(points, drawn)
        self._colours = colour
        self._draw_plot()

    def _on_over(self) -> None:
        self._light.value = ""  # a range of another column
        self._paint()

    @property
    def _lit(self) -> np.ndarray | None:
        """Which beams (N,) are lit; None where no range was chosen."""
        between = brush.ends(self._light.value)
        if between is None:
            return None
        return brush.within(self.stage.points, self._columns[self._over.value], between)

    def _draw_plot(self) -> None:
        up, over = (self._columns[menu.value] for menu in (self._up, self._over))
        rows = np.flatnonzero(self._kept)
        low, high = self._ends(up)
        points, lit = self.stage.points, self._lit
        beside = {"lit": lit, "marked": self._clicked}
        data, series = plot.chart(points, rows, up, over, self._colours, **beside)
        axes = plot.axes(data[0], low, high)
        with self._client.atomic():
            self._plot.scales = axes
            self._plot.data, self._plot.series = data, series
        told = panels.plotted(points, rows, up, axes)
        self._told.content = told + panels.lit(points, self._kept, lit)

    def _on_take(self) -> None:
        points, menus = self.stage.points, (self._over, self._up, self._colour)
        if points is None:
            raise InputError("there are no beams here, so there is no plot to take away")
        names = [self._columns[menu.value] for menu in menus]
        lit = np.ones(len(points.xyz_m), bool) if self._lit is None else self._lit
        table = beams_csv(points, np.flatnonzero(self._kept), names, lit)
        name = f"{self.stage.scene.run.folder.name}-{names[1]}-over-{names[0]}.csv"
        self._client.send_file_download(name, table, save_immediately=True)

    def _tell_scan(self, points: Points | None, drawn: int) -> None:
        stop, names = self.stop.value, recording_names(self.stage.scene.sources)
        label = f"{names[self._at]}.{stop}" if len(names) > 1 else stop
        run = self.stage.scene.run
        found = run.summary.get("misfit_by", {"stop": {}})["stop"].get(label, {})
        self._scan.content = panels.scan(points, drawn, stop, of_stop(found))

    def _on_what(self) -> None:
        self.stage.toggle(
            {"room": ROOM_PATH, "rig": RIG_PATH, "frames": AXES_PATH}[self._what.value]
        )

    def _on_moves(self) -> None:
        if self._moves.value == (MOVES_PATH in self.stage.hidden):
            self.stage.toggle(MOVES_PATH)
        self._moved.visible = self._moves.value

    def _on_point(self, event: Any) -> None:
        index = self.stage.pick(np.array(event.ray_origin), np.array(event.ray_direction))
        if index is not None:
            names = {name: self._names(name) for name in colours.NAME_COLUMNS}
            self._point.content = panels.point(self.stage.points, index, names)
            self._clicked = index
            self._draw_plot()

    @property
    def _at(self) -> int:
        """Number of the chosen recording."""
        return self.stage.scene.names.index(self.recording.value)

    @property
    def _source(self) -> Any:
        return self.stage.scene.sources[self._at]

    def _names(self, column: str) -> dict[int, str]:
        """What the numbers of a column stand for."""
        if column == LOCATION:
            return location_names(self.stage.scene, self._at)
        mesh = self._source.reference
        return mesh.label_names if mesh and column == "label" else {}

    def _fill(self, menu: Any, options: Sequence[str], key: str = "") -> None:
        """Give a menu other options; chosen is what the address asks for, or what was, or the
        first."""
        asked = self._asks.get(key)
        chosen = asked if asked in options else menu.value
        menu.options = tuple(options)
        menu.value = chosen if chosen in options else options[0]
        if asked in options:
            del self._asks[key]
