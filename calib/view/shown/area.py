"""A rectangle drawn over the room: beams that end behind it are lit, in the plot too."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib.view.shown import look
from chains import se3

HOW = "Shift and drag in the room, or drag across the plot, to light up beams in both."
NUMBERS = 11  # of an area, as an address has it


@dataclass(frozen=True)
class Area:
    """What an eye sees through a rectangle, which is the same part of the room at every stop.

    Args:
        eye_m: (3,) where the eye is, reference frame.
        wxyz: (4,) T_reference_eye's rotation; the eye's axes point right, down and ahead.
        edges: left, top, right and bottom of the rectangle, as tangents of angles from ahead.
    """

    eye_m: np.ndarray
    wxyz: np.ndarray
    edges: tuple[float, float, float, float]

    @classmethod
    def drawn(
        cls,
        camera: tuple[np.ndarray, np.ndarray],
        fov_rad: float,
        aspect: float,
        corners: Sequence[Sequence[float]],
    ) -> Area:
        """An area between two corners of a picture.

        Args:
            camera: where its eye is, and its orientation, as of the class.
            fov_rad: its angle of view, from below to above.
            aspect: its width over its height.
            corners: upper left and lower right, in widths and heights of the picture.
        """
        high = np.tan(fov_rad / 2)
        tangents = (2 * np.asarray(corners, float) - 1) * [high * aspect, high]
        return cls(*camera, tuple(tangents.ravel().tolist()))

    @classmethod
    def read(cls, text: str) -> Area | None:
        """What `write` wrote; None where the text is anything else."""
        found = look.numbers(text, NUMBERS)
        if found is None or not any(found[3:7]):
            return None
        return cls(np.array(found[:3]), np.array(found[3:7]), found[7:])

    def write(self) -> str:
        """The area as an address has it."""
        return ",".join(f"{x:.5g}" for x in (*self.eye_m, *self.wxyz, *self.edges))

    def moved(self, by_m: np.ndarray) -> Area:
        """The same, seen from elsewhere."""
        return replace(self, eye_m=self.eye_m + by_m)

    def holds(self, xyz_m: np.ndarray) -> np.ndarray:
        """Which points (N,) of xyz_m (N, 3) are inside."""
        x, y, ahead = se3.apply(se3.inverse(se3.from_xyz_quat(self.eye_m, self.wxyz)), xyz_m).T
        left, top, right, bottom = self.edges
        across = (x >= left * ahead) & (x <= right * ahead)
        return (ahead > 0) & across & (y >= top * ahead) & (y <= bottom * ahead)
