"""Recordings and scans as other libraries' tables and clouds."""

import sys

import numpy as np
import pytest

from chains.errors import InputError
from sensors.recording import RecordedStops, read_scan, write_table

STOPS = """stop,location,time_s,elbow,hand.x,hand.y,hand.z,hand.qw,hand.qx,hand.qy,hand.qz,\
tip.x,tip.y,tip.z,temperature_c
s1,L0,1.5,0.25,1,2,3,1,0,0,0,4,5,6,20.5
s2,L1,2.5,-0.5,,,,,,,,7,8,9,21.5
"""


@pytest.fixture
def recording(tmp_path):
    """Two stops, the first with a scan of 5 points."""
    (tmp_path / "stops.csv").write_text(STOPS)
    (tmp_path / "scans").mkdir()
    columns = {axis: np.arange(1, 6, dtype=np.float32) + i for i, axis in enumerate("xyz")}
    columns |= {"ring": np.arange(5, dtype=np.uint16), "column": np.arange(5, dtype=np.uint16) * 3}
    columns |= {"intensity": np.linspace(0, 1, 5), "humidity": np.full(5, 0.4)}
    write_table(tmp_path / "scans" / "s1.parquet", columns)
    return RecordedStops.open(tmp_path, ["elbow"], ["hand", "tip"], rings=8)


def test_stops_are_a_data_frame_with_the_columns_of_their_file(recording):
    pandas = pytest.importorskip("pandas")
    frame = recording.to_pandas()
    expected = pandas.read_csv(recording.folder / "stops.csv")
    pandas.testing.assert_frame_equal(frame[expected.columns], expected, check_dtype=False)
    assert list(frame.columns) == list(expected.columns)


def test_a_scan_is_the_same_in_every_library(recording):
    pytest.importorskip("pandas")
    scan = recording.scan(0)
    frame, table, cloud = scan.to_pandas(), scan.to_arrow(), scan.to_open3d()
    assert frame.columns.tolist() == table.column_names
    assert {"x", "y", "z", "ring", "column", "intensity", "humidity"} <= set(frame.columns)
    for name in table.column_names:
        np.testing.assert_array_equal(frame[name], table[name].to_numpy())
        if name not in "xyz":
            np.testing.assert_array_equal(cloud.point[name].numpy()[:, 0], frame[name])
    np.testing.assert_array_equal(cloud.point["positions"].numpy(), scan.xyz_m)
    assert frame["ring"].dtype.kind == "i"


def test_a_scan_written_from_its_arrow_table_is_read_back(recording, tmp_path):
    import pyarrow.parquet

    scan = recording.scan(0)
    pyarrow.parquet.write_table(scan.to_arrow(), tmp_path / "again.parquet")
    again = read_scan(tmp_path / "again.parquet")
    np.testing.assert_array_equal(again.xyz_m, scan.xyz_m)
    np.testing.assert_array_equal(again.ring, scan.ring)
    np.testing.assert_array_equal(again.extra["humidity"], scan.extra["humidity"])


def test_a_library_that_is_missing_is_named(recording, monkeypatch):
    monkeypatch.setitem(sys.modules, "pandas", None)
    monkeypatch.setitem(sys.modules, "open3d", None)
    for make in (recording.to_pandas, recording.scan(0).to_pandas):
        with pytest.raises(InputError, match="needs pandas: pip install pandas"):
            make()
    with pytest.raises(InputError, match="needs open3d: pip install open3d"):
        recording.scan(0).to_open3d()
