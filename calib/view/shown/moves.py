"""How far the links of a rig stand from CAD, as arrows; every parameter with its sigma."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calib.runs.estimates import variable_estimates
from calib.runs.run import Run
from calib.show.tables import effect_cells
from calib.view.scene import Scene
from chains import se3
from chains.escape import html as escape

TIMES = 100  # as long as the move: a millimetre is a decimetre, on a rig of a metre or two
LEAST_M = 1e-7  # a move of less would be no arrow
SURE = 2.0  # sigmas, from which a move is hardly chance


@dataclass(frozen=True)
class Move:
    """How far the origin of a link stands from where CAD has it in its parent.

    Args:
        link: its edge of the frame tree.
        at_m: (3,) where it is, reference frame.
        move_m: (3,) from CAD, in that frame's axes.
        sigma_m: of the length of the move, along it; NaN where none is known.
    """

    link: str
    at_m: np.ndarray
    move_m: np.ndarray
    sigma_m: float

    @property
    def length_m(self) -> float:
        """How far it is."""
        return float(np.linalg.norm(self.move_m))

    @property
    def sure(self) -> bool:
        """Whether it is more than `SURE` of its sigmas."""
        return self.length_m > SURE * self.sigma_m

    @property
    def text(self) -> str:
        """Its link, its length and the sigma of that."""
        sigma = "" if np.isnan(self.sigma_m) else f" ± {1e3 * self.sigma_m:.2f}"
        return f"{self.link}: {1e3 * self.length_m:.2f}{sigma} mm"

    @property
    def arrow_m(self) -> np.ndarray:
        """(2, 3) from the link's origin, `TIMES` as long as the move."""
        return np.stack([self.at_m, self.at_m + TIMES * self.move_m])


def moves(scene: Scene, recording: int, stop: str) -> list[Move]:
    """The moves of all links of a rig, as it stood at a stop.

    Raises:
        InputError: nothing was measured at the stop, so nothing says where the rig was.
    """
    twists, covariances = scene.twists(recording, stop)
    found = []
    for edge, twist, covariance in zip(
        scene.sources[recording].rig.tree.edges, twists, covariances, strict=True
    ):
        move_m = se3.exp(twist)[:3, 3]
        length_m = float(np.linalg.norm(move_m))
        if length_m > LEAST_M:
            along = move_m / length_m
            axes = scene.place(recording, stop, edge.parent)[:3, :3] @ edge.T_parent_child[:3, :3]
            at_m = scene.place(recording, stop, edge.child)[:3, 3]
            sigma_m = float(np.sqrt(along @ covariance[3:, 3:] @ along))
            found.append(Move(edge.name, at_m, axes @ move_m, sigma_m))
    return found


def parameters(run: Run) -> str:
    """Every parameter of a run with its sigma, as HTML: of links how far they are from CAD, of an
    effect with many parameters a summary."""
    rows = []
    for row in variable_estimates(run):
        cad = "no CAD" if np.isnan(row.estimate).all() else "from CAD"
        where = "" if row.parent is None else f" in {row.parent}, {cad}"
        rows.append([f"<b>{escape(row.variable)}</b>{escape(where)}"])
        for name, cell, unit, told in effect_cells(row):
            texts = [name, f"{cell} {unit}".strip(), "" if told else "confounded"]
            rows.append(list(map(escape, texts)))
    return f'<table data-is="parameters" style="width:100%">{"".join(map(_row, rows))}</table>'


def _row(cells: Sequence[str]) -> str:
    how = ' colspan="3" style="padding-top:.4em"' if len(cells) == 1 else ' style="padding:0"'
    return f"<tr>{''.join(f'<td{how}>{cell}</td>' for cell in cells)}</tr>"
