"""Round numbers for the ends of axes and of scales of colour."""

from __future__ import annotations

import numpy as np


def round_up(value: float) -> float:
    """The next of 1, 2, 5 times a power of ten; 1 of what is not positive."""
    if not value > 0:
        return 1.0
    power = 10.0 ** np.floor(np.log10(value))
    return float(next(n for n in (1, 2, 5, 10) if n * power >= value * (1 - 1e-9)) * power)
