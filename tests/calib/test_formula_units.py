"""Units of a formula's parameters, and how large its values may be."""

import numpy as np
import pytest

from calib.effects import View
from calib.effects.own.formula import FormulaEffect
from chains.errors import InputError

DAMP = {"name": "damp", "site": "range", "unit": "m", "sigma": 0.01, "basis": ["range"]}


def made(**changes):
    return FormulaEffect.read(DAMP | changes, "mine.yaml", {})


@pytest.mark.parametrize(
    "unit", ["mm", "mm/K", "deg", "m * mrad", "°", "1/cm", "m \u00b5m", "\u03bcm"]
)
def test_units_that_numbers_do_not_have_are_refused(unit):
    """They would be printed beside numbers in m and rad."""
    with pytest.raises(InputError, match=r"take and give m and rad.*write (m|rad) in place of"):
        made(unit=unit)


@pytest.mark.parametrize("unit", ["1", "m", "m/K", "rad/(N m)", "rad/h", "1/m**2", "kg m", "m/°C"])
def test_units_of_si_are_taken(unit):
    assert made(unit=unit).unit == unit


def test_a_formula_whose_squares_overflow_is_refused():
    view = View(None, 2, {"range_m": np.array([1.0, 100.0])}, np.zeros((2, 0)))
    with pytest.raises(InputError, match=r"effect 'damp': the formula reaches 1e\+200 here"):
        made(basis=["range**100"]).basis(view)
