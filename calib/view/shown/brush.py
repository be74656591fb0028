"""A range of what the plot is over, dragged across it or written: its beams are lit in the room."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from calib.view.scene import Points
from calib.view.shown.colours import column

LABEL = "Light up"
BRUSH_HINT = "Drag across the plot, or write two numbers: 2 to 4.5"
UNLIT = (211, 213, 217)  # fainter than any colour of a scale, on white walls
SCRIPT = Path(__file__).with_name("page.js")  # looks for LABEL


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
