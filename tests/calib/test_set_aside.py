"""Scans that a fit set aside, or was told to leave out: what follows a fit goes on without them."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from calib.effects import find
from calib.evaluation import evaluate
from calib.evaluation.apply import apply
from calib.problem.model import Model
from calib.report import report
from calib.runs.add import add
from calib.runs.calibrate import calibrate
from calib.runs.diagnose import diagnose
from calib.runs.reopen import stand_of
from calib.runs.run import RESIDUALS, Run
from calib.simulation import simulate
from calib.solve import fit
from calib.solve.torn import agreeing
from calib.view.scene import Scene
from sensors.recording import read_table

from .simulated import made

pytestmark = pytest.mark.slow


def quiet(what, done, total):
    pass


EXCHANGED = ("L00P00", "L03P02")
TOKENS = [f"{stop}:scan" for stop in EXCHANGED]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A recording in which two scans are exchanged, a run of it, and one that leaves them out."""
    folder = tmp_path_factory.mktemp("aside")
    simulate("tiny", folder / "rec", 4)
    first, second = (folder / f"rec/scans/{stop}.parquet" for stop in EXCHANGED)
    kept = first.read_bytes()
    first.write_bytes(second.read_bytes())
    second.write_bytes(kept)
    run = calibrate([folder / "rec"], folder / "aside", hold_out="none")
    diagnose(run, refits=False)
    add(run, [], folder / "left", without=TOKENS)
    return folder


@pytest.fixture(params=["aside", "left"])
def run(folder, request):
    return Run.open(folder / request.param)


def test_the_fit_does_without_them(run):
    aside, left = run.set_aside, run.left_out
    assert (aside, left) in ((TOKENS, []), ([], TOKENS))
    stops = {path.stem for path in (run.folder / RESIDUALS).glob("[!_]*")}
    assert len(stops) == 10 and stops.isdisjoint(EXCHANGED)


def test_both_are_named_with_the_stop_at_which_they_were_taken(folder):
    found = Run.open(folder / "aside").diagnosis()
    told = [(b["without"], b["belongs_to"]) for b in found["blunders"]]
    assert told == list(zip(TOKENS, EXCHANGED[::-1], strict=True))
    wild = [g["token"] for g in found["groups"] if g["statistic"] > g["limit"]]
    assert wild == TOKENS


@pytest.mark.long
def test_there_is_a_report(run, tmp_path):
    written = report([run], tmp_path / "page.html")
    html = (tmp_path / "page.html").read_text()
    assert all(token in html[: html.index("<nav")] for token in TOKENS)
    assert written.contents.charts


def test_they_are_not_evaluated(run, tmp_path):
    evaluate(run, tmp_path / "out")
    told = "".join(str(path) for path in (tmp_path / "out").rglob("*"))
    assert "L00P01" in told and not any(stop in told for stop in EXCHANGED)


def test_the_workbench_shows_their_stops_without_points(run):
    scene = Scene.of(run)
    for stop in EXCHANGED:
        assert stop in scene.stops(0) and scene.points(0, stop) is None
    assert scene.points(0, "L00P01") is not None


def test_they_are_corrected_like_any_other_scan(run, folder, tmp_path):
    """Rings read long or short by the same, wherever a scan was taken."""
    apply(run, [folder / "rec"], tmp_path)
    offset_m = run.solution.shared.effects["ring_range_offset"].estimate
    for stop in (*EXCHANGED, "L01P01"):
        before, after = (
            read_table(place / f"rec/scans/{stop}.parquet") for place in (folder, tmp_path)
        )
        points = [np.stack([t[c] for c in "xyz"], axis=1).astype(float) for t in (before, after)]
        moved_m = np.linalg.norm(points[1] - points[0], axis=1)
        np.testing.assert_allclose(moved_m, np.abs(offset_m[before["ring"]]), atol=2e-6)


@pytest.fixture(scope="module")
def sagging(tmp_path_factory):
    """An arm that sags so much that a scan contradicts the others."""
    folder = tmp_path_factory.mktemp("sagging")
    made(folder / "rec", "tiny", seed=1, arm_gravity_sag=3.0)
    run = calibrate([folder / "rec"], folder / "run", hold_out="none")
    assert run.set_aside == ["L01P00:scan"]
    return run


def test_a_scan_that_a_missing_effect_put_far_off_is_taken_back(sagging, tmp_path):
    """It stayed set aside with the effect in the model, and was called wrong."""
    grown = add(sagging, "arm_gravity_sag", tmp_path / "grown")
    assert grown.converged and not grown.set_aside
    stops = {path.stem for path in (grown.folder / RESIDUALS).glob("[!_]*")}
    assert "L01P00" in stops
    model = Model(tuple(map(find, grown.effects)))
    cold = calibrate(sagging.recordings, tmp_path / "cold", model, hold_out="none")
    for name in grown.effects:
        ours, theirs = (each.solution.shared.effects[name] for each in (grown, cold))
        assert (np.abs(ours.estimate - theirs.estimate) <= 0.15 * theirs.sigma).all()


def test_a_scan_that_contradicts_the_others_once_a_fit_has_it_stays_set_aside(
    sagging, tmp_path, monkeypatch
):
    grown, asked = add(sagging, "arm_gravity_sag", tmp_path / "grown"), []

    def once(*of):
        asked.append(of)
        return agreeing(*of) if len(asked) == 1 else set()

    monkeypatch.setattr(fit, "agreeing", once)
    (effect,) = (find(name) for name in grown.effects if name == "arm_gravity_sag")
    stand = stand_of(sagging, quiet).with_effects([effect], quiet)
    assert len(asked) == 2 and stand.estimate.converged
    assert stand.estimate.problem.set_aside == {"L01P00:scan"}
    assert len(stand.estimate.scans) == 11


def test_a_scan_without_a_beam_that_counts_agrees_with_nothing(sagging):
    stand = stand_of(sagging, quiet)
    (scan,) = stand.estimate.problem.aside
    rows = scan.rows(stand.estimate.values, None)
    none = replace(rows, usable=np.zeros_like(rows.usable))
    blind = SimpleNamespace(rows=lambda *_: none, group=scan.group)
    assert agreeing([blind], stand.estimate.values, 1.0) == set()
    assert agreeing([scan], stand.estimate.values, 1e3) == {"L01P00:scan"}


@pytest.mark.long
def test_such_a_scan_is_no_blunder_beside_the_effect(sagging):
    found = diagnose(sagging, refits=False)
    assert found.worth_adding == ["arm_gravity_sag"] and not found.blunders
