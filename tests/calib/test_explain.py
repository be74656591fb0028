"""The loop that explains: what it adds, refuses, drops and keeps, and how it takes up again."""

import json
import shutil
from types import SimpleNamespace

import pytest

from calib.problem.model import Model
from calib.runs import explain as module
from calib.runs.explain import EXPLANATION, MOST_RUNGS, explain
from calib.runs.run import Run
from calib.show.diagnosis import print_explanation
from calib.simulation import simulate
from chains.errors import InputError

from .test_diagnose import HIDDEN, SEED, SMALL

A, B, C = "incidence_angle_bias", "arm_axis_tilt", "beam_origin_offset"


class World:
    """Stands in for fits and diagnoses: the error of each set of effects, and what is then named.

    Args:
        errors: effects beside those of the first fit -> held-out rms.
        named: the same -> what the diagnosis of that model calls worth adding.
        spoiled: what a diagnosis says to leave out, as long as it is not.
        judged: effect -> its parameters and rivals; of others `KNOWN`.
        each: the same as of `errors` -> rms of each stop held out.
    """

    def __init__(self, errors, named, spoiled=(), judged=None, each=None):
        self.errors, self.named, self.spoiled, self.fits = errors, named, spoiled, []
        self.judged, self.each, self.refits = judged or {}, each or {}, []

    def run(self, out, model, below=None):
        names = frozenset(model.names) - frozenset(Model().names)
        self.fits.append(names)
        out.mkdir(parents=True)
        error = self.errors[names] + 5.0 * len(model.without)
        rms = {"fit": error, "held_out": error, "noise_floor": 1.0}
        grown_from = str(below.folder.resolve()) if below else None
        summary = {"rms_mm": rms, "converged": True, "held_out_each_mm": self.each.get(names)}
        return Run(out, model.document() | {"grown_from": grown_from}, summary, None)

    def diagnose(self, run, progress, refits, candidates=(), kept=None):
        self.refits.append(refits)
        names = frozenset(run.effects) - frozenset(Model().names)
        adding = self.named.get(names, [])
        verdict = "missing_effect" if adding else "adequate"
        spoiled = [token for token in self.spoiled if token not in run.model["without"]]
        return SimpleNamespace(
            worth_adding=adding,
            candidates=[{"add": name, **self.judged.get(name, KNOWN)} for name in adding],
            formulas={},
            blunders=[{"without": token} for token in spoiled],
            verdict="bad_data" if spoiled else verdict,
            sentences=[str(sorted(names))],
        )


KNOWN = {"dof": 1, "rivals": []}


def of(*names):
    return frozenset(names)


@pytest.fixture
def climbed(monkeypatch, tmp_path):
    """A function that explains a `World`, and gives the explanation."""

    def climb(world):
        monkeypatch.setattr(
            module, "calibrate", lambda recordings, out, model, progress: world.run(out, model)
        )
        monkeypatch.setattr(
            module, "grow", lambda run, model, out, progress: world.run(out, model, run)
        )
        monkeypatch.setattr(module, "diagnose", world.diagnose)
        return explain([tmp_path / "rec"], tmp_path / "ladder")

    return climb


def ladder(explanation):
    return [(s["added"], s["dropped"], s["held_out_rms_mm"]) for s in explanation.steps]


# ------------------------------------------------------------------------------------------ rules


def test_what_lowers_the_held_out_error_is_added_until_nothing_is_named(climbed, tmp_path):
    world = World(
        {of(): 9.0, of(A): 5.0, of(A, B): 2.0, of(B): 8.0}, {of(): [A], of(A): [B], of(A, B): []}
    )
    found = climbed(world)
    assert ladder(found) == [([], [], 9.0), ([A], [], 5.0), ([B], [], 2.0)]
    assert found.diagnosis.sentences == [str(sorted([A, B]))], "of the last run"
    assert found.refused == []
    assert sorted(p.name for p in (tmp_path / "ladder").iterdir()) == [
        "00",
        "01",
        "02",
        EXPLANATION,
    ]


def test_what_a_mishap_spoiled_is_left_out_first_whatever_the_error_then_is(climbed):
    """Its rows are gone from the error too, so that says nothing."""
    spoiled = ("L00P01:scan", "cad:lidar")
    found = climbed(World({of(): 9.0, of(A): 5.0}, {of(): [A]}, spoiled))
    assert [s["left_out"] for s in found.steps] == [[], [*spoiled], []]
    assert ladder(found) == [([], [], 9.0), ([], [], 19.0), ([A], [], 15.0)]
    assert [run.model["without"] for run in found.runs] == [[], [*spoiled], [*spoiled]]
    assert found.diagnosis.verdict == "adequate"


@pytest.mark.parametrize("error", [9.0, 9.1, 8.98], ids=["the same", "worse", "hardly less"])
def test_what_does_not_lower_it_is_refused_and_not_tried_again(climbed, tmp_path, error):
    world = World({of(): 9.0, of(A): error, of(B): 8.0, of(A, B): 1.0}, {of(): [A, B], of(B): [A]})
    found = climbed(world)
    assert ladder(found) == [([], [], 9.0), ([B], [], 8.0)]
    assert found.refused == [A]
    assert world.fits.count(of(A)) == 1 and of(A, B) not in world.fits
    assert not (tmp_path / "ladder" / "02").exists()
    written = json.loads((tmp_path / "ladder" / EXPLANATION).read_text())
    assert written["refused"] == [A] and len(written["ladder"]) == 2


@pytest.mark.parametrize(("general", "steady"), [(True, True), (True, False), (False, False)])
def test_a_later_one_with_a_more_general_rival_must_help_at_most_stops(climbed, general, steady):
    """B lowers the error of all stops together; of each, or of one alone."""
    each = {of(A): [5.0, 5.0, 5.0, 5.0]}
    each[of(A, B)] = [4.0, 4.1, 3.9, 4.0] if steady else [5.2, 5.1, 5.2, 0.0]
    errors = {of(): 9.0, of(A): 5.0, of(A, B): 4.0, of(B): 8.0}
    judged = {B: {"dof": 2, "rivals": [{"add": A, "effect": A, "dof": 4 if general else 2}]}}
    found = climbed(World(errors, {of(): [A], of(A): [B]}, (), judged, each))
    assert [s["added"] for s in found.steps][1:] == (
        [[A]] if general and not steady else [[A], [B]]
    )
    assert found.refused == ([B] if general and not steady else [])


def test_where_a_name_is_refused_what_nothing_told_it_apart_from_is_tried(climbed):
    judged = {A: {"dof": 1, "rivals": [{"add": n, "effect": n, "dof": 1} for n in (B, C)]}}
    errors = {of(): 9.0, of(A): 9.5, of(B): 5.0, of(C): 4.0}
    found = climbed(World(errors, {of(): [A], of(B): []}, (), judged))
    assert [s["added"] for s in found.steps] == [[], [B]] and found.refused == [A]


def test_what_was_added_in_place_of_nothing_that_was_told_from_it_is_said_to_the_end(climbed):
    """Not of a rival that came into the model too, nor once what was added has gone again."""
    told = {"dof": 1, "odds": 2.0, "separate": "a longer walk"}
    rivals = [{"add": name, "effect": name, **told} for name in (B, C)]
    judged = {A: {"dof": 1, "rivals": rivals}}
    errors = {of(): 9.0, of(A): 5.0, of(A, B): 4.0, of(B): 8.0}
    found = climbed(World(errors, {of(): [A], of(A): [B]}, (), judged))
    (said,) = found.untold
    assert said.startswith(f"{A} was added. On these data it is not distinguishable from {C} ")
    assert found.document()["sentences"][-1] == said
    dropped = World(errors | {of(B): 3.0}, {of(): [A], of(A): [B]}, (), judged)
    shutil.rmtree(found.runs[0].folder.parent)
    assert climbed(dropped).untold == []


@pytest.mark.parametrize("last", [[B], []], ids=["refused", "calm"])
def test_where_the_last_name_is_refused_the_diagnosis_looks_at_stops_held_out(climbed, last):
    """As ``rigcal diagnose`` of that rung does, so that both say the same of it."""
    world = World({of(): 9.0, of(A): 5.0, of(A, B): 5.5}, {of(): [A], of(A): last})
    assert climbed(world).refused == last and world.refits == [
        False,
        False,
        *([True] if last else []),
    ]


def test_at_the_noise_floor_any_fall_counts(climbed):
    found = climbed(World({of(): 1.0, of(A): 0.9999}, {of(): [A]}))
    assert [s["added"] for s in found.steps] == [[], [A]]


def test_nothing_added_is_one_rung(climbed):
    found = climbed(World({of(): 9.0, of(A): 9.5}, {of(): [A]}))
    assert ladder(found) == [([], [], 9.0)] and found.refused == [A]


def test_what_a_later_step_left_idle_is_dropped(climbed):
    world = World(
        {of(): 9.0, of(A): 5.0, of(A, B): 3.0, of(B): 2.9}, {of(): [A], of(A): [B], of(B): []}
    )
    found = climbed(world)
    assert ladder(found)[2:] == [([B], [], 3.0), ([], [A], 2.9)]
    assert found.runs[-1].effects == (*Model().names, B)


def test_what_still_helps_is_kept(climbed):
    world = World(
        {of(): 9.0, of(A): 5.0, of(A, B): 3.0, of(B): 3.1}, {of(): [A], of(A): [B], of(A, B): []}
    )
    assert [s["dropped"] for s in climbed(world).steps] == [[], [], []]


def test_what_was_dropped_comes_back_only_if_it_helps_and_it_ends(climbed):
    world = World(
        {of(): 9.0, of(A): 5.0, of(A, B): 3.0, of(B): 2.9}, {of(): [A], of(A): [B], of(B): [A]}
    )
    found = climbed(world)
    assert found.refused == [A] and ladder(found)[-1] == ([], [A], 2.9)


def test_a_shape_of_an_effect_that_is_there_is_not_added_beside_it(climbed):
    near = "near_range_bias@0.7"
    world = World({of(): 9.0, of(near): 5.0}, {of(): [near], of(near): ["near_range_bias@1.3"]})
    assert ladder(climbed(world))[1:] == [([near], [], 5.0)]


def test_another_shape_of_what_repeats_is_added_beside_it(climbed):
    one, two = "range_cyclic@0.7", "range_cyclic@1.3"
    world = World(
        {of(): 9.0, of(one): 5.0, of(one, two): 3.0, of(two): 6.0}, {of(): [one], of(one): [two]}
    )
    assert ladder(climbed(world))[1:] == [([one], [], 5.0), ([two], [], 3.0)]


def test_it_ends_where_everything_helps(climbed):
    names = [e.name for e in Model(tuple(MANY)).effects]
    errors, named = Falling(), {of(*names[:i]): [names[i]] for i in range(len(names))}
    found = climbed(World(errors, named))
    assert len(found.runs) == MOST_RUNGS
    assert found.diagnosis.sentences == [str(sorted(names[: MOST_RUNGS - 1]))], "of the last run"


MANY = (
    *("range_scale", "range_step@1", "near_range_bias@1", "ring_elevation_offset", A, B, C),
    *("ring_azimuth_offset", "elevation_scale", "encoder_eccentricity"),
)


class Falling(dict):
    """Errors that every effect lowers."""

    def __missing__(self, names):
        return 100.0 - len(names)


def test_a_folder_with_other_things_is_refused_and_left_alone(climbed, tmp_path):
    (tmp_path / "ladder").mkdir()
    (tmp_path / "ladder" / "thesis.tex").write_text("all of it")
    with pytest.raises(InputError, match=r"holds thesis\.tex"):
        climbed(World({}, {}))
    assert (tmp_path / "ladder" / "thesis.tex").read_text() == "all of it"
    (tmp_path / "ladder" / "thesis.tex").unlink()
    (tmp_path / "ladder").rmdir()
    (tmp_path / "ladder").write_text("a file")
    with pytest.raises(InputError, match="is a file"):
        climbed(World({}, {}))


def test_a_recording_that_is_not_there_leaves_no_folder(tmp_path):
    with pytest.raises(InputError):
        explain([tmp_path / "nowhere"], tmp_path / "ladder")
    assert not list(tmp_path.iterdir())


# ---------------------------------------------------------------------------------------- for real


@pytest.fixture(scope="module")
def explained(tmp_path_factory, diagnosed_once):
    """A recording with a hidden effect, explained."""
    folder = tmp_path_factory.mktemp("explain")
    simulate(SMALL, folder / "rec", SEED, {HIDDEN: 3.0})
    return folder, explain([folder / "rec"], folder / "ladder")


@pytest.fixture
def folder(explained, tmp_path):
    """The same recording, and a copy of its ladder that may be changed: its paths stay."""
    kept = shutil.copytree(explained[0], tmp_path / "kept", copy_function=shutil.copy2)
    yield explained[0]
    shutil.rmtree(explained[0])
    shutil.copytree(kept, explained[0], copy_function=shutil.copy2)


def times(folder, *rungs):
    return {
        p: p.stat().st_mtime_ns for r in rungs for p in (folder / r).glob("[!d]*") if p.is_file()
    }


@pytest.mark.long
def test_the_ladder_falls_to_an_adequate_model(explained):
    folder, found = explained
    assert [s["added"] for s in found.steps] == [[], [HIDDEN]]
    errors = [s["held_out_rms_mm"] for s in found.steps]
    assert errors[1] < 0.5 * errors[0]
    assert found.diagnosis.verdict == "adequate"
    written = json.loads((folder / "ladder" / EXPLANATION).read_text())
    assert written["verdict"] == "adequate" and written["ladder"] == found.steps
    verdicts = [
        json.loads((run.folder / "diagnosis.json").read_text())["verdict"] for run in found.runs
    ]
    assert verdicts == ["missing_effect", "adequate"], "every rung keeps its own"


def test_people_read_rungs_ladder_and_verdict(explained, capsys):
    _, found = explained
    print_explanation(found)
    out = capsys.readouterr().out
    before, after = (s["held_out_rms_mm"] for s in found.steps)
    assert f"+ {HIDDEN}  {before:.2f} -> {after:.2f}" in out
    assert "verdict: the model is adequate" in out and found.diagnosis.sentences[0] in " ".join(
        out.split()
    )
    found = SimpleNamespace(**vars(found) | {"runs": found.runs[:1], "refused": [C]})
    print_explanation(found)
    out = capsys.readouterr().out
    assert "start" in out and f"not added, as the held-out error did not fall: {C}." in out


@pytest.mark.long
def test_an_interrupted_call_takes_up_the_rungs_that_are_there(folder):
    ladder = folder / "ladder"
    before, last = times(ladder, "00"), json.loads((ladder / EXPLANATION).read_text())
    shutil.rmtree(ladder / "01")
    (ladder / EXPLANATION).unlink()
    found = explain([folder / "rec"], ladder)
    assert times(ladder, "00") == before and (ladder / "01" / "summary.json").is_file()
    assert [s["added"] for s in found.steps] == [[], [HIDDEN]]
    for was, now in zip(last["ladder"], found.steps, strict=True):
        assert now["held_out_rms_mm"] == pytest.approx(was["held_out_rms_mm"], rel=1e-6)


@pytest.mark.long
def test_rungs_of_another_model_are_made_anew_and_those_above_go(folder):
    """Found with a bias in it, the model needs no further rung."""
    ladder = folder / "ladder"
    before = times(ladder, "00")
    found = explain([folder / "rec"], ladder, Model((*Model().names, HIDDEN)))
    assert len(found.runs) == 1 and found.diagnosis.verdict == "adequate"
    assert times(ladder, "00") != before and not (ladder / "01").exists()
    changed = folder / "rec" / "stops.csv"
    changed.write_text(changed.read_text().replace("L02", "L03"))
    before = times(ladder, "00")
    explain([folder / "rec"], ladder, Model((*Model().names, HIDDEN)))
    assert times(ladder, "00") != before, "the recording is not what it was"
