"""tree.svg: every frame of a rig under the one that it hangs from, with its place and sigma."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

import numpy as np

from calib.exporters.fitted import FittedRig, for_every_rig
from calib.exporters.written import Written, warnings, write_text
from calib.results.solution import FrameEstimate
from calib.runs.estimates import variable_estimates
from chains import escape, se3

ROW_PX, STEP_PX, LEFT_PX, TOP_PX, LINE_PX = 30, 26, 24, 84, 20
FONT = "font-family:system-ui,sans-serif;font-size:13px"
BOLD_STYLE, NUMBERS_STYLE = "font-weight:600", "font-family:ui-monospace,monospace;font-size:12px"
SVG_INK, SVG_PALE, SVG_AMBER, SVG_RED = "#1f2933", "#9aa5b1", "#b7791f", "#b00020"
BASE_STANDS = {
    "stop": "stands anew at every stop",
    "location": "stands anew at every location",
    "never": "stands still",
}
_CHARACTER = 7.6  # px, of the names' font


@dataclass(frozen=True)
class _Row:
    """A frame in the picture: its line in the order of the tree, and what is said of it."""

    frame: str
    depth: int
    above: int | None
    place: str
    sigma: str
    loose: bool
    """Nothing rigid holds it: a joint, or where the rig was put."""
    told: bool


@for_every_rig
def write_tree(fit: FittedRig, folder: Path) -> Written:
    """Write tree.svg; effects are not in it."""
    rows = list(_rows(fit))
    names = max(LEFT_PX + STEP_PX * row.depth + _CHARACTER * len(row.frame) for row in rows)
    where, spread = names + 40, names + 490
    warning = warnings(fit.run)
    top = TOP_PX + LINE_PX * len(warning)
    size = {"width": f"{spread + 240:.0f}", "height": f"{top + ROW_PX * len(rows) + 16}"}
    svg = Element("svg", size, xmlns="http://www.w3.org/2000/svg", style=FONT)
    SubElement(svg, "title").text = escape.line(f"Frames of {fit.rig.name}")
    SubElement(svg, "rect", width="100%", height="100%", fill="white")
    for i, line in enumerate(warning):
        _text(svg, LEFT_PX, 28 + LINE_PX * i, line, SVG_RED, style=BOLD_STYLE)
    _text(svg, LEFT_PX, top - 56, f"Frames of {fit.rig.name}", style=BOLD_STYLE)
    said = "each in the axes of the frame above it, angles as in URDF; sigma of the worst axis"
    _text(
        svg, LEFT_PX, top - 36, f"{said}, amber where the data alone do not identify it", SVG_PALE
    )
    for x, title in ((where, "x, y, z, roll, pitch, yaw"), (spread, "one sigma")):
        _text(svg, x, top - 12, title, SVG_PALE)
    for i, row in enumerate(rows):
        x, y = LEFT_PX + STEP_PX * row.depth, top + ROW_PX * i + 12
        if row.above is not None:
            up, left = top + ROW_PX * row.above + 20, x - STEP_PX + 6
            dashed = {"stroke-dasharray": "4 3"} if row.loose else {}
            line = {"d": f"M{left},{up}V{y}H{x - 4}", "fill": "none", "stroke": SVG_PALE} | dashed
            SubElement(svg, "path", line)
        _text(svg, x, y + 5, row.frame, style=BOLD_STYLE)
        _text(svg, where, y + 5, row.place, SVG_PALE if row.loose else SVG_INK, style=NUMBERS_STYLE)
        _text(
            svg, spread, y + 5, row.sigma, SVG_INK if row.told else SVG_AMBER, style=NUMBERS_STYLE
        )
    ElementTree.indent(svg)
    path = fit.file(folder, "tree.svg")
    write_text(path, ElementTree.tostring(svg, "unicode") + "\n")
    return Written([path], fit.not_held())


def _rows(fit: FittedRig) -> Iterator[_Row]:
    """Every frame, after the one that it hangs from."""
    tree, frames, rig = fit.rig.tree, fit.frames, fit.rig
    mine = {name: name for name in frames} | {f"{rig.name}/{name}": name for name in frames}
    told = {mine.get(row.variable): bool(row.told.all()) for row in variable_estimates(fit.run)}
    under: dict[str, list[str]] = {}
    for name, frame in frames.items():
        if name not in tree.frames:
            under.setdefault(frame.parent, []).append(name)
    under.setdefault(rig.world, []).append(tree.root)
    edges = {edge.child: edge for edge in tree.edges}
    for edge in tree.edges:
        under.setdefault(edge.parent, []).append(edge.child)
    waiting, count = [(rig.world, 0, None)], 0
    while waiting:
        frame, depth, above = waiting.pop()
        edge, estimate = edges.get(frame), frames.get(frame)
        place, loose = "", False
        if frame == tree.root:
            place, loose = BASE_STANDS[rig.moves], True
        elif estimate is not None:
            place = _place(estimate.T_parent_child)
        elif edge is not None:
            joint = edge.joint
            loose = joint is not None
            place = f"joint {joint.name}, {joint.kind}" if joint else _place(fit.origins[edge.name])
        yield _Row(
            frame=frame,
            depth=depth,
            above=above,
            place=place,
            sigma=_sigma(estimate),
            loose=loose,
            told=told.get(frame, True),
        )
        waiting += [(child, depth + 1, count) for child in reversed(under.get(frame, []))]
        count += 1


def _place(T: np.ndarray) -> str:
    x, y, z = T[:3, 3]
    roll, pitch, yaw = np.degrees(se3.to_rpy(T))
    return f"{x:z8.4f} {y:z8.4f} {z:z8.4f} m {roll:z8.2f} {pitch:z8.2f} {yaw:z8.2f}°"


def _sigma(estimate: FrameEstimate | None) -> str:
    if estimate is None:
        return ""
    mm, mrad = 1e3 * estimate.sigma_m.max(), 1e3 * estimate.sigma_rad.max()
    return f"± {mm:.3f} mm  ± {mrad:.3f} mrad" if mm or mrad else "held"


def _text(svg: Element, x: float, y: float, text: str, fill: str = SVG_INK, **more: str) -> None:
    place = {"x": f"{x:.0f}", "y": f"{y:.0f}", "fill": fill, "xml:space": "preserve"}
    SubElement(svg, "text", place, **more).text = escape.line(text)
