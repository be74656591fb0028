"""A chart: what it is called, what it found, how it is read, and how it is drawn."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from calib.report import plots

if TYPE_CHECKING:
    from calib.report.plots import Figure


@dataclass(frozen=True)
class Chart:
    """One figure of a run.

    Args:
        id: its name in ``rigcal plot`` and its anchor in the page.
        title: the finding, in a sentence.
        reading: how to read it, in a sentence or two.
        draw: makes the figure.
        wide: whether it takes the page's whole width.
        quiet: whether it shows nothing of note, or what a table says as well: the page has its
            title alone, which opens it.
        answer: whether it says how good the model is, or what is wrong with it: of a run that is
            not to be used as it stands, the page has all others as titles alone.
    """

    id: str
    title: str
    reading: str
    draw: Callable[[], Figure]
    wide: bool = False
    quiet: bool = False
    answer: bool = False

    def figure(self) -> Figure:
        """The figure, drawn in the house style."""
        with plots.styled():
            return plots.with_plain_text(self.draw())

    def document(self) -> dict[str, Any]:
        """As ``--json`` gives it."""
        return {"id": self.id, "title": self.title}


@dataclass(frozen=True)
class Absent:
    """A figure that a run does not have, and why."""

    id: str
    why: str
