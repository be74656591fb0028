"""The page of one browser: its widgets, and what happens when they are used."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from calib.runs.ladder import Rung
from calib.view import panels
from calib.view.bench import Bench
from calib.view.desk import Findings
from calib.view.effects import known
from calib.view.effects.curve import CurveOver
from calib.view.effects.expected import Asked, Expected
from calib.view.effects.own import OwnFormula, document
from calib.view.effects.ticks import Ticks
from calib.view.job import Change, JobMessage, PlanStops, Report, Task
from calib.view.leave_out import LeaveOut
from calib.view.picture import Picture
from calib.view.plans.ask import AskPlan
from calib.view.plans.ghosts import plan_beside
from calib.view.server import Visitor
from calib.view.shown import brush, look
from calib.view.shown.menu import NOTHING, fill
from calib.view.shown.moves import parameters
from calib.view.shown.taken import extrinsics_zip, run_zip
from calib.view.stage import PANEL_PX
from chains.errors import InputError

SETTLED_S = 0.4  # the camera rests for so long before the address tells where it is
EXPORTS, REPORT_FILE, FOLDER = "Exports", "Report", "Run folder"
TAKE_HINT = (
    "What 'rigcal export' writes, in all formats; what 'rigcal report' writes; all of the run"
)
WORKED_OUT = "The held-out error is being predicted from the linearisation …"
LOOKS = "Read-only: this address cannot change anything."


class Page:
    """The workbench in one browser. What is chosen here is chosen here alone; runs that are made,
    and the fit that makes them, are everybody's.

    Every widget's callback ends in a redrawing of what it changed.

    Args:
        visitor: the browser, whether a fit may be started from it, and what its address asks for.
        bench: what all browsers share.
    """

    def __init__(self, visitor: Visitor, bench: Bench) -> None:
        client = visitor.client
        # Of the window until the panels are docked, then of what they leave of it.
        window_px = client.camera.image_width, client.camera.image_height
        self.client, self.bench, self.may_change = client, bench, visitor.may_change
        self.desk = bench.desk()
        self.findings: Findings | None = None
        self._visitor, self._asks = visitor, look.read(visitor.asks)
        self._settling: threading.Timer | None = None
        self._address = ""
        self._lock = threading.RLock()
        self._worker = ThreadPoolExecutor(1, "rigcal page")  # what was used first is done first
        self._written: TemporaryDirectory | None = None  # where a report is being written
        self._asked: Asked | None = None
        self._expected = Expected(
            self.desk.trust, lambda *told: self._guarded(partial(self._on_expected, *told))()
        )
        gui = client.gui
        gui.main_panel.dock_right()
        gui.main_panel.set_width(PANEL_PX)
        gui.add_html(panels.note(LOOKS), visible=not self.may_change)
        self._note, self._wrong = gui.add_html("", visible=False), False
        self._run = gui.add_dropdown("Run", list(self.desk.runs))
        self._run.on_update(self._heard(self._on_run))
        self.picture = Picture(client, window_px, self._heard, self._asks, bench.scene)
        visitor.run(brush.SCRIPT.read_text(encoding="utf-8"))
        self._add_ladder_widgets()
        self._blunders = LeaveOut(gui, self._heard, self._on_leave_out)
        self._add_findings_widgets()
        self._plan = AskPlan(gui, self._heard, self._on_plan)
        self._dark = gui.add_checkbox("Dark", bool(self._asks.get("dark")))
        self._dark.on_update(self._heard(self._paint_page))
        self._paint_page()
        client.camera.on_update(self._on_camera)

    def open(self) -> None:
        """Show the chosen run, and from now on what is being made."""
        self._guarded(self._begin)()
        if self.desk.refused:
            self._tell("; ".join(self.desk.refused), bad=True)
        self.bench.listen(self._hear)
        self._show_busy()

    def close(self) -> None:
        """Its browser has gone."""
        self.bench.forget(self._hear)
        self._expected.stop()
        self._worker.shutdown(wait=False, cancel_futures=True)
        if self._settling is not None:
            self._settling.cancel()

    def _begin(self) -> None:
        asked = self._asks.get("run")
        if asked in self.desk.runs:
            self.desk.choose(asked)
        self._show_run()
        if asked is not None and asked not in self.desk.runs:
            raise InputError(f"the address asks for run '{asked}', which is not here")

    # ------------------------------------------------------------------------------------ widgets

    def _add_findings_widgets(self) -> None:
        gui = self.client.gui
        with gui.add_folder("Findings"):
            self._findings = gui.add_html("")
            self._formulas = gui.add_html("")
            self._diagnose = gui.add_button("Diagnose", visible=False)
            self._curve = CurveOver(gui, self._heard)
        self._ticks = Ticks(gui, self._heard, self._on_ticks, self._on_refit)
        with self._ticks.folder:
            self._bar = gui.add_progress_bar(0.0, visible=False)
            self._doing = gui.add_html("", visible=False)
            self._cancel = gui.add_button("Cancel", visible=False, color="gray")
            self._own = OwnFormula(gui, self._heard, self._on_own)
        self._diagnose.on_click(self._heard(self._start))
        self._cancel.on_click(self._heard(self._on_cancel))

    def _add_ladder_widgets(self) -> None:
        with self.client.gui.add_folder("Ladder"):
            self._ladder = self.client.gui.add_html("")
            self._undo = self.client.gui.add_button("Undo", hint="Back to the run below")
        with self.client.gui.add_folder("Parameters", expand_by_default=False):
            self._parameters = self.client.gui.add_html("")
        files = (EXPORTS, REPORT_FILE, FOLDER)
        take = self.client.gui.add_button_group("Download", files, hint=TAKE_HINT)
        take.on_click(self._heard(self._on_take, of=lambda event: event.target.value))
        self._undo.on_click(self._heard(self._on_undo))

    def _heard(
        self, use: Callable[..., None], of: Callable[[Any], Any] | None = None
    ) -> Callable[[Any], Any]:
        """A callback of a widget. What a person does is done in its order, however long each step
        takes.

        Args:
            use: what the widget does.
            of: what of the event it is called with; nothing where None.
        """

        async def heard(event: Any) -> None:
            if event.client is None:
                return  # the page itself changed the widget
            told = () if of is None else (of(event),)
            step = self._guarded(partial(self._do, use, *told))
            with contextlib.suppress(RuntimeError):  # the page is being closed
                self._worker.submit(step)

        return heard

    def _do(self, use: Callable[..., None], *told: Any) -> None:
        """What a widget does; what was wrong before is told no more."""
        if self._wrong:
            self._tell("")
        use(*told)

    def _guarded(self, use: Callable[[], None]) -> Callable[[], None]:
        """Do it while nothing else is done; what goes wrong is told on the page."""

        def call() -> None:
            with self._lock:
                try:
                    use()
                except InputError as error:
                    self._tell(str(error), bad=True)
                except Exception as error:
                    self._tell(f"internal fault: {type(error).__name__}: {error}", bad=True)
                self._readdress()

        return call

    def _paint_page(self) -> None:
        dark = self._dark.value
        self.client.gui.configure_theme(show_logo=False, show_share_button=False, dark_mode=dark)

    def _readdress(self) -> None:
        """Have the browser's address ask for what is shown."""
        dark = "1" if self._dark.value else ""
        text = look.write({"run": self.desk.chosen, "dark": dark, **self.picture.look()})
        if text != self._address:
            self._address = text
            self._visitor.readdress(text)

    def _on_camera(self, _: Any) -> None:
        """The camera moves at every frame: wait until it rests."""
        if self._settling is not None:
            self._settling.cancel()
        self._settling = threading.Timer(SETTLED_S, self._guarded(lambda: None))
        self._settling.daemon = True
        self._settling.start()

    def _tell(self, text: str, bad: bool = False) -> None:
        """Put a sentence above everything else; an empty one takes it away."""
        self._note.content, self._note.visible = panels.note(text, bad), bool(text)
        self._wrong = bad

    # ------------------------------------------------------------------------------- what is shown

    def _show_run(self) -> None:
        """Everything anew, for the chosen run."""
        with self.client.atomic():  # nothing of another run stands beside what is of this one
            self._show_numbers()
            self._show_findings()
            self._tell(f"Reading the recordings of {self.desk.chosen} …")
        desk = self.desk
        try:
            scene = self.bench.scene(desk.run)
        except InputError:
            self.picture.clear()
            raise
        others = {name: run for name, run in desk.runs.items() if name != desk.chosen}
        below = desk.rungs()[-1].below
        self._plan.of(scene.sources[0].rig)
        self.picture.show(scene, others, desk.name_of(below.folder) if below else None)
        self._tell("")

    def _show_numbers(self) -> None:
        desk = self.desk
        fill(self._run, list(desk.runs), desk.chosen)
        self._ladder.content = "".join(
            (panels.moved(desk.run), panels.ladder(desk.rungs()), panels.standing_out(desk.run))
        )
        self._parameters.content = panels.framed(parameters(desk.run))
        self._undo.disabled = desk.rungs()[-1].below is None

    def _on_run(self) -> None:
        self.desk.choose(self._run.value)
        self._show_run()

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
            offered = self.desk.addable(self.findings)
            listed = list(offered)[: panels.SHOWN_CANDIDATES] if self.findings else []
            self._ticks.show(self.desk.effects, offered, listed)
            self._plan.show(self.findings.remedies if self.findings else [])

    def _on_ticks(self, wanted: Mapping[str, Any]) -> str:
        """Show the curve of what was ticked last; what is known of all that is ticked."""
        first = next(iter(self.desk.addable(self.findings)), NOTHING) if self.findings else ""
        self._curve.show(self.findings, self._ticks.latest or first)
        others = {name: run for name, run in self.desk.runs.items() if name != self.desk.chosen}
        told = known.told(self.desk.run, wanted, self.findings, others)
        self._asked = None
        before = self.desk.run.summary["rms_mm"]["held_out"]
        if told.endswith(known.NOT_KNOWN_YET) and before is not None and self.may_change:
            self._asked = (
                self.desk.run.folder,
                self._change(*known.difference(self.desk.effects, wanted)),
            )
            self._expected.ask(*self._asked)
            told = told.removesuffix(known.NOT_KNOWN_YET) + WORKED_OUT
        return told

    def _on_expected(self, asked: Asked, after: float | None) -> None:
        """Tell what was worked out of the set that is ticked, if it still is."""
        if asked == self._asked:
            before = self.desk.run.summary["rms_mm"]["held_out"]
            self._ticks.tell(known.linearised(before, after))

    def _change(self, added: Mapping[str, Any], dropped: Sequence[str]) -> Change:
        out = self.desk.folder_for(*added, dropped=dropped)
        return Change(out, tuple(added.values()), tuple(dropped))

    def _on_refit(self, added: Mapping[str, Any], dropped: Sequence[str]) -> None:
        if not added and not dropped:
            raise InputError("these are the effects of the run; tick others, or untick some")
        self._start(self._change(added, dropped))

    def _on_own(self, text: str, site: str) -> None:
        effect = document(text, site, self.picture.beams(), self.desk.run.effects)
        self._start(Change(self.desk.folder_for(effect["name"]), (effect,)))

    def _on_leave_out(self, tokens: Sequence[str]) -> None:
        self._start(Change(self.desk.folder_without(), without=tuple(tokens)))

    def _on_plan(self, purpose: str | None, stops: int) -> None:
        self._start(PlanStops(plan_beside(self.desk.run).parent, purpose, stops))

    def _on_take(self, what: str) -> None:
        name = self.desk.run.folder.name
        if what == REPORT_FILE:
            self._ask()
            written = TemporaryDirectory(prefix="rigcal-report-")
            self._start(Report(Path(written.name) / f"{name}.html"))
            self._written = written
        elif what == FOLDER:
            self._send(f"{name}.zip", run_zip(self.desk.run))
        else:
            self._send(f"{name}-extrinsics.zip", extrinsics_zip(self.desk.run))

    def _send(self, name: str, content: bytes) -> None:
        self.client.send_file_download(name, content, save_immediately=True)

    def _send_report(self, done: bool) -> None:
        """Give the report to who asked for it, and leave nothing of it here."""
        written, self._written = self._written, None
        if written is not None:
            with written as folder:
                for file in Path(folder).glob("*.html") if done else ():
                    self._send(file.name, file.read_bytes())

    def _on_undo(self) -> None:
        told = self.desk.undo()
        self._show_run()
        self._tell(told)

    # ------------------------------------------------------------------------- in the background

    def _start(self, change: Task | None = None) -> None:
        self._ask()
        self.bench.start(self, self.desk.run.folder, change)
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
        self._diagnose.disabled = busy or not self.may_change
        for widget in (self._blunders, self._ticks, self._own, self._plan):
            widget.busy(busy or not self.may_change)
        self._bar.value, self._doing.content = 0.0, panels.note("Starting …")

    def _hear(self, told: JobMessage, by: Any) -> None:
        """Show what a job tells; `by` is the page that started it."""
        if told.kind == "progress":
            if not self._bar.visible:  # another page started it
                self._show_busy()
            self._bar.value = float(np.clip(100 * told.share, 0, 100))
            self._doing.content = panels.note(told.text)
        elif told.kind == "run":
            self._guarded(partial(self._made, Path(told.text), by is self))()
        elif told.kind == "plan":
            if by is self:
                self._guarded(partial(self._planned, told.text))()
        else:
            self._guarded(partial(self._ended, told, by is self))()

    def _made(self, folder: Path, here: bool) -> None:
        """A run stands: it is shown where it was asked for, and offered elsewhere."""
        if here:
            self.desk.choose(self.desk.name_of(folder))
            self._show_run()
            self._tell(panels.new_run(self.desk.rungs()[-1]))
        else:
            fill(self._run, list(self.desk.runs), self.desk.chosen)
            self._tell(panels.new_run(Rung(self.desk.runs[self.desk.name_of(folder)], None)))

    def _planned(self, worth: str) -> None:
        """A plan stands beside the run: it is drawn, and told what it is worth."""
        self.picture.show_planned()
        self._plan.tell(worth)

    def _ended(self, told: JobMessage, here: bool) -> None:
        with self.client.atomic():
            self._show_busy()
            if told.kind == "done" and self.findings is None:
                self._show_findings()
        if here:
            self._send_report(told.kind == "done")
        if told.kind == "stopped" and here:
            self._tell("Cancelled; what was not finished left nothing behind.")
        if told.kind == "failed" and here:
            raise InputError(told.text)
