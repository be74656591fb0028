"""What an effect could not be told from when it was named is not forgotten once it was added."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from calib import add, diagnose, fit
from calib.effects import DEFAULT, find
from calib.problem.model import Model
from calib.problem.spread import spread_of
from calib.problem.unknowns import Key
from calib.runs import diagnose as diagnosing
from calib.runs.asked.commands import command_without
from calib.runs.asked.in_place import InPlace, OtherEstimate, Untried, in_place, rivals_told
from calib.runs.calibrate import calibrate
from calib.runs.reopen import stand_of
from sensors.documents import read_json

from .simulated import made


def quiet(what, done, total):
    pass


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
    turned = {**told, "add": "a", "dof": 2, "odds": 0.5}
    as_well = {"dof": 1, "rivals": [turned]}
    assert rivals_told(run) == {"a": {"dof": 2, "rivals": [told]}, "b": as_well}


def test_only_what_was_told_of_an_effect_is_asked_for(flexing, tmp_path):
    run, _, grown = flexing
    assert rivals_told(None) == {} == run.summary["rivals"]
    assert set(rivals_told(run)) == set(grown.summary["rivals"]) > {"base_flex", "arm_gravity_sag"}
    assert "base_flex" in rivals_told(grown)  # and so in those that grow from it
    plain = calibrate(run.recordings, tmp_path / "plain", Model(tuple(map(find, grown.effects))))
    assert not diagnose(plain, refits=False).in_place


def test_a_rival_that_is_added_instead_has_the_named_one_as_its_own(flexing, tmp_path):
    run, _, _ = flexing
    other = diagnose(add(run, ["arm_gravity_sag"], tmp_path / "other"))
    flex = next(each for each in other.in_place if each["rival"] == "base_flex")
    assert (flex["effect"], other.verdict) == ("arm_gravity_sag", "adequate")
    assert 1 / 20 < flex["odds"] < 20


def test_costs_are_compared_with_rows_that_scatter_alike(tmp_path):
    """A wrong effect leaves joints that scatter; with their spread estimated anew that would cost
    nothing."""
    made(tmp_path / "rec", "tiny", seed=1, arm_gravity_sag=0.5)
    model = Model((*map(find, DEFAULT), find("arm_gravity_sag"), find("joint_scatter")))
    stand = stand_of(calibrate([tmp_path / "rec"], tmp_path / "run", model, "none"), quiet)
    stand = stand.refitted(model, stand.estimate.start, quiet)
    wrong = model.minus(["arm_gravity_sag"]).plus((find("warmup_drift"),))
    cost = stand.estimate.robust_cost
    anew = stand.refitted(wrong, stand.estimate.start, quiet).estimate.robust_cost - cost
    alike = stand.compared(wrong, stand.estimate.start, quiet)
    assert anew < 10 and alike.estimate.converged
    assert alike.estimate.robust_cost - cost > 100
    same = stand.compared(model, stand.estimate.start, quiet).estimate
    assert same.robust_cost == pytest.approx(cost, abs=1e-3)
    assert spread_of(alike.estimate.problem) == spread_of(stand.estimate.problem)


def test_what_fits_far_better_in_its_place_is_no_adequate_model(flexing, monkeypatch):
    run, _, grown = flexing
    told = dict(change=OtherEstimate("mount.tx", 1e-3, "m", 2.0), separate="stops", alike=False)
    better = InPlace("base_flex", "arm_gravity_sag", odds=0.01, **told)
    monkeypatch.setattr(diagnosing, "in_place", lambda *_: iter([better]))
    found = diagnose(grown)
    assert found.verdict == "unexplained_structure"
    assert found.sentences[0].startswith("arm_gravity_sag in place of base_flex would fit far bett")
    assert not any("The model is adequate" in sentence for sentence in found.sentences)
    chosen = found.command.split("--effects ")[1].split(",")
    assert chosen == [n if n != "base_flex" else "arm_gravity_sag" for n in grown.effects]
    assert found.command.startswith(f"rigcal fit {run.recordings[0]} -o {grown.folder}-instead")


def test_what_was_not_fitted_in_its_place_is_said(flexing, tmp_path):
    """Of a run from an earlier one, as costs are then of other rows."""
    run, _, grown = flexing
    from_it = add(run, ["base_flex"], tmp_path / "later")
    from_it = replace(from_it, model={**from_it.model, "prior": str(run.folder)})
    (said, *_) = in_place(from_it, stand_of(grown, quiet), 1.0, quiet)
    assert isinstance(said, Untried) and "rests on an earlier one" in said.sentence
    assert said.sentence.startswith("When base_flex was named, ")
    assert command_without(grown, ["s0:scan"]).startswith(f"rigcal add {grown.folder} ")
