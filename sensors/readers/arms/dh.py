"""A table of Denavit and Hartenberg, as YAML or CSV, made into an arm.

Columns or keys: ``name``, ``a``, ``alpha``, ``d``, ``theta`` (the offset of its zero), and where
wanted ``type`` (revolute or prismatic), ``lower``, ``upper``, ``mass_kg`` and ``centre_m``. Lengths
and angles may say their unit: ``a_mm``, ``alpha_deg``. The convention is a key or column of that
name: ``standard`` or ``modified``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from chains.errors import InputError
from chains.readers.dh import DhRow, to_urdf
from sensors.documents import nearest, read_yaml
from sensors.readers.base import ArmDescription, Contents, Options, Progress
from sensors.readers.tables.sheets import ANGLES, LENGTHS, is_number, open_sheet, split_unit

_CONVENTIONS = ("standard", "modified")
_LENGTHS, _ANGLES = ("a", "d"), ("alpha", "theta")
_SAME = {"joint": "name", "offset": "theta", "theta_offset": "theta", "convention": "convention"}
_KEYS = ("name", *_LENGTHS, *_ANGLES, "type", "lower", "upper", "mass_kg", "centre_m", "convention")
_LONGEST_M = 10.0  # a choice: no link is longer, and one of 10 mm or more in millimetres is found


def read_dh(files: Sequence[Path], options: Options, progress: Progress) -> Contents:
    """Read one table of Denavit and Hartenberg.

    Raises:
        InputError: not one file, a key or number is wrong, or the convention is not said.
    """
    progress("reading the arm", 0, 1)
    if len(files) != 1:
        raise InputError(f"dh takes one table of an arm, not {len(files)}; name one file")
    (path,) = files
    yaml = path.suffix in (".yaml", ".yml")
    head, records = _from_yaml(path) if yaml else _from_sheet(path)
    said = {head.get("convention", options.dh)} | {r.pop("convention", None) for r in records}
    said -= {None}
    if len(said) != 1 or not said <= set(_CONVENTIONS):
        told = " and ".join(sorted(map(str, said))) or "not said"
        raise InputError(
            f"{path}: the convention is {told}; say --dh "
            "standard (Rz Tz Tx Rx) or --dh modified (Rx Tx Rz Tz), or write convention: standard"
        )
    (convention,) = said
    rows = [_row(path, k, record, options) for k, record in enumerate(records)]
    name = str(head.get("name", path.stem))
    base, tip = options.base or "arm_base", options.tip or "arm_end"
    line = f"{path.name}: an arm of {len(rows)} joints, {convention} Denavit-Hartenberg: "
    return Contents(
        arm=ArmDescription(to_urdf(name, rows, convention == "modified", base, tip), base, tip),
        understood=(line + ", ".join(row.name for row in rows),),
    )


def _from_yaml(path: Path) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    data, _ = read_yaml(path)
    head, rows = (data, data.get("joints")) if isinstance(data, dict) else ({}, data)
    if not isinstance(rows, list) or not rows or not all(isinstance(r, dict) for r in rows):
        raise InputError(
            f"{path}: a list `joints` of rows as {{name: j1, a: 0, d: 0.1, alpha: 0}} is wanted"
        )
    return head, [dict(row) for row in rows]


def _from_sheet(path: Path) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    sheet, _ = open_sheet(path)
    lines = [sheet.cells(line) for _, line in sheet.lines()]
    names, *rows = lines
    if not rows or any(len(row) != len(names) for row in rows):
        raise InputError(f"{path}: a header and a row for each joint are wanted, of equal length")
    cells = [[_value(cell, sheet.decimal_comma) for cell in row] for row in rows]
    return {}, [dict(zip(names, row, strict=True)) for row in cells]


def _value(cell: str, comma: bool) -> Any:
    if not is_number(cell, comma):
        return cell or None
    return float(cell.replace(",", ".") if comma else cell)


def _row(path: Path, k: int, record: Mapping[str, Any], options: Options) -> DhRow:
    """One row in SI units."""
    where = f"{path}: row {k + 1}"
    values: dict[str, Any] = {}
    for key, value in record.items():
        name, unit = (key, None) if key in _KEYS else split_unit(key)
        name = _SAME.get(name.lower(), name.lower())
        if name not in _KEYS:
            raise InputError(f"{where}: unknown column {key}{nearest(name, _KEYS)}")
        if value is None:
            continue
        if name in (*_LENGTHS, *_ANGLES, "lower", "upper", "mass_kg"):
            value = _number(where, key, value)
        if name in _LENGTHS:
            value *= LENGTHS.get(unit or options.length_unit or "m", 1.0)
            if abs(value) > _LONGEST_M:
                raise InputError(
                    f"{where}: {key} is {value:g} m, which looks like millimetres; say {name}_mm"
                )
        elif name in _ANGLES:
            beyond = abs(value) > 2 * np.pi + 1e-3  # only degrees go there
            value *= ANGLES.get(unit or options.angle_unit or ("deg" if beyond else "rad"), 1.0)
        values[name] = value
    if missing := [name for name in ("a", "alpha", "d") if name not in values]:
        raise InputError(f"{where}: {missing[0]} is missing; each row has a, alpha and d")
    return _made(where, k, values)


def _made(where: str, k: int, values: Mapping[str, Any]) -> DhRow:
    kind = str(values.get("type", "revolute"))
    if kind not in ("revolute", "prismatic"):
        raise InputError(f"{where}: type is {kind}; a joint is revolute or prismatic")
    centre = values.get("centre_m", (0.0, 0.0, 0.0))
    numbers = isinstance(centre, list | tuple) and all(isinstance(c, int | float) for c in centre)
    if not numbers or len(centre) != 3:
        raise InputError(f"{where}: centre_m is {centre}; three numbers are wanted")
    return DhRow(
        name=str(values.get("name", f"joint_{k + 1}")),
        a_m=values["a"],
        alpha_rad=values["alpha"],
        d_m=values["d"],
        theta_rad=values.get("theta", 0.0),
        kind=kind,
        lower=values.get("lower", -2 * np.pi),
        upper=values.get("upper", 2 * np.pi),
        mass_kg=values.get("mass_kg", 0.0),
        centre_m=tuple(float(v) for v in centre),
    )


def _number(where: str, key: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
        raise InputError(f"{where}: {key} is {value!r}; a number is wanted")
    return float(value)
