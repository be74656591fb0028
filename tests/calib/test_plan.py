"""Plans: what they promise, held against fits of the stops that they ask for, in worlds that share
no code with the program."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import calib
from tests.worlds import World, write

# Joint 5 never turned; joints 2, 3 and 6 hardly did.
NARROW = World(seed=3, locations=2, stops=5, beams=1200, turned=(1, 0.3, 0.3, 1, 0, 0.3))
FEW = {"stops": 3, "candidates": 120}
JOINTS = [f"joint_{k}" for k in range(1, 7)]


def fitted(world, folder):
    """A run of a world."""
    write(world, folder / "rec")
    return calib.fit([folder / "rec"], folder / "run", hold_out="none")


def followed(world, plan):
    """The world in which a plan's stops were measured as well."""
    then = [(int(s["location"][1:]), tuple(s[name] for name in JOINTS)) for s in plan.stops]
    return replace(world, then=tuple(then))


def sigma(run):
    """Of every parameter, as the graph has it: what rows say, whatever chance made of a few."""
    return np.sqrt(np.diag(run.solution.graph))


@pytest.fixture(scope="module")
def narrow(tmp_path_factory):
    """A run of the narrow world."""
    return fitted(NARROW, tmp_path_factory.mktemp("narrow"))


def test_sigmas_are_as_promised(narrow, tmp_path):
    """Of every parameter within 15 %, where planned stops bring much."""
    plan = calib.plan(narrow, **FEW)
    later = fitted(followed(NARROW, plan), tmp_path)
    assert later.solution.names == tuple(plan.names)
    promised = plan.after.sigma / plan.now.sigma
    kept = sigma(later) / sigma(narrow)
    assert promised.min() < 0.2 and np.median(promised) < 0.95
    np.testing.assert_allclose(kept, promised, rtol=0.15)


def test_a_diagnosis_names_the_plan_that_would_tell_its_rivals_apart():
    """Of a confirmed effect with rivals, or of effects of the model that may be another."""
    from calib.diagnosis.weak import to_be_told_apart

    plain = {"step": None, "indistinguishable_from": ["x"], "add": "w"}
    found = plain | {"step": 2, "add": "arm_gravity_sag", "indistinguishable_from": ["base_flex"]}
    weak = [
        {"parameters": ["lidar.tz"], "sigma_mm": 0.6},
        {"parameters": ["range_scale", "faro_scale"], "sigma_mm": None},
    ]
    assert to_be_told_apart([plain, found], weak) == ["arm_gravity_sag", "base_flex"]
    assert to_be_told_apart([plain], weak) == ["range_scale", "faro_scale"]
    assert to_be_told_apart([plain], weak[:1]) == []
