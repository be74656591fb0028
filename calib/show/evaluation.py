"""What ``rigcal evaluate`` prints."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.table import Table

from calib.show.tables import columns_table, mm, terminal

BIN_HEADINGS = {
    "incidence_deg": "incidence, degrees",
    "distance_m": "distance, m",
    "label": "material",
    "ring": "ring",
}
LISTED_RINGS = 16  # rings of a sensor with more are not listed one by one


def print_evaluations(evaluations: Mapping[str, Mapping[str, Any]]) -> None:
    """Print evaluations by run: the only one in full, several side by side."""
    if len(evaluations) == 1:
        print_evaluation(next(iter(evaluations.values())))
        return
    console = terminal()
    table = columns_table("mm", *(Path(run).name for run in evaluations))
    for column in table.columns[1:]:
        column.justify = "right"
    for what, value in _LINES.items():
        table.add_row(what, *(value(each) for each in evaluations.values()))
    console.print(table)


def _near_std(signed: Mapping[str, Any]) -> float | None:
    return signed["far"]["std_without_mm"] if signed["far"] else signed["std"]


_LINES = {
    "returns": lambda e: f"{e['returns']}",
    "range against the surface, mean": lambda e: mm(e["signed_error_mm"]["mean"], "+"),
    "std": lambda e: mm(e["signed_error_mm"]["std"]),
    "std without those far off": lambda e: mm(_near_std(e["signed_error_mm"])),
    "half of the central 68 % of directions": lambda e: mm(e["signed_error_mm"]["half_68"]),
    "mean size": lambda e: mm(e["accuracy_mm"]),
    "precision": lambda e: mm(e["precision_mm"]),
    "cloud to mesh, mean": lambda e: mm(e["cloud_to_mesh_mm"]["mean"], "+"),
    "cloud to mesh, std": lambda e: mm(e["cloud_to_mesh_mm"]["std"]),
}


def print_predicted(found: Mapping[str, Any], out: Path | None) -> None:
    """Print how far off an arm is at poses, and how well that is known, in short.

    Args:
        found: what ``rigcal evaluate --at --json`` prints.
        out: the table of every pose, if it was written.
    """
    console = terminal()
    table = columns_table("mm", "mean", "largest")
    for column in table.columns[1:]:
        column.justify = "right"
    for name, what in (("error_mm", "true less drawn place"), ("sigma_mm", "its sigma")):
        table.add_row(what, mm(found[name]["mean"]), mm(found[name]["max"]))
    console.print(f"'{found['body']}' at {found['poses']} poses, in the axes of '{found['frame']}'")
    console.print(table)
    if found["beyond_measured"]:
        each = [f"{name} at {count} poses" for name, count in found["beyond_measured"].items()]
        console.print(
            f"Beyond all that was measured, where nothing checks the model: {', '.join(each)}."
        )
    console.print(f"pose by pose: {out}" if out else "-o FILE.csv writes it pose by pose")


def print_evaluation(evaluation: Mapping[str, Any]) -> None:
    """Print an evaluation: as a whole, then by what it may depend on."""
    console = terminal()
    how = "corrected by the model" if evaluation["corrected"] else "as measured"
    console.print(f"{evaluation['returns']} returns, {how}; mm", style="bold")
    signed, nearest = evaluation["signed_error_mm"], evaluation["cloud_to_mesh_mm"]
    table = _table("")
    table.add_row(
        "range against the surface",
        *(mm(signed["mean"], "+"), mm(signed["std"])),
        *(mm(evaluation["accuracy_mm"]), mm(evaluation["precision_mm"])),
    )
    if far := signed["far"]:
        table.add_row(
            f"without {far['returns']} returns beyond {far['beyond_mm']:.0f} mm",
            *(mm(far["mean_without_mm"], "+"), mm(far["std_without_mm"]), "", ""),
        )
    table.add_row("cloud to mesh", mm(nearest["mean"], "+"), mm(nearest["std"]), "", "")
    table.add_row()
    console.print(table)
    if evaluation["planes"]:
        console.print(_planes(evaluation["planes"]))
    for name, heading in BIN_HEADINGS.items():
        rows = evaluation["by"][name]
        if len(rows) > 1 and (name != "ring" or len(rows) <= LISTED_RINGS):
            console.print(_by(heading, rows))


def _planes(planes: Sequence[Mapping[str, Any]]) -> Table:
    table = columns_table("plane of", "thickness", "stops", "returns")
    for plane in planes:
        cells = (mm(plane["thickness_mm"]), f"{plane['stops']}", f"{plane['n']}")
        table.add_row(plane["label"], *cells)
    for column in table.columns[1:]:
        column.justify = "right"
    table.add_row()
    return table


def _by(heading: str, rows: Sequence[Mapping[str, Any]]) -> Table:
    table = _table(heading)
    for row in rows:
        cells = (mm(row["mean_mm"], "+"), mm(row["std_mm"]))
        cells += (mm(row["accuracy_mm"]), mm(row["precision_mm"]))
        table.add_row(row.get("name") or f"{row['value']:g}", *cells, f"{row['n']}")
    table.add_row()
    return table


def _table(heading: str) -> Table:
    table = columns_table(heading, "mean", "std", "accuracy", "precision", "returns")
    for column in table.columns[1:]:
        column.justify = "right"
    return table
