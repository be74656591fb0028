"""The hidden effects of the bench of arms: as large as is said, and known by their names."""

import numpy as np
import pytest

from calib.effects import CATALOGUE

from ..calib.arm_worlds import bent
from .arm_effects import outcome
from .arm_worlds_hidden import KINDS, WHITE, Session, scaled


@pytest.fixture(scope="module")
def arm(tmp_path_factory):
    rng = np.random.default_rng(8)
    world = bent(tmp_path_factory.mktemp("arm"), "ur10", rng)
    return world, Session.drawn(world, rng, 60)


def test_what_names_an_effect_is_in_the_catalogue():
    known = {effect.family for effect in CATALOGUE}
    assert {name for kind in KINDS.values() for name in kind.right} <= known


@pytest.mark.parametrize("kind", KINDS)
def test_an_effect_changes_what_is_seen_by_its_size_in_the_noise(arm, kind):
    world, session = arm
    none = world.seen(session.joints)
    seen = scaled(KINDS[kind].hide(world, session, np.random.default_rng(3)), 2.0)
    change = (none.inv() * seen).as_exp_coords() * WHITE
    rms = np.sqrt(np.mean(np.square(change)))
    assert rms == pytest.approx(0.0 if kind == "nothing" else 2.0, rel=0.02, abs=1e-6)


def test_outcomes_tell_the_right_name_from_its_group_and_from_none():
    def said(kind, verdict, names, rivals=()):
        told = {name: list(rivals) for name in names[:1]}
        return {"case": ("ur10", kind, 1.0, 9), "verdict": verdict, "names": names, "rivals": told}

    gear, scale = "arm_gear_error", "arm_joint_scale"
    assert outcome(said("gear", "missing_effect", [gear])) == "right"
    assert outcome(said("gear", "missing_effect", [scale], [gear])) == "group"
    assert outcome(said("gear", "missing_effect", [scale, gear])) == "later"
    assert outcome(said("gear", "missing_effect", [scale])) == "other"
    assert outcome(said("gear", "adequate", [])) == "missed"
    assert outcome(said("nothing", "adequate", [])) == "right"
    assert outcome(said("nothing", "missing_effect", [scale])) == "false"
