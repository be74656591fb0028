"""Ninety kinds of damage: each is refused, named or harmless; none calm and wrong, or endless.

A small recording is damaged in one way each, ten times as much as can be detected, and `rigcal
check`, `fit` and `diagnose` are asked. Of files that no reader can take, see test_bad_input.py.
"""

from __future__ import annotations

import shutil
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from calib.simulation import Spec, simulate

from ..mishaps import MISHAPS, Scene
from ..mishaps.judge import as_truth, asked, largest, off

SPEC = Spec(lidar="hesai_pandarxt32", locations=4, stops_per_location=3, column_step=150)
TIMES = 10  # the detectable size
UNCHANGED = 1.0  # sigma of the good recording's fit
LIMIT = 2.0  # times as long as the good recording's fit
SLACK_S = 0.3  # beside it, CPU seconds: what one pass more or less of a short fit takes
LONGEST_S = 60

# What the program does not see yet, and how it fares instead.
UNSEEN: dict[str, str] = {}
# They take seconds each, and others of their sort are run always.
LONG: set[str] = set()


@dataclass(frozen=True)
class Good:
    """The recording with nothing wrong.

    Args:
        folder: of it.
        found: what is said of it.
        truth: its estimates, as `off` takes them.
        sigmas: of each.
    """

    folder: Path
    found: dict[str, Any]
    truth: dict[str, Any]
    sigmas: dict[str, float]


@pytest.fixture(scope="module")
def good(tmp_path_factory) -> Good:
    """A recording with nothing wrong, and what is said of it once everything is compiled."""
    home = tmp_path_factory.mktemp("good")
    recording, run = home / "recording", home / "run"
    simulate(SPEC, recording, seed=1)
    asked(recording, run)
    found, truth = asked(recording, run), as_truth(run)
    sigmas = {name: error.sigma for name, error in off(run, truth).items()}
    return Good(folder=recording, found=found, truth=truth, sigmas=sigmas)


def test_nothing_is_said_of_a_good_recording(good):
    """Else every case below might be named for another reason."""
    assert good.found["outcome"] == "adequate", good.found
    assert not good.found["odd"] and not good.found["blunders"]


def kinds() -> list[Any]:
    marks = {kind: [] for kind in MISHAPS}
    for kind, why in UNSEEN.items():
        marks[kind].append(pytest.mark.xfail(reason=why, strict=True))
    for kind in LONG:
        marks[kind].append(pytest.mark.long)
    return [pytest.param(kind, marks=each, id=kind) for kind, each in marks.items()]


@pytest.mark.slow
@pytest.mark.parametrize("kind", kinds())
def test_damage_is_refused_or_named_or_harmless(good, tmp_path, kind):
    recording, run = shutil.copytree(good.folder, tmp_path / "recording"), tmp_path / "run"
    rng = np.random.default_rng(zlib.crc32(kind.encode()))
    done = MISHAPS[kind].apply(Scene(recording, rng), TIMES)
    found = asked(recording, run, LONGEST_S, at_any_rate=False)
    outcome, codes = found["outcome"], found["codes"]
    assert outcome not in ("endless", "fault"), found
    allowed_s = LIMIT * good.found["seconds"][1] + SLACK_S
    assert found["seconds"][1] < allowed_s, f"a fit took {found['seconds'][1]} s of {allowed_s:.1f}"
    if outcome == "refused":
        return
    if outcome == "not converged":
        assert codes[1] == 3, f"not converged, and exit code {codes[1]}"
        return
    moved = largest(off(run, good.truth, done), good.sigmas)
    if MISHAPS[kind].harmless:
        assert moved < UNCHANGED and outcome == "adequate", (moved, found)
    elif outcome == "adequate" and set(found["odd"]) <= set(good.found["odd"]):
        assert moved < UNCHANGED, f"calm, and an estimate is off by {moved:.1f} sigma"
