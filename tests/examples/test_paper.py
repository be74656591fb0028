"""The study's own methods and tables against closed forms, exact recordings and other libraries."""

import re
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from scipy.spatial.transform import Rotation

from calib.problem.model import Model, Source
from calib.simulation import PRESETS, Spec, simulate
from chains import se3
from chains.errors import InputError
from examples.paper import Scale, sequence, study, tables
from examples.paper.case import Case, well_seen
from examples.paper.conditions import DELAY_S, QUICK, TABLE_6
from examples.paper.figures import by_ring
from examples.paper.page import _table_6
from sensors.meshes import ransac_plane

from ..calib.simulated import changed, made, nominal
from ..programs import ROOT, script

EXACT = {"noise": 0, "build_error": 0, "occluded_share": 0}
CIRCLES = changed(PRESETS["one-joint"], **EXACT, stops_per_location=8)


# ---------------------------------------------------------------------------------------- circles


@pytest.mark.parametrize("share", [1.0, 0.4])
def test_a_circle_has_the_radius_it_was_drawn_with(share):
    rng = np.random.default_rng(1)
    angle = np.linspace(0, 2 * np.pi * share, 20)
    flat = 0.7 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    points = Rotation.random(rng=rng).apply(flat) + rng.uniform(-5, 5, 3)
    assert sequence.fit_circle(points) == pytest.approx(0.7, abs=1e-12)


def test_two_points_are_no_circle():
    with pytest.raises(InputError, match="2 points do not fix a circle"):
        sequence.fit_circle(np.eye(3)[:2])


def test_circles_tell_lengths_that_lie_across_an_axis(tmp_path):
    """Of an exact arm: those across come out exactly, that along its own axis stays as drawn."""
    spec = changed(CIRCLES, acting={"arm_link_length": 0.002})
    source, truth = made(tmp_path / "rec", spec)
    found = dict(zip(source.rig.arm_edges, sequence.lengths_from_circles(source), strict=True))
    true = dict(zip(source.rig.arm_edges, truth["effects"]["arm_link_length"], strict=True))
    for name in ("joint_3", "joint_5", "joint_tip"):
        assert found[name] == pytest.approx(true[name], abs=2e-6)
    assert true["joint_1"] == 0.002
    assert found["joint_1"] == pytest.approx(0, abs=1e-9)


def test_an_error_of_the_mount_goes_into_the_last_length(tmp_path):
    """CAD is taken at its word, so what it has wrong is taken for arm: the sequence's weakness."""
    made(tmp_path / "rec", CIRCLES)
    rig = tmp_path / "rec" / "rig.yaml"
    rig.write_text(rig.read_text().replace("[0.0, 0.0, 0.02]", "[0.0, 0.0, 0.017]"))
    wrong = Source.open(tmp_path / "rec")
    edge = wrong.rig.tree.edge_names.index("mount")
    assert wrong.rig.tree.edges[edge].T_parent_child[2, 3] == pytest.approx(0.017)
    lengths = sequence.lengths_from_circles(wrong)
    assert dict(zip(wrong.rig.arm_edges, lengths, strict=True))["joint_tip"] == pytest.approx(
        0.003, abs=1e-5
    )


def test_circles_need_one_joint_at_a_time(tmp_path):
    source, _ = made(tmp_path / "rec", changed(PRESETS["arm-tracker"], locations=1))
    with pytest.raises(InputError, match="at location L00 not one joint alone turns"):
        sequence.lengths_from_circles(source)


# ------------------------------------------------------------------------------------ two ways


@pytest.fixture(scope="module")
def exact(tmp_path_factory):
    """A case whose hardware is as on paper, without any noise."""
    folder = tmp_path_factory.mktemp("exact")
    small = {"lidar": "hesai_pandarxt32", "locations": 3, "stops_per_location": 2}
    still = Spec(**EXACT, **small, column_step=400, mesh_error_m=0, mixed_pixel_share=0)
    made(folder / "recording", still)
    circles, _ = made(folder / "circles", CIRCLES)
    moving = changed(PRESETS["moving"], **EXACT, locations=2, stops_per_location=3)
    late = {str(tables.__file__).replace("tables.py", "late.py"): DELAY_S}
    late, _ = made(folder / "moving", changed(moving, acting=late))
    return Case(sensor="XT", folder=folder / "recording", circles=circles, moving=late, work=folder)


@pytest.mark.parametrize("by_tracker", [True, False])
def test_both_ways_lead_to_where_an_exact_lidar_is(exact, by_tracker):
    state = exact.placed(by_tracker)
    for scan in state.problem.scans:
        true = np.array(exact.truth["stops"][scan.name]["T_faro_lidar"])
        np.testing.assert_allclose(scan.pose(state.values), true, atol=2e-6)
    assert tables.against_truth(exact, state)["pose_mm"] < 2e-3


def test_a_wrong_length_opens_a_gap_as_wide(exact):
    state = exact.on_paper()
    assert tables.gaps_mm(exact.source, Model(), state.values).max() < 1e-3
    (term,) = (t for t in state.problem.terms[0] if t.variable == "arm_link_length")
    names = [exact.source.rig.arm_edges[i] for i in term.free]
    longer = 0.004 * (np.array(names) == "joint_tip")
    values = {**state.values, "arm_link_length": longer}
    gaps = tables.gaps_mm(exact.source, Model(), values)
    np.testing.assert_allclose(gaps, 4.0, atol=1e-3)


def test_a_delay_opens_a_gap_only_in_motion(exact):
    """As far as the arm got in that time, by a chain of scipy's transforms."""
    recording = exact.moving.recording
    rates = np.stack([recording.covariates[f"rate.{j}"] for j in exact.moving.rig.joint_names], 1)
    at = [nominal(exact.moving, "mount_markers", q).translation for q in recording.joints]
    true = recording.joints + DELAY_S * rates
    went = [nominal(exact.moving, "mount_markers", q).translation for q in true]
    expected = 1e3 * np.linalg.norm(np.subtract(at, went), axis=1)
    assert expected.mean() > 1
    gaps = tables.gaps_mm(exact.moving, Model(), exact.on_paper().values)
    np.testing.assert_allclose(gaps, expected, atol=1e-3)
    both = tables.two_ways(exact, {"paper": exact.on_paper()})["paper"]
    assert both["all"] == pytest.approx((both["static"] + expected.mean()) / 2, abs=1e-3)


def test_what_is_learnt_from_and_what_is_judged_are_all_stops_once(exact):
    learnt, judged = exact.stops(False), exact.stops(True)
    assert sorted(learnt + judged) == sorted(exact.stops())
    copy = Source.open(exact.learnt_from).recording
    assert copy.stops == learnt
    assert not set(copy.location) & {name[:3] for name in judged}
    np.testing.assert_array_equal(
        copy.joints, exact.source.recording.joints[np.isin(exact.source.recording.stops, learnt)]
    )


# ----------------------------------------------------------------------------- means and spreads


def table_of(n, seed=0, **columns):
    """A table of n directions, each of 50 returns."""
    rng = np.random.default_rng(seed)
    base = {
        "count": np.full(n, 50.0),
        "ring": rng.integers(0, 4, n),
        "precision_m": rng.uniform(0.004, 0.01, n),
        "incidence_rad": rng.uniform(0, 1.4, n),
        "intensity": rng.uniform(0, 100, n),
    }
    return {**base, **columns}


def test_ring_offsets_are_means_over_returns():
    rng = np.random.default_rng(2)
    ring, error, count = rng.integers(0, 5, 300), rng.standard_normal(300), rng.integers(1, 9, 300)
    values = {sequence.RINGS: np.zeros(6)}  # of the last ring nothing was seen
    found = sequence.offsets_by_ring(values, ring, error, count)[sequence.RINGS]
    each = pd.DataFrame({"ring": ring.repeat(count), "error": error.repeat(count)})
    np.testing.assert_allclose(found[:5], each.groupby("ring")["error"].mean())
    assert found[5] == pytest.approx(each["error"].mean())


def test_spread_is_that_of_single_returns():
    rng = np.random.default_rng(3)
    points = table_of(4000)
    error = 0.005 * rng.standard_normal(4000)
    error[:200] += 0.3
    found = tables.spread(points, error, np.arange(4000))
    shots = 1e3 * (
        error[:, None] + points["precision_m"][:, None] * rng.standard_normal((4000, 50))
    )
    assert found["mean"] == pytest.approx(shots.mean(), abs=0.3)
    assert found["std"] == pytest.approx(shots.std(), rel=0.01)
    assert found["near"] == pytest.approx(shots[200:].std(), rel=0.03)
    assert found["far_share"] == pytest.approx(0.05)
    assert found["noise"] == pytest.approx(1e3 * np.sqrt(np.mean(points["precision_m"] ** 2)), 0.02)


def test_the_filter_leaves_out_grazing_beams_and_the_darkest_tenth():
    points = table_of(5000)
    kept = well_seen(points)
    assert points["incidence_rad"][kept].max() < np.radians(70)
    upright = points["incidence_rad"] < np.radians(70)
    assert kept.sum() == pytest.approx(0.9 * upright.sum(), rel=0.01)


def test_a_ring_s_error_is_that_of_bright_upright_near_returns():
    n = 4000
    points = table_of(n, reference_intensity=np.full(n, 0.6), distance_m=np.full(n, 3.0))
    error = 0.01 * points["ring"].astype(float)
    spoilt = {"incidence_rad": 1.3, "reference_intensity": 0.2, "distance_m": 7.0}
    for i, (name, value) in enumerate(spoilt.items()):
        points[name][i::5] = value
        error[i::5] = 9.0
    found = by_ring({**points, "raw_signed_error_m": error}, 6)
    np.testing.assert_allclose(found[:4], [0, 0.01, 0.02, 0.03], atol=1e-12)
    assert np.isnan(found[4:]).all()


def test_a_plane_is_as_thick_as_its_noise():
    rng = np.random.default_rng(4)
    n = 3000
    across, precision, incidence = 0.006 * rng.standard_normal(n), np.full(n, 0.008), np.full(n, 1)
    xyz = np.stack([*rng.uniform(-1, 1, (2, n)), across], axis=1)
    xyz[:60, 2] += rng.uniform(0.2, 1.0, 60)  # something in front of it
    xyz = Rotation.from_rotvec([0.4, -0.2, 1]).apply(xyz) + np.array([1, 2, 3])
    points = table_of(n, precision_m=precision, incidence_rad=incidence.astype(float))
    points |= {f"{axis}_m": column for axis, column in zip("xyz", xyz.T, strict=True)}
    expected = 1e3 * np.hypot(0.006, 0.008 * np.cos(1.0))
    assert tables.thickness_mm(points, np.arange(n)) == pytest.approx(expected, rel=0.03)
    assert tables.thickness_mm(points, np.arange(20)) is None


def test_a_ransac_plane_is_the_one_that_most_points_lie_on():
    rng = np.random.default_rng(5)
    wall = np.stack([*rng.uniform(-1, 1, (2, 500)), 0.001 * rng.standard_normal(500)], axis=1)
    points = np.concatenate([wall, rng.uniform(-1, 1, (100, 3)) + np.array([0, 0, 2])])
    found = ransac_plane(points, 0.02)
    assert set(found) == set(range(500))
    np.testing.assert_array_equal(found, ransac_plane(points, 0.02))
    with pytest.raises(InputError, match="2 points lie on no plane"):
        ransac_plane(points[:2], 0.02)


def test_table_6_has_the_study_s_figures_beside_ours():
    row = {"mean": 1.0, "std": 2.0, "half_68": 1.0, "near": 2.0, "far_share": 0.0, "noise": 1.0}
    steps = ("origin", "origin, filtered", "one offset", "ring offsets", "joint graph")
    text = _table_6([{"step": step, **row} for step in steps])
    for step, (mean, std) in TABLE_6.items():
        assert f"| {step} | **1.00** ({mean:g}) | **2.0** ({std:g}) |" in text


# ------------------------------------------------------------------------------------- the whole


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A very small study, and where it was written."""
    out = tmp_path_factory.mktemp("study")
    scale = Scale(3, 3, 100, turns=8, sensors=("XT",), explained=())
    return study(out, scale), out


@pytest.mark.long
def test_the_graph_predicts_better_than_paper_and_the_sequence(whole):
    methods = whole[0]["sensors"]["XT"]["methods"]
    paper, ours, graph = (methods[m] for m in ("on paper", "the study's sequence", "joint graph"))
    assert ours["pose_mm"] < paper["pose_mm"]
    assert graph["half_68"] < ours["half_68"]
    assert graph["pose_mrad"] < ours["pose_mrad"]
    assert graph["ring_pattern_mm"] < 0.5 * ours["ring_pattern_mm"]


@pytest.mark.slow
def test_the_page_shows_what_was_found_and_every_figure_it_names(whole):
    found, out = whole
    page = (out / "study.md").read_text()
    for line in found["sensors"]["XT"]["methods"].values():
        assert f"**{line['held_out_rms']:.2f}**" in page
    named = re.findall(r"\]\((figures/[^)]+)\)", page)
    assert len(named) == 5
    assert all((out / name).stat().st_size > 10_000 for name in named)
    assert all(claim["figures"] in page for claim in found["shape"])


@pytest.mark.slow
def test_points_can_be_read_as_one_table(whole):
    found, out = whole
    points = pd.read_parquet(out / "XT/sequence/points.parquet")
    assert set(points["location"]) == {"L00", "L01", "L02"}
    mean_mm = 1e3 * np.average(points["raw_signed_error_m"], weights=points["count"])
    ours = found["sensors"]["XT"]["table_5"]["signed_error_mm"]["mean"]
    assert ours == pytest.approx(mean_mm, abs=0.02)


def test_every_lidar_has_its_own_mount_on_the_same_arm(tmp_path):
    """So the circles of one recording speak of the arm of the other."""
    small = replace(QUICK, locations=2, stops=1, column_step=1000, turns=2)
    truths = {}
    for name, spec, seed in (
        ("a", small.one_joint(), 7),
        ("b", small.moving(), 7),
        ("c", small.moving(), 8),
    ):
        simulate(spec, tmp_path / name, seed)
        truths[name] = pd.read_json(tmp_path / f"{name}.truth.json", typ="series")
    a, b, c = truths.values()
    assert a["frames"] == b["frames"]
    assert b["frames"]["mount"] != c["frames"]["mount"]
    assert b["frames"]["arm_base"] == c["frames"]["arm_base"]
    for truth in (b, c):
        assert truth["effects"]["arm_link_length"] == a["effects"]["arm_link_length"]
    assert np.allclose(se3.inverse(np.array(a["T_faro_opti"])), se3.inverse(b["T_faro_opti"]))


def test_the_example_can_be_asked_what_it_does(tmp_path):
    assert "--quick" in script(ROOT / "examples" / "paper_study.py", ["--help"], tmp_path)
