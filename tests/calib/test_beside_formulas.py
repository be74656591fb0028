"""Beside a formula of a structure, neither scatter nor mishaps that take in the structure are left:
what is there besides is."""

from types import SimpleNamespace

import numpy as np
import pytest

import calib
from calib.diagnosis.search import beside_formulas, search
from calib.diagnosis.verdict.unnamed import Unnamed
from calib.effects import find
from calib.effects.own.formula import FormulaEffect
from calib.runs.diagnose import with_formulas_and_names
from calib.runs.reopen import stand_of
from sensors.recording import read_table, write_table

from ..worlds import World, write

# Of another program's: each surface has its own brightness, so the mesh takes in most of what
# brightness does.
WORLD = World(seed=1, locations=3, stops=4, beams=200, stop_scatter_m=0.004)
DARK = {
    "name": "dark",
    "site": "range",
    "unit": "m",
    "sigma": 0.1,
    "basis": ["intensity", "intensity**2"],
    "what": "A parabola over intensity.",
}
BENT_M = 0.3


def quiet(what, done, total):
    pass


def bend(path):
    """Lengthen the ranges of a scan by a parabola over intensity."""
    table = read_table(path)
    xyz = np.stack([table[axis] for axis in "xyz"], axis=1).astype(float)
    range_m = np.linalg.norm(xyz, axis=1)
    bright = table["intensity"].astype(float)
    longer = BENT_M * bright * (bright - 1.0)  # as the formula has it, without a constant
    xyz *= (1 + longer / range_m)[:, None]
    write_table(path, table | {a: xyz[:, k].astype(np.float32) for k, a in enumerate("xyz")})


@pytest.fixture(scope="module")
def stand(tmp_path_factory):
    """Where a fit of such a recording stands; one body at one stop is 20 mm from where it was."""
    folder = tmp_path_factory.mktemp("beside")
    write(WORLD, folder / "rec")
    for path in sorted((folder / "rec/scans").iterdir()):
        bend(path)
    head, *rows = (folder / "rec/stops.csv").read_text().splitlines()
    cells, at = rows[3].split(","), head.split(",").index("mount_markers.x")
    cells[at] = str(float(cells[at]) + 0.02)
    rows[3] = ",".join(cells)
    (folder / "rec/stops.csv").write_text("\n".join([head, *rows, ""]))
    run = calib.fit([folder / "rec"], folder / "run", hold_out="none")
    return stand_of(run, quiet)


@pytest.mark.long
def test_scatter_is_judged_beside_a_formula_and_so_are_mishaps(stand):
    done = search(stand, quiet)
    assert {c.effect.name for c in done.chance} > {"stop_range_scatter"}
    formula = FormulaEffect.read(DARK, "dark.yaml", {})
    fitted = stand.with_effects([formula], quiet)
    beside = beside_formulas(done, fitted, True, quiet)
    (scatter,) = beside.chance
    assert scatter.effect.name == "stop_range_scatter"
    (spread,) = scatter.spreads
    assert abs(spread.sd - WORLD.stop_scatter_m) < 3 * spread.sigma < WORLD.stop_scatter_m
    assert {b.blunder.group.where for b in beside.blunders} == {"L00P03"}
    assert "dark" in beside.beside.stand.model.names
    assert beside.looks is done.looks and beside.found is done.found and beside.scatter_judged


@pytest.mark.parametrize("instead", [False, True])
def test_names_that_a_formula_makes_needless_are_not_beside_it(stand, instead):
    names = ("label_range_offset", "faro_scale")
    found = SimpleNamespace(
        found=[SimpleNamespace(effect=find(name)) for name in names], chance=["some"], blunders=()
    )
    formula = SimpleNamespace(effect=lambda taken, what: DARK)
    formulas = Unnamed([formula], instead, (3.0, 2.0), needless=names[:1])
    whole = with_formulas_and_names(stand, found, formulas, None, quiet)
    kept = () if instead else names[1:]
    assert whole.model.names == (*stand.model.names, *kept, "dark")
    nothing = SimpleNamespace(found=found.found, chance=(), blunders=())
    assert with_formulas_and_names(stand, nothing, formulas, None, quiet) is None
