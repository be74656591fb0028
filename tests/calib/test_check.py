"""rigcal check: every part described, every problem found, and expectations that a fit keeps."""

import json
import shutil
from types import SimpleNamespace

import numpy as np
import pytest

from calib import effects
from calib import problem as problems
from calib.diagnosis.candidates import lacking
from calib.problem.model import Model, Source
from calib.results.check import check
from calib.results.solution import solution_of
from calib.rig.inventory import (
    PlacedScan,
    odd_beams,
    odd_columns,
    odd_payloads,
    odd_rig,
    odd_times,
)
from calib.solve.fit import solve
from chains import se3
from chains.arm import Mass
from chains.errors import InputError
from chains.frames import Edge
from sensors.recording import read_table

from . import broken, rigs


@pytest.fixture(scope="module")
def box(tmp_path_factory):
    """A recording with nothing wrong."""
    return rigs.write(tmp_path_factory.mktemp("check") / "box")


@pytest.fixture(scope="module")
def found(box):
    return check(box)


@pytest.fixture
def rec(box, tmp_path):
    """A copy to break."""
    return shutil.copytree(box, tmp_path / "box")


def poses(body):
    """A pattern of a body's columns in stops.csv."""
    return rf"{body}_markers\.(x|y|z|q.)"


# ---------------------------------------------------------------------------------- what is there


def test_a_sound_recording_has_no_problem(found):
    assert found.problems == []
    assert found.odd == [
        "all stops stand at 2 locations; with 3 or more, whole locations can be held out of a fit"
    ]


def test_every_part_is_described(found):
    contents = dict(found.contents)
    assert len(contents) == len(found.contents), "a name is there twice"
    incidence = contents.pop("beams")
    assert contents == {
        "rig": "box: velodyne_vlp16 with 16 rings, arm of 3 joints (without masses), "
        "5 frames from CAD",
        "stops": "4 at 2 locations, over 3 min",
        "base_markers": "seen at 4 of 4 stops",
        "mount_markers": "seen at 4 of 4 stops",
        "base_guess": "given at 4 of 4 stops",
        "per-stop covariates": "temperature_c",
        "scans": "4 of 400 points, up to 4 sweeps averaged",
        "rings": "16 of 16 seen",
        "intensity": "up to 255 of 255",
        "targets": "4 within 3.0 x 2.0 x 0.9 m",
        "mesh": "300 triangles in 6 surfaces, 4.0 x 3.0 x 2.5 m",
        "labels": "label_0",
    }
    assert incidence.startswith("100% meet a surface")


def test_times_that_are_missing_are_said_to_be(rec):
    """Row numbers were taken for seconds: neither minutes nor a drift follow from them."""
    broken.without("stops.csv", "time_s")(rec)
    found = check(rec)
    assert found.problems == [] and dict(found.contents)["stops"] == "4 at 2 locations, no times"
    source = Source.open(rec)
    assert not {"time_s", "elapsed_s", "moved.turn"} & set(source.columns)
    assert "time_s" not in source.recording.to_pandas()
    for name in ("warmup_drift", "mount_creep", "mount_slip", "arm_backlash", "arm_joint_lag"):
        assert lacking(effects.find(name), [source], frozenset(source.columns)), name


def test_what_the_beams_meet_is_what_was_simulated(box, found):
    """Distances against the points' own, which one beam in twenty falsifies."""
    ranges = [
        np.linalg.norm(list(map(read_table(p).get, "xyz")), axis=0) for p in box.glob("scans/*")
    ]
    low, high = np.quantile(np.concatenate(ranges), [0.05, 0.95])
    words = dict(found.contents)["beams"].split()
    near, far = (float(words[i]) for i in (words.index("at") + 1, words.index("m") - 1))
    assert near == pytest.approx(low, abs=0.15) and far == pytest.approx(high, abs=0.15)


# ------------------------------------------------------------------------------- what can be told


@pytest.fixture(scope="module")
def fitted(box):
    return solve(problems.build([Source.open(box)], Model()))


def test_expected_sigmas_are_those_of_a_fit(found, fitted):
    """One linearisation at the start foretells the fit's joint covariance."""
    sigma, start = np.sqrt(np.diag(fitted.covariance)), 0
    for v in fitted.variables:
        now, units = sigma[start : start + v.dim], np.array(v.units)
        start += v.dim
        for unit, shown in (("m", "mm"), ("rad", "mrad")):
            told = 1e3 * now[(units == unit) & (now < 0.99 * v.sigma)]
            if len(told):
                least, largest = found.expected[v.name][shown]
                assert least == pytest.approx(told.min(), rel=0.15), v.name
                assert largest == pytest.approx(told.max(), rel=0.15), v.name


def test_what_can_be_told_is_said_with_its_unit(found):
    assert set(found.expected) == {line.split(":")[0] for line in found.can}
    least, largest = found.expected["faro"]["mm"]
    line = next(line for line in found.can if line.startswith("faro: "))
    assert f"{least:.2g} to {largest:.2g} mm" in line and " mrad" in line


def test_what_cannot_be_told_is_what_the_fit_says_too(box, found):
    problem = problems.build([Source.open(box)], Model())
    later = solution_of(problem, solve(problem)).not_estimated
    assert [entry["name"] for entry in found.cannot] == [entry["name"] for entry in later]
    assert all(entry["why"] for entry in found.cannot)


def test_without_scans_the_lidar_cannot_be_told(rec):
    shutil.rmtree(rec / "scans")
    found = check(rec)
    assert found.problems == [] and "ring_range_offset" not in found.expected
    cannot = {entry["name"]: entry["why"] for entry in found.cannot}
    assert "scans/<stop>.parquet" in cannot["lidar"]


def test_more_noise_is_foretold(box, rec):
    broken.rig("tracker", "sigma_m", value=0.004)(rec)
    coarse, fine = check(rec).expected, check(box).expected
    assert coarse["faro"]["mm"][0] > fine["faro"]["mm"][0]


def test_the_document_is_json_with_all_of_it(found):
    document = json.loads(json.dumps(found.document()))
    assert document["contents"] == dict(found.contents)
    assert document["can"] == found.can and document["cannot"] == found.cannot
    assert document["problems"] == [] and document["odd"] == found.odd
    assert document["expected_sigma"]["lidar"]["mm"] == list(found.expected["lidar"]["mm"])


# ----------------------------------------------------------------------------------- what is wrong


def assert_each_once(problems_, parts):
    for part in parts:
        assert sum(part in problem for problem in problems_) == 1, (part, problems_)
    assert len(problems_) == len(parts), problems_


def test_one_problem_does_not_hide_another(rec):
    broken.overwrite("scans/s1.parquet")(rec)
    broken.table("scans/s2.parquet", ring=lambda r: r + np.uint16(1))(rec)
    broken.overwrite("targets.csv")(rec)
    broken.overwrite("reference/mesh.ply")(rec)
    parts = ("s1.parquet", "s2.parquet: ring 16", "targets.csv", "mesh.ply")
    assert_each_once(check(rec).problems, parts)


def test_a_broken_rig_hides_neither_stops_nor_targets_nor_scans(rec):
    broken.text("rig.yaml", "name:", "name: [")(rec)
    broken.cells("stops.csv", "time_s", "soon", row=0)(rec)
    broken.cells("targets.csv", "faro_x", "", row=1)(rec)
    broken.table("scans/s0.parquet", count=np.zeros_like)(rec)
    parts = ("rig.yaml:", "stops.csv: row 1", "targets.csv: row 2", "s0.parquet: count")
    assert_each_once(check(rec).problems, parts)


def test_a_scan_that_cannot_be_read_leaves_the_others_to_tell(rec, found):
    broken.overwrite("scans/s1.parquet")(rec)
    less = check(rec)
    assert_each_once(less.problems, ["s1.parquet"])
    assert dict(less.contents)["scans"].startswith("3 of 400 points")
    ring, before = (of.expected["ring_range_offset"]["mm"] for of in (less, found))
    assert ring[0] == pytest.approx(before[0] * np.sqrt(4 / 3), rel=0.1)


def test_stops_that_see_nothing_of_the_mesh_are_a_problem_each(rec):
    for stop in (2, 3):
        broken.cells("stops.csv", r".*_markers\.[xyz]", lambda m: m + 50, row=stop)(rec)
    assert_each_once(
        check(rec).problems, ["stop 's2': none of its 400", "stop 's3': none of its 400"]
    )


def test_a_folder_that_is_not_there_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"nowhere: .*no such folder"):
        check(tmp_path / "nowhere")


# ----------------------------------------------------------------------------------- what looks odd


def assert_odd(folder, *sentences):
    """The check finds no problem, these oddities, and no other but the few locations."""
    found = check(folder)
    assert found.problems == []
    odd = [line for line in found.odd if "locations" not in line]
    for sentence in sentences:
        assert sum(sentence in line for line in odd) == 1, (sentence, odd)
    assert len(odd) == len(sentences), odd


def test_a_joint_at_rest_and_one_beyond_its_limits(rec):
    broken.cells("stops.csv", "slide", 0.1)(rec)
    broken.cells("stops.csv", "turn", 3.5, row=3)(rec)
    broken.cells("stops.csv", poses("mount"), "", row=3)(rec)
    assert_odd(rec, "turn is beyond its limits of -3 to 3 rad at s3;", "slide hardly moved")


def test_bodies_that_are_hardly_seen(rec):
    for stop in (1, 2, 3):
        broken.cells("stops.csv", poses("mount"), "", row=stop)(rec)
    broken.cells("stops.csv", poses("base"), "", row=3)(rec)
    assert_odd(rec, "mount_markers is seen at 1 of 4 stops only", "no tracked body is seen at s3;")


def test_scans_without_stop_stops_without_scan_rings_without_points(rec):
    (rec / "scans/s3.parquet").rename(rec / "scans/s9.parquet")
    for path in (rec / "scans").iterdir():
        broken.table(f"scans/{path.name}", ring=lambda r: np.where(r == 7, 8, r).astype("u2"))(rec)
    assert_odd(
        rec,
        "scans/ holds s9, but stops.csv has no such stop",
        "there is no scan of s3",
        "no point comes from ring 7;",
    )


def test_scans_that_the_rig_has_no_lidar_for(rec):
    broken.rig("lidar", value=None)(rec)
    assert_odd(rec, "no 'lidar' in rig.yaml", "fill a box of")  # what is left is an arm alone


def test_targets_that_are_mixed_up(rec):
    def swap(text):
        """Exchange upper and lower of the last target, and the spheres of the first two."""
        rows = [line.split(",") for line in text.splitlines()]
        rows[4][4:7], rows[4][7:10] = rows[4][7:10], rows[4][4:7]
        rows[1][1:4], rows[2][1:4] = rows[2][1:4], rows[1][1:4]
        return "\n".join(map(",".join, rows)) + "\n"

    broken.text("targets.csv", swap)(rec)
    odd = check(rec).odd
    assert any(line.startswith("the rod of t3 does not hang as the others do") for line in odd), odd
    assert any(line.startswith("tracker and scanner place t") for line in odd), odd


@pytest.mark.parametrize(
    ("times", "unit"), [(1.0, None), (1e3, "milliseconds"), (1e6, "microseconds"), (1e9, "nanos")]
)
def test_times_in_another_unit(times, unit):
    for start_s, gap_s in ((0.0, 90.0), (1.7e9, 10.0), (1.7e9, 86400.0)):  # a stop a day, too
        if start_s or times < 2e3:  # from 0 on, others than milliseconds need a longer look
            time_s = times * (start_s + gap_s * np.array([0.0, 1, 2, 40, 41, 41, 42]))
            told = list(odd_times(SimpleNamespace(timed=True, time_s=time_s)))
            assert len(told) == (unit is not None), time_s
            assert all(f"is it in {unit}" in each for each in told)
    assert list(odd_times(SimpleNamespace(timed=False, time_s=np.full(7, np.nan)))) == []


def test_payloads_that_no_arm_carries(monkeypatch):
    def odd(*kg, masses=(10.0, 8.0), doubts=()):
        """What is said of loads on an arm whose links weigh so much, or are said to."""
        monkeypatch.setattr("calib.rig.inventory._odd_masses", lambda rig: iter(doubts))
        rig = SimpleNamespace(tips=["flange"], masses=[SimpleNamespace(kg=m) for m in masses])
        columns = {"payload_kg": np.array(kg), "temperature_c": np.full(len(kg), -300.0)}
        return list(odd_payloads(rig, SimpleNamespace(covariates=columns)))

    assert odd(0.0, 5.0, np.nan) == odd(100.0, masses=()) == []
    (said,) = odd(0.0, 2500.0)
    assert "payload_kg goes up to 2500" in said and "(18 kg)" in said and "in grams?" in said
    assert "in grams?" in odd(5000.0, masses=())[0]
    assert odd(10.0, masses=(1.0,) * 6, doubts=["all weigh 1 kg; are these measured?"]) == []
    (said,) = odd(0.0, -2.5)
    assert "down to -2.5" in said


def test_a_sigma_in_millimetres(rec):
    broken.rig("reference", "sigma_m", value=0.6)(rec)
    assert_odd(rec, "reference.sigma_m is 0.6 m in rig.yaml")


def placed(roll_rad, incidence_deg=(5, 70), residual_m=0.01, further=1.0):
    """Scans of stops that turn about z and lean by `roll_rad`, one each."""
    spread = np.radians(np.linspace(*incidence_deg, 50))
    return [
        PlacedScan(
            name=f"s{k}",
            T=pose([k, 0, 0], [roll, 0, k]),
            share=1.0,
            range_m=np.ones(50),
            incidence_rad=spread,
            residual_m=residual_m,
            further=further,
        )
        for k, roll in enumerate(roll_rad)
    ]


def pose(xyz_m, rpy_rad):
    return rigs.pose(xyz_m, rpy_rad).as_matrix()


def test_views_that_differ_are_not_odd():
    assert list(odd_beams(placed([0.0, 0.3, 0.1]))) == []


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"roll_rad": [0.0, 0.02, 0.0]}, "spin axis points the same way at all stops"),
        ({"incidence_deg": (40, 60)}, "at 41 to 59 deg from their normal only"),
        ({"residual_m": 0.4}, "at s0, s1, s2 and 1 more half of the beams end more than 0.3 m"),
        ({"residual_m": 4.0, "further": 3.3}, "the unit of the mesh, which lies 3.3 times as far"),
        ({"residual_m": 4.0, "further": 0.3}, "the unit of the mesh, which lies 0.3 times as far"),
    ],
)
def test_views_that_are_alike_or_beside_the_room(change, sentence):
    (line,) = odd_beams(placed(**{"roll_rad": [0.0, 0.3, 0.1, 0.0], **change}))
    assert sentence in line


def weighing(*kg: float, length_m: float = 0.4):
    """A rig of nothing but an arm, each link as long and of its mass."""
    edges = [
        Edge(f"j{i}", f"l{i}", f"l{i + 1}", se3.from_xyz_rpy([0, 0, length_m], [0, 0, 0]))
        for i in range(len(kg))
    ]
    masses = tuple(Mass(f"l{i + 1}", each, np.zeros(3)) for i, each in enumerate(kg) if each)
    return SimpleNamespace(
        tracker=None,
        target=None,
        reference=None,
        chains=(tuple(edge.name for edge in edges),),
        edge={edge.name: edge for edge in edges}.get,
        masses=masses,
    )


@pytest.mark.parametrize(
    ("kg", "said"),
    [
        ((7.8, 12.9, 3.9, 2.0), None),  # 26.6 kg at 1.6 m
        ((0.0, 0.0, 0.0), None),
        ((1.0, 1.0, 1.0), "all 3 links with a mass weigh 1 kg"),
        ((7800.0, 12900.0, 3900.0), "weigh 24600 kg in the URDF, at a length of 1.20 m"),
        ((0.0078, 0.0129, 0.0039), "weigh 0.0246 kg"),
    ],
)
def test_masses_that_no_arm_has_are_said(kg, said):
    assert [line for line in odd_rig(weighing(*kg)) if said is None or said not in line] == []
    assert len(list(odd_rig(weighing(*kg)))) == (said is not None)


def test_numbers_that_stand_for_none():
    def odd(*column):
        stops = [f"P{i:02d}" for i in range(len(column))]
        return list(odd_columns(SimpleNamespace(stops=stops, covariates={"lux": np.array(column)})))

    usual = np.linspace(20.6, 24.0, 20)
    (said,) = odd(*usual, -999.0, -999.0)
    assert "lux is -999 at P20, P21" in said and "20.6 to 24 at all others" in said
    (said,) = odd(*usual[:9], np.nan, 9999.0)
    assert "9999 at P10" in said
    (said,) = odd(*[21.0] * 12, -999.0)
    assert "-999 at P12" in said and "21 to 21 at all others" in said
    (said,) = odd(*usual, 1e6)
    assert "1e+06 at P20" in said
    # Neither a tail, nor of few stops, nor what is switched on at one of them, nor the next day.
    assert odd(*usual, 30.0) == odd(*usual[:5], -999.0) == odd(*[0.0] * 20, 5.0) == []
    assert odd(*[21.0] * 8, *[21.1] * 8, 23.0) == odd(*np.arange(20) * 120.0, 50_000.0) == []
    assert odd(*np.linspace(-1500, 1500, 20), -999.0) == odd(*[np.nan] * 12) == odd() == []
