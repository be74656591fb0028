"""What an effect could not be told from when it was named is not forgotten once it was added."""

from types import SimpleNamespace

import numpy as np
import pytest

from calib import add, diagnose, fit
from calib.effects import find
from calib.problem.model import Model
from calib.problem.unknowns import Key
from calib.runs.asked.in_place import rivals_told
from calib.runs.calibrate import calibrate
from sensors.documents import read_json

from .simulated import made


@pytest.fixture(scope="module")
def flexing(tmp_path_factory):
    """A run whose arm sags so little that its base may flex as well, and the run with that."""
    folder = tmp_path_factory.mktemp("in_place")
    made(folder / "rec", "tiny", seed=1, arm_gravity_sag=0.1)
    run = fit([folder / "rec"], folder / "run")
    found = diagnose(run)
    assert found.worth_adding == ["base_flex"]
    return run, found, add(run, found.worth_adding, folder / "grown")


def value(run, key):
    """An estimate and its sigma."""
    sigma = np.sqrt(run.solution.covariance[(at := run.solution.keys.index(key)), at])
    effect = run.solution.shared.effects[key.unknown]
    return effect.estimate[list(effect.names).index(key.dof)], sigma


def test_what_would_fit_in_place_of_an_effect_of_the_model_is_told(flexing, tmp_path):
    run, found, grown = flexing
    (named,) = (c for c in found.candidates if c["step"])
    assert "arm_gravity_sag" in named["indistinguishable_from"]
    again = diagnose(grown)
    (other,) = (each for each in again.in_place if each["rival"] == "arm_gravity_sag")
    assert again.verdict == "adequate" and other["effect"] == "base_flex"
    assert again.sentences[0].startswith("The model is adequate")
    said = [s for s in again.sentences if " in place of base_flex would fit as well (odds " in s]
    assert again.sentences[1 : 1 + len(said)] == said and len(said) == len(again.in_place)
    assert again.plan.split(" --for ")[1].startswith("base_flex,") and not other["alike"]
    assert "arm_gravity_sag" in again.plan and str(grown.folder) in again.plan
    assert read_json(grown.folder / "diagnosis.json")["in_place"] == list(again.in_place)

    # A fit of its own, from the start, with the sag.
    names = [find(name) for name in grown.effects if name != "base_flex"]
    model = Model((*names, find("arm_gravity_sag")))
    alone = calibrate([run.recordings[0]], tmp_path / "alone", model, hold_out="none")
    key = Key(*other["parameter"].split(".", 1))
    (with_flex, sigma), (with_sag, _) = (value(each, key) for each in (grown, alone))
    assert other["change"] == pytest.approx(with_sag - with_flex, abs=0.1 * sigma)
    assert other["sigmas"] == pytest.approx(abs(other["change"]) / sigma, rel=1e-6)
    assert other["sigmas"] > 1.0


def test_rivals_as_an_earlier_version_told_them_are_left_out():
    told = {"add": "b", "dof": 1, "odds": 2.0, "separate": "stops", "alike": False}
    candidates = [
        {"add": "a", "dof": 2, "rivals": [told, {"add": "c", "odds": 1.0}]},
        {"add": "d", "dof": 1, "rivals": [{"add": "c"}]},
        {"add": "e"},
    ]
    run = SimpleNamespace(summary={}, diagnosis=lambda: {"candidates": candidates})
    assert rivals_told(run) == {"a": {"dof": 2, "rivals": [told]}}


def test_only_what_was_told_of_an_effect_is_asked_for(flexing, tmp_path):
    run, _, grown = flexing
    assert rivals_told(None) == {} == run.summary["rivals"]
    assert set(rivals_told(run)) == set(grown.summary["rivals"]) == {"base_flex"}
    assert "base_flex" in rivals_told(grown)  # and so in those that grow from it
    plain = calibrate(run.recordings, tmp_path / "plain", Model(tuple(map(find, grown.effects))))
    assert not diagnose(plain, refits=False).in_place
