"""What a tracker errs by at a place: it moves all that is there, and the place is the model's."""

import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
import yaml

from calib.diagnosis.structure.empirical import PoseShape
from calib.effects import Effect, Param, ShapeStep, Site, find
from calib.problem import build
from calib.problem.model import Model, Source
from calib.residuals.targets import HangingTarget
from calib.runs.add import add
from calib.runs.calibrate import calibrate
from calib.runs.diagnose import diagnose
from calib.simulation import simulate
from calib.simulation.spec import load_spec

from . import arm_worlds, rigs

OF_PLACE = ("optitrack_scale", "optitrack_distortion", "tracker_creep")
SCALE = 8e-4


@pytest.fixture(scope="module")
def problem(tmp_path_factory):
    folder = rigs.write(tmp_path_factory.mktemp("volume") / "box")
    return build([Source.open(folder)], Model(tuple(map(find, OF_PLACE))))


@pytest.fixture(scope="module")
def values(problem):
    """A state away from the drawing, where the tracker errs by centimetres."""
    rng = np.random.default_rng(5)
    errors = {n: rng.uniform(-0.03, 0.03, problem.variables[n].dim) for n in OF_PLACE}
    return rigs.shaken(problem.variables, problem.initial, 0.1) | errors


def test_derivatives_know_that_the_error_goes_with_the_place(problem, values):
    assert {n for b in problem.bodies for n in b.by_place.terms} == set(OF_PLACE)
    for body in problem.bodies[:4]:
        rigs.assert_block_derivatives(body, problem.variables, values)


def test_derivatives_of_targets_by_errors_of_the_tracker(problem, values):
    targets = [b for b in problem.blocks if isinstance(b, HangingTarget)]
    assert set(targets[0].tracked) == set(OF_PLACE[:2])
    for target in targets:
        rigs.assert_block_derivatives(target, problem.variables, values)


def test_what_is_made_of_an_effect_goes_by_the_place_as_that_does():
    creep, scale = find("tracker_creep"), find("optitrack_scale")
    settle = find("tracker_settle").at(500.0)
    step = ShapeStep(settle, {"box": np.ones(6)})
    assert all(e.goes_by_place and not e.of_volume for e in (creep, settle, step))
    assert ShapeStep(scale, {"box": np.ones(1)}).of_volume
    assert PoseShape(find("tracker_slip").at(9.0), "time_s", (0.0, 1.0), 2).goes_by_place
    assert not PoseShape(find("mount_slip").at(9.0), "time_s", (0.0, 1.0), 2).goes_by_place


class Mine(Effect):
    """Of a user, about the second body alone."""

    name, site, covariates = "mine", Site.TRACKER, ("tracked",)

    def params(self, rig):
        return (Param("along", "m", 0.01),)

    def basis(self, view):
        out = np.zeros((view.rows, len(view.rig.tracker.bodies), 6, 1))
        out[:, 1, 3] = np.sin(view["elapsed_s"])[:, None]
        return out


def test_an_effect_of_a_user_moves_bodies_alone_and_sees_all_columns(tmp_path):
    source = Source.open(rigs.write(tmp_path / "box"))
    problem = build([source], Model((Mine(),)))
    assert not any("mine" in b.variables for b in problem.blocks if isinstance(b, HangingTarget))
    values = problem.initial | {"mine": np.array([0.01])}
    for body in problem.bodies:
        (moved, _), (still, _) = (body.evaluate(v, False) for v in (values, problem.initial))
        elapsed = source.columns["elapsed_s"][[k for _, k in body.stop_names]]
        second = body.body == source.rig.tracker.bodies[1]
        assert np.allclose(moved, still) == (not second or np.allclose(np.sin(elapsed), 0))


def test_bodies_and_targets_are_seen_by_the_same_metre(problem, values):
    """In a tracker's frame whose metre is too long all positions are longer, and nothing else."""
    values = values | {n: np.zeros_like(values[n]) for n in OF_PLACE}
    longer = values | {"optitrack_scale": np.array([SCALE])}
    for body in problem.bodies:
        true, seen = (body.seen(v).T for v in (values, longer))
        np.testing.assert_allclose(seen[:, :3, 3], (1 + SCALE) * true[:, :3, 3], rtol=1e-12)
        np.testing.assert_allclose(seen[:, :3, :3], true[:, :3, :3], atol=1e-12)
    for target in (b for b in problem.blocks if isinstance(b, HangingTarget)):
        (before, _), scaled = target.evaluate(values, False), 1 + SCALE
        seen = replace(target, lower_m=scaled * target.lower_m, upper_m=scaled * target.upper_m)
        tracked = {**target.tracked, "optitrack_scale": target.tracked["optitrack_scale"] * scaled}
        after, _ = replace(seen, tracked=tracked).evaluate(
            values | {"optitrack_scale": np.array([SCALE / scaled])}, False
        )
        np.testing.assert_allclose(after, before, atol=1e-9)


@pytest.mark.long
def test_a_scale_that_all_the_tracker_sees_has_is_named_and_nothing_beside_it(tmp_path):
    """It was told as scatter of targets too, of 1.8 mm in such a recording."""
    simulate(load_spec("tiny"), tmp_path / "rec", 4, {})
    for name, parts in (("stops", ("base_markers", "mount_markers")), ("targets", ("u", "l"))):
        path = tmp_path / "rec" / f"{name}.csv"
        table = pd.read_csv(path)
        longer = [
            c
            for c in table.columns
            if c.startswith(parts) and c.endswith(("_x", "_y", "_z", ".x", ".y", ".z"))
        ]
        assert len(longer) == 6
        table[longer] *= 1 + SCALE
        table.to_csv(path, index=False)
    run = calibrate([tmp_path / "rec"], tmp_path / "run")
    found = diagnose(run).document()
    (named,) = (c for c in found["candidates"] if c["step"])
    assert named["add"] == "optitrack_scale"
    (scale,), (sigma,) = named["parameters"]["estimate"], named["parameters"]["sigma"]
    assert abs(scale - SCALE) < 4 * sigma
    (pair,) = named["together"]
    assert "it from range_scale and faro_scale together." in " ".join(found["sentences"])
    both = add(run, pair["effects"], tmp_path / "both")
    estimate = [float(both.solution.shared.effects[n].estimate[0]) for n in pair["effects"]]
    sigma = [float(both.solution.shared.effects[n].sigma[0]) for n in pair["effects"]]
    assert np.all(np.abs(np.subtract(estimate, pair["estimate"])) < 4 * np.array(sigma))
    left = next(
        c for c in diagnose(both).document()["candidates"] if c["effect"] == "optitrack_scale"
    )
    assert left["statistic"] < 0.01 * named["statistic"] and not left["step"]


@pytest.mark.parametrize("arm", ["puma560", "panda"])
def test_noise_of_a_tracker_is_no_scale_of_it(tmp_path, arm):
    """Where the geometry of an arm is unknown, next to nothing tells a scale from that. Added to
    the model, that of the first arm was 0.022 ± 0.009, as it shrank the noise."""
    rng, folder, poses = np.random.default_rng([78, 1]), tmp_path / "rec", 60
    world = arm_worlds.bent(folder, arm, rng)
    read = world.draw(rng, poses)
    seen = world.seen(read) * arm_worlds.exp(7.0 * arm_worlds.noise(rng, poses))
    arm_worlds.save(folder, world, read, seen, {}, 2e-5)
    run = calibrate([folder], tmp_path / "run", hold_out="none")
    added = add(run, ["optitrack_scale"], tmp_path / "added")
    found = yaml.safe_load((added.folder / "solution.yaml").read_text(encoding="utf-8"))
    scale = found["effects"]["optitrack_scale"]
    assert abs(scale["estimate"][0]) < scale["sigma"][0] / 10


def test_what_a_scale_would_change_unseen_is_what_it_does_change(tmp_path):
    """An arm's lengths take in the whole of the tracker's scale: of those that move by most of
    their sigmas the first is named, and by how many."""
    (param,) = find("optitrack_scale").params(SimpleNamespace(tracker=True))
    rng = np.random.default_rng(12)
    world = arm_worlds.bent(tmp_path / "rec", "puma560", rng)
    read, errors = world.draw(rng, 60), arm_worlds.exp(arm_worlds.noise(rng, 60))
    lengths = []
    for times in (1.0, 1.0 + param.sigma):
        T = world.seen(read) * errors
        seen = type(T).from_components(times * T.translation, T.rotation)
        arm_worlds.save(tmp_path / "rec", world, read, seen, {}, 2e-5)
        run = calibrate([tmp_path / "rec"], tmp_path / f"run{times}", hold_out="none")
        lengths.append(run.solution.shared.effects["arm_link_length"])
    sigma = np.maximum(lengths[0].sigma, 1e-9)  # 0 of joints that are drawn without a length
    moved = np.abs(lengths[1].estimate - lengths[0].estimate) / sigma
    said = [s for s in diagnose(run, refits=False).sentences if "Nothing here checks" in s]
    (found,) = re.findall(r"would change arm_link_length\.(\S+) by (\d+) of its sigmas", said[0])
    at = lengths[0].names.index(found[0])
    assert float(found[1]) == pytest.approx(moved[at], rel=0.2) and moved[at] > 0.8 * moved.max()
