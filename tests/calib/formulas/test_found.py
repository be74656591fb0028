"""What was found, as people and files read it: says what it is, with sigmas that cover."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest

from calib.diagnosis.formulas.factors import Factor
from calib.diagnosis.formulas.found import FittedTerm, Formula, settled, with_sigma
from calib.diagnosis.formulas.picture import picture_of
from calib.diagnosis.formulas.pursuit import ConfirmedTerm, form
from calib.diagnosis.formulas.terms import FormulaTerm
from calib.effects import View
from calib.effects.own.expression import Expression
from calib.effects.own.formula import FormulaEffect
from sensors.documents import json_text

from .made import table

EXACT = 1e-7  # of an amount: sigma by which many digits are written


@pytest.mark.parametrize(
    ("value", "sigma", "text"),
    [
        (15.04, 0.4, "15.0(4)"),
        (15.04, 0.95, "15.0(10)"),
        (15.04, 0.94, "15.0(9)"),
        (15.04, 0.194, "15.04(19)"),
        (15.04, 0.196, "15.0(2)"),
        (15.04, 0.0996, "15.04(10)"),
        (15.04, 1.5, "15.0(15)"),
        (15.04, 9.96, "15(10)"),
        (1234.5, 12.0, "1234(12)"),
        (1234.5, 37.0, "1230(40)"),
        (1234.5, 960.0, "1200(1000)"),
        (-0.0321, 0.002, "-0.032(2)"),
        (15.04, np.nan, "15.04"),
        (15.04, np.inf, "15.04"),
        (15.04, 0.0, "15.04"),
    ],
)
def test_a_number_has_the_digits_that_its_sigma_supports(value, sigma, text):
    assert with_sigma(value, sigma) == text


def test_what_is_written_is_the_number_within_a_fraction_of_its_sigma():
    """To half a unit of the last digit, of which the sigma is 2 to 19."""
    rng = np.random.default_rng(0)
    for value, sigma in zip(rng.normal(0, 100, 400), 10 ** rng.uniform(-6, 3, 400), strict=True):
        number, digits = re.fullmatch(r"(-?[\d.]+)\((\d+)\)", with_sigma(value, sigma)).groups()
        unit = 10.0 ** -len(number.partition(".")[2])
        assert abs(float(number) - value) < 0.51 * max(unit, sigma / 2)
        assert int(digits) * unit == pytest.approx(sigma, rel=0.26)


# The sentence -------------------------------------------------------------------------------------


def formula(*parts: FittedTerm) -> Formula:
    return Formula(parts=parts, steps=[], rms_m=1e-3, seen={}, picture={})


def part(factors, at, amounts, relative=EXACT) -> FittedTerm:
    term = FormulaTerm(tuple(factors))
    amount = 1e-3 * np.array(amounts)
    constants = np.abs(np.array(term.constants)) * relative
    return FittedTerm(
        term=term,
        at=tuple(at),
        amount=amount,
        covariance=np.diag(np.square(amount * relative)),
        constants_sigma=constants,
    )


def value_of(says: str, covariates: dict) -> np.ndarray:
    """Read a sentence as a reader would, sigmas left out."""
    text = re.sub(r"(\d)\(\d+\)", r"\1", says.removeprefix("range = true "))
    text = text.replace(" mm * ", " * 0.001 * ")
    return Expression(text.removeprefix("+ "), "a test").value(covariates.__getitem__)


X = {
    "temperature_c": np.linspace(15, 35, 41),
    "ring": np.arange(41) % 32.0,
    "azimuth_rad": np.linspace(-3, 3, 41),
    "label": np.arange(41) % 3.0,
}
WARM = Factor("temperature_c", "line", (25.0, 10.0))
RING = Factor("ring", "line", (16.0, 16.0))
TURN = Factor("azimuth_rad", "harmonic", (3.0,))
WAVE = Factor("ring", "wave", (7.5,))
CLASS = Factor("label", "class", (2.0,))
SAID = {
    "one column": part([WARM], [0], [4.0]),
    "a negative amount": part([WARM], [0], [-4.0]),
    "a line and its zero": part([WARM], [0, 1], [4.0, 1.3]),
    "a zero below nought": part([Factor("azimuth_rad", "line", (0.0, 3.0))], [0, 1], [4.0, 5.0]),
    "lines, one with its zero": part([WARM, RING], [0, 1], [4.0, -1.3]),
    "lines, the other with its zero": part([WARM, RING], [0, 2], [-4.0, -1.3]),
    "lines, neither": part([WARM, RING], [0, 3], [4.0, -1.3]),
    "lines, in full": part([WARM, RING], [0, 1, 2, 3], [4.0, -1.3, 0.7, 0.2]),
    "a sine and a cosine": part([TURN], [0, 1], [3.0, -2.0]),
    "a wave, turned by more than a right angle": part([WAVE], [0, 1], [-3.0, 2.0]),
    "a wave times a class": part([WAVE, CLASS], [0, 1], [-3.0, -2.0]),
    "a class times a wave": part([CLASS, TURN], [0, 1], [3.0, 2.0]),
    "two waves": part([WAVE, TURN], [0, 3], [3.0, 2.0]),
    "a line times a class": part([WARM, CLASS], [0, 1], [3.0, 2.0]),
    "a window": part([Factor("azimuth_rad", "window", (-1.0, 0.5))], [0], [-25.0]),
    "outside": part([Factor("azimuth_rad", "outside", (-1.0, 0.5))], [0], [2.0]),
    "a square": part([Factor("ring", "square", (16.0, 16.0))], [0, 1], [2.0, 1.0]),
    "a cosine and one": part([Factor("azimuth_rad", "cosine")], [0, 1], [2.0, 1.0]),
    "a bump": part([Factor("azimuth_rad", "bump", (-1.0, 0.5))], [0], [-2.0]),
}


@pytest.mark.parametrize("name", SAID)
def test_the_sentence_is_the_function(name):
    found = formula(SAID[name])
    assert value_of(found.says, X) == pytest.approx(found.value_m(X), abs=1e-7)


def test_the_sentence_of_two_terms_is_their_sum():
    found = formula(SAID["a line and its zero"], SAID["a window"])
    assert value_of(found.says, X) == pytest.approx(found.value_m(X), abs=1e-7)


def test_sentences_read_like_physics():
    """An amount, a line with its zero, a phase, each with the digits that its sigma supports."""
    warm = formula(part([WARM, RING], [0, 2], [15.0, -4.0], 0.02)).says
    # The zero: 25 + 10 * 4 / 15; its sigma: 10 * 4 / 15 * hypot(0.02, 0.02).
    assert warm == "range = true + 15.0(3) mm * (temperature_c - 27.67(8)) / 10 * (ring - 16) / 16"
    turned = formula(part([TURN], [0, 1], [3.0, 4.0], 0.02)).says
    assert turned == "range = true + 5.00(7) mm * sin(3 * azimuth_rad + 0.927(14))"


def test_constants_that_were_found_have_their_sigmas():
    wave = replace(part([WAVE], [0, 1], [3.0, 4.0], 0.02), constants_sigma=np.array([0.03]))
    assert formula(wave).says == (
        "range = true + 5.00(7) mm * sin(2 * pi * ring / 7.50(3) + 0.927(14))"
    )
    bump = Factor("azimuth_rad", "bump", (-1.0, 0.5))
    two = part([bump, WARM], [0], [2.0], 0.02)
    two = replace(two, constants_sigma=np.array([0.02, 0.004]))
    assert formula(two).says == (
        "range = true + 2.00(4) mm * exp(-((azimuth_rad + 1.00(2)) / 0.500(4))**2)"
        " * (temperature_c - 25) / 10"
    )


# The effect ---------------------------------------------------------------------------------------


def test_the_effect_starts_at_the_amounts_and_is_the_formula():
    found = formula(SAID["lines, one with its zero"], SAID["a window"])
    document = found.effect((), "a page")
    again = FormulaEffect.read(json.loads(json_text(document)), "a.yaml", {})
    basis = again.basis(View(None, 41, X, np.zeros((1, 0))))[:, 0]
    assert basis @ np.array(document["start"]) == pytest.approx(found.value_m(X), abs=1e-6)
    assert [p.start for p in start_of(again)] == pytest.approx(found.amount.tolist(), rel=1e-3)
    assert document["sigma"] >= 2.5 * np.abs(found.amount).max()


def start_of(effect: FormulaEffect):
    class Rig:
        lidar, tracker, target = True, None, None

    return effect.params(Rig())


def test_its_name_is_of_its_covariates_and_not_taken():
    found = formula(SAID["a class times a wave"])
    assert found.name() == "empirical_label_azimuth"
    taken = ["empirical_label_azimuth", "empirical_label_azimuth_2"]
    assert found.effect(taken, "")["name"] == "empirical_label_azimuth_3"


# Settled ------------------------------------------------------------------------------------------


def steps_of(beams, *terms: FormulaTerm) -> list[ConfirmedTerm]:
    model = beams.projection()
    forms = [form(model, term, 1) for term in terms]
    return [ConfirmedTerm(form=f, alike=[], p_value=1e-6, p_adjusted=1e-6) for f in forms]


def test_terms_over_the_same_covariates_are_one_formula():
    def hidden(c):
        return (
            4e-3 * np.sin(c["range_m"]) + 3e-3 * (c["range_m"] > 6) + 3e-3 * (c["intensity"] > 0.5)
        )

    beams = table(1, stops=10, each=100, hidden=hidden)
    one = FormulaTerm((Factor("range_m", "harmonic", (1.0,)),))
    two = FormulaTerm((Factor("range_m", "step", (6.0,)),))
    other = FormulaTerm((Factor("intensity", "step", (0.5,)),))
    formulas = settled(beams, steps_of(beams, one, two, other))
    assert [len(f.parts) for f in formulas] == [2, 1]
    values = beams.covariates["range_m"]
    assert formulas[0].seen == {"range_m": (values.min(), values.max())}


def test_columns_that_chance_explains_are_left_out():
    beams = table(2, stops=15, each=100, hidden=lambda c: 3e-3 * np.cos(2 * c["azimuth_rad"]))
    (found,) = settled(
        beams, steps_of(beams, FormulaTerm((Factor("azimuth_rad", "harmonic", (2.0,)),)))
    )
    assert found.texts == ("cos(2 * azimuth_rad)",)
    assert abs(found.amount[0] - 3e-3) < 4 * found.parts[0].sigma[0] < 1.5e-3


def test_what_the_model_takes_on_is_left_out():
    """Of a line over range the constant is the range zero that is estimated anyway."""
    beams = table(3, stops=15, each=100, hidden=lambda c: 3e-3 * (c["range_m"] - 4) / 5)
    (found,) = settled(
        beams, steps_of(beams, FormulaTerm((Factor("range_m", "line", (6.0, 5.0)),)))
    )
    assert found.texts == ("(range_m - 6) / 5",)
    assert found.rms_m == pytest.approx(3e-3 * np.std(beams.covariates["range_m"]) / 5, rel=0.1)


@pytest.mark.parametrize("correlation", [-0.9, 0.0, 0.9])
def test_amplitude_and_phase_are_as_well_known_as_sine_and_cosine_together(correlation):
    """By drawing these: to half of the last digit that is written, and 5 %."""
    amount, sigma = np.array([8e-3, 3e-3]), np.array([4e-4, 2e-4])
    covariance = np.outer(sigma, sigma) * np.array([[1.0, correlation], [correlation, 1.0]])
    wave = FormulaTerm((Factor("azimuth_rad", "harmonic", (2.0,)),))
    none = np.zeros(0)
    told = formula(FittedTerm(wave, (0, 1), amount, covariance, constants_sigma=none)).says
    drawn = np.random.default_rng(0).multivariate_normal(amount, covariance, 4000)
    wanted = 1e3 * np.std(np.hypot(*drawn.T)), np.std(np.arctan2(*drawn.T[::-1]))
    written = re.findall(r"\.(\d+)\((\d+)\)", told)
    assert len(written) == 2
    for (digits, last), true in zip(written, wanted, strict=True):
        unit = 10.0 ** -len(digits)
        assert int(last) * unit == pytest.approx(true, abs=0.5 * unit + 0.05 * true), told


@pytest.mark.long
def test_sigmas_cover():
    """Errors in their sigmas, of 40 worlds; in every other stops scatter. Of the wave both the sine
    and the cosine are there."""

    def hidden(c):
        return 4e-3 * np.sin(2 * np.pi * c["incidence_rad"] / 0.8 + 0.8) * c["intensity"]

    line = Factor("intensity", "power", (1.0, 1.0))
    start = FormulaTerm((Factor("incidence_rad", "wave", (0.85,)), line))
    turned = np.array([np.cos(0.8), np.sin(0.8)])
    z = []
    for seed in range(40):
        beams = table(200 + seed, stops=14, each=60, scatter_m=5e-4 * (seed % 2), hidden=hidden)
        (found,) = settled(beams, steps_of(beams, start))
        (part,) = found.parts
        assert part.at == (0, 1)
        off = [*(part.amount - 4e-3 * turned), part.term.constants[0] - 0.8]
        z.append(off / np.concatenate([part.sigma, part.constants_sigma]))
    # A standard deviation of 40 is known to 11 %, a mean to 0.16.
    assert np.std(z, axis=0) == pytest.approx(np.ones(3), abs=0.35)
    assert np.mean(z, axis=0) == pytest.approx(np.zeros(3), abs=0.5)


@pytest.mark.long
def test_an_edge_is_told_no_closer_than_the_values_beside_it():
    """Errors of a window's edges in their sigmas, of 30 worlds; a ring's edge lies midway."""
    edges, z = np.array([-1.0, 0.5]), []
    start = FormulaTerm(
        (Factor("azimuth_rad", "window", (-1.2, 0.6)), Factor("ring", "step", (14.2,)))
    )

    def hidden(c):
        inside = (c["azimuth_rad"] > edges[0]) & (c["azimuth_rad"] < edges[1])
        return 0.03 * inside * (c["ring"] > 15)

    for seed in range(30):
        beams = table(300 + seed, stops=12, each=80, hidden=hidden)
        (found,) = settled(beams, steps_of(beams, start))
        (part,) = found.parts
        z.append((np.array(part.term.constants[:2]) - edges) / part.constants_sigma[:2])
        assert part.term.constants[2] == 15.5
        assert part.constants_sigma[2] == pytest.approx(1 / 12**0.5, rel=0.05)
        assert "(ring > 15.5(3))" in found.says
    # Uniform errors are within 1.73 sigma; a few gaps are of beams that noise puts on a wrong side.
    assert np.mean(np.abs(z) < 2) > 0.9
    assert np.sqrt(np.mean(np.square(z))) < 1.3


# The picture --------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def pictured():
    term = FormulaTerm(
        (Factor("azimuth_rad", "window", (0.0, 1.5)), Factor("ring", "step", (15.5,)))
    )
    beams = table(6, stops=20, each=400, hidden=lambda c: 6e-3 * term.columns(c)[:, 0])
    fit, theta = beams.projection(term.columns(beams.covariates)).fitted(
        term.columns(beams.covariates)
    )
    value = term.columns(beams.covariates) @ theta
    return beams, value, picture_of(beams, ["azimuth_rad", "ring"], value, fit)


def test_a_picture_shows_what_was_planted_and_that_little_is_left(pictured):
    _, _, picture = pictured
    measured, drawn, left = (np.array(picture[k], float) for k in ("measured", "formula", "left"))
    edges = [np.array(e) for e in picture["edges"]]
    assert measured.shape == tuple(len(e) - 1 for e in edges)
    middle = [(e[1:] + e[:-1]) / 2 for e in edges]
    inside = (middle[0][:, None] > 0.2) & (middle[0][:, None] < 1.3) & (middle[1] > 16)
    assert np.nanmean(drawn[inside]) == pytest.approx(6.0, abs=0.4)
    assert np.nanmean(measured[inside]) == pytest.approx(6.0, abs=0.6)
    assert np.nanmax(np.abs(measured - drawn - left)) < 1e-9
    assert np.sqrt(np.nanmean(left**2)) < 1.0  # about 20 beams of 2 mm in each


def test_bins_without_beams_are_null(pictured):
    beams, value, _ = pictured
    far = beams.covariates["azimuth_rad"].copy()
    far[:2] = 40.0, 41.0
    moved = replace(beams, covariates={**beams.covariates, "far": far})
    picture = picture_of(moved, ["far"], value, moved.projection())
    shown = json.loads(json_text(picture))["measured"]
    assert len(shown) == 48 and None in shown and shown[0] is not None
