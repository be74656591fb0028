"""The widgets beside the room: recording and stop, what colours and sizes of dots mean, what of the
rig is drawn."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from calib.view import panels
from calib.view.shown.moves import SURE, TIMES

NOTHING = "—"
CLICK = "Click a point to read it. Keys: N next stop, P previous stop."
MOVES_LABEL = f"Moves x {TIMES}"
MOVES_HINT = (
    f"How far each link stands from CAD, {TIMES} times as long; grey: less than {SURE:.0f} sigmas"
)
PLANNED_HINT = "Where the plan beside the run has the arm stand, by the stops' numbers"
SIZE_HINT = "A column as the size of the dots, in the room and in the plot"
PARTS = ("room", "rig", "frames")


class RoomMenu:
    """Its widgets.

    Args:
        gui: viser's.
        asks: what the browser's address asks for, by `look.KEYS`.
    """

    def __init__(self, gui: Any, asks: Mapping[str, str]) -> None:
        self.recording = gui.add_dropdown("Recording", [NOTHING])
        self.stop = gui.add_dropdown("Stop", [NOTHING])
        self.go = gui.add_button_group("Go to", ("previous", "next"), hint="Keys: P and N")
        self.colour = gui.add_dropdown("Colour", [NOTHING])
        self._legend = gui.add_html("")
        self.size = gui.add_dropdown("Dot size", [NOTHING], hint=SIZE_HINT)
        self._sizes = gui.add_html("")
        self.below = gui.add_slider("Show up to, m", 0.0, 1.0, 0.01, 1.0, visible=False)
        self.what = gui.add_button_group("Hide, show", PARTS)
        self._lines_why = gui.add_html("", visible=False)
        self.moves = gui.add_checkbox(MOVES_LABEL, bool(asks.get("moves")), hint=MOVES_HINT)
        self.moved = gui.add_html("", visible=False)
        self.planned = gui.add_checkbox("Planned stops", False, hint=PLANNED_HINT, visible=False)
        self.scan = gui.add_html("")
        self.point = gui.add_html(panels.note(CLICK))

    def show(self, visible: bool) -> None:
        """Whether there are beams to draw."""
        for widget in (self.below, self.colour, self.size):
            widget.visible = visible
        self.point.content = panels.note(CLICK) if visible else ""
        if not visible:
            self.explain("", "")

    def explain(self, colours: str, sizes: str) -> None:
        """Say what colours and sizes of dots mean."""
        self._legend.content, self._sizes.content = colours, sizes

    def lines_why(self, why: str) -> None:
        """Say why links are drawn as lines; nothing where they are not."""
        self._lines_why.content, self._lines_why.visible = panels.note(why), bool(why)


def fill(menu: Any, options: Sequence[str], asked: str | None = None) -> bool:
    """Give a menu other options; chosen is what was asked for, or what was, or the first. Whether
    what was asked for is there."""
    chosen = asked if asked in options else menu.value
    if tuple(options) != tuple(menu.options):  # it may be open
        menu.options = tuple(options)
    menu.value = chosen if chosen in options else options[0]
    return asked in options
