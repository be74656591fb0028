"""What to measure next, asked for on the page: stops are planned, and stand in the room."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from calib.planning import MOST_PLANNED, USUAL_STOPS
from calib.planning.purpose import ALL, RELIABILITY, WORKSPACE
from calib.rig import Rig
from calib.view import panels
from calib.view.shown.menu import fill

AS_FOUND = "what the diagnosis needs"
HINT = "Choose the stops that tell most, among random poses of the arm; written beside the run"


class AskPlan:
    """A folder of the panel, hidden where the rig has no arm.

    Args:
        gui: viser's.
        guarded: makes a callback of what a widget does.
        use: called with what stops are for, as ``--for`` takes it or None, and how many, when the
            button is clicked.
    """

    def __init__(
        self, gui: Any, guarded: Callable[..., Any], use: Callable[[str | None, int], None]
    ) -> None:
        self._use = use
        self._folder = gui.add_folder("Measure next", visible=False, expand_by_default=False)
        with self._folder:
            self._for = gui.add_dropdown("For", [AS_FOUND])
            self._stops = gui.add_number(
                "Stops", USUAL_STOPS, min=1, max=MOST_PLANNED, step=1, hint="How many are planned"
            )
            self._button = gui.add_button("Plan", hint=HINT)
            self._told = gui.add_html("", visible=False)
        self._button.on_click(guarded(self._on_click))

    def of(self, rig: Rig) -> None:
        """Stops are planned for a rig with an arm."""
        self._folder.visible = bool(rig.joint_names)

    def show(self, remedies: Sequence[Mapping[str, Any]]) -> None:
        """Offer what stops can be for; `remedies` as diagnosis.json has them."""
        needed = [",".join(each["names"]) for each in remedies if each["plan"]]
        fill(self._for, list(dict.fromkeys([AS_FOUND, *needed, ALL, WORKSPACE, RELIABILITY])))
        self.tell("")

    def tell(self, text: str) -> None:
        """Say what a plan is worth; an empty text takes it away."""
        self._told.content, self._told.visible = panels.note(text), bool(text)

    def busy(self, busy: bool) -> None:
        """Whether a job runs, so that another cannot be started."""
        self._button.disabled = busy

    def _on_click(self) -> None:
        purpose = self._for.value
        self._use(None if purpose == AS_FOUND else purpose, int(self._stops.value))
