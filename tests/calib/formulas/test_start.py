"""A fit begins where an effect says, so that beams far off have weight from its first pass on."""

import pytest

from calib.effects.own.formula import FormulaEffect
from calib.problem import build
from calib.problem.model import Model, Source
from calib.simulation import Spec
from calib.solve.fit import solve
from chains.errors import InputError

from .. import rescans
from ..simulated import made

SMALL = Spec(lidar="hesai_pandarxt32", locations=2, stops_per_location=2, column_step=100)
PAGE = {"name": "sector", "site": "range", "unit": "m", "sigma": 0.1}
SECTOR = "(azimuth_rad > 0.3) * (azimuth_rad < 1.0)"


def effect(*start: float, basis=(SECTOR,)) -> FormulaEffect:
    page = PAGE | {"basis": list(basis)} | ({"start": list(start)} if start else {})
    return FormulaEffect.read(page, "sector.yaml", {})


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """A recording whose ranges are off in a sector by so much: made when asked."""

    def of(by_m: float) -> Source:
        source, _ = made(tmp_path_factory.mktemp("start") / "rec", SMALL)
        rescans.change_ranges(source.recording.folder, rescans.sector(0.3, 1.0, by_m))
        return Source.open(source.recording.folder)

    return of


def test_unknowns_begin_where_the_effect_says(recorded):
    source, basis = recorded(0.0), (SECTOR, "humidity * range")
    begun = build([source], Model().plus((effect(0.025, -0.001, basis=basis),)))
    assert begun.initial["sector"].tolist() == [0.025, -0.001]
    assert begun.variables["sector"].mean.tolist() == [0.0, 0.0]  # nothing more is known of it
    assert build([source], Model().plus((effect(),))).initial["sector"].tolist() == [0.0]


@pytest.mark.parametrize("by_m", [0.1, -0.3])
def test_beams_far_off_are_taken_up_from_where_the_effect_begins_and_not_from_zero(recorded, by_m):
    """What trackers and targets alone say of an effect on beams, that is nothing, takes no start
    away."""
    source = recorded(by_m)
    near, zero = (
        solve(build([source], Model().plus((e,)))) for e in (effect(0.9 * by_m), effect())
    )
    assert near.values["sector"][0] == pytest.approx(by_m, abs=1e-3)
    assert abs(zero.values["sector"][0] - by_m) > 0.05


def test_a_start_that_is_wrong_is_left(recorded):
    source = recorded(0.0)
    found = solve(build([source], Model().plus((effect(0.01),))))
    assert abs(found.values["sector"][0]) < 1e-3


@pytest.mark.parametrize("start", [(0.025, 0.0), (0.1, 0.1, 0.1)])
def test_a_start_of_another_length_is_refused_in_a_sentence(start):
    with pytest.raises(InputError) as refused:
        effect(*start)
    said = str(refused.value)
    assert f"start has {len(start)} numbers, and basis 1 formulas; give one for each" in said
    assert "sector.yaml" in said and "\n" not in said


def test_a_start_is_kept_in_its_document():
    again = FormulaEffect.read(effect(0.025).document(), "again.yaml", {})
    assert again.file.start == (0.025,)
    assert "start" not in effect().document()


@pytest.mark.slow
def test_the_sector_of_the_independent_simulator(shared):
    folder = shared / "recordings" / "known_sector"
    if not folder.is_dir():
        pytest.skip(f"not here: {folder}")
    first = -2.835741863599985  # of its truth
    page = PAGE | {"basis": [f"(azimuth_rad > {first}) * (azimuth_rad < {first + 0.7})"]}
    one = FormulaEffect.read(page | {"start": [-0.02]}, "sector.yaml", {})
    found = solve(build([Source.open(folder)], Model().plus((one,))))
    assert found.values["sector"][0] == pytest.approx(-0.025, abs=1e-3)
