"""One recording, and the two halves of its stops."""

import shutil
from pathlib import Path

import numpy as np

from calib.simulation import Spec, simulate

from ..mishaps import Scene


def halves(spec: Spec, folder: Path) -> None:
    """Write `whole`, `first` and `second` into a folder."""
    simulate(spec, folder / "whole", seed=5)
    with Scene(folder / "whole", np.random.default_rng()).sheet("stops.csv") as stops:
        count = len(stops)
    for half, kept in (("first", range(count // 2)), ("second", range(count // 2, count))):
        shutil.copytree(folder / "whole", folder / half)
        with Scene(folder / half, np.random.default_rng()).sheet("stops.csv") as stops:
            stops.keep(list(kept))
