"""Stops that tell rivals apart: what they are chosen by, and rivals that no stops tell apart."""

from __future__ import annotations

import numpy as np
import pytest

import calib
from calib.planning.criteria import Apart, every_pair
from calib.planning.information import Information
from calib.problem.unknowns import Key

from .narrow import run_of

SAG, SCALE, BENDING = "arm_gravity_sag", "arm_joint_scale", "arm_link_bending"


def known(data):
    keys = tuple(Key("u", f"p{k}") for k in range(len(data)))
    return Information(keys, np.ones(len(data)), data, np.zeros_like(data))


def rows(seed, count):
    return np.random.default_rng(seed).standard_normal((count, 6))


def left(J, of, others):
    """Mean square of what regression on other columns leaves of some."""
    beside = J[:, others]
    rest = J[:, of] - beside @ np.linalg.lstsq(beside, J[:, of], rcond=None)[0]
    return np.mean(np.sum(rest**2, axis=0))


EFFECTS = {0: [2, 3], 1: [4], 2: [5]}  # beside a model of two columns; the third effect is in it
ADDED = [2, 3, 4]
SIZE = 1.5


def test_sizes_from_which_rivals_are_told_are_those_of_regressions():
    now, more = rows(0, 20), rows(1, 12)
    of = [(np.array(at), np.full(len(at), SIZE)) for at in EFFECTS.values()]
    by = Apart(known(now.T @ now), of, np.array(ADDED))
    both, short = np.concatenate([now, more]), []
    for one, other in every_pair(3):
        mine, beside = EFFECTS[one], EFFECTS[other]
        alone = [k for k in range(6) if k not in ADDED and k not in mine]
        rival = sorted({*alone, *beside} - {*mine})
        wanted = 1 + SIZE**2 * left(now, mine, alone)
        short.append(wanted / (SIZE**2 * left(both, mine, rival)))
    value = by.of((by.start + more.T @ more)[None])[0]
    assert value == pytest.approx(-np.log(np.mean(short)), rel=1e-9)


def test_the_pair_that_is_hardest_to_tell_counts_most():
    """Of two stops, each of which tells one effect better, that of the effect which is hidden."""
    now = np.diag([50.0, 50.0, 4.0])
    now[0, 1] = now[1, 0] = 49.9
    of = [(np.array([k]), np.ones(1)) for k in range(3)]
    by = Apart(known(now), of, np.arange(3))
    hidden, open_ = np.diag([1.0, 1.0, 0.0]), np.diag([0.0, 0.0, 100.0])
    apart, other = by.of(by.start + np.stack([hidden, open_]))
    assert apart > other
    without = Apart(known(now), of, np.arange(3), [(0, 2), (1, 2), (2, 0), (2, 1)])
    apart, other = without.of(without.start + np.stack([hidden, open_]))
    assert apart < other


@pytest.fixture(scope="module")
def plans(once):
    """To tell two rivals apart, and these beside one that does what the first does."""
    run, groups = run_of(once), ((SAG, SCALE), (SAG, SCALE, BENDING))
    return [calib.plan(run, purpose=",".join(g), candidates=150).document() for g in groups]


@pytest.mark.long
def test_rivals_that_no_stops_tell_apart_are_named_and_take_no_stops_from_others(plans):
    """Where two axes meet, the moment across the one turns the arm about the other: links that bend
    there do what the joint's sag does."""
    two, three = plans
    assert two["never_told_apart"] == []
    never = {(each["effect"], each["from"]) for each in three["never_told_apart"]}
    assert never == {(SAG, BENDING), (BENDING, SAG)}
    sizes = [each["smallest_detectable"][SAG]["beside"][SCALE] for each in (two, three)]
    assert sizes[0]["after"] < 0.2 * sizes[0]["now"]
    assert sizes[1]["after"] < 1.3 * sizes[0]["after"]
    both = three["smallest_detectable"][SAG]
    assert both["beside_rivals"] == both["beside"][SCALE]


def test_rivals_that_no_stops_tell_apart_are_printed(once, rigcal):
    words = ["plan", run_of(once).folder, "--for", f"{SAG},{BENDING}", "--candidates", 40]
    code, told, _ = rigcal(*words)
    assert code == 0
    said = " ".join(told.split())
    assert f"at all 40 poses {BENDING} moves all that is seen almost as {SAG} does" in said
    assert f"With them {SAG} is found" not in said
