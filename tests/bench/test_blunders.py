"""The benchmark of blunders counts what it says, and its worlds are good recordings."""

from __future__ import annotations

import io
import json

import numpy as np
import pytest
from rich.console import Console

from ..mishaps import MISHAPS, Scene
from .blunders import QUICK, QUICK_RIG, Case, cases, run
from .blunders_table import NOTHING, false_names, show, verdict
from .blunders_worlds import RIGS, SHARED, made, preset

CALM = {
    "case": "all/0/two scans exchanged x10",
    "rig": "all",
    "kind": "two scans exchanged",
    "times": 10,
    "outcome": "adequate",
    "right": ["A:scan", "B:scan"],
    "group": ["A:*"],
    "blunders": [],
    "names": [],
    "odd": [],
    "sentence": "",
    "seconds": [0.1, 1.0, 1.0],
    "off": [["lidar.tx", 9.0, True]],
    "told_off": 1.0,
    "moved": 0.5,
    "without_it": {"outcome": "adequate", "names": [], "odd": []},
}


def bad(*blunders, **more):
    return CALM | {"outcome": "bad_data", "blunders": list(blunders)} | more


EFFECT = CALM | {"outcome": "missing_effect", "names": ["range_scale"]}


@pytest.mark.parametrize(
    ("result", "wanted"),
    [
        (CALM, "calm"),
        (CALM | {"told_off": 4.1, "moved": 3.1}, "silent"),
        (CALM | {"told_off": 4.1}, "calm"),  # and so it is in the good recording
        (CALM | {"told_off": 4.1, "without_it": {}}, "silent"),  # which is this one
        (CALM | {"moved": 3.1}, "moved"),
        (CALM | {"outcome": "refused"}, "refused"),
        (CALM | {"outcome": "endless"}, "endless"),
        (CALM | {"outcome": "not converged", "told_off": 9.0}, "not converged"),
        (bad(["B:scan"]), "right"),
        (bad(["A:joints"]), "group"),
        (bad(["C:joints", "B:scan"]), "group"),
        (bad(["C:joints"]), "alarm"),
        (bad(["B:scan"], outcome="not converged"), "right"),
        (CALM | {"outcome": "missing_effect", "names": ["range_scale"]}, "alarm"),
        (EFFECT | {"rivals": {"range_scale": ["B:scan", "faro_scale"]}}, "group"),
        (EFFECT | {"rivals": {"range_scale": ["faro_scale"]}}, "alarm"),
    ],
)
def test_a_case_has_its_class(result, wanted):
    assert verdict(result) == wanted


def test_what_is_said_without_the_mishap_is_no_word_on_it():
    said = {"outcome": "missing_effect", "names": ["range_scale"], "odd": []}
    result = CALM | said | {"without_it": said, "told_off": 5.0, "moved": 4.0}
    assert verdict(result) == "silent"
    assert verdict(result | {"names": ["faro_scale"]}) == "alarm"


def test_names_that_are_neither_right_nor_in_the_group_are_false():
    assert false_names(bad(["B:scan"], ["C:joints"], ["A:x"])) == ["C:joints"]


def test_the_table_shows_what_is_wrong():
    null = CALM | {"case": "all/0/nothing x0", "kind": NOTHING, "right": [], "without_it": {}}
    wrong = CALM | {"told_off": 9.0, "moved": 8.0, "seconds": [0.1, 9.0, 1.0]}
    failed = {"case": "all/1/nothing x0", "error": "Traceback\nValueError: no"}
    text = io.StringIO()
    show([null, wrong, failed], Console(file=text, width=200))
    lines = text.getvalue().splitlines()
    assert "SILENTLY WRONG: all/0/two scans exchanged x10: lidar.tx 9.0 sigma" in lines
    assert "FAILED: all/1/nothing x0: ValueError: no" in lines
    (gross,) = (line.split() for line in lines if line.strip().startswith("gross, with a name"))
    assert gross[4:] == [*"1.......1...1", "0.00"]


def test_sizes_of_a_kind_are_in_one_recording():
    features = {"own all": {"arm", "tracker", "base", "poses", "mesh", "lidar", "targets"}}
    listed = list(cases(["own all"], "*", 5, features))
    assert {c.kind for c in listed} == set(MISHAPS)
    assert len({c.name for c in listed}) == len(listed)
    one = [c for c in listed if c.kind == "a sphere misplaced"]
    assert [c.times for c in one] == [1, 3, 10] and len({c.number for c in one}) == 1
    few = list(cases(["own all"], "*", 5, {"own all": {"lidar"}}))
    assert {c.kind for c in few} < {c.kind for c in listed}
    assert set(QUICK) <= set(MISHAPS) and QUICK_RIG in RIGS


@pytest.mark.long
def test_a_case_is_run_from_the_files_to_the_judgement(tmp_path, monkeypatch):
    monkeypatch.setitem(RIGS, "own all", preset("tiny"))  # twelve stops
    null = run(Case("own all", 0), tmp_path, {})
    assert null["outcome"] == "adequate" and null["told_off"] < 4
    assert json.loads(json.dumps(null)) == null
    again = run(Case("own all", 0, "quaternions of either sign", 10), tmp_path, null)
    assert verdict(again) == "calm" and again["moved"] < 1e-3
    sign = run(Case("own all", 0, "CAD of the sensor of wrong sign", 10), tmp_path, null)
    assert sign["moved"] > 3


@pytest.mark.parametrize("rig", [r for r in RIGS if not r.startswith("own")])
def test_a_rig_has_what_its_name_says(tmp_path, rig):
    if not SHARED.is_dir():
        pytest.skip(f"the recordings of the independent simulator are not here: {SHARED}")
    scene = Scene(made(rig, 0, tmp_path / "recording"), np.random.default_rng())
    lacks = {
        "all": set(),
        "no arm": {"arm", "base"},
        "no mesh": {"mesh", "targets"},
        "no tracker": {"tracker", "base", "poses", "targets"},
        "arm alone": {"base", "mesh", "lidar", "targets"},
    }
    whole = {"arm", "tracker", "base", "poses", "mesh", "lidar", "targets"}
    assert scene.features() == whole - lacks[rig]
