"""arm.urdf, the arm's own file with the origins that were fitted, and rig.urdf, with every frame.

A URDF knows geometry that holds wherever the arm stands. What changes with the pose, the weather or
time (sag, gears, eccentric encoders, growth) it cannot hold, and says so at its head.
"""

from __future__ import annotations

from pathlib import Path

from calib.exporters.fitted import FittedRig, for_every_rig
from calib.exporters.written import NO_PLACE_FOR_SIGMAS, Unheld, Written, write_text
from chains.frames import Edge
from chains.readers.urdf_out import (
    empty_robot,
    with_comment,
    with_frames,
    with_mimics,
    with_origins,
)

URDF_CONVENTIONS = (
    "A joint's origin is T_parent_child at a reported joint of 0: xyz in m, in the parent's axes;",
    "rpy in rad about the parent's fixed x, then y, then z. Lengths, tilts and offsets of joints",
    "are in the origins, so joints are given as the encoders report them. Limits are the maker's.",
    "A joint that follows another has the multiplier that was fitted, where the model has that.",
)


@for_every_rig
def write_urdf(fit: FittedRig, folder: Path) -> Written:
    """Write arm.urdf where the rig has an arm, and rig.urdf with its fixed frames added.

    Raises:
        Unheld: the rig has neither arm nor frames.
    """
    tree = fit.rig.tree
    if not tree.edges:
        raise Unheld("the rig has neither an arm nor frames")
    not_held = [NO_PLACE_FOR_SIGMAS, *fit.not_held({*fit.fixed, *fit.ratios})]
    files, where = [], fit.rig.arm_urdf or "rig.urdf"
    if fit.rig.arm_urdf:
        arm = with_origins(fit.rig.arm_urdf.read_bytes(), fit.origins, where)
        arm = with_mimics(arm, fit.mimics, where)
        files.append(fit.file(folder, "arm.urdf"))
        lines = fit.head(URDF_CONVENTIONS, not_held)
        write_text(files[-1], with_comment(arm, lines, where))
    else:
        arm = empty_robot(fit.rig.name, tree.root)
    fixed = [
        Edge(name, frame.parent, name, frame.T_parent_child) for name, frame in fit.frames.items()
    ]
    whole, left = with_frames(arm, fixed, where)
    not_held += [f"{name}: nothing fixed ties it to the rest of the URDF's tree" for name in left]
    files.append(fit.file(folder, "rig.urdf"))
    write_text(files[-1], with_comment(whole, fit.head(URDF_CONVENTIONS, not_held), where))
    return Written(files, not_held)
