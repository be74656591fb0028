"""What could be behind a formula, and when formulas stand in for names."""

from types import SimpleNamespace

import pytest

from calib.diagnosis.formulas.factors import NOT_COVARIATES
from calib.diagnosis.formulas.why import ARM_JOINT, MECHANISMS, OF_ARM, WHY_JOINT, WHY_OTHER, why
from calib.diagnosis.structure.empirical import PoseShape
from calib.diagnosis.verdict import unnamed as module
from calib.diagnosis.verdict.unnamed import unnamed
from calib.effects import CATALOGUE, Site
from calib.results.errors import ErrorSize

KNOWN = sorted({c for e in CATALOGUE if e.site is Site.BEAM for c in e.covariates})


@pytest.mark.parametrize("name", sorted({*KNOWN, *MECHANISMS} - NOT_COVARIATES))
def test_each_covariate_of_the_catalogue_has_a_mechanism_and_an_experiment(name):
    found = why([name])
    assert found["mechanisms"][name] not in ("", WHY_OTHER[0])
    assert found["experiments"][name] not in ("", WHY_OTHER[1])


def test_a_joint_and_a_column_of_the_users_own_have_theirs():
    found = why(["elbow", "wind"], {"elbow"})
    assert found["mechanisms"] == {"elbow": WHY_JOINT[0], "wind": WHY_OTHER[0]}
    of_arm = why(["elbow", "wind", "payload_kg"], {"elbow"}, of_arm=True)
    payload = OF_ARM["payload_kg"][0]
    assert of_arm["mechanisms"] == {
        "elbow": ARM_JOINT[0],
        "wind": WHY_OTHER[0],
        "payload_kg": payload,
    }
    sites = {e.family: e.site for e in CATALOGUE}
    assert of_arm["known"] and {sites[name] for name in of_arm["known"]} == {Site.JOINTS}


@pytest.mark.parametrize(
    ("covariates", "among", "not_among"),
    [
        (["incidence_rad"], "incidence_angle_bias", "warmup_drift"),
        (["intensity", "range_m"], "intensity_range_walk", "incidence_angle_bias"),
    ],
)
def test_known_effects_hang_on_its_covariates_and_on_nothing_else(covariates, among, not_among):
    known = why(covariates)["known"]
    assert among in known and not_among not in known
    families = {e.family: set(e.covariates) for e in CATALOGUE if e.family in known}
    assert all(hangs_on <= set(covariates) for hangs_on in families.values())


def test_nothing_known_hangs_on_a_column_of_the_users_own():
    assert why(["wind"])["known"] == []


# Formulas or names --------------------------------------------------------------------------------

FLOOR = 2.0  # mm


def effect(i, over):
    """An effect on ranges with one parameter; the second has a shape as well."""
    return SimpleNamespace(
        name=f"effect_{i}",
        site=Site.BEAM,
        covariates=(over,),
        params=lambda rig: range(1),
        shape_name="scale" if i else "",
        formula="azimuth = true + a" if over == "turn" else "range = true + a",
    )


class Fit(float):
    """The held-out error of a fit with a formula, and of one without effects as well."""

    def lacking(self, names, progress):
        return Fit(self + sum({"effect_0": 0.5, "effect_1": 0.01}[name] for name in names))


class World:
    """A search that found some names, and what held-out stops say of models, in mm.

    Args:
        names: how many were found; each lowers the error from 4 by 0.5.
        first, last: error with formulas beside the model alone, and beside the names; None where
            there are none.
    """

    def __init__(
        self, monkeypatch, names=0, first=None, last=None, over=None, constants=1, unit="m"
    ):
        known = {"model": SimpleNamespace(names=()), "sources": [SimpleNamespace(rig=None)]}
        self.stands = [SimpleNamespace(estimate=i, **known) for i in range(names + 1)]
        every = [f"effect_{i}" for i in range(names)]

        def lacking(gone, progress):
            assert list(gone) == every
            return self.stands[0]

        self.stands[-1].lacking = lacking
        found = [SimpleNamespace(effect=effect(i, over or f"column_{i}")) for i in range(names)]
        self.search = SimpleNamespace(
            looks=[SimpleNamespace(stand=s) for s in self.stands],
            found=found,
            chance=(),
            unsettled=None,
            at_first=(),
            unnamed=(),
        )
        after = {0: first, names: last} if names else {0: last}
        self.asked = []

        def find(stand, progress, by_location=False):
            self.asked.append(stand.estimate)
            self.by_location = by_location
            error = after[stand.estimate]
            formula = {"covariates": ("wind",), "constants": constants, "unit": unit}
            return [] if error is None else [SimpleNamespace(**formula, after=error)]

        monkeypatch.setattr(module, "find", find)
        monkeypatch.setattr(module, "with_formulas", lambda _, formulas, __: Fit(formulas[0].after))

    def unnamed(self, doubtful=False, looks=True):
        def unseen(stand):
            rms = 4.0 - 0.5 * stand.estimate if stand in self.stands else stand
            return SimpleNamespace(size=ErrorSize(rms, rms, FLOOR), rejected_share=0.0)

        return unnamed(self.search, doubtful, unseen if looks else None, lambda *_: None)


def went(found):
    """The held-out error before and after, where anybody looked."""
    return found.fall and (found.fall.before_mm, found.fall.after_mm)


def test_a_formula_beside_no_name_is_told_with_what_it_gains(monkeypatch):
    found = World(monkeypatch, last=2.1).unnamed()
    assert len(found.formulas) == 1 and not found.instead
    assert went(found) == (4.0, 2.1) and not found.refused


@pytest.mark.parametrize(("after", "told"), [(3.97, True), (3.99, False), (4.5, False)])
def test_a_formula_that_predicts_unseen_stops_no_better_is_refused(monkeypatch, after, told):
    """Better is by a hundredth of the floor: 0.02 mm."""
    found = World(monkeypatch, last=after).unnamed()
    assert bool(found.formulas) == told == (not found.refused)
    if not told:
        assert f"(4.00 to {after:.2f} mm)" in found.refused and "wind" in found.refused


@pytest.mark.parametrize("where", ["at_first", "unnamed"])
@pytest.mark.parametrize(("after", "told"), [(2.4, True), (2.6, False)])
def test_a_formula_takes_the_place_of_a_motion_where_it_leaves_nothing(
    monkeypatch, where, after, told
):
    """Nothing is 1.25 times the floor: 2.5 mm."""
    world = World(monkeypatch, last=after)
    by_name = {e.name: e for e in CATALOGUE}
    moved = PoseShape(by_name["mount_slip"], "time_s", (0.0, 100.0), 1)
    setattr(world.search, where, [SimpleNamespace(effect=moved)])
    found = world.unnamed()
    assert bool(found.formulas) == told and not found.refused
    world.asked.clear()
    assert not world.unnamed(looks=False).formulas and not world.asked


def test_nobody_looks_and_a_formula_is_told_without_a_gain(monkeypatch):
    found = World(monkeypatch, last=9.0).unnamed(looks=False)
    assert len(found.formulas) == 1 and found.fall is None and not found.refused


def test_nothing_is_found_and_nothing_said(monkeypatch):
    found = World(monkeypatch).unnamed()
    assert not found.formulas and not found.refused and not found.instead


def test_a_formula_beside_the_names_is_judged_against_them(monkeypatch):
    found = World(monkeypatch, names=2, first=1.0, last=2.5).unnamed()
    assert not found.instead
    assert went(found) == (3.0, 2.5)


@pytest.mark.parametrize(("first", "instead"), [(2.9, True), (2.97, False), (3.2, False)])
def test_a_formula_takes_the_place_of_doubtful_names_that_predict_worse(
    monkeypatch, first, instead
):
    """The names come down from 4 to 3 mm; better is by a hundredth of 4."""
    found = World(monkeypatch, names=2, first=first, last=None).unnamed(doubtful=True)
    assert found.instead == instead
    assert went(found) == ((4.0, first) if instead else None)


def test_names_without_doubt_are_not_replaced(monkeypatch):
    world = World(monkeypatch, names=2, first=1.0, last=None)
    assert not world.unnamed(doubtful=False).instead
    assert world.asked == [2]


def test_doubtful_names_are_kept_where_no_formula_is(monkeypatch):
    world = World(monkeypatch, names=2, first=None, last=2.5)
    found = world.unnamed(doubtful=True)
    assert not found.instead and went(found) == (3.0, 2.5)
    assert world.asked == [0, 2]


@pytest.mark.parametrize(
    ("over", "constants", "first", "instead"),
    [
        ("wind", 6, 2.01, True),
        ("wind", 6, 2.03, False),  # worse by more than a hundredth of the floor, of 2 mm
        ("wind", 7, 2.01, False),
        ("rain", 6, 2.01, False),
        ("turn", 6, 2.01, False),
        (None, 6, 2.01, False),
    ],
)
def test_a_simpler_formula_takes_the_place_of_several_names_that_make_up_a_curve(
    monkeypatch, over, constants, first, instead
):
    """Four effects have seven constants, and come down to 2 mm."""
    world = World(monkeypatch, names=4, first=first, over=over, constants=constants)
    assert world.unnamed().instead == instead


def test_a_formula_of_more_takes_no_place_of_names_without_doubt(monkeypatch):
    world = World(monkeypatch, names=4, first=1.0, last=None, over="wind", constants=99)
    assert not world.unnamed().instead and world.unnamed(doubtful=True).instead


def test_a_formula_that_leaves_much_is_no_better_than_several_names(monkeypatch):
    """Of 2 mm."""
    assert not World(monkeypatch, names=2, first=3.0, over="wind").unnamed().instead


def test_one_name_is_no_curve_of_several(monkeypatch):
    world = World(monkeypatch, names=1, first=3.0, over="wind", constants=0)
    assert not world.unnamed().instead and world.asked == [1]


@pytest.mark.parametrize("settled", [True, False])
@pytest.mark.parametrize("per", ["location", "stop"])
@pytest.mark.parametrize("names", [0, 2])
def test_formulas_are_judged_by_location_where_locations_scatter(monkeypatch, settled, per, names):
    world = World(monkeypatch, names=names, last=2.1, first=2.1)
    scatter = SimpleNamespace(effect=SimpleNamespace(per=per, name="scatter"))
    key, value = ("chance", (scatter,)) if settled else ("unsettled", scatter)
    setattr(world.search, key, value)
    world.unnamed(doubtful=True)
    assert world.by_location == (per == "location")


@pytest.mark.parametrize(
    ("over", "unit", "needless"),
    [("wind", "m", ["effect_1"]), ("rain", "m", ["effect_1"]), ("rain", "rad", [])],
)
def test_names_that_it_may_replace_are_asked_for_beside_a_formula(
    monkeypatch, over, unit, needless
):
    """The error is 0.5 mm larger without the first name, 0.01 without the second, both of beams;
    a formula of a joint takes the place of what depends on its covariates alone."""
    found = World(monkeypatch, names=2, last=2.5, over=over, unit=unit).unnamed()
    assert found.formulas and found.needless == needless


@pytest.mark.parametrize(
    ("named", "after", "better"),
    [
        ((3.0, 0.05), (3.1, 0.004), False),
        ((3.0, 0.05), (2.4, 0.004), True),
        ((2.1, 0.05), (2.4, 0.004), True),
        ((3.0, 0.004), (2.4, 0.05), False),
        ((3.0, 0.004), (2.4, 0.004), True),
        ((2.41, 0.004), (2.4, 0.004), False),
        ((5.0, 0.004), (4.1, 0.004), False),
        ((5.0, 0.05), (4.1, 0.004), False),
    ],
    ids=[
        "worse, of more",
        "of more",
        "by chance, of more",
        "of fewer",
        "of as many",
        "no better",
        "than bad names",
        "than bad names, of more",
    ],
)
def test_errors_are_compared_by_how_many_beams_they_are_of(named, after, better):
    """In mm, where 2 are expected, and the share of beams that were rejected."""
    before, *both = (
        SimpleNamespace(size=ErrorSize(rms_mm, rms_mm, FLOOR), rejected_share=share)
        for rms_mm, share in ((4.0, 0.1), named, after)
    )
    assert module._better(before, *both) == better
