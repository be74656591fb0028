"""What a diagnosis says of recordings whose truth is known, and what its file holds."""

import json
import math
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from calib.diagnosis.verdict.names import _names_hold
from calib.diagnosis.verdict.sentences import rival_sentence
from calib.runs.calibrate import calibrate, grow, grown_model
from calib.runs.diagnose import diagnose
from calib.runs.run import Run
from calib.show.diagnosis import print_diagnosis
from calib.simulation import Spec, simulate
from chains.errors import InputError
from sensors.recording import RecordedStops

HIDDEN = "incidence_angle_bias"
SMALL = Spec(
    lidar="hesai_pandarxt32", locations=3, stops_per_location=2, column_step=200, room="box"
)
SEED = 1
CANDIDATE = {
    "effect",
    "site",
    "p_value",
    "p_adjusted",
    "statistic",
    "dof",
    "held_out_rms_mm",
    "rejected_share",
    "error_explained",
    "parameters",
    "smallest_detectable",
    "indistinguishable_from",
}


@pytest.fixture(scope="module")
def studies(tmp_path_factory):
    """Folder, run and diagnosis of a recording where nothing is hidden, and of one with a bias."""
    folder, out = tmp_path_factory.mktemp("diagnose"), {}
    for name, hide in (("null", {}), ("hidden", {HIDDEN: 3.0})):
        simulate(SMALL, folder / name, SEED, hide)
        run = calibrate([folder / name], folder / f"{name}-run")
        out[name] = run, diagnose(run)
    return out


@pytest.fixture(params=["null", "hidden"])
def study(studies, request):
    """A run, its diagnosis, and the file of that."""
    run, diagnosis = studies[request.param]
    return run, diagnosis, json.loads((run.folder / "diagnosis.json").read_text())


@pytest.fixture
def copied(studies, tmp_path):
    """A copy of the run where nothing is hidden, fitted to a copy of its recording."""
    run, _ = studies["null"]
    recording = shutil.copytree(run.recordings[0], tmp_path / "rec")
    folder = shutil.copytree(run.folder, tmp_path / "run")
    text = (folder / "model.yaml").read_text().replace(str(run.recordings[0]), str(recording))
    (folder / "model.yaml").write_text(text)
    (folder / "diagnosis.json").unlink()
    return Run.open(folder)


def numbers(data):
    """Every number of a document, however deep."""
    if isinstance(data, dict):
        data = list(data.values())
    if isinstance(data, list):
        return [n for each in data for n in numbers(each)]
    return [data] if isinstance(data, int | float) else []


# ---------------------------------------------------------------------------------------- verdicts


@pytest.mark.long
def test_where_nothing_is_hidden_the_model_is_adequate(studies):
    _, found = studies["null"]
    assert found.verdict == "adequate"
    assert found.worth_adding == [] and found.unexplained == []
    assert "adequate" in found.sentences[0]
    assert all(
        c["step"] is None and c["held_out_rms_mm"]["after"] is None for c in found.candidates
    )


def test_a_hidden_effect_is_named_first_and_sized(studies):
    run, found = studies["hidden"]
    assert found.verdict == "missing_effect" and found.worth_adding == [HIDDEN]
    first = found.candidates[0]
    assert first["effect"] == HIDDEN and first["step"] == 1
    # Six stops, and one wall that holds half of the information.
    assert first["p_adjusted"] < min(0.01, found.candidates[1]["p_adjusted"])
    assert HIDDEN in found.sentences[0]
    truth = json.loads(run.recordings[0].with_suffix(".truth.json").read_text())
    (true_m,) = truth["effects"][HIDDEN]
    # One step from a fit that lacks it, so a rough size; the refit below is sharp.
    assert first["parameters"]["estimate"][0] == pytest.approx(true_m, rel=0.5)


def test_the_fall_of_the_held_out_error_is_that_of_adding_the_effect(studies, tmp_path):
    run, found = studies["hidden"]
    before, after = (found.candidates[0]["held_out_rms_mm"][k] for k in ("before", "after"))
    assert before == run.summary["rms_mm"]["held_out"]
    grown = grow(run, grown_model(run, [found.candidates[0]["add"]]), tmp_path / "grown")
    assert grown.summary["rms_mm"]["held_out"] == pytest.approx(after, rel=0.02)
    assert after < 0.5 * before
    assert 0.8 < found.candidates[0]["error_explained"] <= 1.0
    truth = json.loads(run.recordings[0].with_suffix(".truth.json").read_text())
    effect = grown.solution.shared.effects[HIDDEN]
    assert abs(effect.estimate[0] - truth["effects"][HIDDEN][0]) < 4 * effect.sigma[0]
    again = diagnose(grown, refits=False)
    assert HIDDEN not in {c["effect"] for c in again.candidates}
    assert again.verdict == "adequate"


def test_without_refits_the_same_is_found_and_no_fall_is_claimed(studies, tmp_path):
    run, found = studies["hidden"]
    copy = Run.open(shutil.copytree(run.folder, tmp_path / "run"))
    quick = diagnose(copy, refits=False)
    assert quick.worth_adding == found.worth_adding
    assert quick.candidates[0]["held_out_rms_mm"] == {"before": None, "after": None}
    assert "held-out" not in quick.sentences[0]


# ---------------------------------------------------------------------------------------- the file


def test_the_file_has_what_the_contract_says(study):
    _, found, written = study
    assert written["verdict"] == found.verdict
    assert written["sentences"] == list(found.sentences)
    assert {"candidates", "unexplained", "weak_directions"} <= written.keys()
    assert len(written["candidates"]) > 10
    for each in written["candidates"]:
        assert each.keys() >= CANDIDATE
        assert each["held_out_rms_mm"].keys() == {"before", "after"}
        assert each["parameters"].keys() == {"unit", "names", "estimate", "sigma"}
        lengths = {len(each["parameters"][k]) for k in ("names", "estimate", "sigma")}
        assert len(lengths) == 1, each["effect"]
        assert each["dof"] >= 1 and each["statistic"] >= 0
    assert written["weak_directions"], "mounts that only their sum is seen of"
    for direction in written["weak_directions"]:
        assert direction["parameters"] and direction["sigma_mm"] > 0 and direction["needs"]


def test_every_number_is_one(study):
    _, _, written = study
    for each in written["candidates"]:
        assert all(map(math.isfinite, numbers(each))), each["effect"]
        assert None not in each["parameters"]["estimate"] + each["parameters"]["sigma"]
        for key in ("p_value", "p_adjusted"):
            assert 1e-6 <= each[key] <= 1.0, each["effect"]
        assert each["p_value"] <= each["p_adjusted"], each["effect"]


def test_candidates_are_ranked_and_none_is_in_the_model(study):
    run, _, written = study
    names = [c["effect"] for c in written["candidates"]]
    assert len(names) == len(set(names)) and not set(names) & set(run.effects)
    steps = [c["step"] for c in written["candidates"]]
    confirmed = [s for s in steps if s]
    assert confirmed == sorted(confirmed) and steps[: len(confirmed)] == confirmed
    assert not set(names) & set(written["untestable"])


def test_what_cannot_be_seen_is_not_tested(studies):
    """One range zero for all rings is what the rings' own zeros do together."""
    _, found = studies["null"]
    assert "absorbed by the model" in found.untestable["range_offset"]


# ------------------------------------------------------------------------------------------ people


def test_people_read_it_in_mm_and_within_100_columns(studies, capsys):
    run, found = studies["hidden"]
    print_diagnosis(found, run.summary["residual"])
    out = capsys.readouterr().out
    # In one line, ready to be pasted.
    commands = [found.command, *(remedy["plan"] for remedy in found.remedies)]
    assert max(len(line) for line in out.splitlines() if line not in commands) <= 100
    row = next(line for line in out.splitlines() if line.startswith("1 "))
    estimate_m, sigma_m = (found.candidates[0]["parameters"][k][0] for k in ("estimate", "sigma"))
    before, after = (found.candidates[0]["held_out_rms_mm"][k] for k in ("before", "after"))
    p = f"{found.candidates[0]['p_adjusted']:.2g}"
    assert f"{before:.2f} -> {after:.2f}" in row and p in row
    assert f"{1e3 * estimate_m:+.2f} ± {1e3 * sigma_m:.2f} mm" in row
    assert "range_offset" in out.split("what could not be tested")[1]
    assert "found from" not in out


def test_people_read_of_what_was_not_seen_at_all(studies, capsys):
    """Then it has no size in mm."""
    _, found = studies["null"]
    unseen = {"parameters": ["arm_end"], "sigma_mm": None, "needs": "stops that move it"}
    print_diagnosis(replace(found, weak_directions=[unseen]))
    assert "arm_end  stops that move it" in capsys.readouterr().out


def test_of_an_adequate_model_people_read_what_would_have_been_found(studies, capsys):
    _, found = studies["null"]
    print_diagnosis(found)
    out = capsys.readouterr().out
    size_m = next(c for c in found.candidates if c["effect"] == HIDDEN)["smallest_detectable"]
    assert 1e-5 < size_m < 1e-2
    line = next(x for x in out.split("found from")[-1].splitlines() if HIDDEN in x)
    assert f"{1e3 * size_m:.2g}" in line and "mm" in line


def test_every_kind_of_mishap_has_a_size_from_which_it_is_found(studies):
    _, found = studies["null"]
    document = found.document()
    sizes, kinds = document["detectable"], {g["token"]: g["kind"] for g in document["groups"]}
    assert {"body", "joints", "scan", "target", "frame"} <= set(kinds.values())
    assert sizes.keys() == {*kinds, "rings", "mesh:scale"}
    # None where one direction is checked by nothing, as a turn of a scan that meets a floor alone.
    assert {kinds[token] for token in kinds if not sizes[token]} <= {"scan"}
    assert 0 < sizes["rings"]["rad"] < 0.1
    scale = next(c for c in found.candidates if c["effect"] == "faro_scale")
    assert 0 < scale["smallest_detectable"] < 0.01
    assert sizes["mesh:scale"] == {"1": scale["smallest_detectable"]}


def test_rivals_and_structure_are_printed(studies, capsys):
    _, found = studies["hidden"]
    first = {**found.candidates[0], "indistinguishable_from": ["faro_scale"]}
    formula = {"name": "empirical_azimuth"}
    left = {"covariates": ["ring", "azimuth_rad"], "rms_mm": 1.94, "p_adjusted": 3e-5}
    print_diagnosis(replace(found, candidates=[first], unexplained=[{**left, "formula": formula}]))
    lines = [" ".join(line.split()) for line in capsys.readouterr().out.splitlines()]
    at = lines.index("not distinguishable on these data")
    assert lines[at + 1] == f"{HIDDEN} faro_scale"
    assert "ring x azimuth_rad 3e-05 1.94 empirical_azimuth" in lines


@pytest.mark.parametrize(
    ("odds", "said"),
    [
        (2.54, "not distinguishable from faro_scale (odds 2.5 to 1); some stops would"),
        (0.4, "not distinguishable from faro_scale (odds 1 to 2.5); some stops would"),
        (1 / 4567, "faro_scale explains more (odds 1 to 4,567); some stops would separate them."),
        (1e-80, "faro_scale explains more (odds 1 to more than a million);"),
    ],
)
def test_a_rival_is_told_with_its_odds(odds, said):
    """At which it cannot be told from an effect; beyond 20 to 1 against that it explains more."""
    rival = {"effect": "faro_scale", "odds": odds, "separate": "some stops"}
    assert said in rival_sentence(rival)


# --------------------------------------------------------------------------------------- bad input


def test_a_recording_that_has_moved_is_said(copied, tmp_path):
    (tmp_path / "rec").rename(tmp_path / "elsewhere")
    with pytest.raises(InputError, match=r"no longer there.*rigcal fit"):
        diagnose(copied)
    assert not (copied.folder / "diagnosis.json").exists()


def test_a_recording_that_has_changed_is_said(copied):
    stops = Path(copied.recordings[0] / "stops.csv")
    stops.write_text(stops.read_text().replace("L00", "L99"))
    with pytest.raises(InputError, match=r"has changed since"):
        diagnose(copied)


def test_a_run_without_a_state_is_said(copied):
    (copied.folder / "state.npz").unlink()
    with pytest.raises(InputError, match=r"state.npz is missing.*fit it again"):
        diagnose(copied)


def test_a_column_of_ones_own_is_a_covariate_that_structure_may_hang_on(copied, tmp_path):
    """Any extra column of stops.csv is looked at, whether or not an effect of the catalogue is."""
    path = copied.recordings[0] / "stops.csv"
    head, *rows = path.read_text().splitlines()
    draughts = np.linspace(0, 1, len(rows))
    rows = [f"{row},{value}" for row, value in zip(rows, draughts, strict=True)]
    path.write_text("\n".join([f"{head},draught", *rows, ""]))
    assert RecordedStops.open(copied.recordings[0], (), (), 32).covariates
    run = calibrate([copied.recordings[0]], tmp_path / "draughty")
    found = diagnose(run)
    assert found.verdict == "adequate"
    assert ("draught",) in {curve.covariates for curve in found.curves}


@pytest.mark.parametrize(("looks", "hold"), [(1.0, False), (30.0, True)])
def test_a_name_is_held_against_structure_at_the_price_of_both(looks, hold):
    """Structure that explains a little more, found among many, is no better than a name."""

    def explains(evidence, looks):
        # Of two degrees of freedom the tail is exp(-x / 2).
        test = SimpleNamespace(statistic=2 * evidence, dof=2, columns=[0, 1])
        effect = SimpleNamespace(name="bins", family="bins", params=lambda rig: [])
        return SimpleNamespace(test=test, looks=looks, effect=effect)

    named = explains(50.0, 30.0)

    def names_hold(bins, left):
        looks = [SimpleNamespace(named=SimpleNamespace(common=1.0)) for _ in range(2)]
        for look, candidate in zip(looks, (bins, explains(left, looks)), strict=True):
            look.unnamed = SimpleNamespace(candidates=[candidate])
        rig = SimpleNamespace(joint_names=[])
        looks[0].stand = SimpleNamespace(sources=[SimpleNamespace(rig=rig)])
        step = SimpleNamespace(candidate=named, before=looks[0])
        return _names_hold(SimpleNamespace(looks=looks, found=[step]))

    assert names_hold(explains(52.0, looks), left=2.0) == hold
    # In its place it explains no more than the name does, and what that leaves it.
    much = explains(60.0, 30.0)
    assert names_hold(much, left=1.0) and not names_hold(much, left=9.0)
