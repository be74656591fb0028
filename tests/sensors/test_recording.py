"""Recordings: what is written is what is read, and what is wrong is named."""

import shutil
from unittest.mock import patch

import numpy as np
import pytest

from chains.errors import InputError
from sensors.holds import spread_known
from sensors.recording import RecordedStops, read_table, write_table

JOINTS = ("shoulder", "slide")
HEADER = "stop,location,time_s,shoulder,slide,cart.x,cart.y,cart.z,cart.qw,cart.qx,cart.qy,cart.qz"
ROWS = (
    "a,L0,0,0.1,0.2,1,2,3,1,0,0,0",
    "b,L0,60,-3.1,0.0,,,,,,,",
    "c,L1,120,1,1,1,2,3,0.6,0,0,0.8001",
)
TARGETS = (
    "target,faro_x,faro_y,faro_z,upper_x,upper_y,upper_z,lower_x,lower_y,lower_z",
    "T1,0,0,0,0,0,0.4,0,0,0.2",
    "T2,1,0,0,1,0,0.4,1,0,0.2",
    "T3,0,1,0,0,1,0.4,0,1,0.2",
)


def cloud(**changes):
    """Columns of a small averaged scan; None leaves a column out."""
    columns = {
        "x": np.array([1, 2, 3], np.float32),
        "y": np.array([0, 1, 0], np.float32),
        "z": np.array([0, 0, 1], np.float32),
        "ring": np.array([0, 1, 2], np.uint16),
        "column": np.array([5, 6, 7], np.uint16),
        "intensity": np.array([10, 20, 30], np.float32),
    }
    return {name: values for name, values in (columns | changes).items() if values is not None}


@pytest.fixture
def write(tmp_path):
    """A function that writes a recording folder and returns it."""

    def write_recording(header=HEADER, rows=ROWS, targets=TARGETS, scans=None):
        (tmp_path / "stops.csv").write_text("\n".join([header, *rows]) + "\n")
        if targets:
            (tmp_path / "targets.csv").write_text("\n".join(targets) + "\n")
        for name, columns in (scans or {}).items():
            write_table(tmp_path / "scans" / f"{name}.parquet", columns)
        return tmp_path

    return write_recording


def open_cart(folder, **changes):
    """Open a recording of the cart that the tests write."""
    return RecordedStops.open(
        folder, **({"joint_names": JOINTS, "bodies": ["cart"], "rings": 4} | changes)
    )


def test_stops_are_read_as_written(write):
    guess = [f"base_guess.{part}" for part in ("x", "y", "z", "qw", "qx", "qy", "qz")]
    cells = [",20.5,ok,7,8,9,1,0,0,0", ",,3 times,7,8,9,1,0,0,0", ",22,,7,8,9,1,0,0,0"]
    folder = write(
        ",".join([HEADER, "temperature_c", "note", *guess]),
        [row + more for row, more in zip(ROWS, cells, strict=True)],
        scans={"a": cloud(), "c": cloud()},
    )
    recording = open_cart(folder)
    assert recording.stops == ["a", "b", "c"] and recording.location.tolist() == ["L0", "L0", "L1"]
    np.testing.assert_array_equal(recording.time_s, [0, 60, 120])
    np.testing.assert_array_equal(recording.joints, [[0.1, 0.2], [-3.1, 0], [1, 1]])
    cart = recording.bodies["cart"]
    assert cart.shape == (3, 7) and np.isnan(cart[1]).all()
    np.testing.assert_allclose(cart[2], [1, 2, 3, 0.6, 0, 0, 0.8], atol=1e-4)
    np.testing.assert_allclose(np.linalg.norm(cart[2, 3:]), 1, atol=1e-15)
    np.testing.assert_array_equal(recording.base_guess, np.tile([7, 8, 9, 1, 0, 0, 0], (3, 1)))
    assert list(recording.covariates) == ["temperature_c"]
    np.testing.assert_array_equal(recording.covariates["temperature_c"], [20.5, np.nan, 22])
    assert recording.has_scan.tolist() == [True, False, True]
    np.testing.assert_array_equal(
        recording.targets.upper_m - recording.targets.lower_m, [[0, 0, 0.2]] * 3
    )


def test_a_body_without_quaternion_is_a_point_and_an_arm_is_optional(write):
    recording = RecordedStops.open(
        write("stop,location,time_s,nest.x,nest.y,nest.z", ["a,L,0,1,2,3", "b,L,1,,,"], None),
        [],
        ["nest"],
    )
    assert recording.joints.shape == (2, 0) and recording.targets is None
    np.testing.assert_array_equal(
        recording.bodies["nest"], [[1, 2, 3, *[np.nan] * 4], [np.nan] * 7]
    )


def replace(rows, old, new):
    """The rows with one text replaced, which must be there."""
    assert sum(old in row for row in rows) == 1
    return [row.replace(old, new) for row in rows]


@pytest.mark.parametrize("column", ["t", "time_s"])
def test_a_recording_may_be_without_times(write, column):
    """No such column, or one without a single value."""
    rows = [",".join([*row.split(",")[:2], "", *row.split(",")[3:]]) for row in ROWS]
    recording = open_cart(write(HEADER.replace("time_s", column), rows))
    assert np.isnan(recording.time_s).all() and not recording.timed


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"rows": []}, r"stops\.csv has no rows"),
        ({"rows": replace(ROWS, "b,L0", "a,L0")}, r"stops\.csv: row 2: a is there twice"),
        ({"rows": replace(ROWS, "b,L0", "../b,L0")}, r"row 2: '\.\./b' is no name for a file"),
        ({"header": HEADER.replace("slide", "slid")}, r"column slide is missing; the arm's URDF"),
        ({"header": HEADER.replace("location", "l")}, r"column location is missing"),
        (
            {"header": HEADER.replace("cart.qy", "cart.q")},
            r"column cart\.qy is missing; cart needs",
        ),
        ({"header": HEADER.replace("cart", "wagon")}, r"column cart\.x is missing"),
        ({"rows": replace(ROWS, "0.1", "hot")}, r"row 1 \(a\): shoulder is 'hot', not a number"),
        ({"rows": replace(ROWS, "60", "")}, r"row 2 \(b\): time_s is empty"),
        ({"rows": replace(ROWS, "0.1", "nan")}, r"row 1 \(a\): shoulder is empty"),
        ({"rows": replace(ROWS, "-3.1", "-178")}, r"row 2 \(b\): shoulder is -178;.*degrees"),
        ({"rows": replace(ROWS, "1,1,1,2,3", "1,1,,2,3")}, r"row 3 \(c\): cart\.x is empty"),
        ({"rows": replace(ROWS, "0.6,", ",")}, r"row 3 \(c\): cart\.qw is empty"),
        (
            {"rows": replace(ROWS, "3,1,0,0,0", "inf,1,0,0,0")},
            r"row 1 \(a\): cart\.z is empty or not",
        ),
        (
            {"rows": replace(ROWS, "3,1,0,0,0", "x,1,0,0,0")},
            r"row 1 \(a\): cart\.z is 'x', not a num",
        ),
        ({"rows": replace(ROWS, "0.6,", "0.7,")}, r"row 3 \(c\): the quaternion.*length 1\.063"),
        (
            {"rows": replace(ROWS, "2,3,1,", "2400,3,1,")},
            r"row 1 \(a\): cart is 2400 m.*millimetres",
        ),
        ({"targets": TARGETS[:3]}, r"targets\.csv has 2 rows; it takes 3"),
        (
            {"targets": replace(TARGETS, "T2,1", "T2,")},
            r"targets\.csv: row 2 \(T2\): faro_x is empty",
        ),
        ({"targets": replace(TARGETS, "T3,0,1", "T3,0,?")}, r"row 3 \(T3\): faro_y is '\?'"),
        ({"targets": replace(TARGETS, "T3,0,1", "T3,0,1200")}, r"row 3 \(T3\): faro_y is 1200"),
        (
            {"targets": replace(TARGETS, "upper_z", "upper")},
            r"targets\.csv: column upper_z is missing",
        ),
        ({"targets": replace(TARGETS, "1,0,0.4", "1,0,0.2")}, r"row 2 \(T2\): the two markers"),
        ({"scans": {"elsewhere": cloud()}}, r"scans holds elsewhere\.parquet.*such as a\.parquet"),
    ],
)
def test_what_is_wrong_in_the_tables_is_named_in_one_sentence(write, change, sentence):
    with pytest.raises(InputError, match=sentence) as error:
        open_cart(write(**change))
    assert "\n" not in str(error.value)


def test_a_covariate_that_is_mostly_numbers_must_be_so_throughout(write):
    rows = [row + cell for row, cell in zip(ROWS, [",20", ",2o", ",21"], strict=True)]
    with pytest.raises(InputError, match=r"row 2 \(b\): temperature_c is '2o', not a number"):
        open_cart(write(HEADER + ",temperature_c", rows))


@pytest.mark.parametrize("name", ["temperature_c", "flange.payload_kg", "j1.torque"])
def test_what_is_measured_in_numbers_is_none_with_a_unit_and_never_infinite(write, name):
    def opened(cells, name=name):
        rows = [row + "," + cell for row, cell in zip(ROWS, cells, strict=True)]
        return open_cart(write(HEADER + f",{name}", rows))

    with pytest.raises(InputError, match=rf"row 1 \(a\): {name} is '20.1 C', not a number"):
        opened(["20.1 C", "20.2 C", ""])
    with pytest.raises(InputError, match=rf"row 2 \(b\): {name} is not finite; leave a cell empty"):
        opened(["20", "inf", "21"])
    assert not opened(["warm", "cold", ""], name="weather").covariates
    np.testing.assert_array_equal(opened(["20", "", "21"]).covariates[name], [20, np.nan, 21])


def test_a_folder_without_stops_is_named(tmp_path):
    with pytest.raises(InputError, match=r"stops\.csv does not exist"):
        open_cart(tmp_path)


def test_an_averaged_scan_is_read_as_written(write):
    columns = cloud(
        count=np.array([20, 19, 1], np.uint16),
        range_std_m=np.array([0.01, 0.02, np.nan], np.float32),
        signal=np.array([1, 2, 3], np.int32),
        comment=np.array(["a", "b", "c"]),
        __index_level_0__=np.array([4, 7, 9]),  # as pandas writes what is left of a table
    )
    scan = open_cart(write(scans={"a": columns})).scan(0)
    np.testing.assert_array_equal(scan.xyz_m, [[1, 0, 0], [2, 1, 0], [3, 0, 1]])
    assert scan.xyz_m.dtype == np.float64 and scan.ring.dtype == scan.column.dtype == np.int64
    assert (scan.ring.tolist(), scan.column.tolist()) == ([0, 1, 2], [5, 6, 7])
    assert (scan.intensity.tolist(), scan.count.tolist()) == ([10, 20, 30], [20, 19, 1])
    np.testing.assert_array_equal(scan.range_std_m, columns["range_std_m"])
    assert list(scan.extra) == ["signal"] and scan.extra["signal"].tolist() == [1, 2, 3]


@pytest.mark.parametrize(
    ("spread_m", "count", "known"),
    [
        ([0.01, 0.02, 0.03], [20, 20, 20], [True, True, True]),
        ([0.0, 0.02, 0.03], [20, 20, 20], [True, True, True]),  # one of them by chance
        ([0.0, 0.0, 0.03], [20, 20, 20], [False, False, False]),  # nothing was recorded
        ([0.01, np.nan, 0.0], [20, 20, 1], [True, False, False]),  # one sweep has no spread
    ],
)
def test_which_spreads_say_how_far_sweeps_scatter(write, spread_m, count, known):
    columns = cloud(count=np.array(count), range_std_m=np.array(spread_m))
    scan = open_cart(write(scans={"a": columns})).scan(0)
    assert spread_known(scan.range_std_m, scan.count).tolist() == known
    first = np.arange(3) == 0  # alone, a spread of 0 tells nothing
    alone = known[0] and spread_m[0] > 0
    assert spread_known(scan.range_std_m, scan.count, first).tolist() == [alone, False, False]


def test_what_a_scan_does_not_say_is_unknown_and_no_returns_are_left_out(write):
    columns = cloud(
        intensity=None, x=np.array([1, np.nan, 0], np.float32), z=np.zeros(3, np.float32)
    )
    scan = open_cart(write(scans={"a": columns})).scan(0)
    np.testing.assert_array_equal(scan.xyz_m, [[1, 0, 0]])
    assert scan.ring.tolist() == [0] and scan.count.tolist() == [1]
    assert np.isnan(scan.intensity).all() and np.isnan(scan.range_std_m).all()


NONE = np.zeros(3, np.float32)


@pytest.mark.parametrize(
    ("columns", "sentence"),
    [
        (cloud(y=None), r"a\.parquet: column y is missing; a scan has x, y, z, ring, column"),
        (cloud(ring=None), r"a\.parquet: column ring is missing"),
        (
            cloud(x=np.array(["1", "2", "3"])),
            r"a\.parquet: column x is string; it should be float32",
        ),
        (cloud(ring=np.array([0.0, 1.0, 2.0])), r"column ring is double; it should be uint16"),
        (cloud(ring=np.array([0, 1, 4])), r"a\.parquet: ring 4 is not in the sensor's 0 to 3"),
        (cloud(ring=np.array([0, -1, 3])), r"a\.parquet: ring -1 is not in the sensor's 0 to 3"),
        (cloud(x=1000 * cloud()["x"]), r"a\.parquet: half of the points are beyond 2000 m"),
        (cloud(x=NONE, y=NONE, z=NONE), r"a\.parquet has no returns"),
        (cloud(x=NONE + np.nan), r"a\.parquet has no returns"),
        ({name: values[:0] for name, values in cloud().items()}, r"a\.parquet has no returns"),
        (
            {name: values[:0] for name, values in cloud(scan=np.zeros(3, int)).items()},
            r"a\.parquet has no returns",
        ),
        (cloud(count=np.array([3, 0, 1])), r"a\.parquet: count is below 1"),
    ],
)
def test_what_is_wrong_in_a_scan_is_named_in_one_sentence(write, columns, sentence):
    with pytest.raises(InputError, match=sentence) as error:
        open_cart(write(scans={"a": columns})).scan(0)
    assert "\n" not in str(error.value)


def test_an_empty_cell_of_an_index_is_refused(write):
    pyarrow = pytest.importorskip("pyarrow")
    folder = write(scans={"a": cloud()})
    from pyarrow import parquet

    for extra in ({}, {"scan": [0, 0, 1]}):
        table = pyarrow.table(
            cloud() | {"ring": pyarrow.array([0, None, 2], pyarrow.uint16())} | extra
        )
        parquet.write_table(table, folder / "scans/a.parquet")
        with pytest.raises(InputError, match=r"a\.parquet: column ring has empty cells"):
            open_cart(folder).scan(0)


def test_a_scan_that_is_missing_or_no_parquet_is_named(write):
    folder = write(scans={"a": cloud()})
    with pytest.raises(InputError, match=r"b\.parquet does not exist"):
        open_cart(folder).scan(1)
    (folder / "scans/a.parquet").write_text("x y z")
    with pytest.raises(InputError, match=r"a\.parquet is not a Parquet file"):
        open_cart(folder).scan(0)


def test_tables_come_back_as_they_were(tmp_path):
    columns = {
        "f": np.array([1.5, np.nan]),
        "u": np.array([1, 65535], np.uint16),
        "s": np.array(["a", "bé"]),
        "strided": np.arange(4.0)[::2],
    }
    write_table(tmp_path / "t.parquet", columns)
    for name, values in read_table(tmp_path / "t.parquet").items():
        np.testing.assert_array_equal(values, columns[name])
        assert values.dtype.kind == columns[name].dtype.kind


def test_the_digest_changes_with_any_file_and_only_then(write):
    folder = write(scans={"a": cloud()})
    before = open_cart(folder).digest()
    (folder / "notes.txt").write_text("not a part")
    assert open_cart(folder).digest() == before and len(before) == 64
    write_table(folder / "scans/a.parquet", cloud(z=np.ones(3, np.float32)))
    after = open_cart(folder).digest()
    (folder / "targets.csv").unlink()
    assert len({before, after, open_cart(folder).digest()}) == 3


def test_recordings_by_an_independent_simulator_open_without_their_scans(shared, tmp_path):
    names = [f"joint_{i}" for i in range(1, 7)]
    bodies = ["base_markers", "mount_markers"]
    folder = shared / "recordings/known_nothing_hidden"
    with patch("sensors.recording.read_table", side_effect=AssertionError("a scan was read")):
        recording = RecordedStops.open(folder, names, bodies, rings=128)
    assert recording.joints.shape == (30, 6) and recording.has_scan.all()
    assert len(recording.targets.names) == 5 and list(recording.covariates) == [
        "temperature_c",
        "humidity",
    ]
    unseen = np.isnan(recording.bodies["mount_markers"]).all(axis=1)
    assert 0 < unseen.sum() < 10 and not np.isnan(recording.bodies["base_markers"]).any()
    scan = recording.scan(29)
    assert len(scan.xyz_m) > 5000 and np.unique(scan.ring).size == 128
    assert (scan.count == 20).all() and 0.001 < np.median(scan.range_std_m) < 0.05

    for part in ("stops.csv", "scans"):
        (shutil.copytree if (folder / part).is_dir() else shutil.copy)(
            folder / part, tmp_path / part
        )
    shutil.rmtree(tmp_path / "scans")
    assert not RecordedStops.open(tmp_path, names, bodies).has_scan.any()
