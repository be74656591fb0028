"""A formula of one's own, added as an effect: a fit with it says what stops held out make of it."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection
from typing import Any

import numpy as np

from calib.diagnosis.formulas.found import LEAST_SIGMA
from calib.effects.own.expression import Expression
from calib.effects.own.formula import FormulaEffect
from calib.view import panels
from calib.view.scene import Points
from calib.view.shown.columns import COMPARED_COLUMNS, value_of
from chains.errors import InputError

SITES = {"range": "m", "azimuth": "rad", "elevation": "rad"}  # what it adds to -> in which unit
MADE_BY_FITS = ("residual_m", "sigma_m", "weight", *COMPARED_COLUMNS)  # columns that a fit makes
LONGEST_IN_FOLDER = 40  # letters of it that a folder's name takes up
FORMULA_HINT = "Of range, incidence, ring, ... and columns of stops, e.g. (humidity - 0.45) * range"


class OwnFormula:
    """A box for a formula, what it adds to, and a button that refits with it.

    Args:
        gui: viser's.
        guarded: makes a callback of what a widget does.
        use: called with the formula and one of `SITES`, when the button is clicked.
    """

    def __init__(
        self, gui: Any, guarded: Callable[..., Any], use: Callable[[str, str], None]
    ) -> None:
        self._use = use
        self._text = gui.add_text("Own formula", "", hint=FORMULA_HINT)
        self._site = gui.add_dropdown("Adds to", tuple(SITES), initial_value="range")
        self._button = gui.add_button("Try", hint="Refit with it times a number to be found")
        self._wrong = gui.add_html("", visible=False)
        self._button.on_click(guarded(self._clicked))

    def busy(self, busy: bool) -> None:
        """Whether a job runs, so that another cannot be started."""
        self._button.disabled = busy

    def _clicked(self) -> None:
        wrong = ""
        try:
            self._use(self._text.value, self._site.value)
        except InputError as error:
            wrong = str(error)
        self._wrong.content, self._wrong.visible = panels.note(wrong, bad=True), bool(wrong)


def document(text: str, site: str, points: Points, taken: Collection[str]) -> dict[str, Any]:
    """The effect that adds a formula, times a number, as a file of formulas has it.

    The number's sigma is such that the formula changes a beam by as much as those that a diagnosis
    proposes: by `LEAST_SIGMA`, root mean square over the beams.

    Args:
        text: the formula.
        site: one of `SITES`.
        points: beams of the run.
        taken: names of effects that the model has.

    Raises:
        InputError: it is no formula of what is known of a beam before a fit.
    """
    if not text.strip():
        raise InputError(f"write a formula first. {FORMULA_HINT}")
    expression = Expression(text.strip(), "yours")
    made = [n for n in MADE_BY_FITS if {n, n.removesuffix("_m")} & set(expression.names)]
    if made:
        raise expression.wrong(f"{made[0]} is a result of the fit; an effect cannot depend on it")
    values = value_of(points, expression)
    size = float(np.sqrt(np.mean(np.square(values))))
    if not 0 < size < np.inf:
        raise expression.wrong("it is 0 at every beam here, or no number at some")
    name = "own_" + "_".join(re.findall(r"[A-Za-z0-9]+", text))[:LONGEST_IN_FOLDER].strip("_")
    found = {
        "name": next(n for n in (name, *(f"{name}_{i}" for i in range(2, 1000))) if n not in taken),
        "site": site,
        "unit": SITES[site],
        "sigma": float(f"{LEAST_SIGMA[SITES[site]] / size:.1g}"),
        "basis": [expression.text],
        "what": "A formula that was tried in the workbench.",
    }
    FormulaEffect.read(found, "the formula", {})
    return found
