"""Pictures of effects: their closed forms, in the units of the axes."""

import numpy as np
import pytest

from calib.effects import CATALOGUE, find, load_effects
from calib.effects.rig import mount_edges
from calib.report.effects import effect_figure
from calib.report.effects.views import REST, TRACKED, walk_of
from calib.rig import load_rig

from . import rigs
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


def test_what_moves_a_frame_is_drawn_as_how_far_the_lidar_moves_and_turns(rig):
    """Over time, against the frame tree with that twist in it."""
    effect = find("mount_slip")
    moves, turns = effect_figure(effect, rig).axes
    assert (moves.get_ylabel(), turns.get_ylabel()) == ("lidar moves, mm", "turns, mrad")
    assert turns.get_xlabel() == "time since the first stop, min"
    sigma = effect.params(rig)[0].sigma
    tree = rig.tree
    joints = np.full((1, len(rig.joint_names)), REST)
    twists = np.zeros((1, len(tree.edges), 6))
    twists[0, mount_edges(rig)[0], 0] = sigma
    at, bent = (tree.transform("lidar", joints, x)[0] for x in (None, twists))
    label, line = next((x.get_label(), x) for x in moves.lines if "rx" in x.get_label())
    assert label.endswith(f"= {sigma:g} rad")
    mm = line.get_ydata()
    assert mm[0] == 0.0
    assert mm[-1] == pytest.approx(1e3 * np.linalg.norm(bent[:3, 3] - at[:3, 3]), rel=1e-3)
    assert turns.lines[0].get_ydata()[-1] == pytest.approx(1e3 * sigma)


def test_what_bends_the_tracked_volume_is_drawn_over_the_place_of_a_body(rig):
    ax, ((x_m, mm),) = curves("optitrack_scale", rig)
    (scale,) = find("optitrack_scale").params(rig)
    away_m = np.sqrt(np.square(x_m) + np.square(TRACKED[2]).sum())
    np.testing.assert_allclose(mm, 1e3 * scale.sigma * away_m)
    assert ax.get_ylabel() == "body moves, mm"


def test_two_covariates_are_a_map(rig):
    """A beam that starts beside its axis seems turned by the angle that its shift subtends."""
    effect = find("beam_origin_offset")
    figure = effect_figure(effect, rig)
    ax = next(x for x in figure.axes if x.get_title(loc="left").startswith("azimuth: tangential"))
    mesh = ax.collections[0]
    edges = mesh.get_coordinates()
    x, y = ((e[1:] + e[:-1]) / 2 for e in (edges[0, :, 0], edges[:, 0, 1]))
    mrad = mesh.get_array().reshape(len(y), len(x))
    sigma = next(p.sigma for p in effect.params(rig) if p.name == "tangential")
    across_m = x[None, :] * np.cos(np.radians(y))[:, None] + rig.lidar.beam_origin_m[0]
    far = x > 2
    np.testing.assert_allclose(np.abs(mrad)[:, far], 1e3 * sigma / across_m[:, far], rtol=1e-3)
    assert (ax.get_xlabel(), figure.axes[0].get_ylabel()) == ("range, m", "elevation, deg")


def test_of_many_alike_a_draw_of_their_priors_is_drawn(rig):
    ax, ((ring, mm),) = curves("ring_range_offset", rig)
    assert len(ring) == rig.lidar.rings and ax.get_xlabel() == "ring"
    sigma = find("ring_range_offset").params(rig)[0].sigma
    assert np.std(mm) == pytest.approx(1e3 * sigma, rel=0.25) and len(set(mm)) == len(mm)
    ax, ((_, mm),) = curves("stop_range_scatter", rig)
    assert ax.get_xlabel() == "stop" and np.std(mm) == pytest.approx(0.3, rel=0.5)
    ax, _ = curves("label_range_offset", rig)
    assert [t.get_text() for t in ax.get_xticklabels()] == list(rig.labels.values())


def test_what_depends_on_nothing_is_drawn_along_the_axes(rig):
    (ax,) = effect_figure(find("target_sphere_offset"), rig).axes
    (lower,) = find("target_sphere_offset").params(rig)
    assert [bar.get_height() for bar in ax.patches] == pytest.approx([0, 0, -1e3 * lower.sigma])


def test_the_command_draws_an_effect_or_says_why_not(rigcal, tmp_path):
    for name in ("range_scale", "tracker_creep"):
        code, out, _ = rigcal("effects", name, "-o", tmp_path / f"{name}.svg")
        assert code == 0 and out.startswith(name)
        assert b"<svg" in (tmp_path / f"{name}.svg").read_bytes()
    for words, why in (
        (("range_quantisation", "-o", tmp_path / "b.svg"), "has no picture"),
        (("range_scale", "-o", tmp_path / "b.jpg"), ".png, .svg, .pdf"),
        (("-o", tmp_path / "b.svg"), "draws one effect"),
    ):
        code, out, err = rigcal("effects", *words)
        assert (code, out) == (2, "") and why in err
    assert len(list(tmp_path.iterdir())) == 2


def test_every_effect_that_the_rig_can_have_has_a_picture(rig):
    none = {effect.name for effect in CATALOGUE if effect_figure(effect, rig) is None}
    assert none == {effect.name for effect in CATALOGUE if not effect.params(rig)}
    of_others = {"arm_mimic_ratio", "arm_rail_bending", "arm_screw_error", "range_quantisation"}
    assert none == of_others | {effect.name for effect in CATALOGUE if effect.needs_standing}


def test_every_picture_has_room_for_what_it_draws(rig):
    for effect in CATALOGUE:
        figure = effect_figure(effect, rig)
        if figure is not None:
            figure.canvas.draw()
            width = figure.get_size_inches()[0] * figure.dpi
            panels = [ax for ax in figure.axes if ax.get_label() != "<colorbar>"]
            assert panels[0].bbox.width > 0.25 * width, effect.name


def test_an_effect_over_columns_of_a_recording_has_none(rig, tmp_path):
    file = tmp_path / "damp.yaml"
    file.write_text("{name: damp, site: range, unit: m, sigma: 0.01, basis: [humidity * range]}")
    (own,) = load_effects((str(file),))
    assert "humidity" in own.covariates and effect_figure(own, rig) is None


@pytest.mark.parametrize("name", ["arm_screw_error@0.02", "arm_rail_bending"])
def test_what_is_about_linear_joints_is_drawn_along_one(tmp_path, name):
    rig = load_rig(rigs.write(tmp_path / "rec"))
    effect = find(name)
    walk = walk_of(effect, rig)
    assert walk.label == "position of slide, mm"
    assert np.ptp(walk.x) == pytest.approx(200.0 if "@" in name else 6000.0)
    basis = effect.basis(walk.view)
    assert np.ptp(basis, axis=0).any()
    assert walk.label in {ax.get_xlabel() for ax in effect_figure(effect, rig).axes}
