"""A user's own effects are candidates like the catalogue's: tested, named, added by their names."""

import json
import shutil

import pytest
import yaml

from calib.diagnosis.verdict.unnamed import Unnamed
from calib.effects import load_effects, own_effects
from calib.exporters import export
from calib.rig import load_rig
from calib.runs.add import add
from calib.runs.calibrate import calibrate, grown_model
from calib.runs.diagnose import diagnose
from calib.runs.run import Run
from calib.simulation import Spec, simulate
from calib.view.desk import Desk, Findings
from chains.errors import InputError
from sensors.documents import json_text

from ..thinned import thinned

HUMID = {
    "name": "humid_air",
    "site": "range",
    "unit": "1",
    "sigma": 0.01,
    "basis": ["(humidity - 0.45) * range"],
}
LACKING = HUMID | {"name": "dusty_air", "basis": ["dust"]}
SPEC = Spec(
    lidar="hesai_pandarxt32", room="box", locations=4, stops_per_location=2, column_step=200
)
SEED = 2


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A folder with files of effects, a recording in which one of them is hidden, and its run."""
    folder = tmp_path_factory.mktemp("own")
    (folder / "mine").mkdir()
    (folder / "mine/air.yaml").write_text(yaml.safe_dump([HUMID, LACKING]))
    (folder / "mine/beside.py").write_text("raise SystemExit('it ran')")
    (folder / "humid.yaml").write_text(yaml.safe_dump(HUMID))
    simulate(SPEC, folder / "rec", SEED, {str(folder / "humid.yaml"): 1.5})
    calibrate([folder / "rec"], folder / "run")
    return folder


@pytest.fixture(scope="module")
def diagnosed(made):
    """The run, diagnosed with the folder of effects."""
    run = Run.open(made / "run")
    return run, diagnose(run, candidates=str(made / "mine"))


def moved(made, tmp_path, effects):
    """The recording and run in another folder, where ``rig.yaml`` names effects."""
    rec = shutil.copytree(made / "rec", tmp_path / "rec")
    rig = yaml.safe_load((rec / "rig.yaml").read_text())
    (rec / "rig.yaml").write_text(yaml.safe_dump(rig | {"effects": effects}))
    shutil.copy(made / "humid.yaml", rec)
    return rec


@pytest.mark.long
def test_it_is_named_before_the_catalogue(diagnosed):
    _, found = diagnosed
    assert found.verdict == "missing_effect" and found.worth_adding == ["humid_air"]
    first = found.candidates[0]
    assert first["effect"] == first["add"] == "humid_air" and first["document"] == HUMID
    assert first["parameters"]["names"] == ["amount"] and first["smallest_detectable"] > 0
    assert "humid_air is missing" in found.sentences[0]
    assert all("document" not in c for c in found.candidates[1:])


@pytest.mark.long
def test_without_it_another_takes_its_place(made, monkeypatch):
    """So that the test above tells something. What has no name is not looked for."""
    monkeypatch.setattr("calib.runs.diagnose.unnamed", lambda *_: Unnamed())
    found = diagnose(Run.open(made / "run"), refits=False)
    assert "humid_air" not in json_text(found.document())


def test_what_cannot_be_tested_says_why(diagnosed):
    _, found = diagnosed
    assert found.untestable["dusty_air"] == "the recordings lack dust"
    assert any("dusty_air" in sentence for sentence in found.sentences)


def test_it_is_added_by_the_name_that_was_printed(made, diagnosed, rigcal, tmp_path):
    run, found = diagnosed
    (run.folder / "diagnosis.json").write_text(json_text(found.document()))
    code, said, _ = rigcal("add", run.folder, "humid_air", "-o", tmp_path / "grown")
    assert code == 0 and "humid_air" in said
    grown = Run.open(tmp_path / "grown")
    assert HUMID in grown.model["effects"]
    after = found.candidates[0]["held_out_rms_mm"]["after"]
    assert grown.summary["rms_mm"]["held_out"] == pytest.approx(after, rel=0.02)
    estimate = grown.solution.shared.effects["humid_air"]
    (true,) = json.loads((made / "rec.truth.json").read_text())["effects"]["humid_air"]
    assert abs(estimate.estimate[0] - true) < 4 * estimate.sigma[0]
    offered = Desk.of([run.folder]).addable(Findings.read(run))
    assert next(iter(offered)) == "humid_air" and offered["humid_air"] == HUMID


def test_a_name_that_nobody_printed_is_refused(made):
    with pytest.raises(InputError, match="'humid_are' is not in the catalogue"):
        grown_model(Run.open(made / "run"), ["humid_are"])


def test_a_diagnosis_cannot_replace_what_the_catalogue_has(diagnosed, tmp_path):
    run, found = diagnosed
    other = Run.open(shutil.copytree(run.folder, tmp_path / "run"))
    document = json.loads(json_text(found.document()))
    document["candidates"][0] |= {"effect": "range_scale", "add": "range_scale"}
    (other.folder / "diagnosis.json").write_text(json_text(document))
    assert grown_model(other, ["range_scale"]).effects[-1].origin is None
    assert grown_model(other, ["range_scale"]).effects[-1].document() == "range_scale"


def test_python_that_a_diagnosis_names_does_not_run_unasked(diagnosed, made, tmp_path):
    run, found = diagnosed
    other = Run.open(shutil.copytree(run.folder, tmp_path / "run"))
    document = json.loads(json_text(found.document()))
    python = {"python": str(made / "mine/beside.py"), "name": "X"}
    document["candidates"][0] |= {"document": python}
    (other.folder / "diagnosis.json").write_text(json_text(document))
    with pytest.raises(InputError, match="does not run unasked"):
        grown_model(other, ["humid_air"])
    assert "humid_air" not in Desk.of([other.folder]).addable(Findings.read(other))


def test_a_diagnosis_cannot_slip_a_file_in(diagnosed, made, tmp_path):
    run, found = diagnosed
    other = Run.open(shutil.copytree(run.folder, tmp_path / "run"))
    document = json.loads(json_text(found.document()))
    file = str(made / "mine/beside.py")
    document["candidates"][0] |= {"effect": "range_cyclic", "add": "range_cyclic", "document": file}
    (other.folder / "diagnosis.json").write_text(json_text(document))
    assert file not in Desk.of([other.folder]).addable(Findings.read(other)).values()
    assert grown_model(other, ["range_cyclic"]).names[-1] == "range_cyclic@1"
    with pytest.raises(InputError, match="not in the catalogue"):
        grown_model(other, ["humid_air"])


def test_a_folder_holds_its_formulas_and_runs_nothing(made, tmp_path):
    assert [e.name for e in load_effects(str(made / "mine"))] == ["humid_air", "dusty_air"]
    with pytest.raises(InputError, match="has no file of effects"):
        load_effects(str(tmp_path))


# ---------------------------------------------------------------------------------------- rig.yaml


@pytest.mark.long
def test_a_rig_names_effects_beside_it(made, tmp_path, rigcal):
    """They are candidates of every diagnosis, and go by their names."""
    rec = moved(made, tmp_path, ["humid.yaml"])
    assert [e.name for e in own_effects([load_rig(rec)])] == ["humid_air"]
    run = calibrate([rec], tmp_path / "run", hold_out="none")
    assert diagnose(run, refits=False).worth_adding == ["humid_air"]
    (run.folder / "diagnosis.json").unlink()
    assert add(run, "humid_air", tmp_path / "grown").effects[-1] == "humid_air"
    named = ["--effects", "ring_range_offset,humid_air", "--hold-out", "none"]
    code, _, err = rigcal("fit", rec, "-o", tmp_path / "named", *named)
    assert code == 0, err
    assert Run.open(tmp_path / "named").effects == ("ring_range_offset", "humid_air")


@pytest.mark.parametrize(
    ("effects", "words"),
    [
        (["mine.py"], "no YAML file of formulas"),
        (["gone.yaml"], "does not exist"),
        ("humid.yaml", "effects"),
    ],
)
def test_a_wrong_file_of_a_rig_is_named_with_its_line(made, tmp_path, effects, words):
    rec = moved(made, tmp_path, effects)
    with pytest.raises(InputError, match=r"rig\.yaml:\d+: .*effects") as refused:
        load_rig(rec)
    assert words in str(refused.value)


def test_one_name_for_two_effects_is_refused(made, tmp_path):
    rec = moved(made, tmp_path, ["humid.yaml"])
    other = tmp_path / "other.yaml"
    other.write_text(yaml.safe_dump(HUMID | {"sigma": 0.02}))
    with pytest.raises(InputError, match="another effect is called 'humid_air' too"):
        own_effects([load_rig(rec)], str(other))


# ---------------------------------------------------------------------------------- what follows


def test_an_export_has_its_formula(made, diagnosed, tmp_path):
    run, found = diagnosed
    (run.folder / "diagnosis.json").write_text(json_text(found.document()))
    grown = add(run, "humid_air", tmp_path / "grown")
    export(grown, tmp_path / "out", ["yaml"])
    told = yaml.safe_load((tmp_path / "out/extrinsics.yaml").read_text())["effects"]
    assert "(humidity - 0.45) * range" in told["humid_air"]["formula"]
    assert told["arm_link_length"]["formula"]


@pytest.mark.long
def test_what_no_catalogue_has_is_sized_as_an_independent_simulator_made_it(shared, tmp_path):
    """Ranges that depend on ring x temperature, by 15 mm; see the recordings' README. Every third
    stop of thirty is enough for that."""
    made, rec = shared / "recordings/known_ring_by_temperature", tmp_path / "rec"
    thinned(made, rec, 3, 4)
    basis = ["(temperature - 27) / 4 * (2 * ring / 63 - 1)"]
    effect = HUMID | {"name": "ring_by_temperature", "unit": "m", "basis": basis}
    (tmp_path / "mine.yaml").write_text(yaml.safe_dump(effect))
    run = calibrate([rec], tmp_path / "run")
    found = diagnose(run, refits=False, candidates=str(tmp_path / "mine.yaml"))
    assert found.worth_adding == ["ring_by_temperature"]
    grown = add(run, found.worth_adding, tmp_path / "grown")
    size, sigma = (
        getattr(grown.solution.shared.effects["ring_by_temperature"], which)[0]
        for which in ("estimate", "sigma")
    )
    true, _ = json.loads(made.with_suffix(".truth.json").read_text())["params"]["x_temp_ring"]
    assert abs(size - true) < 4 * sigma < 1e-3
    before, after = (each.summary["rms_mm"]["held_out"] for each in (run, grown))
    assert after < 0.5 * before


# ------------------------------------------------------------------------------------ command line


def test_a_page_of_ones_own(made, rigcal):
    code, said, _ = rigcal("effects", made / "humid.yaml")
    assert code == 0 and "humid_air" in said and "(humidity - 0.45) * range" in said
    code, said, _ = rigcal("effects", made / "mine", "--json")
    assert [page["name"] for page in json.loads(said)] == ["humid_air", "dusty_air"]


@pytest.mark.long
def test_explain_adds_it_as_a_rung(made, rigcal, tmp_path):
    own = ["--candidates", made / "humid.yaml"]
    code, _, err = rigcal("explain", made / "rec", "-o", tmp_path / "ladder", *own)
    assert code == 0, err
    ladder = json.loads((tmp_path / "ladder/explanation.json").read_text())["ladder"]
    assert [rung["added"] for rung in ladder] == [[], ["humid_air"]]


@pytest.mark.long
def test_both_names_of_the_option_are_one(made, rigcal, tmp_path, diagnosed_once):
    run = shutil.copytree(made / "run", tmp_path / "run")
    found = []
    for option in ("--effects", "--candidates"):
        code, said, _ = rigcal("diagnose", run, "--no-refits", "--json", option, made / "mine")
        assert code == 0
        found.append(said)
    assert found[0] == found[1] and "humid_air" in found[0]
