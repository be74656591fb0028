"""Fit, report and diagnosis agree on a run: what forbids to believe it, what asks for care."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from scipy import special

from calib.blunders.judged import ALPHA_BLUNDER
from calib.diagnosis.search import search
from calib.results.outstanding import outstanding, standing_out
from calib.runs.belief import cautions, forbids, limits
from calib.runs.calibrate import calibrate
from calib.runs.diagnose import diagnose
from calib.runs.reopen import stand_of
from calib.runs.run import Run
from calib.show.verdict import judge
from calib.simulation import simulate

from . import arm_worlds
from .test_arm_geometry import opened


def _of_tips(folder):
    """A sound recording of an arm with three balls, one group of which is 3.1 times its sigma."""
    simulate("laser-tracker", folder / "rec", 3)
    calibrate(folder / "rec", folder / "run")


@pytest.fixture(scope="module")
def run(once):
    return Run.open(once(_of_tips) / "run")


@pytest.fixture(scope="module")
def searched(run):
    """What a search of its residuals finds, whatever its summary says: it is sought once."""
    quiet = lambda what, done, total: None  # noqa: E731
    return search(stand_of(run, quiet), quiet)


def diagnosed(run, searched, monkeypatch):
    monkeypatch.setattr("calib.runs.diagnose.search", lambda *_: searched)
    return diagnose(run, refits=False)


def changed(run, **summary):
    return replace(run, summary=run.summary | summary)


def test_chance_makes_one_of_many_groups_look_bad(run):
    """150 groups of three rows: one beyond three sigmas is no news, and one beyond six is."""
    found = run.summary["misfit_by"]
    ratios = {(s, b): x for s, each in found["stop"].items() for b, x in each["bodies"].items()}
    worst = max(ratios, key=ratios.get)
    assert ratios[worst] > 3.0 and not standing_out(run.summary)
    stops = {worst[0]: {"bodies": {worst[1]: 6.0}}}
    spoilt = changed(run, misfit_by=found | {"stop": found["stop"] | stops})
    assert list(outstanding(spoilt.summary)) == [", ".join(worst)]
    assert any("6.0 times larger" in each for each in cautions(spoilt))


def test_the_limit_is_that_of_the_largest_of_so_many(run):
    """Of groups of many, whose scale is known, it is a quantile of chi-square."""
    many = limits({"tool": [3.0] * 2000})["tool"]
    tail = 1 - (1 - ALPHA_BLUNDER) ** (1 / 2000)
    assert many**2 == pytest.approx(special.chdtri(3, tail) / 3, rel=0.05)
    rng = np.random.default_rng(0)
    drawn = np.sqrt(np.square(rng.standard_normal((500, 200, 3))).mean(axis=2).max(axis=1))
    share = np.mean(drawn > limits({"tool": [3.0] * 200})["tool"])
    assert share < 0.02
    few, more = (limits({"tool": [3.0] * n})["tool"] for n in (8, 2000))
    assert few > 2 and more > few - 1


def judged(summary):
    """Where errors are other ones, those of poses, by which a run is judged, are, too."""
    return summary | ({"rms_pose_mm": summary["rms_mm"]} if "rms_mm" in summary else {})


@pytest.mark.parametrize(
    ("summary", "said"),
    [
        ({"misfit": {"tracker": 3.5}}, "residuals of the tracker are 3.5 times larger"),
        ({"rms_mm": {"nominal": 2.0, "fit": 0.1, "held_out": 0.5, "noise_floor": 0.13}},
         "the held-out error is 3.8 times as large as expected"),
        ({"set_aside": ["L01P01:tip_1"]}, "L01P01:tip_1 contradict everything else"),
        ({"rings": [{"what": "shifted", "sentence": "rings of x are numbered 1 too high"}]},
         "rings of x are numbered 1 too high"),
    ],
)  # fmt: skip
def test_what_forbids_belief_takes_the_verdict_along(run, searched, monkeypatch, summary, said):
    spoilt = changed(run, **judged(summary))
    assert any(said in each for each in forbids(spoilt)) and not forbids(run)
    found = diagnosed(spoilt, searched, monkeypatch)
    assert found.verdict == "bad_data"
    assert any("should not be used" in each and said in each for each in found.sentences)
    verdict = judge(spoilt, found.document())
    assert verdict.light == "red" and any(said in each for each in verdict.reasons)


@pytest.mark.parametrize(
    ("summary", "said"),
    [
        ({"misfit": {"tracker": 1.9}}, "residuals of the tracker are 1.9 times larger"),
        ({"rms_mm": {"nominal": 2.0, "fit": 0.1, "held_out": 0.2, "noise_floor": 0.13}},
         "held-out error is 1.5 times as large as expected"),
        ({"rms_mm": {"nominal": 2.0, "fit": 0.1, "held_out": None, "noise_floor": 0.13}},
         "o stops were held out"),
    ],
)  # fmt: skip
def test_what_asks_for_care_is_told_by_both(run, searched, monkeypatch, summary, said):
    """Without scans, too: no structure of beams is there to confirm or not."""
    spoilt = changed(run, **judged(summary))
    found = diagnosed(spoilt, searched, monkeypatch)
    assert found.verdict == "adequate" and any(said in each for each in found.sentences)
    verdict = judge(spoilt, found.document())
    assert verdict.light == "amber" and any(said in each for each in verdict.reasons)


def test_of_a_sound_run_neither_is_told(run, searched, monkeypatch):
    found = diagnosed(run, searched, monkeypatch)
    assert found.verdict == "adequate" and not forbids(run) and not cautions(run)


def test_what_numbers_hardly_are_is_said_of_the_run(tmp_path):
    """A payload in grams: what gives way to it is found all the same, and a thousandth as soft."""
    rng = np.random.default_rng(3)
    opened(tmp_path / "rec", arm_worlds.bent(tmp_path / "rec", "ur10", rng), rng, poses=40)
    table = pd.read_csv(tmp_path / "rec" / "stops.csv")
    for kg, wrong in ((2.0, False), (2000.0, True)):
        table.assign(payload_kg=kg * (np.arange(len(table)) % 3)).to_csv(
            tmp_path / "rec" / "stops.csv", index=False
        )
        run = calibrate([tmp_path / "rec"], tmp_path / f"run{kg}", hold_out="none")
        said = [each for each in cautions(run) if "payload_kg goes up to 4000" in each]
        assert bool(said) == wrong


def test_what_moved_since_a_run_that_was_not_diagnosed_asks_for_that(run, tmp_path):
    """What its model lacks seems to move; where it was diagnosed, or nothing moved, no word."""
    numbers = {"parameters": ["tx"], "units": ["m"], "change": [0.01], "sigma": [1e-4]}
    arm = {"name": "arm_base", "moved": True, "p_value": 1e-6, "freed": 4.0, **numbers}
    earlier = tmp_path / "earlier"
    later = replace(run, model=run.model | {"prior": "../earlier"}, folder=tmp_path / "later")

    def asked(*links):
        found = cautions(replace(later, summary=run.summary | {"links": list(links)}))
        return [each for each in found if "was not diagnosed" in each]

    assert not asked(arm)  # it is gone
    earlier.mkdir()
    (said,) = asked(arm)
    assert f"'rigcal diagnose {earlier}'" in said
    assert not asked(arm | {"moved": False})
    (earlier / "diagnosis.json").write_text("{}")
    assert not asked(arm)
