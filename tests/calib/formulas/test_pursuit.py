"""Forms that are planted in made-up residuals come back as they are."""

import re
from dataclasses import replace

import numpy as np
import pytest

from calib.diagnosis.formulas.factors import Factor
from calib.diagnosis.formulas.found import FittedTerm, Formula, settled
from calib.diagnosis.formulas.pursuit import ConfirmedTerm, Form, form, pursue, simplest
from calib.diagnosis.formulas.terms import FormulaTerm, refine, slopes

from .made import table

ALPHA = 0.01


def labels(rng, c):
    return {"label": rng.integers(0, 4, len(c["range_m"])).astype(float)}


def parity(c):
    return np.where(c["ring"] % 2 == 1, 1.0, -1.0)


# What is planted, in which covariates, and what must be in the texts.
PLANTED = {
    "a line times a line": (
        lambda c: 4e-3 * (c["temperature_c"] - 25) / 10 * (c["intensity"] - 0.5) / 0.5,
        {"temperature_c", "intensity"},
    ),
    "a window across the gap": (
        lambda c: 4e-3 * ((c["azimuth_rad"] > 2.8) | (c["azimuth_rad"] < -2.5)),
        {"azimuth_rad"},
    ),
    "a window": (
        lambda c: 3e-3 * ((c["azimuth_rad"] > 0.3) & (c["azimuth_rad"] < 1.1)),
        {"azimuth_rad"},
    ),
    "a decay": (lambda c: 8e-3 * np.exp(-(c["range_m"] - 1) / 1.5), {"range_m"}),
    "a wave": (lambda c: 2e-3 * np.sin(2 * np.pi * c["range_m"] / 2.3 + 0.7), {"range_m"}),
    "a class times a line": (
        lambda c: 5e-3 * (c["label"] == 2) * (c["incidence_rad"] - 0.6) / 0.6,
        {"label", "incidence_rad"},
    ),
    "parity of rings times a line": (
        lambda c: 2e-3 * parity(c) * (c["range_m"] - 6.5) / 5.5,
        {"ring", "range_m"},
    ),
    "a step": (lambda c: 3e-3 * (c["incidence_rad"] > 0.8), {"incidence_rad"}),
    # Whose average over any of the three is nothing.
    "three together": (
        lambda c: (
            4e-3
            * np.sin(2 * c["azimuth_rad"])
            * (c["temperature_c"] - 25)
            / 10
            * (c["intensity"] - 0.525)
            / 0.5
        ),
        {"azimuth_rad", "temperature_c", "intensity"},
    ),
    # Whose scale and amount can hardly be told apart, and which is there all the same.
    "through zero": (
        lambda c: 3e-3 * (c["temperature_c"] - 25) / 10 * np.log(c["range_m"] / 5) * c["intensity"],
        {"range_m", "temperature_c", "intensity"},
    ),
}


def two_walls(rng, c):
    """Azimuths of stops that each look at two walls, 23 degrees of either."""
    stops = len(np.unique(c["temperature_c"]))
    ways = rng.uniform(-np.pi, np.pi, (stops, 1, 1)) + np.array([0.0, 1.9])
    there = ways + rng.uniform(-0.2, 0.2, (stops, len(c["ring"]) // stops // 2, 2))
    return {"azimuth_rad": (there.reshape(-1) + np.pi) % (2 * np.pi) - np.pi}


def test_a_form_is_found_where_too_few_stops_confirm_any_smooth_function():
    """Of 56 directions, by 12 stops; a form with a product as its own has two."""
    beams = table(
        3,
        stops=12,
        each=300,
        hidden=lambda c: 8e-3 * np.sin(3 * c["azimuth_rad"]) * c["elevation_rad"] / 0.27,
        more=two_walls,
    )
    (step,) = pursue(beams, ALPHA, lambda *what: None)
    assert set(step.form.term.covariates) == {"azimuth_rad", "elevation_rad"}
    assert "sin(3 * azimuth_rad)" in step.form.term.texts[0]


@pytest.mark.parametrize("seed", range(4))
def test_chance_is_no_form_where_stops_are_few(seed):
    """Each stop has a range zero of its own, which bins of azimuth may take on."""
    beams = table(seed, stops=12, each=300, scatter_m=0.002, more=two_walls)
    assert not pursue(beams, ALPHA, lambda *what: None)


@pytest.fixture(scope="module")
def found():
    """What is planted, as it is found: made when asked."""
    made = {}

    def of(name):
        if name not in made:
            hidden, _ = PLANTED[name]
            beams = table(11, hidden=hidden, more=labels)
            steps = pursue(beams, ALPHA, lambda *_: None)
            made[name] = beams, steps, settled(beams, steps) if steps else []
        return made[name]

    return of


@pytest.mark.parametrize("name", PLANTED)
@pytest.mark.long
def test_a_planted_form_is_found_over_its_covariates_alone(found, name):
    _, covariates = PLANTED[name]
    _, steps, formulas = found(name)
    assert [set(f.covariates) for f in formulas] == [covariates]
    assert all(s.p_value <= s.p_adjusted < ALPHA for s in steps)


@pytest.mark.parametrize("name", PLANTED)
@pytest.mark.long
def test_it_is_worth_what_was_planted(found, name):
    """But for what the model absorbs, ranges are changed by as much; here a tenth may be off."""
    hidden, _ = PLANTED[name]
    beams, _, formulas = found(name)
    model = beams.projection()
    planted = model.off(hidden(beams.covariates)[:, None])[0]
    value = model.off(sum(f.value_m(beams.covariates) for f in formulas)[:, None])[0]
    assert np.std(value - planted) < 0.15 * np.std(planted)


CONSTANTS = {
    "a window across the gap": (-2.5, 2.8),
    "a window": (0.3, 1.1),
    "a decay": (1.5,),
    "a wave": (2.3,),
    "a step": (0.8,),
}


@pytest.mark.parametrize("name", CONSTANTS)
def test_constants_are_right_within_their_sigmas(found, name):
    _, _, (formula,) = found(name)
    (part,) = formula.parts
    assert len(part.term.constants) == len(part.constants_sigma) == len(CONSTANTS[name])
    for got, sigma, true in zip(
        part.term.constants, part.constants_sigma, CONSTANTS[name], strict=True
    ):
        assert 0 < sigma < 0.2 * max(abs(true), 1.0)
        assert abs(got - true) < 4 * sigma


def kinds(formula):
    return [(f.covariate, f.kind) for part in formula.parts for f in part.term.factors]


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("a line times a line", {("intensity", "line"), ("temperature_c", "line")}),
        ("a window across the gap", {("azimuth_rad", "outside")}),
        ("a window", {("azimuth_rad", "window")}),
        ("a decay", {("range_m", "decay")}),
        ("a wave", {("range_m", "wave")}),
        ("a class times a line", {("label", "class"), ("incidence_rad", "line")}),
        # Where the line is zero is what the rings' own zeros take on.
        ("parity of rings times a line", {("ring", "every other"), ("range_m", "proportional")}),
        ("a step", {("incidence_rad", "step")}),
        (
            "three together",
            {("azimuth_rad", "harmonic"), ("temperature_c", "line"), ("intensity", "line")},
        ),
        (
            "through zero",
            {("range_m", "logarithm"), ("temperature_c", "line"), ("intensity", "proportional")},
        ),
    ],
)
@pytest.mark.long
def test_the_form_is_that_which_was_planted(found, name, expected):
    _, _, (formula,) = found(name)
    assert set(kinds(formula)) == expected


def test_a_sum_of_two_comes_apart():
    """Each over covariates of its own."""
    one, _ = PLANTED["a line times a line"]
    two, _ = PLANTED["a window"]
    beams = table(12, hidden=lambda c: one(c) + two(c))
    formulas = settled(beams, pursue(beams, ALPHA, lambda *_: None))
    assert {frozenset(f.covariates) for f in formulas} == {
        frozenset({"temperature_c", "intensity"}),
        frozenset({"azimuth_rad"}),
    }
    planted = one(beams.covariates) + two(beams.covariates)
    value = sum(f.value_m(beams.covariates) for f in formulas)
    model = beams.projection()
    left = model.off((value - planted)[:, None])[0]
    assert np.std(left) < 0.15 * np.std(planted)


def test_no_more_terms_than_asked_for():
    one, _ = PLANTED["a step"]
    two, _ = PLANTED["a window"]
    beams = table(13, hidden=lambda c: one(c) + two(c))
    assert len(pursue(beams, ALPHA, lambda *_: None, most=1)) == 1


# Refining -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("share", [0.005, 0.006, 0.3, 3.0])
def test_slopes_are_derivatives_also_where_a_scale_is_at_its_end(share):
    """Of a decay: one over the square of its scale; where it is nearly a step, at least finite."""
    beams = table(17, stops=5)
    x = beams.covariates["range_m"]
    low, scale = x.min(), share * np.ptp(x)
    term = FormulaTerm((Factor("range_m", "decay", (scale, low)),))
    (slope,) = slopes(beams.covariates, term, [0], np.array([2.0])).T
    true = 2.0 * np.exp(-(x - low) / scale) * (x - low) / scale**2
    assert np.isfinite(slope).all()
    if 0.01 < share < 3.0:
        assert slope == pytest.approx(true, abs=0.01 * true.max())
    else:
        assert slope @ true > 0.0


@pytest.mark.parametrize(
    ("kind", "start", "true"),
    [
        ("window", (-0.6, 1.2), (0.3, 0.8)),
        ("outside", (-2.2, 2.5), (-2.5, 2.8)),
        ("step", (0.2,), (-0.7,)),
        ("bump", (0.2, 1.0), (0.5, 0.6)),
    ],
)
def test_refining_moves_constants_to_where_they_are(kind, start, true):
    planted = Factor("azimuth_rad", kind, true)
    beams = table(14, hidden=lambda c: 4e-3 * planted.columns(c)[:, 0])
    term = refine(beams.projection(), FormulaTerm((Factor("azimuth_rad", kind, start),)))
    assert term.constants == pytest.approx(true, abs=0.05)


def test_refining_never_explains_less():
    beams = table(15)
    model = beams.projection()
    for kind, start in (("wave", (3.0,)), ("decay", (2.0, 1.0)), ("window", (3.0, 6.0))):
        term = FormulaTerm((Factor("range_m", kind, start),))
        better = refine(model, term)
        before, after = (form(model, t, 1).statistic for t in (term, better))
        assert after >= before


@pytest.mark.parametrize("kind, start", [("decay", (0.05, 0.3)), ("step", (0.47,))])
def test_holes_in_a_column_are_no_values(kind, start):
    """Constants are found from the stops that have one, and their slopes are finite."""
    planted = Factor("humidity", kind, (0.12, 0.3) if kind == "decay" else (0.44,))
    beams = table(14, stops=30, hidden=lambda c: 6e-3 * planted.columns(c)[:, 0])
    holes = np.isin(beams.stop, [3, 11, 12])
    values = np.where(holes, np.nan, beams.covariates["humidity"])
    residual_m = np.where(holes, beams.residual_m - 6e-3 * planted.columns(beams.covariates)[:, 0],
                          beams.residual_m)  # fmt: skip
    beams = replace(
        beams, covariates={**beams.covariates, "humidity": values}, residual_m=residual_m
    )
    term = refine(beams.projection(), FormulaTerm((Factor("humidity", kind, start),)))
    assert term.constants == pytest.approx(planted.constants[: len(term.constants)], abs=0.03)


def test_a_term_without_constants_stays():
    term = FormulaTerm((Factor("incidence_rad", "over cosine"),))
    assert refine(table(15, stops=5).projection(), term) is term


# What takes the place of what ---------------------------------------------------------------------

LINE, WAVE = (
    FormulaTerm((Factor("range_m", "line", (6.0, 5.0)),)),
    FormulaTerm((Factor("range_m", "wave", (4.0,)),)),
)


MANY = 20  # covariates


def rivals(more: np.ndarray) -> list[Form]:
    """A wave, and a line that leaves so much more of each stop's chi-square."""
    left = np.full(len(more), 100.0)
    best = Form(WAVE, 300.0, 2, left)
    return [best, Form(LINE, 300.0 - more.sum(), 1, left + more)]


def test_the_simpler_form_is_taken_where_stops_do_not_tell():
    wave, line = rivals(np.random.default_rng(0).normal(0.3, 1.0, 30))
    assert simplest([wave, line], MANY) == (line, [wave])


def test_the_better_form_is_taken_where_stops_agree():
    wave, line = rivals(np.random.default_rng(0).normal(2.0, 1.0, 30))
    assert simplest([wave, line], MANY) == (wave, [])


def test_one_stop_alone_does_not_tell():
    more = np.zeros(30)
    more[4] = 60.0
    wave, line = rivals(more)
    assert simplest([wave, line], MANY) == (line, [wave])


def test_stops_that_share_nothing_do_not_count():
    more = np.concatenate([np.full(3, 2.0), np.zeros(40)])
    wave, line = rivals(more)
    wave, line = (replace(f, left=np.where(np.arange(43) < 3, f.left, 0.0)) for f in (wave, line))
    assert simplest([wave, line], MANY)[0] is wave


@pytest.mark.parametrize(("covariates", "taken"), [(1, True), (2, True), (MANY, False)])
def test_what_hangs_on_more_is_told_by_more(covariates, taken):
    """2.4 sigmas: enough for another function of the same, or for a second covariate that could
    have been no other, but the best of twenty is often as good by chance."""
    more = np.random.default_rng(0).normal(0.0, 1.0, 30)
    more = 2.0 + (more - more.mean()) * 2.0 * np.sqrt(30) / 2.4 / more.std(ddof=1)
    best, line = rivals(more)
    product = FormulaTerm((*LINE.factors, Factor("humidity", "line", (0.45, 0.1))))
    further = replace(best, term=product)
    assert (simplest([further, line], covariates)[0] is further) is taken
    assert simplest([best, line], MANY)[0] is best


def test_the_best_of_other_covariates_does_not_shelter_a_poor_form():
    """Stops tell the line from the wave of the same covariate, and neither from what hangs on two
    others: the wave is taken, though the line is simpler."""
    rng = np.random.default_rng(0)
    wave, line = rivals(rng.normal(1.0, 1.0, 30) * 3)
    others = FormulaTerm(
        (Factor("humidity", "line", (0.4, 0.1)), Factor("intensity", "line", (0.5, 0.5)))
    )
    best = Form(others, 400.0, 1, wave.left - rng.normal(3.0, 12.0, 30))
    chosen, alike = simplest([best, wave, line], MANY)
    assert line not in (chosen, *alike) and wave in (chosen, *alike)


def test_what_a_form_leaves_of_stops_is_what_it_does_not_explain():
    beams = table(16, stops=10, each=100, hidden=lambda c: 3e-3 * np.sin(c["range_m"]))
    model = beams.projection()
    found = form(model, FormulaTerm((Factor("range_m", "harmonic", (1.0,)),)), 1)
    alone = model.weight @ np.square(model.left_m)
    _, theta = model.fitted(found.term.columns(beams.covariates))
    assert theta[0] == pytest.approx(3e-3, abs=5e-4)
    assert len(found.left) == 10
    # Part of what is explained is in what trackers say, which no stop's beams hold.
    assert alone - found.left.sum() == pytest.approx(found.statistic, rel=0.1)


def test_the_same_function_of_a_covariate_that_goes_along_says_nothing_else():
    ring = FormulaTerm((Factor("ring", "line", (15.5, 15.5)),))
    height = FormulaTerm((Factor("elevation_rad", "line", (0.0, 0.3)),))
    square = FormulaTerm((Factor("ring", "square", (15.5, 15.5)),))
    chosen = Form(ring, 9.0, 1, np.ones(3))
    others = [Form(term, 8.0, 1, np.ones(3)) for term in (height, square, WAVE)]
    step = ConfirmedTerm(form=chosen, alike=others, p_value=1e-6, p_adjusted=1e-6)
    none = np.zeros(0)
    part = FittedTerm(
        term=ring, at=(0,), amount=none, covariance=np.zeros((0, 0)), constants_sigma=none
    )
    found = Formula(parts=[part], steps=[step], rms_m=0.0, seen={}, picture={})
    # The square only adds a column.
    assert [f.term for f in found.alike] == [WAVE]


OTHERS = [name for name in PLANTED if name not in CONSTANTS]


@pytest.mark.parametrize(
    "name", [*CONSTANTS, *(pytest.param(each, marks=pytest.mark.long) for each in OTHERS)]
)
def test_texts_of_a_term_are_formulas_that_a_file_can_have(found, name):
    for formula in found(name)[2]:
        assert all(re.fullmatch(r"[\w\s.*/+\-()<>=,]+", text) for text in formula.texts)
