"""Hesai's models: what a packet of each has where, and by which packets it is told.

Packet formats: the user manuals of each model.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class HesaiModel:
    """Where a model's packet has what; bytes."""

    name: str
    catalog: str
    size: int
    header: int
    """Before the first block."""
    block_header: int
    """Of a block, before its azimuth."""
    blocks: int
    channels: int
    unit: int
    """Of a channel: range (2), intensity (1), and what is left."""
    range_step_at: int | None
    """Of the range's step in mm; None = 4 mm."""
    shortest_m: float
    """Nearer returns come from the window."""

    @property
    def block(self) -> np.dtype:
        """One block."""
        pixel = np.dtype(
            {
                "names": ["range", "intensity"],
                "formats": ["<u2", "u1"],
                "offsets": [0, 2],
                "itemsize": self.unit,
            }
        )
        head = self.block_header
        return np.dtype(
            {
                "names": ["azimuth", "pixel"],
                "formats": ["<u2", (pixel, self.channels)],
                "offsets": [head, head + 2],
                "itemsize": head + 2 + self.channels * self.unit,
            }
        )


MODELS = (
    HesaiModel(
        name="Pandar40P",
        catalog="hesai_pandar40p",
        size=1262,
        header=0,
        block_header=2,
        blocks=10,
        channels=40,
        unit=3,
        range_step_at=None,
        shortest_m=0.3,
    ),
    HesaiModel(
        name="Pandar64",
        catalog="hesai_pandar64",
        size=1194,
        header=8,
        block_header=0,
        blocks=6,
        channels=64,
        unit=3,
        range_step_at=5,
        shortest_m=0.3,
    ),
    HesaiModel(
        name="Pandar64",
        catalog="hesai_pandar64",
        size=1198,
        header=8,
        block_header=0,
        blocks=6,
        channels=64,
        unit=3,
        range_step_at=5,
        shortest_m=0.3,
    ),
    HesaiModel(
        name="PandarQT64",
        catalog="hesai_pandarqt64",
        size=1072,
        header=12,
        block_header=0,
        blocks=4,
        channels=64,
        unit=4,
        range_step_at=9,
        shortest_m=0.1,
    ),
    HesaiModel(
        name="PandarQT128",
        catalog="hesai_qt128",
        size=1127,
        header=12,
        block_header=0,
        blocks=2,
        channels=128,
        unit=4,
        range_step_at=9,
        shortest_m=0.05,
    ),
    HesaiModel(
        name="PandarXT-16",
        catalog="hesai_xt16",
        size=568,
        header=12,
        block_header=0,
        blocks=8,
        channels=16,
        unit=4,
        range_step_at=9,
        shortest_m=0.05,
    ),
    HesaiModel(
        name="PandarXT-32",
        catalog="hesai_pandarxt32",
        size=1080,
        header=12,
        block_header=0,
        blocks=8,
        channels=32,
        unit=4,
        range_step_at=9,
        shortest_m=0.05,
    ),
    HesaiModel(
        name="PandarXT-32M2X",
        catalog="hesai_xt32m2x",
        size=820,
        header=12,
        block_header=0,
        blocks=6,
        channels=32,
        unit=4,
        range_step_at=9,
        shortest_m=0.5,
    ),
)
_START = {"Pandar40P": b"\xff\xee", "Pandar64": b"\xee\xff\x40\x06"}
_VERSION = {
    "PandarQT64": (3, 1),
    "PandarQT128": (3, 2),
    "PandarXT-16": (6, 1),
    "PandarXT-32": (6, 1),
    "PandarXT-32M2X": (6, 1),
}


def find_model(payload: bytes) -> HesaiModel | None:
    """The model that sent a packet, None where it is no point packet of a model known here."""
    for model in MODELS:
        start = _START.get(model.name)
        if start is None:
            start = b"\xee\xff" + bytes(_VERSION[model.name])
        if len(payload) == model.size and payload.startswith(start):
            return model
    return None
