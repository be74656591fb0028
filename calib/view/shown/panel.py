"""The panel to the left of the room: which beams are looked at, and plots of them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from calib.view import panels
from calib.view.shown import area, brush, plot
from calib.view.shown.menu import NOTHING
from calib.view.stage import PLOT_PX

THIS, HERE, ALL_STOPS = "this stop", "its location", "all stops"
ONLY = "A formula, e.g. (range > 3) * (abs(residual) > 0.002); metres, radians. * is and"
TWO = "The other run in a room and a plot of its own, on the same scales"
TAKE = "The beams of the plot, and the plot as it is shown"
PLOT_HEIGHT_PX, LOW_PX = 300, 210  # of a plot; of one of two
FILES = ("CSV", "SVG", "PNG")


class PlotPanel:
    """Its widgets, and what its plots show.

    Args:
        gui: viser's.
        asks: what the browser's address asks for, by `look.KEYS`.
        locked: whether scales stay as they are.
        narrow: whether there is hardly room for it.
    """

    def __init__(self, gui: Any, asks: Mapping[str, str], locked: bool, narrow: bool) -> None:
        panel = gui.add_panel()
        with panel.add_tab("Beams"):
            stops, menu = asks.get("stops"), (THIS, HERE, ALL_STOPS)
            first = stops if stops in menu else THIS
            self.stops = gui.add_dropdown("Beams of", menu, initial_value=first)
            self.other = gui.add_dropdown("Other run", [NOTHING])
            self.beside = gui.add_checkbox("Side by side", False, hint=TWO, visible=False)
            self.only = gui.add_text("Only where", asks.get("only", ""), hint=ONLY)
            self.wrong = gui.add_html("", visible=False)
            self.lock = gui.add_checkbox("Keep scales", locked, hint="Off: as the beams are")
            self.up = gui.add_dropdown("Plot", [NOTHING])
            self.over = gui.add_dropdown("Over", [NOTHING])
            self.light = gui.add_text(brush.LABEL, asks.get("lit", ""), hint=brush.BRUSH_HINT)
            self.lit_over = asks.get("over", "")  # the column whose range is lit
            self.area = area.Area.read(asks.get("area", ""))
            self.light_all = gui.add_button("Light up all", visible=False, color="gray")
            self._plots = [self._add_plot(gui, visible) for visible in (True, False)]
            gui.add_html(panels.hint(area.HOW))
            self.take = gui.add_button_group("Plot as", FILES, hint=TAKE)
        panel.dock_left()
        panel.set_width(PLOT_PX)
        if narrow:
            panel.minimize()

    def _add_plot(self, gui: Any, visible: bool) -> tuple[Any, Any, Any]:
        name = gui.add_html("", visible=False)
        chart = gui.add_uplot(
            *plot.EMPTY,
            scales={"x": {"time": False}},
            cursor={"drag": {"setScale": False, "x": True}},
            legend={"show": False},
            height=PLOT_HEIGHT_PX,
            visible=visible,
        )
        return name, chart, gui.add_html("", visible=visible)

    @property
    def plot(self) -> Any:
        """The plot of the run that is looked at."""
        return self._plots[0][1]

    def show(self, visible: bool) -> None:
        """Whether there are beams to plot."""
        for widget in (self.up, self.over, self._plots[0][1], self.take):
            widget.visible = visible
        if not visible:
            self.draw([])

    def draw(self, sides: list[tuple[str, plot.Chart, str]], axes: Any = None) -> None:
        """Draw the plots of one run, or of two: the name, the chart, and what is told of each."""
        two = len(sides) > 1
        for i, (name, chart, said) in enumerate(self._plots):
            here = i < len(sides)
            name.visible, chart.visible = two and here, here
            said.visible = here
            if not here:
                said.content = ""
                continue
            title, (data, series), text = sides[i]
            name.content = panels.framed(panels.run_name(title))
            chart.height = LOW_PX if two else PLOT_HEIGHT_PX
            chart.scales, chart.data, chart.series = axes, data, series
            said.content = text
