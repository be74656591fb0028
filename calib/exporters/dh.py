"""dh.yaml: the arm as a table of Denavit and Hartenberg, calibrated, and as drawn beside it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from calib.exporters.fitted import FittedRig, for_every_rig
from calib.exporters.written import NO_PLACE_FOR_SIGMAS, Unheld, Written, commented, write_text
from chains import se3
from chains.frames import Edge
from chains.readers.dh_out import table_of
from sensors.documents import yaml_text

DH_CONVENTIONS = (
    "T_base_tip = base * link 1 * ... * last joint * tip. A link is the matrix product",
    "Rz(theta + q) Tz(d) Tx(a) Rx(alpha) Ry(beta) of a joint that turns; one that slides has its q",
    "in d. The last joint is Rz(q) or Tz(q). q is as the encoder reports it: offsets are in theta.",
    "Where the maker draws two axes parallel d is 0 and beta (Hayati) is free; elsewhere beta is 0",
    "and x lies along the cross product of the two axes. base and tip: xyz_m, then rpy_rad about",
    "fixed x, y, z. calibrated is as fitted, drawn as the maker's URDF has it. A joint that",
    "follows another is not read: its q is multiplier times that of the other, plus offset.",
)


@for_every_rig
def write_dh(fit: FittedRig, folder: Path) -> Written:
    """Write dh.yaml; of an arm with several tips a table for each, in their order.

    Raises:
        Unheld: the rig has no arm that moves.
    """
    rig = fit.rig
    if not rig.joint_names:
        raise Unheld("the rig has no arm")
    not_held, paths = [NO_PLACE_FOR_SIGMAS, *fit.not_held({*fit.fixed, *fit.ratios})], []
    joints = {name: joint for name in rig.arm_edges if (joint := rig.edge(name).joint) is not None}
    followed = {n: (j.name, j.factor, j.shift) for n, j in joints.items() if j.name != n}
    for number, chain in enumerate(rig.chains, 1):
        drawn = [rig.edge(name) for name in chain]
        if all(edge.joint is None for edge in drawn):
            continue
        edges = [_alone(edge, fit.origins[edge.name]) for edge in drawn]
        drawn = [_alone(edge, _unshifted(edge)) for edge in drawn]
        document = {
            "calibrated": _document(edges, drawn, followed | fit.mimics),
            "drawn": _document(drawn, drawn, followed),
        }
        name = "dh.yaml"
        if len(rig.chains) > 1:
            name, document = f"dh_{number}.yaml", {"tip_link": drawn[-1].child, **document}
        paths.append(fit.file(folder, name))
        write_text(paths[-1], commented(fit.head(DH_CONVENTIONS, not_held)) + yaml_text(document))
    return Written(paths, not_held)


def _alone(edge: Edge, T_parent_child: np.ndarray) -> Edge:
    """An edge with this origin, its joint by itself though it may follow another."""
    joint = edge.joint and replace(edge.joint, name=edge.name, factor=1.0, leads=True, shift=0.0)
    return replace(edge, T_parent_child=T_parent_child, joint=joint)


def _unshifted(edge: Edge) -> np.ndarray:
    """The origin (4, 4) of an edge as drawn, without what it has of a follower's offset."""
    return edge.T_parent_child @ (np.eye(4) if edge.joint is None else edge.joint.unshifted)


def _document(
    edges: Sequence[Edge], drawn: Sequence[Edge], followed: Mapping[str, tuple[str, float, float]]
) -> dict[str, Any]:
    """The table of edges, their joints by themselves; of those that follow another, which, by what
    multiplier and offset."""

    def follows(joint: str) -> dict[str, Any]:
        keys = ("follows", "multiplier", "offset")
        return dict(zip(keys, followed[joint], strict=True)) if joint in followed else {}

    table = table_of(edges, drawn)
    last = next(edge.joint for edge in reversed(edges) if edge.joint is not None)
    return {
        "base": _pose(table.T_base_first),
        "links": [{**vars(link), **follows(link.joint)} for link in table.links],
        "last": {"joint": last.name, "kind": last.kind, **follows(last.name)},
        "tip": _pose(table.T_last_tip),
    }


def _pose(T: np.ndarray) -> dict[str, Any]:
    return {"xyz_m": T[:3, 3], "rpy_rad": se3.to_rpy(T)}
