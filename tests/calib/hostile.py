"""A recording whose every name tries to be more than a name, wherever it is shown."""

import csv
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from sensors.documents import read_yaml, write_yaml
from sensors.recording import read_table, write_table

IMAGE = "<img src=x onerror=alert(1)>"
SCRIPT = '"><script>alert(1)</script>'
SINGLE = "'><svg onload=alert(1)>"
TERMINAL = "\x1b]0;x\x07\x9b31m"
MARKUP = "[bold]red[/bold]"
FORMULA = "=cmd|'/c calc'!A1"
PLUS = "+cmd|' calc'!A1"
SHELL = "$(touch pwned)`id`"
LATEX = r"\input{x}%"
ALL = "=" + IMAGE + SCRIPT.replace("/", "") + TERMINAL + MARKUP.replace("/", "") + SHELL + "{x}"

# What it is -> names in the recording, and what each is renamed to.
_PLACES: dict[str, dict[str, str]] = {
    "rig": {"husky-lwa4p-hesai_pandarxt32": ALL},
    "location": {"L00": IMAGE, "L01": FORMULA, "L02": TERMINAL},
    "stop": {"L00P00": ALL, "L00P01": IMAGE, "L01P00": PLUS, "L02P00": MARKUP, "L02P01": SINGLE},
    "frame": {"mount": IMAGE, "lidar": SCRIPT, "arm_base": SHELL},
    "body": {"base_markers": MARKUP, "mount_markers": FORMULA},
    "world": {"faro": SINGLE, "opti": LATEX},
    "joint": {"joint_1": IMAGE, "joint_2": SCRIPT, "joint_3": LATEX, "joint_4": FORMULA},
    "label": {"floor": IMAGE, "ceiling": SCRIPT, "wall_paint": TERMINAL, "wallpaper": ALL},
    "target": {"T1": IMAGE, "T2": PLUS, "T3": TERMINAL, "T4": SINGLE},
    "column": {"temperature_c": SCRIPT, "humidity": FORMULA},
    "column of points": {"near_ir": IMAGE, "column_b": SCRIPT, "column_c": LATEX},
}
PLACES = {
    what: {old: f"{evil} {old}" for old, evil in names.items()} for what, names in _PLACES.items()
}


def renamed(folder: Path, names: Mapping[str, str]) -> None:
    """Give things in a recording other names, in all of its files."""
    rig = _walked(read_yaml(folder / "rig.yaml")[0], names)
    rig["frames"] = {names.get(name, name): frame for name, frame in rig["frames"].items()}
    write_yaml(folder / "rig.yaml", rig)
    labels = folder / "reference" / "labels.yaml"
    known = _walked(read_yaml(labels)[0], names)
    labels.write_text("".join(f"{k}: {json.dumps(name)}\n" for k, name in known.items()))
    for path in (folder / "stops.csv", folder / "targets.csv"):
        with open(path, newline="", encoding="utf-8") as file:
            rows = [[_cell(cell, names) for cell in row] for row in csv.reader(file)]
        with open(path, "w", newline="", encoding="utf-8") as file:
            csv.writer(file).writerows(rows)
    arm = ElementTree.parse(folder / "arm.urdf")
    for element in arm.iter():
        for key, value in element.attrib.items():
            element.set(key, names.get(value, value))
    arm.write(folder / "arm.urdf", encoding="utf-8")
    for path in sorted((folder / "scans").iterdir()):
        if path.stem in names and "/" not in names[path.stem]:
            path = path.rename(path.with_name(f"{names[path.stem]}.parquet"))
        columns = read_table(path)
        write_table(path, {names.get(name, name): values for name, values in columns.items()})


def with_columns(folder: Path) -> None:
    """Give the points columns of their maker's own."""
    rng = np.random.default_rng(0)
    for path in sorted((folder / "scans").iterdir()):
        columns = read_table(path)
        count = len(columns["x"])
        own = {name: rng.random(count) for name in PLACES["column of points"]}
        write_table(path, columns | own)


def _walked(data: Any, names: Mapping[str, str]) -> Any:
    if isinstance(data, dict):
        return {key: _walked(value, names) for key, value in data.items()}
    if isinstance(data, list):
        return [_walked(each, names) for each in data]
    return names.get(data, data) if isinstance(data, str) else data


def _cell(cell: str, names: Mapping[str, str]) -> str:
    head, dot, tail = cell.partition(".")
    return names.get(cell, names.get(head, head) + dot + tail)
