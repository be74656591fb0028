"""A range of what the plot is over, dragged across it or written: its beams are lit in the room."""

from __future__ import annotations

import re

import numpy as np

from calib.view.scene import Points
from calib.view.shown.colours import column

LABEL = "Light up"
BRUSH_HINT = "Drag across the plot, or write two numbers: 2 to 4.5"
UNLIT = (211, 213, 217)  # fainter than any colour of a scale, on white walls
# Plots of viser tell a server nothing of what is dragged across them: the page itself writes the
# range into the field, as a person would. A menu that was used, and a box that was ticked with the
# mouse, let go of the keyboard, whose keys would go to them and not to the next stop: at once, and
# a menu again when its choice is shown, as it may have taken the keyboard back meanwhile.
SCRIPT = """
if (!window.rigcalBrush) {
  window.rigcalBrush = true;
  document.addEventListener("click", e => {
    if (e.detail && e.target.type === "checkbox") e.target.blur();
    if (e.target.closest("[role=option]")) document.activeElement.blur();
  });
  window.rigcalLetGo = () => {
    const used = document.activeElement;
    if (used?.ariaHasPopup === "listbox" && used.ariaExpanded !== "true") used.blur();
  };
  document.addEventListener("mouseup", () => setTimeout(() => {
    const told = document.querySelector("[data-is=plotted]");
    let panel = told;
    while (panel && !panel.querySelector(".u-over")) panel = panel.parentElement;
    const over = panel?.querySelector(".u-over"), box = over?.querySelector(".u-select");
    const width = parseFloat(box?.style.width), left = parseFloat(box?.style.left);
    const label = [...document.querySelectorAll("label")].find(l => l.textContent === "LABEL");
    const field = [...document.querySelectorAll("input")].find(
      i => label?.compareDocumentPosition(i) & Node.DOCUMENT_POSITION_FOLLOWING);
    if (!(width > 0) || !field || box.dataset.told === box.style.cssText) return;
    box.dataset.told = box.style.cssText;
    const low = +told.dataset.low, step = (told.dataset.high - low) / over.clientWidth;
    const ends = [left, left + width].map(px => +(low + px * step).toPrecision(4));
    Object.getOwnPropertyDescriptor(HTMLInputElement.prototype, "value").set.call(
      field, ends.join(" to "));
    field.dispatchEvent(new Event("input", {bubbles: true}));
  }));
}
""".replace("LABEL", LABEL)


def ends(text: str) -> tuple[float, float] | None:
    """Two numbers that are written, the lower first; None where the text is anything else."""
    number = r"\s*([-+]?[\d.]+(?:e[-+]?\d+)?)\s*"
    found = re.fullmatch(f"{number}(?:to|,){number}", text)
    try:
        low, high = sorted(map(float, found.groups())) if found else (0.0, 0.0)
    except ValueError:
        return None
    return (low, high) if low < high else None


def within(points: Points, name: str, between: tuple[float, float]) -> np.ndarray:
    """Which beams (N,) have a column between two values, in the unit that is shown."""
    values = points.columns[name] * column(name).scale
    return (values >= between[0]) & (values <= between[1])
