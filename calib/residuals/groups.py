"""Groups of rows that one mishap spoils together, and the names that people call them by."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

GroupKind = Literal["body", "level", "joints", "scan", "target", "frame", "rings", "surface"]
AT_STOPS = ("body", "level", "joints", "scan")  # kinds that a stop has
SCAN, JOINTS = "scan", "joints"  # what of a stop, beside its bodies and single joints
CAD, MESH = "cad", "mesh"  # where, of what belongs to no stop and no target
# Parts of the mesh: each may be off by itself.
SURFACE, REGION_PART, PATCH = MESH_PARTS = "surface", "region", "patch"
ALONG_BEAMS = "along the beams"  # the direction of a range zero
ALONG_NORMAL = "along its normal"  # that of a part of the mesh
# Its tilts: what stands off the more, the further along its first axis, is turned about its second.
ABOUT_AXES = "about its second axis", "about its first axis"


def part_of_mesh(kind: str, number: int) -> str:
    """What a part of the mesh, of one of `MESH_PARTS`, is called."""
    return f"{kind}_{number}"


def kind_and_number(part: str) -> tuple[str, int]:
    """The inverse of `part_of_mesh`."""
    kind, _, number = part.rpartition("_")
    return kind, int(number)


def level_of(frame: str) -> str:
    """What the level in a frame is called: the tracker may see a body of this name."""
    return f"{frame}.level"


@dataclass(frozen=True)
class Group:
    """Rows that one mishap spoils together.

    Args:
        kind: what kind of thing it is, as diagnosis.json has it.
        where: the stop or target; `CAD` for what rig.yaml or the URDF says, `MESH` of the mesh.
        what: the body, a level as `level_of` has it, `SCAN`, `JOINTS` or one joint; the part of the
            target; the frame or ``effect.parameter``; the part of the mesh, as `part_of_mesh`.
        recording: name of its folder, where there are several recordings.
    """

    kind: GroupKind
    where: str
    what: str
    recording: str = ""

    @property
    def stop(self) -> str | None:
        """The stop that it is of."""
        return self.where if self.kind in AT_STOPS else None

    @property
    def place(self) -> tuple[str, str]:
        """Recording, and where it is: each part of the mesh is a place of its own."""
        return self.recording, self.what if self.where == MESH else self.where

    @property
    def bare(self) -> str:
        """``WHERE:WHAT``, whatever the recording."""
        return f"{self.where}:{self.what}"

    @property
    def token(self) -> str:
        """As ``--without`` takes it: ``WHERE:WHAT``, the recording before it where that matters."""
        return f"{self.recording}/{self.bare}".removeprefix("/")

    @property
    def named(self) -> str:
        """What it is at a stop, whichever stop."""
        return {SCAN: "the scan", JOINTS: "the joints"}.get(self.what, self.what)

    def __str__(self) -> str:
        what = self.named
        of = f"{self.recording}, {self.where}".removeprefix(", ")
        if self.kind == "target":
            return f"target {of}: its {what}"
        if self.kind == "frame":
            return f"the URDF's {what}" if "." in what else f"the CAD of {what}"
        if self.kind == "surface":
            return f"the mesh's {what}"
        return f"{of}: {what}"
