"""A fit to some beams of each scan, a first answer, and the whole one that goes on from it."""

import json
import pickle
from dataclasses import replace

import numpy as np
import pytest

import calib
from calib.problem.model import Source
from calib.runs.asked.commands import command_without
from calib.runs.ladder import ladder
from calib.runs.reopen import reopened
from calib.runs.reproduce import reproduce
from calib.simulation import Spec, simulate
from chains import se3
from chains.errors import InputError

SPEC = Spec(lidar="hesai_pandarxt32", locations=4, stops_per_location=2, column_step=4)
SOME = 1500


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A recording, a run of some beams, a run that goes on from it with all, and one of all."""
    folder = tmp_path_factory.mktemp("beams")
    simulate(SPEC, folder / "rec", 2)
    some = calib.fit([folder / "rec"], folder / "some", calib.Model(beams=SOME))
    calib.add(some, [], folder / "grown", every_beam=True)
    calib.fit([folder / "rec"], folder / "all", calib.Model())
    return folder


def estimates(folder):
    """Tangents of the calibration beyond a state (n,), the sigmas (n,), and the state."""
    run = calib.Run.open(folder)
    with np.load(folder / "covariance.npz") as stored:
        names, covariance = stored["names"].tolist(), stored["covariance"]
    return run.state(), names, np.sqrt(np.diag(covariance))


def apart(a, b):
    """By how much two runs differ (n,), and the sigmas (n,) of both."""
    (one, names, sigma), (two, same, other) = estimates(a), estimates(b)
    assert names == same
    out = []
    for variable in dict.fromkeys(name.rpartition(".")[0] for name in names):
        x, y = one[variable], two[variable]
        out.append(se3.log(se3.inverse(x) @ y) if x.shape == (4, 4) else y - x)
        assert len(out[-1]) == sum(n.rpartition(".")[0] == variable for n in names)
    return np.concatenate(out), sigma, other


def test_so_many_beams_are_drawn_from_all_parts_of_a_scan_and_the_same_each_time(made):
    source = Source.open(made / "rec")
    few = source.of_beams(SOME)
    (scan, beams), (whole, _) = few.store.read(3), source.store.read(3)
    count = len(whole.ring)
    assert len(scan.ring) == SOME == len(beams.range_m) < count / 3
    rows = {tuple(xyz): i for i, xyz in enumerate(whole.xyz_m.tolist())}
    at = np.array([rows[tuple(xyz)] for xyz in scan.xyz_m.tolist()])
    assert np.abs((at + 0.5) * SOME / count - np.arange(SOME) - 0.5).max() < 1.0
    assert (np.diff(at) > 0).all()
    assert len(np.unique(np.diff(at))) > 2, "not every so many-th: a ring could be missed"
    for name, column in whole.columns().items():
        np.testing.assert_array_equal(scan.columns()[name], column[at])
    again = pickle.loads(pickle.dumps(few.store)).read(3)[0]
    np.testing.assert_array_equal(again.xyz_m, scan.xyz_m)
    assert not np.array_equal(few.store.read(4)[0].ring, scan.ring)
    assert len(source.of_beams(count).store.read(3)[0].ring) == count
    assert source.of_beams(None) is source


def test_a_run_says_how_many_beams_it_used_and_all_that_is_made_of_it_uses_these(made):
    run = calib.Run.open(made / "some")
    assert run.beams == SOME and calib.Run.open(made / "all").beams is None
    assert "beams" not in calib.Run.open(made / "all").model
    points = {n: calib.Run.open(made / n).summary["points"] for n in ("some", "grown", "all")}
    assert points["some"] < 8 * SOME < points["all"] / 2
    assert points["grown"] == pytest.approx(points["all"], rel=1e-3)  # but for some near edges
    (source,) = reopened(run)
    assert source.beams == SOME and source.of_beams(None).beams is None
    assert f"--beams {SOME}" in command_without(run, ["L00P00:scan"])
    diagnosis = calib.diagnose(run, refits=False)
    assert diagnosis.verdict == "adequate", diagnosis.sentences


def test_the_estimates_are_as_far_off_those_of_all_beams_as_their_sigmas_say(made):
    """What is estimated from some of the rows and from all differs by the difference of both
    variances (Hausman 1978)."""
    off, sigma, whole = apart(made / "some", made / "all")
    fewer = sigma > 1.2 * whole
    assert fewer.sum() > 20, "rings are known from fewer beams"
    rms = np.sqrt(np.mean(np.square(off[fewer]) / (sigma**2 - whole**2)[fewer]))
    assert 0.6 < rms < 1.4, rms
    assert np.abs(off / sigma).max() < 3.5


def test_the_run_that_goes_on_with_all_beams_ends_where_one_of_all_beams_does(made):
    off, sigma, whole = apart(made / "grown", made / "all")
    assert np.abs(off / whole).max() < 0.1
    np.testing.assert_allclose(sigma, whole, rtol=0.03)
    grown = calib.Run.open(made / "grown")
    assert grown.summary["converged"] and grown.beams is None
    assert reproduce(grown).identical


def test_what_the_lidar_errs_by_and_corrected_scans_are_of_all_beams(made):
    some, whole = (calib.Run.open(made / name) for name in ("some", "all"))
    returns = [
        calib.evaluate(run, made / f"of-{run.folder.name}")["returns"] for run in (some, whole)
    ]
    assert returns[0] == pytest.approx(returns[1], rel=0.01)
    (done,) = calib.apply(some, made / "rec", made / "corrected")
    assert done.points == sum(
        len(Source.open(made / "rec").store.read(k)[0].ring) for k in range(8)
    )


def test_some_beams_are_asked_for_and_told_on_the_command_line(made, rigcal, tmp_path):
    fit = ("fit", made / "rec", "-o", tmp_path / "run", "--hold-out", "none")
    code, out, err = rigcal(*fit, "--beams", 300)
    assert code == 0, err
    assert "of each scan 300 beams at most were used" in " ".join(out.split())
    assert json.loads((tmp_path / "run" / "summary.json").read_text())["points"] < 8 * 300
    code, _, err = rigcal("add", tmp_path / "run", "-o", tmp_path / "no")
    assert code == 2 and "--every-beam" in err
    assert rigcal(*fit, "--beams", 0)[0] == 2
    model = replace(calib.Model(), beams=7)
    assert model.minus(["ring_range_offset"]).beams == 7
    with pytest.raises(InputError, match="at least one beam"):
        calib.Model(beams=0)
    with pytest.raises(InputError, match="used all beams already"):
        calib.add(calib.Run.open(made / "all"), [], tmp_path / "no", every_beam=True)


def test_the_ladder_says_that_beams_came_to_it(made):
    rungs = ladder([calib.Run.open(made / "grown")])
    assert [rung.step for rung in rungs] == ["start", "all beams"]


@pytest.mark.long
def test_an_explanation_by_other_beams_goes_on_from_no_rung(made, tmp_path):
    recording = [made / "rec"]
    for beams in (400, None, 600):
        found = calib.explain(recording, tmp_path / "ladder", calib.Model(beams=beams))
        assert {run.beams for run in found.runs} == {beams}


def test_planes_are_those_of_all_beams(tmp_path):
    """Without a mesh: fewer beams would show fewer planes, and what is evaluated then are others
    than those that were fitted."""
    spec = Spec(mesh=False, targets=0, locations=3, stops_per_location=2, column_step=20)
    simulate(spec, tmp_path / "rec", 1)
    runs = [
        calib.fit([tmp_path / "rec"], tmp_path / name, calib.Model(beams=beams), hold_out="none")
        for name, beams in (("some", 2000), ("all", None))
    ]
    some, whole = (run.state()["planes"] for run in runs)
    assert some.shape == whole.shape
    accuracy = [calib.evaluate(run)["accuracy_mm"] for run in runs]
    assert accuracy[0] == pytest.approx(accuracy[1], rel=0.1)


def test_the_usual_intensity_is_that_of_all_beams(made):
    source = Source.open(made / "rec")
    assert source.of_beams(100).store.median_intensity == source.store.median_intensity > 0
