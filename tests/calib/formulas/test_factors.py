"""Functions of one covariate: their texts, as files have them, against closed forms in numpy."""

import numpy as np
import pytest
import yaml

from calib.diagnosis.formulas.factors import FACTOR_KINDS, Factor, columns_of, factors
from calib.diagnosis.formulas.terms import FormulaTerm
from calib.effects import View
from calib.effects.own.expression import Expression
from calib.effects.own.formula import FormulaEffect

X = np.array([0.31, 0.4, 0.8, 1.0, 1.25, 1.4])
PI = np.pi
# Kind -> constants, and the columns that they have; written apart from the texts.
FORMS = {
    "line": ((0.9, 0.5), lambda x, a, b: [(x - a) / b, 1]),
    "square": ((0.9, 0.5), lambda x, a, b: [np.square((x - a) / b), (x - a) / b, 1]),
    "proportional": ((0.7,), lambda x, a: [x / a]),
    "logarithm": ((0.7,), lambda x, a: [np.log(x) - np.log(a), 1]),
    "root": ((0.7,), lambda x, a: [(x / a) ** 0.5]),
    "power": ((0.7, 3.0), lambda x, a, p: [np.exp(p * np.log(x / a))]),
    "reciprocal": ((0.7,), lambda x, a: [a / x]),
    "saturation": ((0.7,), lambda x, a: [np.log((a + x) / a)]),
    "share": ((0.7,), lambda x, a: [1 - a / (a + x)]),
    "decay": ((0.2, 0.3), lambda x, a, x0: [1 / np.exp((x - x0) / a)]),
    "growth": ((0.2, 1.4), lambda x, a, x0: [np.exp((x - x0) / a)]),
    "wave": ((0.45,), lambda x, a: [np.exp(2j * PI * x / a).imag, np.exp(2j * PI * x / a).real]),
    "harmonic": ((3.0,), lambda x, m: [np.exp(1j * m * x).imag, np.exp(1j * m * x).real]),
    "step": ((0.9,), lambda x, a: [np.heaviside(x - a, 0)]),
    "window": ((0.5, 1.1), lambda x, a, b: [np.heaviside(x - a, 0) - np.heaviside(x - b, 1)]),
    "outside": ((0.5, 1.1), lambda x, a, b: [1 - np.heaviside(x - a, 0) + np.heaviside(x - b, 1)]),
    "ramp": ((0.9, 2.0), lambda x, a, b: [np.where(x > a, x - a, 0) / b]),
    "ramp down": ((0.9, 2.0), lambda x, a, b: [np.where(x < a, a - x, 0) / b]),
    "bump": ((0.9, 0.3), lambda x, a, b: [np.exp(-((x - a) ** 2) / b**2)]),
    "over cosine": ((), lambda x: [(1 - np.cos(x)) / np.cos(x)]),
    "tangent": ((), lambda x: [np.sin(x) / np.cos(x)]),
    "tangent squared": ((), lambda x: [1 / np.cos(x) ** 2 - 1]),
    "sine": ((), lambda x: [np.cos(x - PI / 2)]),
    "cosine": ((), lambda x: [np.sin(x + PI / 2), 1]),
}
WHOLE = np.arange(9.0)
FORMS_OF_RINGS = {
    "every other": ((), lambda x: [-np.cos(PI * x)]),
    "block": ((2.0,), lambda x, n: [np.where(np.isin(x, [2, 3, 6, 7]), 1, -1)]),
    "one of": ((4.0, 3.0), lambda x, n, k: [np.isin(x, [3, 7])]),
    "class": ((5.0,), lambda x, k: [np.isin(x, [5])]),
}


@pytest.mark.parametrize("name", ["range_m", "azimuth_rad", "ring", "temperature_c"])
def test_columns_are_what_the_texts_say(name):
    """Those that are fitted, from constants, and those that a file has, from text."""
    rng = np.random.default_rng(0)
    low = -3.0 if name == "azimuth_rad" else 0.0
    values = np.round(rng.uniform(low, 30.0, 500)) if name == "ring" else rng.uniform(low, 3, 500)
    values[::50] = np.nan
    each = factors(name, values, 500)
    assert len(each) > 40
    for one in each:
        same = columns_of(one.texts, {name: values})
        assert one.columns({name: values}) == pytest.approx(same, abs=1e-9), one


def stacked(columns: list, rows: int) -> np.ndarray:
    return np.stack([np.broadcast_to(c, rows) for c in columns], axis=1).astype(float)


def test_every_kind_is_here():
    assert {*FORMS, *FORMS_OF_RINGS} >= set(FACTOR_KINDS)


@pytest.mark.parametrize("kind", FACTOR_KINDS)
@pytest.mark.parametrize("as_file", [False, True])
def test_a_kind_is_its_closed_form(kind, as_file):
    at = X if kind in FORMS else WHOLE
    constants, columns = {**FORMS, **FORMS_OF_RINGS}[kind]
    factor = Factor("column", kind, constants)
    if as_file:
        document = {"name": "a", "site": "range", "unit": "m", "sigma": 1.0}
        text = yaml.safe_dump({**document, "basis": list(factor.texts)})
        effect = FormulaEffect.read(yaml.safe_load(text), "a.yaml", {})
        found = effect.basis(View(None, len(at), {"column": at}, np.zeros((1, 0))))[:, 0]
    else:
        found = factor.columns({"column": at})
    assert found == pytest.approx(stacked(columns(at, *constants), len(at)), abs=1e-12)


@pytest.mark.parametrize("kind", FACTOR_KINDS)
def test_free_constants_come_first_and_are_moved_alone(kind):
    constants, _ = {**FORMS, **FORMS_OF_RINGS}[kind]
    factor = Factor("column", kind, constants)
    other = tuple(c + 0.125 for c in constants[: factor.free])
    assert factor.at(other).constants == (*other, *constants[factor.free :])


def test_constants_are_written_to_six_digits():
    text, _ = Factor("time_s", "line", (1234.56789, 0.000123456789)).texts
    assert text == "(time_s - 1234.57) / 0.000123457"
    # Ten days of seconds are known to better than a minute, and a span of them as well.
    (text,) = Factor("time_s", "step", (864000.4,)).texts
    assert text == "time_s > 864000"


@pytest.mark.parametrize(
    ("constants", "text"),
    [((0.0, 2.0), "x / 2"), ((-0.0, 2.0), "x / 2"), ((-3.0, 2.0), "(x + 3) / 2")],
)
def test_what_changes_nothing_is_left_out(constants, text):
    assert Factor("x", "line", constants).texts[0] == text


def test_a_factor_of_one_is_left_out():
    assert Factor("azimuth_rad", "harmonic", (1.0,)).texts == (
        "sin(azimuth_rad)",
        "cos(azimuth_rad)",
    )
    assert Factor("azimuth_rad", "harmonic", (11.0,)).texts[0] == "sin(11 * azimuth_rad)"


def test_where_there_is_no_value_a_column_is_zero():
    holes = {"x": np.array([1.0, np.nan, -1.0]), "y": np.ones(3)}
    assert columns_of(("log(x)", "1", "y / (x + 1)"), holes) == pytest.approx(
        np.array([[0.0, 1.0, 0.5], [0.0, 1.0, 0.0], [0.0, 1.0, 0.0]])
    )


COVARIATES = {
    "range_m": np.linspace(1, 9, 500),
    "incidence_rad": np.linspace(0, 1.3, 500),
    "azimuth_rad": np.linspace(-3.1, 3.1, 500),
    "elevation_rad": np.linspace(-0.3, 0.3, 500),
    "ring": np.arange(500) % 32.0,
    "temperature_c": np.linspace(15, 35, 500),
    "joint_1": np.linspace(-2, 2, 500),
    "label": np.arange(500) % 5.0,
}


@pytest.mark.parametrize("name", COVARIATES)
def test_what_is_tried_has_no_unit_and_is_of_size_one(name):
    """In another unit a covariate has the same columns, and none is so large or so small that an
    amount would say nothing to a reader. Angles go into sines as they are."""
    values = COVARIATES[name]
    angles = ("over cosine", "tangent", "tangent squared", "sine", "cosine", "harmonic")
    named = ("class", "every other", "block", "one of")
    some = factors(name, values, len(values))
    other = factors(name, 1000 * values, len(values))
    assert [f.kind for f in other if f.kind not in named] == [
        f.kind for f in some if f.kind not in named
    ]
    for one, two in zip(some, other, strict=False):
        columns = one.columns({name: values})
        assert 0.0 < np.abs(columns).max() < 200, one
        if one.kind in (*angles, *named, "logarithm", "root", "power", "reciprocal"):
            continue
        moved = two.columns({name: 1000 * values})
        same = np.abs(moved - columns).max(axis=1) < 1e-4
        assert same.mean() > 0.99, one  # a text has six digits, so an edge may move past a value


def test_a_column_of_few_stops_has_no_windows():
    kinds = {f.kind for f in factors("humidity", COVARIATES["incidence_rad"], 12)}
    assert "step" in kinds and not kinds & {"window", "bump", "outside"}


def test_a_column_of_two_values_is_a_step_and_of_one_nothing():
    assert factors("wind", np.array([0.0, 1.0] * 9), 18) == [Factor("wind", "step", (0.5,))]
    assert factors("wind", np.ones(9), 9) == []


def test_a_rare_class_is_none():
    label = np.repeat([1.0, 2.0, 9.0], [990, 496, 4])
    assert [f.constants for f in factors("label", label, 3)] == [(1.0,), (2.0,)]


def test_columns_of_a_product_are_all_products():
    term = FormulaTerm((Factor("x", "line", (1.0, 2.0)), Factor("y", "cosine")))
    x, y = np.linspace(0, 1, 5), np.linspace(0, 3, 5)
    a = (x - 1) / 2
    expected = np.stack([a * np.cos(y), a, np.cos(y), np.ones(5)], axis=1)
    assert term.columns({"x": x, "y": y}) == pytest.approx(expected)
    assert term.texts == ("((x - 1) / 2) * (cos(y))", "(x - 1) / 2", "cos(y)", "1")


# What formulas may use beside what they had ------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("floor(x)", [-2, -1, 0, 0, 2]),
        ("mod(x, 2)", [0.5, 1.5, 0, 0.5, 0]),
        ("mod(x, 2) > 0.75", [0, 1, 0, 0, 0]),
        ("where(x > 0, floor(x / 2), -1)", [-1, -1, -1, 0, 1]),
        ("x == 2", [0, 0, 0, 0, 1]),
        ("x != 2", [1, 1, 1, 1, 0]),
    ],
)
def test_expressions_have_floor_mod_and_equality(text, expected):
    x = np.array([-1.5, -0.5, 0.0, 0.5, 2.0])
    assert Expression(text, "a test").value({"x": x}.get).tolist() == expected
