"""Runs that grow from runs: what they take over, what they refuse, and the ladder they make."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import calib
from calib.effects import Effect, find
from calib.problem.model import Model
from calib.results.solution import EffectEstimate
from calib.runs.calibrate import calibrate, grow, grown_model
from calib.runs.ladder import ladder
from calib.runs.reopen import reopened
from calib.runs.run import Run
from chains.errors import InputError
from sensors.documents import read_yaml, write_json

from . import rigs

SMALL = Model(("ring_range_offset",), ("mount.tx",))
NOTHING = {
    "verdict": "adequate",
    "heading": "the model is adequate",
    "too_few_stops": False,
    "command": None,
    **{name: [] for name in ("sentences", "candidates", "unexplained", "weak_directions")},
    **{name: [] for name in ("curves", "blunders", "groups")},
}
FORMULA = """\
name: lean
site: range
unit: m
sigma: 0.01
basis: ["sin(2 * azimuth)", "cos(2 * azimuth)"]
"""


def diagnosis(*candidates):
    """A diagnosis with these candidates."""
    empty = ("p_adjusted", "step", "dressed_up", "held_out_rms_mm", "unabsorbed_rms_mm")
    return NOTHING | {"candidates": [dict.fromkeys(empty) | c for c in candidates]}


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A folder with a recording, a run of it, and one that grew from that."""
    folder = tmp_path_factory.mktemp("grow")
    rigs.write(folder / "rec", seed=4)
    first = calibrate([folder / "rec"], folder / "first", SMALL, "stop", folds=2)
    return first, calib.add(first, ["arm_joint_offset", "mount_slip@150"], folder / "second")


@pytest.fixture
def first(made, tmp_path):
    """A copy of the first run, to be changed."""
    return Run.open(shutil.copytree(made[0].folder, tmp_path / "run"))


def test_a_run_says_where_its_fit_stood(made):
    run = made[0]
    state = run.state()
    assert {"faro", "gravity", "root@a", "root@b", "joints@s1", "arm_base"} <= state.keys()
    assert any(name.startswith("target:") for name in state)
    np.testing.assert_allclose(
        state["faro"], run.solution.shared.frames["faro"].T_parent_child, atol=1e-12
    )
    rings = run.solution.shared.effects["ring_range_offset"]
    assert tuple(state["ring_range_offset.dofs"]) == rings.names
    np.testing.assert_allclose(state["ring_range_offset"], rings.estimate, atol=1e-12)
    assert "tx" not in state["mount.dofs"]
    for kind in ("surface", "region", "patch"):
        name = f"0/reference_{kind}"
        assert len(state[name]) == len(state[f"{name}.dofs"]) > 3


def test_a_grown_run_has_the_same_recordings_choices_and_more_effects(made):
    first, second = made
    was, now = first.model, second.model
    assert second.grown_from == first.folder.resolve() and first.grown_from is None
    assert now["steps"] == [Model.read(was).document()] and was["steps"] == []
    assert now["effects"] == [*was["effects"], "arm_joint_offset", "mount_slip@150"]
    for key in ("recordings", "fixed", "hold_out", "folds", "prior"):
        assert now[key] == was[key], key
    assert now["fixed"] == ["mount.tx"] and now["folds"] == 2 and now["hold_out"] == "stop"
    assert second.summary["converged"]
    assert second.summary["rms_mm"]["held_out"] is not None


def test_a_grown_run_is_the_one_that_a_fit_from_nothing_gives(made, tmp_path):
    _, second = made
    rec = second.recordings[0]
    anew = calibrate([rec], tmp_path / "anew", Model.read(second.model), "stop", folds=2)
    for kind, rms in anew.summary["rms_mm"].items():
        assert second.summary["rms_mm"][kind] == pytest.approx(rms, rel=0.01), kind
    assert second.summary["iterations"] < anew.summary["iterations"]
    here, there = (run.solution.shared.effects for run in (second, anew))
    for name, effect in there.items():
        off = (here[name].estimate - effect.estimate)[effect.sigma > 0]
        assert np.abs(off / effect.sigma[effect.sigma > 0]).max() < 0.15, name


def test_a_run_may_grow_smaller(made, tmp_path):
    _, second = made
    model = Model.read(second.model).minus(["mount_slip@150"])
    third = grow(second, model, tmp_path / "third")
    assert third.effects == ("ring_range_offset", "arm_joint_offset")
    assert [rung.dropped for rung in ladder([third])][-1] == ["mount_slip@150"]


def test_a_users_effect_is_written_so_that_it_can_be_read_again(first, tmp_path):
    (tmp_path / "lean.yaml").write_text(FORMULA)
    second = grow(first, grown_model(first, [str(tmp_path / "lean.yaml")]), tmp_path / "lean")
    (tmp_path / "lean.yaml").unlink()
    assert second.effects[-1] == "lean"
    third = grow(second, grown_model(second, ["arm_joint_offset"]), tmp_path / "more")
    assert third.effects == ("ring_range_offset", "lean", "arm_joint_offset")
    assert third.solution.shared.effects["lean"].names == ("p1", "p2")
    again = Model.read(third.model)
    expected = {"effects": third.model["effects"], "fixed": ["mount.tx"], "without": []}
    assert again.document() == expected
    with pytest.raises(InputError, match="lean"):
        again.plus([e for e in again.effects if e.name == "lean"])


# --------------------------------------------------------------------------------------- shapes


def chosen(run, *names):
    return grown_model(run, names).names[1:]


def test_a_shape_is_what_is_written_or_what_the_diagnosis_found_or_the_usual(first):
    assert chosen(first, "range_cyclic@0.7") == ("range_cyclic@0.7",)
    usual = find("range_cyclic").shape
    assert chosen(first, "range_cyclic") == (f"range_cyclic@{usual:.6g}",)
    candidates = [
        {"effect": "range_cyclic", "add": "range_cyclic@1.9"},
        {"effect": "range_cyclic", "add": "range_cyclic@0.5"},
        {"effect": "arm_joint_offset", "add": "arm_joint_offset"},
    ]
    write_json(first.folder / "diagnosis.json", diagnosis(*candidates))
    assert chosen(first, "range_cyclic") == ("range_cyclic@1.9",), "the best, which is the first"
    assert chosen(first, "range_cyclic@0.7") == ("range_cyclic@0.7",)
    assert chosen(first, "near_range_bias")[0].startswith("near_range_bias@")
    assert chosen(first, "arm_joint_offset") == ("arm_joint_offset",)


def test_two_shapes_of_one_effect_are_two_effects(first):
    model = grown_model(first, ["range_cyclic@0.7", "range_cyclic@1.3"])
    assert model.names[1:] == ("range_cyclic@0.7", "range_cyclic@1.3")
    assert model.minus(["range_cyclic@0.7"]).names[1:] == ("range_cyclic@1.3",)


@pytest.mark.parametrize(
    "text", ["{", "[]", "{}", json.dumps(NOTHING | {"candidates": [3]}), json.dumps(diagnosis({}))]
)
def test_a_diagnosis_that_cannot_be_read_is_said(first, text):
    (first.folder / "diagnosis.json").write_text(text)
    with pytest.raises(InputError, match=r"diagnosis.json is no diagnosis of this version"):
        grown_model(first, ["range_cyclic"])


# --------------------------------------------------------------------------------------- refusals


@pytest.mark.parametrize(
    ("effect", "words"),
    [
        ("ring_range_offset", "in the model already"),
        ("arm_joint_ofset", "did you mean 'arm_joint_offset'"),
        ("arm_joint_offset@3", "no shape"),
        ("nowhere.yaml", "nowhere.yaml does not exist"),
    ],
)
def test_an_effect_that_cannot_be_added_is_refused(first, effect, words):
    with pytest.raises(InputError, match=words):
        grown_model(first, [effect])


def test_an_effect_twice_is_refused_whatever_its_shape_is_called(first):
    usual = find("range_cyclic").shape
    with pytest.raises(InputError, match="already"):
        grown_model(first, [f"range_cyclic@{usual}", "range_cyclic"])


def test_an_effect_that_the_model_has_not_cannot_be_dropped():
    with pytest.raises(InputError, match="did you mean arm_joint_offset"):
        Model().minus(["arm_joint_ofset"])
    held = ("arm_joint_offset.turn", "arm_joint_offset", "lidar.tz")
    assert Model(fixed=held).minus(["arm_joint_offset"]).fixed == ("lidar.tz",)


def test_an_effect_may_not_be_called_as_a_frame_is(first, tmp_path):
    (tmp_path / "lean.yaml").write_text(FORMULA.replace("lean", "lidar"))
    with pytest.raises(InputError, match="'lidar'"):
        grow(first, grown_model(first, [str(tmp_path / "lean.yaml")]), tmp_path / "out")


def test_an_effect_with_nothing_to_act_on_is_refused(first, tmp_path):
    class Idle(Effect):
        name, site = "idle", find("ring_range_offset").site

        def params(self, rig):
            return ()

        def basis(self, view):
            raise AssertionError

    with pytest.raises(InputError, match="'idle' has nothing to act on"):
        grow(first, Model.read(first.model).plus([Idle()]), tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_recordings_must_be_what_they_were(first, tmp_path):
    copy = shutil.copytree(first.recordings[0], tmp_path / "rec")
    told = first.model["recordings"][0] | {"path": str(copy)}
    run = replace(first, model=first.model | {"recordings": [told]})
    model = grown_model(run, ["arm_joint_offset"])
    stops = (copy / "stops.csv").read_text()
    (copy / "stops.csv").write_text(stops.replace("s3,b", "s3,c"))
    with pytest.raises(InputError, match=r"has changed since .*rigcal fit"):
        grow(run, model, tmp_path / "out")
    shutil.rmtree(copy)
    with pytest.raises(InputError, match=r"no longer there.*rigcal fit"):
        grow(run, model, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_recording_stays_open_only_while_it_is_what_it_was(first, tmp_path):
    copy = shutil.copytree(first.recordings[0], tmp_path / "rec")
    told = first.model["recordings"][0] | {"path": str(copy)}
    run = replace(first, model=first.model | {"recordings": [told]})
    assert reopened(run)[0] is reopened(run)[0]
    stops = (copy / "stops.csv").read_text()
    (copy / "stops.csv").write_text(stops.replace("s3,b", "s3,c"))
    with pytest.raises(InputError, match="has changed since"):
        reopened(run)


def test_a_run_without_a_state_is_of_an_earlier_version(first, tmp_path):
    (first.folder / "state.npz").write_bytes(b"PK no longer")
    with pytest.raises(InputError, match=r"state.npz is no whole NumPy file"):
        first.state()
    (first.folder / "state.npz").unlink()
    with pytest.raises(InputError, match="made by an earlier version; fit it again"):
        grow(first, SMALL, tmp_path / "out")


def test_a_run_cannot_replace_what_it_grows_from(first):
    with pytest.raises(InputError, match="give another"):
        grow(first, SMALL, first.folder)
    assert Run.open(first.folder).summary == first.summary


# ------------------------------------------------------------------------------------------ ladder


def rungs(*runs):
    return [
        (Path(d["run"]).name, d["added"], d["dropped"])
        for d in (rung.document() for rung in ladder(runs))
    ]


GROWN = [("first", [], []), ("second", ["arm_joint_offset", "mount_slip@150"], [])]


def test_the_ladder_goes_down_to_the_root_of_a_single_run(made):
    first, second = made
    assert rungs(second) == rungs(second, first) == rungs(first, second) == GROWN
    assert rungs(first) == []
    document = ladder([second])[1].document()
    assert document["grown_from"] == str(first.folder.resolve())
    for key, kind in (("held_out_rms_mm", "held_out"), ("fit_rms_mm", "fit")):
        assert document[key] == second.summary["rms_mm"][kind]
    assert document["noise_floor_mm"] == second.summary["rms_mm"]["noise_floor"]


def test_runs_that_have_nothing_to_do_with_it_are_not_on_the_ladder(made, first):
    assert rungs(first, made[1], made[0]) == GROWN
    assert rungs(first, made[0]) == []


def test_a_ladder_whose_foot_is_gone_says_so(made):
    _, second = made
    lost = replace(second, model=second.model | {"grown_from": "/nowhere/at/all"})
    assert rungs(lost) == [("second", None, None)]
    assert json.loads(json.dumps(ladder([lost])[0].document()))["grown_from"] == "/nowhere/at/all"


def test_runs_that_grew_in_a_circle_end(made):
    """A run made anew from what had grown from it."""
    first, second = made
    bent = replace(first, model=first.model | {"grown_from": str(second.folder)})
    assert len(rungs(bent, second)) == 2


# ------------------------------------------------------------------------------------------- units


def test_parameters_of_several_units_have_one_each(made, first):
    _, second = made
    slip = second.solution.shared.effects["mount_slip@150"]
    kinds = {"r": "rad", "t": "m"}
    assert slip.units == tuple(kinds[name[0]] for name in slip.names)
    assert slip.unit == ", ".join(slip.units) and len(slip.units) == 6
    rings = second.solution.shared.effects["ring_range_offset"]
    assert rings.unit == "m" and set(rings.units) == {"m"} and len(rings.units) == rigs.RINGS
    written = read_yaml(second.folder / "solution.yaml")[0]["effects"]
    assert written["mount_slip@150"]["unit"] == slip.unit
    assert EffectEstimate("m", ("a", "b"), np.zeros(2), np.ones(2)).units == ("m", "m")


def test_recordings_of_one_rig_keep_a_table_for_every_stop(tmp_path):
    for seed in (4, 5):
        rigs.write(tmp_path / f"rec{seed}", seed=seed)
    folders = [tmp_path / "rec4", tmp_path / "rec5"]
    run = calibrate(folders, tmp_path / "run", SMALL, "none")
    found = (run.folder / "residuals.parquet").glob("[!_]*")
    tables = sorted(path.name for path in found)
    assert tables == [f"box.{k}.{stop}.parquet" for k in (0, 1) for stop in sorted(rigs.STOPS)]
