"""A list of effects, each with a tick: those of the model, and what it may lack."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

from calib.view import panels
from calib.view.effects.known import difference

MORE = "another effect …"
MOST = 1000  # effects in a list: viser puts widgets in the order of numbers, this many to a step


class Ticks:
    """A list of effects, what is known of the set that is ticked, and a button that refits with it.

    Args:
        gui: viser's.
        guarded: makes a callback of what a widget does.
        say: what is known of a set of effects (name -> as `Desk.addable` has it), in a sentence;
            asked whenever the set changes.
        use: called with what is added, as `rigcal add` takes it, and the names of what is taken
            away, when the button is clicked.
    """

    def __init__(
        self,
        gui: Any,
        guarded: Callable[..., Any],
        say: Callable[[Mapping[str, Any]], str],
        use: Callable[[Mapping[str, Any], Sequence[str]], None],
    ) -> None:
        self._gui, self._guarded, self._say, self._use = gui, guarded, say, use
        self._own: dict[str, Any] = {}
        self._offered: dict[str, Any] = {}
        self._boxes: dict[str, Any] = {}
        self.latest: str | None = None  # the effect that was ticked last
        self.folder = gui.add_folder("Effects")
        with self.folder:
            self._more = gui.add_dropdown("Add", [MORE])
            self._said = gui.add_html("")
            self._button = gui.add_button("Refit", hint="With the effects that are ticked")
        self._more.on_update(guarded(self._on_more))
        self._button.on_click(guarded(self._on_button))

    def show(
        self, own: Mapping[str, Any], offered: Mapping[str, Any], listed: Sequence[str]
    ) -> None:
        """List the effects of a run, ticked, and others.

        Args:
            own: those of its model: name -> as model.yaml has it.
            offered: those that can be added: name -> as `rigcal add` takes it.
            listed: those of them that stand in the list; the rest are in a menu.
        """
        while self._boxes:
            self._boxes.popitem()[1].remove()
        self._own, self._offered, self.latest = dict(own), dict(offered), None
        for name in own:
            self._add(name, ticked=True)
        for name in listed:
            self._add(name)
        self._show_rest()
        self._tell()

    @property
    def wanted(self) -> dict[str, Any]:
        """The effects that are ticked."""
        every = self._own | self._offered
        return {name: every[name] for name, box in self._boxes.items() if box.value}

    def busy(self, busy: bool) -> None:
        """Whether a job runs, so that another cannot be started."""
        self._button.disabled = busy

    def _add(self, name: str, ticked: bool = False) -> None:
        order = self._more.order - 1 + len(self._boxes) / MOST
        with self.folder:
            box = self._gui.add_checkbox(name, ticked, order=order)
        box.on_update(self._guarded(partial(self._on_tick, name)))
        self._boxes[name] = box

    def _show_rest(self) -> None:
        rest = [name for name in self._offered if name not in self._boxes]
        self._more.options = [MORE, *rest]
        self._more.value, self._more.visible = MORE, bool(rest)

    def _on_tick(self, name: str) -> None:
        self.latest = name
        self._tell()

    def _on_more(self) -> None:
        name = self._more.value
        if name != MORE:
            self._add(name, ticked=True)
            self._show_rest()
            self._on_tick(name)

    def _tell(self) -> None:
        self.tell(self._say(self.wanted))

    def tell(self, text: str) -> None:
        """Say what is known of the set that is ticked."""
        self._said.content = panels.expected(text)

    def _on_button(self) -> None:
        added, dropped = difference(self._own, self.wanted)
        self._use(added, dropped)
