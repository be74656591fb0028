"""Where an effect begins that is added to a fit which rejects all that it explains."""

import pytest

from calib.effects.own.formula import FormulaEffect
from calib.problem import build
from calib.problem.model import Model, Source
from calib.simulation import Spec
from calib.solve.fit import solve
from sensors.documents import Marks

from . import rescans
from .rescans import change_ranges
from .simulated import made

SMALL = Spec(lidar="hesai_pandarxt32", locations=3, stops_per_location=2, column_step=50)
FIRST_RAD, LAST_RAD = 0.3, 1.0


def sector(sigma: float = 0.3) -> FormulaEffect:
    page = {"name": "sector", "site": "range", "unit": "m", "sigma": sigma}
    page["basis"] = [f"(azimuth_rad > {FIRST_RAD}) * (azimuth_rad < {LAST_RAD})"]
    return FormulaEffect.read(page, "sector.yaml", Marks({}))


def shifted(source: Source, by_m: float) -> Source:
    """The recording with the ranges of a sector made longer."""
    change_ranges(source.recording.folder, rescans.sector(FIRST_RAD, LAST_RAD, by_m))
    return Source.open(source.recording.folder)


@pytest.mark.parametrize("by_m", [0.025, -0.1])
def test_an_effect_takes_up_beams_that_had_no_weight(tmp_path, by_m):
    source = shifted(made(tmp_path / "rec", SMALL)[0], by_m)
    without = solve(build([source], Model()))
    found = solve(build([source], Model().plus((sector(),))), start=without.start)
    assert found.values["sector"][0] == pytest.approx(by_m, abs=1e-3)
    anew = solve(build([source], Model().plus((sector(),))))
    assert found.values["sector"][0] == pytest.approx(anew.values["sector"][0], abs=1e-4)


def test_an_effect_that_explains_nothing_begins_at_zero(tmp_path):
    source = made(tmp_path / "rec", SMALL)[0]
    without = solve(build([source], Model()))
    found = solve(build([source], Model().plus((sector(),))), start=without.start)
    assert abs(found.values["sector"][0]) < 1e-3
