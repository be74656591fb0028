"""The page of one browser: its widgets, and what happens when they are used."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from calib.problem.model import recording_names
from calib.show.misfit import of_stop
from calib.view import colours, panels
from calib.view.bench import Bench
from calib.view.desk import DiagnosisCurve, Findings
from calib.view.job import Told
from calib.view.leave_out import LeaveOut
from calib.view.scene import Points
from calib.view.stage import AXES, PANEL_PX, RIG, ROOM, Stage
from chains.errors import InputError

CURVE_PX = 180
NOTHING = "—"
LOOKS = "Opened to look at: this address cannot change anything."


class Page:
    """The workbench in one browser. What is chosen here is chosen here alone; runs that are made,
    and the fit that makes them, are everybody's.

    Every widget's callback ends in a redrawing of what it changed.

    Args:
        client: viser's, of the browser.
        bench: what all browsers share.
        may_change: whether a fit may be started from here.
    """

    def __init__(self, client: Any, bench: Bench, may_change: bool) -> None:
        self.client, self.bench, self.may_change = client, bench, may_change
        self.desk = bench.desk()
        self.stage = Stage(client)
        self.findings: Findings | None = None
        self._columns: dict[str, str] = {}  # heading -> column that points can be coloured by
        self._covariates: dict[str, str] = {}  # heading -> covariate that has a curve
        self._lock = threading.RLock()
        gui = client.gui
        gui.configure_theme(show_logo=False, show_share_button=False)
        gui.main_panel.dock_right()
        gui.main_panel.set_width(PANEL_PX)
        gui.add_html(panels.note(LOOKS), visible=not may_change)
        self._note = gui.add_html("", visible=False)
        self._add_scan_widgets()
        self._add_ladder_widgets()
        self._blunders = LeaveOut(gui, self._on_leave_out)
        self._add_findings_widgets()
        client.scene.on_click()(self._guarded(self._on_point, with_event=True))

    def open(self) -> None:
        """Show the chosen run, and from now on what is being made."""
        self._guarded(self._show_run)()
        if self.desk.refused:
            self._tell("; ".join(self.desk.refused), bad=True)
        self.bench.listen(self._hear)
        self._show_busy()

    def close(self) -> None:
        """Its browser has gone."""
        self.bench.forget(self._hear)

    # ------------------------------------------------------------------------------------ widgets

    def _add_scan_widgets(self) -> None:
        gui = self.client.gui
        self._run = self._menu("Run", list(self.desk.runs), self._on_run)
        self._recording = self._menu("Recording", [NOTHING], self._on_recording)
        self._stop = self._menu("Stop", [NOTHING], self._on_stop)
        self._colour = self._menu("Colour", [NOTHING], lambda: self._paint())
        self._legend = gui.add_html("")
        self._below = gui.add_slider("Show up to, m", 0.0, 1.0, 0.01, 1.0, visible=False)
        self._below.on_update(self._guarded(self._paint))
        self._what = gui.add_button_group("Hide, show", ("room", "rig", "frames"))
        self._what.on_click(self._guarded(self._on_what))
        self._scan = gui.add_html("")
        self._point = gui.add_html(panels.note("Click a point to read it."))

    def _add_findings_widgets(self) -> None:
        gui = self.client.gui
        with gui.add_folder("Findings"):
            self._findings = gui.add_html("")
            self._formulas = gui.add_html("")
            self._effect = self._menu("Effect", [NOTHING], self._choose_curve)
            self._add = gui.add_button("Add", hint="Refit with this effect, from this run")
            self._diagnose = gui.add_button("Diagnose", visible=False)
            self._bar = gui.add_progress_bar(0.0, visible=False)
            self._doing = gui.add_html("", visible=False)
            self._cancel = gui.add_button("Cancel", visible=False, color="gray")
            self._over = self._menu("Curve over", [NOTHING], self._draw_curve)
            self._curve = gui.add_uplot(
                *_curve(None),
                scales={"x": {"time": False}},
                bands=({"series": (2, 3), "fill": "rgba(0, 0, 0, 0.08)"},),
                height=CURVE_PX,
            )
        self._add.on_click(self._guarded(self._on_add))
        self._diagnose.on_click(self._guarded(lambda: self._start(self.desk.run.folder)))
        self._cancel.on_click(self._guarded(self._on_cancel))

    def _add_ladder_widgets(self) -> None:
        with self.client.gui.add_folder("Ladder"):
            self._ladder = self.client.gui.add_html("")
            self._undo = self.client.gui.add_button("Undo", hint="Back to the run below")
        self._undo.on_click(self._guarded(self._on_undo))

    def _menu(self, label: str, options: list[str], use: Callable[[], None]) -> Any:
        menu = self.client.gui.add_dropdown(label, options)
        menu.on_update(self._guarded(use))
        return menu

    def _guarded(self, use: Callable[..., None], with_event: bool = False) -> Callable[..., None]:
        """A callback: one at a time, and what goes wrong is told on the page."""

        def call(event: Any = None) -> None:
            if event is not None and event.client is None:
                return  # the page itself changed the widget
            with self._lock:
                try:
                    use(event) if with_event else use()
                except InputError as error:
                    self._tell(str(error), bad=True)
                except Exception as error:
                    self._tell(f"internal fault: {type(error).__name__}: {error}", bad=True)

        return call

    def _tell(self, text: str, bad: bool = False) -> None:
        """Put a sentence above everything else; an empty one takes it away."""
        self._note.content, self._note.visible = panels.note(text, bad), bool(text)

    # ------------------------------------------------------------------------------- what is shown

    def _show_run(self) -> None:
        """Everything anew, for the chosen run."""
        desk = self.desk
        self._fill(self._run, list(desk.runs), desk.chosen)
        self._ladder.content = "".join(
            (panels.moved(desk.run), panels.ladder(desk.rungs()), panels.standing_out(desk.run))
        )
        self._undo.disabled = desk.rungs()[-1].below is None
        self._show_findings()
        self._tell(f"Reading the recordings of {desk.chosen} …")
        try:
            scene = self.bench.scene(desk.run)
        except InputError:
            self._show_nothing()
            raise
        self._fill(self._recording, scene.names, self._recording.value)
        self._recording.visible = len(scene.names) > 1
        self.stage.scene = scene
        self._on_recording()
        self._tell("")

    def _show_nothing(self) -> None:
        self.stage.clear()
        self._below.visible = False
        for menu in (self._recording, self._stop, self._colour):
            self._fill(menu, [NOTHING])
        for html in (self._legend, self._scan, self._point):
            html.content = ""

    def _on_run(self) -> None:
        self.desk.choose(self._run.value)
        self._show_run()

    def _on_recording(self) -> None:
        stops = self.stage.scene.stops(self._at)
        if not stops:
            self._show_nothing()
            raise InputError(f"{self._recording.value}: nothing was measured at any of its stops")
        self.stage.open(self.stage.scene, self._at)
        self._fill(self._stop, stops, self._stop.value)
        self._on_stop()

    def _on_stop(self) -> None:
        points = self.stage.show(self._at, self._stop.value)
        self._below.visible = self._colour.visible = points is not None
        self._point.content = panels.note("Click a point to read it.") if points else ""
        if points is None:
            self._legend.content = ""
            self._tell_scan(None, 0)
            return
        self._columns = {colours.column(n).heading: n for n in colours.choices(points)}
        self._fill(self._colour, list(self._columns), self._colour.value)
        low, high, free = self.stage.ceiling_m()
        self._below.min, self._below.max = np.floor(low * 100) / 100, np.ceil(high * 100) / 100
        self._below.value = float(np.clip(free, self._below.min, self._below.max))
        self._paint()

    def _paint(self) -> None:
        points = self.stage.points
        if points is None:
            return
        colour, scale = colours.coloured(points, self._columns[self._colour.value], self._labels)
        drawn = self.stage.paint(colour, self._below.value + 0.01)
        self._legend.content = panels.legend(scale)
        self._tell_scan(points, drawn)

    def _tell_scan(self, points: Points | None, drawn: int) -> None:
        stop, names = self._stop.value, recording_names(self.stage.scene.sources)
        label = f"{names[self._at]}.{stop}" if len(names) > 1 else stop
        found = self.desk.run.summary.get("misfit_by", {"stop": {}})["stop"].get(label, {})
        self._scan.content = panels.scan(points, drawn, stop, of_stop(found))

    def _on_what(self) -> None:
        self.stage.toggle({"room": ROOM, "rig": RIG, "frames": AXES}[self._what.value])

    def _on_point(self, event: Any) -> None:
        index = self.stage.pick(np.array(event.ray_origin), np.array(event.ray_direction))
        if index is not None:
            self._point.content = panels.point(self.stage.points, index, self._labels)

    @property
    def _at(self) -> int:
        """Number of the chosen recording."""
        return self.stage.scene.names.index(self._recording.value)

    @property
    def _labels(self) -> dict[int, str]:
        mesh = self.stage.scene.sources[self._at].reference
        return mesh.label_names if mesh else {}

    # ------------------------------------------------------------------------------- the findings

    def _show_findings(self) -> None:
        self.findings = None
        try:
            self.findings = Findings.read(self.desk.run)
        finally:
            self._findings.content = panels.findings(self.findings)
            self._formulas.content = panels.formulas(self.findings)
            self._blunders.show(self.findings.blunders if self.findings else [])
            self._diagnose.visible = self.findings is None
            self._fill(self._effect, list(self.desk.addable(self.findings)) or [NOTHING])
            found = self.findings
            worth = found is not None and bool(found.worth_adding or found.formulas)
            self._add.color = None if worth else "gray"
            self._choose_curve()

    def _choose_curve(self) -> None:
        """The curve that shows the chosen effect best."""
        names = list(self.findings.curves) if self.findings else []
        self._over.visible = self._curve.visible = bool(names)
        self._covariates = {colours.column(n).heading: n for n in names}
        if names:
            best = colours.column(self.findings.covariate_of(self._effect.value)).heading
            self._fill(self._over, list(self._covariates), best)
            self._draw_curve()

    def _draw_curve(self) -> None:
        name = self._covariates[self._over.value]
        scale = colours.column(name).scale
        self._curve.data, self._curve.series = _curve(
            self.findings.curves[name], self._over.value, scale
        )

    def _on_add(self) -> None:
        name = self._effect.value
        what = self.desk.addable(self.findings).get(name)
        if what is None:
            raise InputError(f"'{name}' is not an effect that can be added to this run")
        self._start(self.desk.run.folder, what, self.desk.folder_for(name))

    def _on_leave_out(self, tokens: Sequence[str]) -> None:
        def leave_out() -> None:
            run, out = self.desk.run.folder, self.desk.folder_without()
            self._start(run, out=out, without=tokens)

        self._guarded(leave_out)()

    def _on_undo(self) -> None:
        told = self.desk.undo()
        self._show_run()
        self._tell(told)

    # ------------------------------------------------------------------------- in the background

    def _start(self, run: Path, *what: Any, **more: Any) -> None:
        self._ask()
        self.bench.start(self, run, *what, **more)
        self._tell("")
        self._show_busy()

    def _on_cancel(self) -> None:
        self._ask()
        self.bench.stop()

    def _ask(self) -> None:
        """Whoever may only look has no buttons; this is for one who sends messages without."""
        if not self.may_change:
            raise InputError(LOOKS)

    def _show_busy(self) -> None:
        """Whether a job runs."""
        busy = self.bench.busy
        self._bar.visible = self._doing.visible = busy
        self._cancel.visible = busy and self.may_change
        self._add.disabled = self._diagnose.disabled = busy or not self.may_change
        self._blunders.busy(busy or not self.may_change)
        self._bar.value, self._doing.content = 0.0, panels.note("Starting …")

    def _hear(self, told: Told, by: Any) -> None:
        """Show what a job tells; `by` is the page that started it."""
        if told.kind == "progress":
            if not self._bar.visible:  # another page started it
                self._show_busy()
            self._bar.value = float(np.clip(100 * told.share, 0, 100))
            self._doing.content = panels.note(told.text)
        elif told.kind == "run":
            self._guarded(partial(self._made, Path(told.text), by is self))()
        else:
            self._guarded(partial(self._ended, told, by is self))()

    def _made(self, folder: Path, here: bool) -> None:
        """A run stands: it is shown where it was asked for, and offered elsewhere."""
        if here:
            self.desk.choose(self.desk.name_of(folder))
            self._show_run()
        else:
            self._fill(self._run, list(self.desk.runs), self.desk.chosen)
        self._tell(panels.new_run(folder))

    def _ended(self, told: Told, here: bool) -> None:
        self._show_busy()
        if told.kind == "done" and self.findings is None:
            self._show_findings()
        if told.kind == "stopped" and here:
            self._tell("Cancelled; what was not finished left nothing behind.")
        if told.kind == "failed" and here:
            raise InputError(told.text)

    def _fill(self, menu: Any, options: list[str], chosen: str | None = None) -> None:
        """Give a menu other options, and choose one of them: the first where `chosen` is none."""
        menu.options = options
        menu.value = chosen if chosen in options else options[0]


def _curve(curve: DiagnosisCurve | None, over: str = "", scale: float = 1.0) -> tuple[Any, Any]:
    """Data and series of a curve with its band; of none, two points."""
    if curve is None:
        curve = DiagnosisCurve(*(np.zeros(2),) * 3)
    data = (curve.centres * scale, curve.mean_mm, curve.band_mm, -curve.band_mm)
    edge = {"stroke": "#888888", "width": 1, "dash": (4, 4), "points": {"show": False}}
    series = (
        {"label": over},
        {"label": "mean residual, mm", "stroke": "#0072b2", "width": 2},
        {"label": "chance", **edge},
        {"label": "to", **edge},
    )
    return data, series
