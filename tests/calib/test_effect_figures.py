"""Pictures of effects: their closed forms, in the units of the axes."""

import numpy as np
import pytest

from calib.effects import CATALOGUE, find
from calib.report.effects import effect_figure
from calib.rig import load_rig

from .viewed import small_run


@pytest.fixture(scope="module")
def rig(once):
    return load_rig(once(small_run) / "rec")


def curves(name, rig):
    (ax,) = effect_figure(find(name), rig).axes
    return ax, [line.get_xydata().T for line in ax.lines]


def test_curves_are_the_formulas_of_the_pages(rig):
    ax, ((deg, mm),) = curves("incidence_angle_bias", rig)
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("incidence, deg", "error, mm")
    (k,) = find("incidence_angle_bias").params(rig)
    np.testing.assert_allclose(mm, 1e3 * k.sigma * (1 / np.cos(np.radians(deg)) - 1), atol=1e-9)

    _, ((range_m, mm),) = curves("range_scale", rig)
    (scale,) = find("range_scale").params(rig)
    np.testing.assert_allclose(mm, 1e3 * scale.sigma * range_m)


def test_a_joint_s_error_is_drawn_over_its_angle_in_mrad(rig):
    ax, lines = curves("arm_joint_scale", rig)
    assert (ax.get_xlabel(), ax.get_ylabel()) == (
        f"angle of {rig.joint_names[1]}, deg",
        "error, mrad",
    )
    ((deg, mrad),) = lines  # the others stand still
    param = find("arm_joint_scale").params(rig)[1]
    np.testing.assert_allclose(mrad, 1e3 * param.sigma * np.radians(deg), atol=1e-9)


def test_the_command_draws_an_effect_or_says_why_not(rigcal, tmp_path):
    code, out, _ = rigcal("effects", "range_scale", "-o", tmp_path / "a.svg")
    assert (
        code == 0 and out.startswith("range_scale") and b"<svg" in (tmp_path / "a.svg").read_bytes()
    )
    for words, why in (
        (("label_range_offset", "-o", tmp_path / "b.svg"), "has no picture"),
        (("range_scale", "-o", tmp_path / "b.jpg"), ".png, .svg, .pdf"),
        (("-o", tmp_path / "b.svg"), "draws one effect"),
    ):
        code, out, err = rigcal("effects", *words)
        assert (code, out) == (2, "") and why in err
    assert [path.name for path in tmp_path.iterdir()] == ["a.svg"]


def test_what_depends_on_no_single_number_has_no_picture(rig):
    none = {effect.name for effect in CATALOGUE if effect_figure(effect, rig) is None}
    assert {"range_offset", "label_range_offset", "mount_slip", "stop_range_scatter"} <= none
    assert len(CATALOGUE) - len(none) > 20
