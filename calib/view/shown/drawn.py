"""An arm as the workbench draws it: the shapes of its links, or lines where these are lacking."""

from __future__ import annotations

from calib.rig import Rig
from calib.rig.shapes import Shape, arm_shapes
from calib.view.scene import MOST_TRIANGLES
from chains.errors import InputError


def drawn_shapes(rig: Rig) -> tuple[list[Shape], str]:
    """The shapes of an arm's links, and which links are therefore drawn as lines, in a sentence.

    The sentence is empty where every link that has shapes is drawn, or none has any.
    """
    try:
        shapes, lacking = arm_shapes(rig)
    except InputError as error:
        return [], f"The arm is drawn as lines: {error}."
    triangles = sum(len(shape.triangles) for shape in shapes)
    if triangles > MOST_TRIANGLES:
        return [], (
            f"The arm is drawn as lines: its shapes have {triangles:,} triangles, more than the "
            f"{MOST_TRIANGLES:,} that are drawn."
        )
    if not lacking:
        return shapes, ""
    rest = f", and so are {len(lacking) - 1} more links" if len(lacking) > 1 else ""
    return shapes, f"Drawn as lines: {lacking[0]}{rest}."
