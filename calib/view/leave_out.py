"""What is wrong in a recording, each with a button that leaves it out."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

from calib.blunders import told
from calib.view import panels

MOST_BUTTONS = 6  # blunders that have one of their own; all are listed, and "Leave all out" has all


class LeaveOut:
    """A folder of the panel, hidden where nothing is wrong.

    Args:
        gui: viser's.
        guarded: makes a callback of what a widget does.
        use: called with what ``--without`` takes, when a button is clicked.
    """

    def __init__(
        self, gui: Any, guarded: Callable[..., Any], use: Callable[[Sequence[str]], None]
    ) -> None:
        self._gui, self._guarded, self._use = gui, guarded, use
        self._folder = gui.add_folder("Wrong in the recording", visible=False)
        with self._folder:
            self._listed = gui.add_html("")
        self._buttons: list[Any] = []
        self._busy = False

    def show(self, blunders: Sequence[Mapping[str, Any]]) -> None:
        """List these, as diagnosis.json has them, and no others."""
        while self._buttons:
            self._buttons.pop().remove()
        self._folder.visible = bool(blunders)
        self._listed.content = panels.blunders(blunders)
        tokens = told.tokens(blunders)
        with self._folder:
            for token in tokens[:MOST_BUTTONS]:
                self._offer(f"Leave out {token}", [token])
            if len(tokens) > 1:
                self._offer("Leave all out", tokens)

    def busy(self, busy: bool) -> None:
        """Whether a job runs, so that another cannot be started."""
        self._busy = busy
        for button in self._buttons:
            button.disabled = busy

    def _offer(self, label: str, tokens: Sequence[str]) -> None:
        hint = "Refit without this, from this run"
        button = self._gui.add_button(label, hint=hint, disabled=self._busy)
        button.on_click(self._guarded(partial(self._use, tokens)))
        self._buttons.append(button)
