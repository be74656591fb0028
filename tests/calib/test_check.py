"""rigcal check: every part described, every problem found, and expectations that a fit keeps."""

import json
import shutil

import numpy as np
import pytest

from calib import problem as problems
from calib.check import check
from calib.fit import solve
from calib.inventory import PlacedScan, odd_beams
from calib.model import Model, Source
from chains.errors import InputError
from sensors.documents import read_yaml, write_yaml
from sensors.recording import read_table, write_table

from . import rigs


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


def column(path, name, change):
    """Change a column of a CSV file, a list of texts."""
    head, *rows = [line.split(",") for line in path.read_text().splitlines()]
    at = head.index(name)
    for row, value in zip(rows, change([row[at] for row in rows]), strict=True):
        row[at] = str(value)
    path.write_text("\n".join(",".join(row) for row in (head, *rows)) + "\n")


def rig(folder, change):
    """Change rig.yaml through its data."""
    data, _ = read_yaml(folder / "rig.yaml")
    change(data)
    write_yaml(folder / "rig.yaml", data)


def scan(folder, stop, **columns):
    """Change columns of a scan."""
    path = folder / f"scans/{stop}.parquet"
    write_table(path, read_table(path) | columns)


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
        "rig": "box: velodyne_vlp16 with 16 rings, arm of 3 joints, 5 frames from CAD",
        "stops": "4 at 2 locations, over 3 min",
        "base_markers": "seen at 4 of 4 stops",
        "mount_markers": "seen at 4 of 4 stops",
        "base_guess": "given at 4 of 4 stops",
        "per-stop covariates": "temperature_c",
        "scans": "4 of 400 points, up to 4 sweeps averaged",
        "rings": "16 of 16 seen",
        "targets": "4 within 3.0 x 2.0 x 0.9 m",
        "mesh": "300 triangles in 6 surfaces, 4.0 x 3.0 x 2.5 m",
        "labels": "label_0",
    }
    assert incidence.startswith("100% meet a surface")


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
    from calib.calibrate import solution_of

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
    rig(rec, lambda data: data["tracker"].update(sigma_m=0.004, sigma_rad=0.006))
    coarse, fine = check(rec).expected, check(box).expected
    assert coarse["faro"]["mm"][0] > fine["faro"]["mm"][0]


def test_the_document_is_json_with_all_of_it(found):
    document = json.loads(json.dumps(found.document()))
    assert document["contents"] == dict(found.contents)
    assert document["can"] == found.can and document["cannot"] == found.cannot
    assert document["problems"] == [] and document["odd"] == found.odd
    assert document["expected_sigma"]["lidar"]["mm"] == list(found.expected["lidar"]["mm"])


# ----------------------------------------------------------------------------------- what is wrong


def test_one_problem_does_not_hide_another(rec):
    (rec / "scans/s1.parquet").write_text("no table")
    scan(rec, "s2", ring=np.full(400, 16, np.uint16))
    (rec / "targets.csv").write_text("target,faro_x\nt0,1\n")
    (rec / "reference/mesh.ply").write_text("ply\n")
    problems_ = check(rec).problems
    for part in ("s1.parquet", "s2.parquet: ring 16", "targets.csv", "mesh.ply"):
        assert sum(part in problem for problem in problems_) == 1, (part, problems_)
    assert len(problems_) == 4


def test_a_broken_rig_hides_neither_stops_nor_targets_nor_scans(rec):
    (rec / "rig.yaml").write_text("name: [\n")
    column(rec / "stops.csv", "time_s", lambda cells: ["soon", *cells[1:]])
    column(rec / "targets.csv", "faro_x", lambda cells: ["", *cells[1:]])
    scan(rec, "s0", count=np.zeros(400))
    problems_ = check(rec).problems
    for part in ("rig.yaml", "stops.csv: row 1", "targets.csv: row 1", "s0.parquet: count"):
        assert sum(part in problem for problem in problems_) == 1, (part, problems_)


def test_a_scan_that_cannot_be_read_leaves_the_others_to_tell(rec, found):
    (rec / "scans/s1.parquet").write_text("no table")
    less = check(rec)
    assert len(less.problems) == 1 and "scans" in dict(less.contents)
    assert (
        less.expected["ring_range_offset"]["mm"][0] > found.expected["ring_range_offset"]["mm"][0]
    )


def test_a_stop_that_sees_nothing_of_the_mesh_is_a_problem(rec):
    keys = [f"base_markers.{axis}" for axis in "xyz"] + [f"mount_markers.{axis}" for axis in "xyz"]
    for key in keys:
        column(
            rec / "stops.csv", key, lambda cells: [*cells[:2], *(float(c) + 50 for c in cells[2:])]
        )
    problems_ = check(rec).problems
    assert len(problems_) == 2, problems_
    assert all("400 beams" in problem for problem in problems_)
    assert "'s2'" in problems_[0] and "'s3'" in problems_[1]


def test_a_folder_that_is_not_there_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"nowhere: .*no such folder"):
        check(tmp_path / "nowhere")


# ----------------------------------------------------------------------------------- what looks odd


def oddities(folder):
    found = check(folder)
    assert found.problems == []
    return [line for line in found.odd if "locations" not in line]


def test_a_joint_at_rest_and_one_beyond_its_limits(rec):
    column(rec / "stops.csv", "turn", lambda cells: [*cells[:-1], 3.5])
    column(rec / "stops.csv", "slide", lambda cells: ["0.1"] * 4)
    text = oddities(rec)
    assert any(t.startswith("turn is beyond its limits of -3 to 3 rad at s3") for t in text), text
    assert any(t.startswith("slide moves by 0 m in all") for t in text), text


def test_bodies_that_are_hardly_seen(rec):
    for part in ("x", "y", "z", "qw", "qx", "qy", "qz"):
        column(rec / "stops.csv", f"mount_markers.{part}", lambda cells: [cells[0], "", "", ""])
        column(rec / "stops.csv", f"base_markers.{part}", lambda cells: [*cells[:3], ""])
    text = oddities(rec)
    assert "mount_markers is seen at 1 of 4 stops only; look for what hides it" in text
    assert any(t.startswith("no tracked body is seen at s3;") for t in text), text


def test_scans_without_stop_stops_without_scan_rings_without_points(rec):
    shutil.move(rec / "scans/s3.parquet", rec / "scans/s9.parquet")
    for stop in ("s0", "s1", "s2", "s9"):
        ring = read_table(rec / f"scans/{stop}.parquet")["ring"]
        scan(rec, stop, ring=np.where(ring == 7, 8, ring).astype(np.uint16))
    text = oddities(rec)
    assert any("s9" in t and "no such stop" in t for t in text), text
    assert any(t.startswith("there is no scan of s3") for t in text), text
    assert any(t.startswith("no point comes from ring 7;") for t in text), text


def test_scans_that_the_rig_has_no_lidar_for(rec):
    rig(rec, lambda data: data.pop("lidar"))
    assert any("no 'lidar' in rig.yaml" in t for t in oddities(rec))


def test_targets_that_are_mixed_up(rec):
    column(rec / "targets.csv", "faro_x", lambda cells: [float(cells[0]) + 0.2, *cells[1:]])
    for axis in "xyz":
        path = rec / "targets.csv"
        swapped = {}
        for end in ("upper", "lower"):
            column(path, f"{end}_{axis}", lambda cells, end=end: swapped.setdefault(end, cells))
        column(path, f"upper_{axis}", lambda cells: [*cells[:3], swapped["lower"][3]])
        column(path, f"lower_{axis}", lambda cells: [*cells[:3], swapped["upper"][3]])
    text = check(rec).odd
    assert any(t.startswith("the rod of t3 does not hang as the others do") for t in text), text
    assert any(t.startswith("tracker and scanner place t") for t in text), text


def test_a_sigma_in_millimetres(rec):
    rig(rec, lambda data: data["reference"].update(sigma_m=0.6))
    assert any(t.startswith("reference.sigma_m is 0.6 m in rig.yaml") for t in oddities(rec))


def placed(roll_rad, incidence_deg=(5, 70), residual_m=0.01):
    """Scans of stops that turn about z and lean by `roll_rad`, one each."""
    spread = np.radians(np.linspace(*incidence_deg, 50))
    return [
        PlacedScan(f"s{k}", pose([k, 0, 0], [roll, 0, k]), 1.0, np.ones(50), spread, residual_m)
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
    ],
)
def test_views_that_are_alike_or_beside_the_room(change, sentence):
    (line,) = odd_beams(placed(**{"roll_rad": [0.0, 0.3, 0.1, 0.0], **change}))
    assert sentence in line
