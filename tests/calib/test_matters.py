"""What a finding would change, as predicted, is what it does change once it is fitted."""

from dataclasses import replace
from importlib import import_module
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import ttest_rel, wilcoxon

from calib import add, diagnose, fit
from calib.diagnosis.search import NamedEffect, Search
from calib.diagnosis.search.named import Rival
from calib.diagnosis.stand import Stand
from calib.diagnosis.structure.empirical import Binned
from calib.diagnosis.verdict import _over_the_expected, _unconfirmed, conclude
from calib.diagnosis.verdict.matters import (
    FALL_MATTERS,
    SHIFT_MATTERS,
    Consequences,
    Matters,
    borne_out,
    weighed,
)
from calib.diagnosis.verdict.names import believed, dressed_up
from calib.diagnosis.verdict.sentences import _first_sentences, unconfirmed
from calib.diagnosis.verdict.unnamed import Unnamed
from calib.effects import find
from calib.problem import build
from calib.problem.model import Model, Source
from calib.results.holdout import Fall, gains_m2
from calib.simulation import Spec, simulate
from calib.solve.fit import solve

from ..worlds import World, write

SPEC = Spec(lidar="hesai_pandarxt32", locations=6, stops_per_location=4, column_step=100)

runs = import_module("calib.runs.diagnose")


def quiet(what, done, total):
    pass


@pytest.fixture(scope="module")
def look(tmp_path_factory):
    """A fit that lacks an incidence bias, looked at."""
    folder = tmp_path_factory.mktemp("matters") / "rec"
    simulate(SPEC, folder, 11, {"incidence_angle_bias": 0.3})
    source, model = [Source.open(folder)], Model()
    problem = build(source, model)
    return Stand(source, model, problem, solve(problem)).look(quiet)


@pytest.mark.long
def test_values_move_as_far_as_predicted(look):
    candidate = next(c for c in look.named.candidates if c.effect.name == "incidence_angle_bias")
    rms_mm = {"held_out": 3.0, "fit": 3.0, "noise_floor": 2.0}
    told = Consequences(look, rms_mm).of(candidate, look.named)
    after = look.stand.with_effects([find("incidence_angle_bias")], quiet).estimate
    before = look.stand.estimate
    found = []
    at = np.cumsum([0, *(v.dim for v in after.variables)])
    sigma = np.sqrt(np.diag(after.covariance))
    for v, start in zip(after.variables, at, strict=False):
        if v.name in before.values:
            moved = v.difference(before.values[v.name], after.values[v.name])
            found.append(np.abs(moved) / sigma[start : start + v.dim])
    largest = np.concatenate(found).max()
    # Its own sigma without the effect is smaller, as that holds what the effect does besides.
    assert largest > 2 and 0.5 < told.largest_shift_sigmas / largest < 4


def test_the_error_falls_by_what_is_explained(look):
    candidate = next(c for c in look.named.candidates if c.effect.name == "incidence_angle_bias")
    weigh = Consequences(look, {"held_out": 3.0, "fit": 1.0, "noise_floor": 2.0})
    explained = 1e3 * look.named.rms_m(candidate)
    expected = np.sqrt(9.0 - explained**2) - 3.0
    assert weigh.of(candidate, look.named).held_out_mm == pytest.approx(expected)
    assert weigh.of(candidate, look.named, Fall(5.0, 2.5, 2.0)).held_out_mm == -2.5


@pytest.mark.parametrize(
    ("fall_mm", "shift", "enough"),
    [
        (-1.1 * FALL_MATTERS * 2.0, 0.0, True),
        (-0.9 * FALL_MATTERS * 2.0, 0.0, False),
        (0.0, 1.1 * SHIFT_MATTERS, True),
        (+1.0, 0.9 * SHIFT_MATTERS, False),
    ],
)
def test_either_of_them_is_enough(fall_mm, shift, enough):
    assert Matters(fall_mm, shift, 2.0).enough is enough


def test_one_stop_far_from_all_others_does_not_hide_that_they_agree():
    """As where its pose is extrapolated: by Student's t such a fall would be chance."""
    gain = (0.5, 0.8, 1.1, 0.9, 0.7, 1.2, 0.6, 4000.0)
    assert not Fall(3.0, 2.0, 1.9, gain).by_chance
    assert Fall(3.0, 2.0, 1.9, (*gain[:3], -1.0, -0.6, -0.4, -0.7, 4000.0)).by_chance


@pytest.mark.parametrize(
    ("before_mm", "after_mm", "sure"),
    [(42.0, 1.6, True), (42.0, 30.0, False), (1.7, 1.5, False), (2.2, 1.5, True)],
)
def test_three_stops_bear_out_what_takes_the_error_to_the_expected_one(before_mm, after_mm, sure):
    fall = Fall(before_mm, after_mm, 1.5, (0.1, 2.0, 90.0))
    assert fall.by_chance and borne_out(fall) is sure
    assert borne_out(None) and borne_out(replace(fall, gain_m2=(1.0, 1.1, 0.9)))


@pytest.mark.long
def test_what_predicts_nothing_before_another_is_in_is_asked_beside_it(tmp_path):
    """Encoders off centre are named first, and stops held out are predicted worse with that as long
    as a walk of 4 mm with intensity is missing."""
    hidden = {"intensity_range_walk": 4.0, "encoder_eccentricity": 3.0}
    simulate("tiny", tmp_path / "rec", 45, hidden)
    found = diagnose(fit(tmp_path / "rec", tmp_path / "run"))
    assert found.verdict == "missing_effect" and set(found.worth_adding) == hidden.keys()
    for candidate in found.candidates[:2]:
        held_out = candidate["held_out_rms_mm"]
        assert held_out["after"] < 2.0 < 3.0 * held_out["after"] < held_out["before"]


@pytest.mark.parametrize("mean", [0.2, 0.5, 0.9])
def test_a_fall_is_chance_where_tests_over_stops_say_so(mean):
    rng = np.random.default_rng(5)
    before = rng.normal(9.0, 1.0, 12)
    after = before - rng.normal(mean, 1.0, 12)
    gone = [*before, np.nan], [*after, 3.0]  # no beam of that stop met anything before
    fall = Fall(3.0, 2.9, 2.5, gains_m2(*gone))
    tests = [test(before, after, alternative="greater").pvalue for test in (ttest_rel, wilcoxon)]
    assert fall.by_chance is bool(min(tests) > 0.025)
    spread_m2 = np.std(before - after, ddof=1) / np.sqrt(12)
    # To first order the rms falls by the mean square's fall over the sum of both.
    assert fall.spread_mm == pytest.approx(1e6 * spread_m2 / (3.0 + 2.9))
    assert gains_m2(before, after[1:]) == ()  # other stops: nothing is known
    assert Fall(3.0, 2.9, 2.5).spread_mm is None and not Fall(3.0, 2.9, 2.5).by_chance


@pytest.mark.parametrize("steady", [True, False])
@pytest.mark.parametrize("general", [True, False])
def test_a_later_name_stands_if_stops_bear_it_out_or_nothing_is_more_general(look, steady, general):
    """Two names lower the held-out error as much; stops differ about one of them."""
    gain = {True: (4e-8, 5e-8, 6e-8), False: (-9e-8, 2e-8, 22e-8)}
    falls = {
        "incidence_angle_bias": Fall(3.0, 2.9, 2.0, gain[False]),  # of the first nobody asks
        "azimuth_range_harmonic": Fall(2.9, 2.8, 2.0, gain[steady]),
    }
    steps, more = [], max(look.named.candidates, key=lambda c: c.test.dof)
    for name in falls:
        candidate = next(c for c in look.named.candidates if c.effect.name == name)
        steps.append(
            NamedEffect(
                candidate=candidate,
                before=look,
                after=look,
                judged=candidate.test,
                p_adjusted=1e-4,
                rivals=[Rival(more if general else candidate, log_odds=0.0, more=0.0)],
            )
        )
    found = Search(looks=[look], found=steps, blunders=(), unnamed=(), scatter=None)
    told = weighed(found, falls, {"held_out": 3.0, "fit": 3.0, "noise_floor": 2.0})
    assert [step.effect.name for step in told.found.found] == list(falls)[
        : 1 + (steady or not general)
    ]
    assert len(told.refused) == (general and not steady)
    if told.refused:
        assert f"but so does {more.effect.name}, which is more general" in told.refused[0]
        assert "azimuth_range_harmonic was tried and rejected" in told.refused[0]
        assert "-0.100 mm, ± 0.016" in told.refused[0]


@pytest.mark.parametrize(("times", "doubted"), [(1.3, False), (1.6, True)])
def test_scatter_does_not_excuse_what_it_does_not_explain(look, times, doubted):
    """The error that counts is that of the model with what scatters; without, nobody knows."""
    chance = [SimpleNamespace(effect=SimpleNamespace(name="stop_range_scatter"))]
    found = Search([look], found=(), blunders=(), unnamed=(), scatter=None, chance=chance)
    summary = {"rms_mm": {"held_out": 9.0, "fit": 2.0, "noise_floor": 2.0}}
    assert _over_the_expected(found, {}, summary) == 0.0
    falls = {"stop_range_scatter": Fall(9.0, times * 3.0, 3.0)}
    over = _over_the_expected(found, falls, summary)
    assert over == pytest.approx(times)
    few = summary | {"held_out_each_mm": [8.0, 9.0, 10.0]}
    assert _over_the_expected(found, falls, few) == 0.0, "three stops judge no model"
    assert _unconfirmed(found, over)[0] == doubted


@pytest.mark.parametrize(("scans", "said"), [(0, ""), (1, "scans of 1 stop are"), (4, "")])
def test_an_adequate_model_of_few_scans_says_that_they_are_few(look, scans, said):
    stand = SimpleNamespace(
        model=look.stand.model, estimate=SimpleNamespace(scans=look.stand.estimate.scans[:scans])
    )
    few = SimpleNamespace(linear=look.linear, named=look.named, unnamed=look.unnamed, stand=stand)
    first, *rest = _first_sentences("adequate", few, False)
    assert first.startswith("The model is adequate")
    assert (said in rest[0] and "4 are the least" in rest[0]) if said else not rest


@pytest.mark.parametrize(
    ("over", "shown", "doubted"),
    [(1.2, True, False), (1.3, True, True), (1.45, False, False), (1.6, False, True)],
)
def test_a_large_held_out_error_is_nothing_adequate_though_no_test_says_why(
    look, over, shown, doubted
):
    if not shown:
        look = replace(look, unnamed=replace(look.unnamed, candidates=()))
    found = Search([look], found=(), blunders=(), unnamed=(), scatter=None)
    unsure, candidate = _unconfirmed(found, over)
    assert unsure == doubted and (candidate is not None) == (shown and doubted)
    if doubted:
        said = unconfirmed(candidate, over)
        assert f"{over} times as large as expected, and no test" in said
        assert ("no test says why" in said) == (not shown)


@pytest.mark.parametrize("structure", [True, False])
def test_a_name_that_held_out_stops_refuse_says_something_only_where_structure_does(
    look, structure
):
    candidate = next(c for c in look.named.candidates if c.effect.name == "incidence_angle_bias")
    step = NamedEffect(
        candidate=candidate,
        before=look,
        after=look,
        judged=candidate.test,
        p_adjusted=1e-3,
        rivals=[],
    )
    bins = (c for c in look.unnamed.candidates if isinstance(c.effect, Binned))
    strongest = max(bins, key=lambda c: c.evidence)
    found = Search(
        looks=[look],
        found=[step],
        blunders=(),
        unnamed=(),
        scatter=None,
        at_first=[strongest] if structure else [],
    )
    falls = {"incidence_angle_bias": Fall(2.0, 2.1, 2.0)}
    rms_mm = {"held_out": 2.0, "fit": 2.0, "noise_floor": 2.0}
    told = conclude(found, falls, {"rms_mm": rms_mm, "misfit": {}}, [])
    assert told.verdict == ("unexplained_structure" if structure else "adequate")
    assert len(told.unexplained) == structure and not told.worth_adding
    assert structure or "none that matters is significant" in told.sentences[0]
    assert any("incidence_angle_bias was tried and rejected" in s for s in told.sentences)


@pytest.mark.parametrize(
    ("formulas", "after_mm", "told"),
    [
        (Unnamed(["a formula"]), 3.0, True),
        (Unnamed(["a formula"]), 8.9, False),
        (Unnamed(["a formula"], instead=True), 3.0, False),
        (Unnamed(["a formula"], needless=["it"]), 3.0, False),
        (Unnamed(), 3.0, False),
    ],
    ids=[
        "beside it",
        "which takes little of the error",
        "in its place",
        "beside which it is nothing",
        "no formula",
    ],
)
def test_a_name_stands_beside_a_larger_structure_of_what_it_leaves(look, formulas, after_mm, told):
    weakest = min(look.named.candidates, key=lambda c: c.test.evidence(look.named.common))
    fields = {"before": look, "after": look, "judged": weakest.test, "p_adjusted": 1e-3}
    step = NamedEffect(candidate=weakest, **fields, rivals=[])
    found = Search([look], found=[step], blunders=(), unnamed=(), scatter=None)
    assert found.dressed_up(0)
    name = weakest.effect.name
    falls = {name: Fall(9.0, after_mm, 2.0, (1.0, -1.0, 4.0))}
    assert falls[name].by_chance
    formulas = replace(formulas, needless=[name] * len(formulas.needless))
    assert dressed_up(found, falls, False, formulas) == ([] if told else [name])


def test_a_needless_name_leaves_the_others(look):
    one, other = look.named.candidates[:2]
    fields = {"before": look, "after": look, "p_adjusted": 1e-3, "rivals": []}
    steps = [NamedEffect(candidate=c, judged=c.test, **fields) for c in (one, other)]
    found = Search([look], found=steps, blunders=(), unnamed=(), scatter=None)
    falls = {one.effect.name: Fall(9.0, 3.0, 2.0), other.effect.name: Fall(3.0, 2.9, 2.0, (1, -1))}
    formulas = Unnamed(["a formula"], needless=[other.effect.name])
    for hold in (True, False):
        assert dressed_up(found, falls, hold, formulas) == [other.effect.name]


SCATTER = SimpleNamespace(effect=SimpleNamespace(name="joint_scatter"))


@pytest.mark.parametrize(
    ("gain_m2", "floor_mm", "holds"),
    [
        ((1.0, 1.1, 0.9), 6.0, True),
        ((1.0, 1.1, 0.9), 2.0, False),
        ((1.0, -1.0, 4.0), 6.0, False),
        ((1.0, 1.1, 0.9), None, False),
    ],
    ids=["scatter explains the rest", "it does not", "stops do not confirm it", "no scatter"],
)
def test_a_name_that_stops_confirm_holds_beside_scatter_that_explains_the_rest(
    look, gain_m2, floor_mm, holds
):
    """It takes the error from 9 to 7 mm, which is far above the 2 mm of noise alone."""
    best = max(look.named.candidates, key=lambda c: c.test.evidence(look.named.common))
    strong = replace(best, test=replace(best.test, statistic=1e6))
    fields = {"before": look, "after": look, "judged": best.test, "p_adjusted": 1e-3}
    step = NamedEffect(candidate=strong, **fields, rivals=[])
    found = Search([look], found=[step], blunders=(), unnamed=(), scatter=None, chance=[SCATTER])
    falls = {best.effect.name: Fall(9.0, 7.0, 2.0, gain_m2)}
    if floor_mm:
        falls["joint_scatter"] = Fall(7.0, 7.0, floor_mm)
    assert believed(found, falls) == holds


@pytest.mark.parametrize(
    ("after_mm", "gain_m2", "scatters", "gone"),
    [
        (8.9, (1.0, -1.0, 4.0), True, True),
        (8.9, (1.0, -1.0, 4.0), False, False),
        (8.0, (1.0, 1.1, 0.9), True, False),
        (2.4, (1.0, -1.0, 4.0), True, False),
    ],
    ids=["most stays", "without scatter", "stops agree", "little stays"],
)
def test_beside_scatter_names_that_leave_most_are_none(
    look, monkeypatch, after_mm, gain_m2, scatters, gone
):
    candidate = max(look.named.candidates, key=lambda c: c.test.evidence(look.named.common))
    fields = {"before": look, "after": look, "judged": candidate.test, "p_adjusted": 1e-3}
    step = NamedEffect(candidate=candidate, **fields, rivals=[])
    found = Search([look], found=[step], blunders=(), unnamed=(), scatter=None)
    found = replace(found, chance=[SCATTER] if scatters else ())
    monkeypatch.setattr(runs, "nameless", lambda found, progress: replace(found, found=()))
    falls = {candidate.effect.name: Fall(9.0, after_mm, 2.0, gain_m2)}
    run = SimpleNamespace(summary={"rms_mm": {"held_out": 9.0, "fit": 2.0, "noise_floor": 2.0}})
    again = runs._as_held_out(found, falls, Unnamed(), run, quiet)
    assert bool(again.found) != gone
    assert runs._as_held_out(found, {}, Unnamed(), run, quiet) is found, "nothing was held out"


@pytest.mark.long
def test_what_matters_stands_with_each_finding_and_a_trace_is_said_to_be_one(tmp_path):
    """0.08 mm of 1.6, of a pattern that no value of the calibration is like."""
    simulate(SPEC, tmp_path / "rec", 4, {"azimuth_range_harmonic": 0.03})
    found = diagnose(fit([tmp_path / "rec"], tmp_path / "run"))
    (told,) = (c["matters"] for c in found.candidates if c["effect"] == "azimuth_range_harmonic")
    assert -0.01 < told["held_out_mm"] < 0 < told["largest_shift_sigmas"] < SHIFT_MATTERS
    traces = [s for s in found.sentences if "too small to matter" in s]
    assert found.verdict == "adequate" and not found.worth_adding
    assert len(traces) == 1 and "none that matters" in found.sentences[0]


@pytest.mark.parametrize(("over", "verdict"), [(2.0, "unexplained_structure"), (1.1, "adequate")])
def test_what_single_beams_show_and_no_test_confirms_is_not_called_adequate(look, over, verdict):
    """Unless the held-out error is what it should be: then it is chance."""
    found = Search([look], found=(), blunders=(), unnamed=(), scatter=None)
    rms_mm = {"held_out": over * 2.0, "fit": 2.0, "noise_floor": 2.0}
    told = conclude(found, {}, {"rms_mm": rms_mm, "misfit": {}}, [])
    assert told.verdict == verdict
    if verdict == "adequate":
        assert not told.unexplained and "adequate" in told.sentences[0]
    else:
        assert told.unexplained[0]["covariates"] and "no test confirms" in told.sentences[0]
        assert not any("adequate" in each for each in told.sentences)


@pytest.mark.long
def test_a_joint_whose_zero_slips_is_named_and_not_called_scatter(tmp_path):
    """By a world of its own code: nothing but one joint, from the middle of the session on."""
    world = World(seed=1, locations=5, beams=400, hidden=(("joint_slip", 0.002),))
    truth = write(world, tmp_path / "rec")
    run = fit([tmp_path / "rec"], tmp_path / "run", hold_out="none")
    found = diagnose(run)
    (name,) = found.worth_adding
    assert name.startswith("arm_joint_slip@")
    slipped = add(run, [name], tmp_path / "grown").solution.shared.effects[name]
    joint = slipped.names.index("joint_3")
    size = truth["params"]["joint_slip"]
    assert abs(slipped.estimate[joint] - size) < 4 * slipped.sigma[joint] < size
