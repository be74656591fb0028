"""A run's numbers as columns: its parameters, and what is left of every row."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from calib.runs.asked.pair import unknowns_of
from calib.runs.estimates import variable_estimates
from calib.runs.run import RESIDUALS, Run
from chains.errors import InputError
from sensors.documents import nearest
from sensors.recording import read_table

BEAM_RESIDUALS, INSTRUMENTS = "beams", ("tracker", "level", "target", "prior")


def parameters(run: Run) -> dict[str, np.ndarray]:
    """Every parameter of every frame and effect, as columns (N,).

    ``variable``, ``parameter``, ``unit``; ``estimate`` and ``sigma`` in that unit; ``cad_sigma``,
    how well it was known before, NaN where it was not; ``cad_sigmas``, how many of these it is from
    there; ``identifiable``, whether the data determine it; and of a run that was fitted from
    another one ``moved``, whether its frame or effect has moved since. A frame's estimate is how
    far it is from CAD, as a twist in its own axes, NaN where no CAD says where it should be.

    Raises:
        InputError: the run is incomplete.
    """
    before = {
        (unknown.name, dof): float(sigma)
        for unknown, _ in unknowns_of(run)
        if unknown.kind == "vector"
        for dof, sigma in zip(unknown.dofs, unknown.sigma, strict=True)
    }
    rows = [
        (row.variable, *each)
        for row in variable_estimates(run)
        for each in zip(row.parameters, row.units, row.estimate, row.sigma, row.told, strict=True)
    ]
    variable, parameter, unit, estimate, sigma, identifiable = map(
        np.array, zip(*rows, strict=True)
    )
    known = np.array([before.get((row[0], row[1]), np.nan) for row in rows])
    out = {
        "variable": variable,
        "parameter": parameter,
        "unit": unit,
        "estimate": estimate,
        "sigma": sigma,
        "cad_sigma": known,
        "cad_sigmas": estimate / known,
        "identifiable": identifiable,
    }
    if "links" in run.summary:
        moved = {link["name"] for link in run.summary["links"] if link["moved"]}
        out["moved"] = np.array([name in moved for name in variable.tolist()])
    return out


def residuals(run: Run, kind: str = BEAM_RESIDUALS) -> dict[str, np.ndarray]:
    """Residuals, measured minus predicted, with their sigmas, as columns (N,) with units in names.

    Args:
        run: the run.
        kind: "beams" of all stops, with what effects look at and the robust ``weight``; or
            "tracker", "level", "target" or "prior", whose ``whitened`` is the residual over its
            sigma. Where rows of a table have several units each has its columns, NaN in rows
            of the others.

    Raises:
        InputError: the run has none of that kind.
    """
    if kind not in (BEAM_RESIDUALS, *INSTRUMENTS):
        raise InputError(
            f"there are no residuals of '{kind}'{nearest(kind, [BEAM_RESIDUALS, *INSTRUMENTS])}"
        )
    folder = run.folder / RESIDUALS
    if kind == BEAM_RESIDUALS:
        return _of_beams(run, sorted(folder.glob("[!_]*.parquet")))
    path = folder / f"_{kind}.parquet"
    if not path.is_file():
        raise InputError(f"{run.folder} has no residuals of '{kind}'")
    table = read_table(path)
    unit = table.pop("unit")
    values = {name: table.pop(name) for name in ("residual", "sigma")}
    for name, each in values.items():
        for one in dict.fromkeys(unit.tolist()):
            table[f"{name}_{one}"] = np.where(unit == one, each, np.nan)
    return table


def _of_beams(run: Run, paths: list[Path]) -> dict[str, np.ndarray]:
    """The tables of all stops below each other, NaN where one lacks a column."""
    tables = [read_table(path) for path in paths]
    if not tables:
        raise InputError(f"{run.folder} has no residuals of beams")
    counts = [len(table["residual_m"]) for table in tables]
    out = {"stop": np.repeat([path.stem for path in paths], counts)}
    for name in dict.fromkeys(name for table in tables for name in table):
        parts = zip(tables, counts, strict=True)
        out[name] = np.concatenate([t.get(name, np.full(count, np.nan)) for t, count in parts])
    return out
