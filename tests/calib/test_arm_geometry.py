"""Whole geometry: what is found of arms of many kinds holds within its sigmas; less does not."""

from dataclasses import replace

import numpy as np
import pytest

from calib.diagnosis.verdict import worth_adding
from calib.effects import GEOMETRY, find
from calib.forward import place
from calib.problem import build
from calib.problem.model import Model, Source, default_effects
from calib.runs.calibrate import calibrate
from calib.runs.diagnose import diagnose
from calib.solve.fit import solve
from chains import se3
from chains.frames import FrameTree
from chains.minimal import own_errors

from ..chains.arms import TABLES
from . import arm_worlds, rigs

LESS = GEOMETRY[:2]
POSES = 120
LIKE_ANOTHER = ("ur5e",)  # as ur10, but for its lengths


def opened(folder, world, rng, poses=POSES):
    """A recording of the world, opened."""
    arm_worlds.write(folder, world, rng, poses)
    return Source.open(folder)


def fitted(source, effects):
    return solve(build([source], Model(effects)))


def named(folder, name, rng):
    """A world in which every name of the geometry is off by its prior sigma; and by how much."""
    world = arm_worlds.bent(folder, name, rng, size=0.0)
    edges, truth, twists = world.edges, {}, {e.name: np.zeros(6) for e in world.edges}
    lengths, tree = [], FrameTree(edges)
    own = own_errors(tree, (tuple(e.name for e in edges),), True, (True,))
    for edge in edges:
        long = edge.name in own.lengths
        lengths.append(0.005 * rng.normal() if long else 0.0)
        if long:
            twists[edge.name][3:] += lengths[-1] * own.lengths[edge.name]
    truth["arm_link_length"] = np.array(lengths)
    zeros = {joint: 0.005 * rng.normal() for joint in world.joints}
    truth["arm_joint_offset"] = np.array(list(zeros.values()))
    sizes = []
    for slip in own.slips:
        sizes.append({"rad": 0.003, "m": 0.005}[slip.unit] * rng.normal())
        twists[slip.edge] += sizes[-1] * slip.twist
    truth["arm_geometry"] = np.array(sizes)
    tool = rng.normal(size=6) * np.repeat([arm_worlds.TOOL_RAD, arm_worlds.TOOL_M], 3)
    truth["tool"] = tool
    return replace(world, twists=twists, zeros=zeros, tool=tool), truth


def z_of(estimate, truth):
    """Errors over sigma of all that the truth names."""
    out, first = {}, 0
    sigma = np.sqrt(np.diag(estimate.covariance))
    terms = {t.variable: t for terms in estimate.problem.terms for t in terms}
    for variable in estimate.variables:
        here = slice(first, first := first + variable.dim)
        if variable.name in truth:
            true = truth[variable.name][terms[variable.name].free]
            out[variable.name] = (estimate.values[variable.name] - true) / sigma[here]
    return out


# ------------------------------------------------------------------------------------------ found


@pytest.mark.long
def test_every_name_of_eleven_arms_is_found_within_its_sigma(tmp_path):
    """Truths are drawn from the priors, so all intervals should hold, tied parameters too."""
    held, spread = [], []
    for i, name in enumerate(TABLES):
        for seed in range(4):
            rng = np.random.default_rng([16, i, seed])
            folder = tmp_path / f"{name}{seed}"
            folder.mkdir()
            world, truth = named(folder, name, rng)
            estimate = fitted(opened(folder, world, rng), GEOMETRY)
            assert estimate.converged
            z = np.concatenate(list(z_of(estimate, truth).values()))
            held.append(np.mean(np.abs(z) < 1.96))
            spread.append(np.mean(z**2))
    # Parameters of one arm err together: the arms' own spread says how sure the share is.
    doubt = np.std(held) / np.sqrt(len(held))
    assert abs(np.mean(held) - 0.95) < 3 * doubt + 0.005 and doubt < 0.02
    assert abs(np.mean(spread) - 1.0) < 3 * np.std(spread) / np.sqrt(len(spread))


@pytest.mark.parametrize("name", TABLES)
def test_small_errors_are_told_as_small_ones(tmp_path, name):
    """Links off by 1 mm and 1 mrad: no name has to be many times as large to say so. Of a KUKA KR 6
    an axis that misses the first by 1 mm would be a lean of 40 mrad."""
    rng = np.random.default_rng([18, list(TABLES).index(name)])
    world = arm_worlds.bent(tmp_path, name, rng)
    estimate = fitted(opened(tmp_path, world, rng), GEOMETRY)
    unknowns = estimate.problem.variables
    for effect in GEOMETRY[:-1]:  # none of these joints follows another
        assert np.all(np.abs(estimate.values[effect]) < 2.5 * unknowns[effect].prior_sigma), effect


def test_of_few_poses_lengths_alone_say_what_they_can(tmp_path):
    """Of a KUKA KR 6 whose second axis is drawn 1 mm too near to the first: with 30 poses the whole
    geometry is not in the model, and the length of that origin acts where the base does not."""
    rng = np.random.default_rng(6)
    world = arm_worlds.bent(tmp_path, "kr6", rng, size=0.0)
    world.twists["j2"][3] += 0.001
    source = opened(tmp_path, world, rng, poses=30)
    assert "arm_geometry" not in default_effects([tmp_path])
    estimate = fitted(source, LESS)
    assert estimate.converged and estimate.cost < 1.5 * 90
    assert estimate.values["arm_link_length"][0] == pytest.approx(0.001, abs=2e-4)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["ur10", "irb120"])
def test_where_the_tool_is_at_new_poses_is_known_as_well_as_is_said(tmp_path, name):
    """In worlds that no name describes. Under less than the whole geometry it is not."""
    squares = {effects: [] for effects in (GEOMETRY, LESS)}
    for seed in range(8):
        rng = np.random.default_rng([17, len(name), seed])
        folder = tmp_path / f"{seed}"
        folder.mkdir()
        world = arm_worlds.bent(folder, name, rng)
        source = opened(folder, world, rng)
        joints = world.draw(rng, 200)
        for effects, found in squares.items():
            found.append(off_by(fitted(source, effects), source, world, joints))
    whole, less = (np.array(found) for found in squares.values())
    doubt = whole.mean(axis=1).std() / np.sqrt(len(whole))
    assert abs(whole.mean() - 6.0) < 3 * doubt and doubt < 1.0
    assert less.mean() > 100 * whole.mean()


def off_by(estimate, source, world, joints):
    """Squared errors (K,) of the tool's place in units of its covariance: 6 where that is right."""
    problem = estimate.problem
    stops = place(source.rig, problem.terms[0], joints, {}, problem.bodies[0].stops.root, None)
    placed = stops.in_world("tool", estimate.values)
    names = list(placed.d)
    parts = [np.broadcast_to(placed.d[n], (len(joints), *placed.d[n].shape[1:])) for n in names]
    d = np.concatenate(parts, axis=2)
    off = se3.log(se3.inverse(placed.T) @ world.seen(joints).as_matrix())
    spread = d @ estimate.covariance_of(names) @ d.mT
    return np.einsum("ki,kij,kj->k", off, np.linalg.inv(spread), off)


@pytest.mark.long
@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=pytest.mark.long if n in LIKE_ANOTHER else ()) for n in TABLES]
)
def test_bent_links_are_named_and_with_them_the_model_is_adequate(tmp_path, name):
    """By 1 mm and 1 mrad in all ways. A SCARA's axes are parallel: its tilts alone do nearly all,
    and the whole geometry is named as what cannot be told from them."""
    rng = np.random.default_rng([5, list(TABLES).index(name)])
    folder = tmp_path / name
    folder.mkdir()
    opened(folder, arm_worlds.bent(folder, name, rng), rng, poses=150)
    less = calibrate([folder], tmp_path / "less", Model(LESS), hold_out="none")
    first = diagnose(less, refits=False).candidates[0]
    assert "arm_geometry" in (first["effect"], *first["indistinguishable_from"])
    assert first["effect"] == "arm_geometry" or name == "scara"
    whole = calibrate([folder], tmp_path / "whole", hold_out="none")
    assert diagnose(whole, refits=False).verdict == "adequate"


# ------------------------------------------------------------------------------------- recordings


@pytest.mark.long
def test_axes_that_miss_each_other_are_named_first_and_found(shared, tmp_path):
    """Two axes that CAD draws as meeting miss each other by 3 mm, in an independent simulator's
    recording; zeros and lengths are its truth's then, and were not before."""
    recording = shared / "recordings/arm_axes_miss_each_other"
    less = calibrate([recording], tmp_path / "less", Model(LESS))
    found = diagnose(less)
    assert worth_adding(found.candidates)[0] == "arm_geometry"
    assert found.candidates[0]["held_out_rms_mm"]["after"] < 0.1
    whole = calibrate([recording], tmp_path / "whole")
    assert set(GEOMETRY[:-1]) < {e.name for e in Model.of(None, (), (), [recording]).effects}
    assert diagnose(whole).verdict == "adequate"
    geometry = whole.solution.shared.effects["arm_geometry"]
    at = {
        n: (x, s) for n, x, s in zip(geometry.names, geometry.estimate, geometry.sigma, strict=True)
    }
    size, sigma = at.pop("joint_4.shift_a")
    assert abs(abs(size) - 0.003) < 3 * sigma < 1e-4
    assert all(abs(x) < 3.5 * s for x, s in at.values()), "nothing else is off"


def test_a_smaller_model_says_too_small_a_sigma(shared, tmp_path):
    """A zero that moves by many of its sigmas once the geometry is whole."""
    recording = shared / "recordings/arm_axes_miss_each_other"
    source = Source.open(recording)
    zero = {}
    for effects in (LESS, GEOMETRY):
        estimate = fitted(source, effects)
        first = [v.name for v in estimate.variables].index("arm_joint_offset")
        at = sum(v.dim for v in estimate.variables[:first]) + 3
        sigma = np.sqrt(estimate.covariance[at, at])
        zero[effects] = (estimate.values["arm_joint_offset"][3] - 4.575632766967923e-3) / sigma
    assert abs(zero[LESS]) > 10 and abs(zero[GEOMETRY]) < 3


# ---------------------------------------------------------------------------------------- default


def test_the_default_holds_the_geometry_where_the_poses_tell_it(shared):
    """300 poses of an arm do; 30 stops of a rig that has as many parameters do not."""
    assert default_effects([shared / "recordings/arm_payload"])[-1] == "arm_geometry"
    assert "arm_geometry" not in default_effects([shared / "recordings/known_nothing_hidden"])


def test_ten_rows_a_parameter_a_pose_being_six_and_a_point_three(tmp_path):
    rng = np.random.default_rng(0)
    world = arm_worlds.bent(tmp_path, "positioner", rng)
    source = opened(tmp_path, world, rng, poses=40)
    free = sum(p.sigma > 0 for name in GEOMETRY for p in find(name).params(source.rig))
    rows = (tmp_path / "stops.csv").read_text().splitlines()
    enough = -(-10 * free // 6)

    def told(count, point=False):
        kept = [line.split(",")[: -4 if point else None] for line in rows[: count + 1]]
        (tmp_path / "stops.csv").write_text("\n".join(map(",".join, kept)) + "\n")
        return "arm_geometry" in default_effects([tmp_path])

    assert told(enough) and not told(enough - 1) and not told(enough, point=True)


# ------------------------------------------------------------------------------------------- held


def test_what_no_frame_holds_is_the_geometrys(tmp_path):
    """CAD that is sure of all around the arm leaves its first axis and its flange to it."""

    def edges_off(**changes):
        return {p.name.split(".")[0] for p in find("arm_geometry").params(opened_rig(**changes))}

    def opened_rig(**sigmas):
        frames = rigs.drawing()["frames"]
        for name, frame in frames.items():
            if name in sigmas:
                frame |= {"sigma_m": 0.0, "sigma_rad": 0.0}
        return Source.open(rigs.write(tmp_path / "-".join(sigmas or ["none"]), frames=frames)).rig

    assert edges_off() == {"lift", "slide"}
    sure = edges_off(base_markers=0, arm_base=0)
    assert sure == {"turn", "lift", "slide"}
    sure = edges_off(mount=0, mount_markers=0, lidar=0)
    assert sure == {"lift", "slide", "tip"}
