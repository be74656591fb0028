"""Tables of where rings point that change between two stops."""

import numpy as np
import pytest

from calib.effects import ShapeStep, View, find
from calib.runs.calibrate import calibrate
from calib.runs.diagnose import diagnose

from .simulated import made


@pytest.mark.parametrize("name", ["ring_elevation", "ring_azimuth"])
def test_another_table_of_rings_is_an_offset_of_each_from_then_on(tmp_path, name):
    """And what going to another time would change is what the two differ by."""
    source, _ = made(tmp_path / "rec", "tiny", 1)
    rings, rng = source.rig.lidar.rings, np.random.default_rng(3)
    ring, elapsed_s = rng.integers(0, rings, 400), rng.uniform(0.0, 1000.0, 400)
    view = View(source.rig, 400, {"ring": ring, "elapsed_s": elapsed_s}, np.zeros((1, 0)))
    theta = rng.normal(size=rings)

    def turned(effect):
        found = effect.basis(view)
        return found.values * theta[found.index][:, None]

    always, slips = (turned(find(n)) for n in (f"{name}_offset", f"{name}_slip@400"))
    np.testing.assert_allclose(slips, always * (elapsed_s > 400)[:, None], atol=1e-15)
    step = ShapeStep(find(f"{name}_slip@400"), {source.rig.name: theta}, to=700.0)
    between = (elapsed_s > 400) & (elapsed_s <= 700)
    np.testing.assert_allclose(step.basis(view)[..., 0], -always * between[:, None], atol=1e-15)
    assert np.abs(always[between]).max() > 1.0


@pytest.mark.long
def test_a_table_of_rings_that_changes_is_named_with_its_time(tmp_path):
    """Within the first third of the stops, far from the only time that is asked for at first."""
    source, _ = made(tmp_path / "rec", "tiny", 5, **{"ring_azimuth_slip@260": 2.0})
    found = diagnose(calibrate([tmp_path / "rec"], tmp_path / "run"))
    (name,) = found.worth_adding
    family, _, time_s = name.partition("@")
    assert family == "ring_azimuth_slip"
    elapsed_s = np.sort(source.columns["elapsed_s"])
    assert np.searchsorted(elapsed_s, float(time_s)) == np.searchsorted(elapsed_s, 260.0)
