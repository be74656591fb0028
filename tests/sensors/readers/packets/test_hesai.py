"""Packets built as Hesai's manuals lay them out, decoded by the models' own geometry."""

import struct
from pathlib import Path

import numpy as np
import pytest

from chains.errors import InputError
from sensors.lidar import load_lidar
from sensors.readers.base import Options
from sensors.readers.packets.hesai import decode_hesai, read_angles, read_hesai
from sensors.readers.packets.hesai_models import MODELS

from .captures import write_pcap

# name: head, what stands before a block's azimuth, blocks, channels, bytes of a channel, tail
LAYOUTS = {
    "PandarQT64": (b"\xee\xff\x03\x01\0\0\x40\x04\x01\x04\x02\x01", b"", 4, 64, 4, 28),
    "PandarXT-32": (b"\xee\xff\x06\x01\0\0\x20\x08\x01\x04\x02\x01", b"", 8, 32, 4, 28),
    "PandarXT-16": (b"\xee\xff\x06\x01\0\0\x10\x08\x01\x04\x02\x01", b"", 8, 16, 4, 28),
    "PandarXT-32M2X": (b"\xee\xff\x06\x01\0\0\x20\x06\x01\x05\x03\x01", b"", 6, 32, 4, 28),
    "PandarQT128": (b"\xee\xff\x03\x02\0\0\x80\x02\x01\x04\x02\x1d", b"", 2, 128, 4, 87),
    "Pandar64": (b"\xee\xff\x40\x06\0\x04\0\0", b"", 6, 64, 3, 26),
    "Pandar40P": (b"", b"\xff\xee", 10, 40, 3, 22),
}


def packet(model: str, azimuth_deg: np.ndarray, steps: np.ndarray) -> bytes:
    """One packet: azimuth (blocks,), range in the model's steps (blocks, channels)."""
    head, before, blocks, channels, unit, tail = LAYOUTS[model]
    data = head
    for block in range(blocks):
        data += before + struct.pack("<H", round(azimuth_deg[block] * 100) % 36000)
        for channel in range(channels):
            data += struct.pack("<HB", int(steps[block, channel]), channel) + b"\0" * (unit - 3)
    return data + bytes(tail)


def turns(model: str, n: int, columns: int = 240, start: int = 0) -> list[tuple[float, bytes]]:
    """Packets of n turns, single return; the range of a point is told by its place and turn."""
    _, _, blocks, channels, _, _ = LAYOUTS[model]
    count = n * columns // blocks
    assert count * blocks == n * columns
    column = np.arange(count * blocks) + start
    azimuth = column % columns * 360 / columns
    steps = 1000 + 10 * (column // columns)[:, None] + np.arange(channels)
    return [
        (k * 0.1 * blocks / columns, packet(model, azimuth[rows], steps[rows]))
        for k in range(count)
        if (rows := slice(k * blocks, (k + 1) * blocks))
    ]


def elevation_deg(model: str) -> np.ndarray:
    """(channels,) of a unit: its model's, and a little off."""
    (name,) = {m.catalog for m in MODELS if m.name == model}
    nominal = np.degrees(load_lidar(name).elevation_rad)
    return np.round(nominal + 0.3 * np.sin(np.arange(len(nominal))), 3)


def table(path: Path, model: str) -> Path:
    """Angles of every channel, degrees."""
    rows = [f"{k + 1},{e},{(k % 3 - 1) * 1.5}" for k, e in enumerate(elevation_deg(model))]
    path.write_text("\ufeffChannel,Elevation,Azimuth\n" + "\n".join(rows) + "\n")
    return path


def quiet(what: str, done: int, total: int) -> None:
    """No progress."""


def decoded(packets: list, metadata: Path | None) -> list:
    found = decode_hesai("p", "p", lambda: iter(packets), Options(metadata=metadata), quiet)
    (sweeps,) = found.sweeps
    return list(sweeps.read(np.ones(len(sweeps.time_s), bool)))


@pytest.mark.parametrize("model", LAYOUTS)
def test_every_model_by_its_geometry(model, tmp_path):
    channels = LAYOUTS[model][3]
    angles = table(tmp_path / "angles.csv", model)
    for number, turn in enumerate(decoded(turns(model, 2), angles)):
        p = turn.points
        assert len(p["x"]) == 240 * channels
        step_m = 0.005 if model == "PandarXT-32M2X" else 0.004
        xyz = np.stack([p[axis] for axis in "xyz"], axis=1).astype(float)
        range_m = np.linalg.norm(xyz, axis=1)
        np.testing.assert_allclose(range_m, step_m * (1000 + 10 * number + p["ring"]), rtol=1e-6)
        elevation = np.radians(elevation_deg(model)[p["ring"]])
        np.testing.assert_allclose(xyz[:, 2], range_m * np.sin(elevation), atol=1e-5)
        clockwise = np.arctan2(xyz[:, 0], xyz[:, 1])  # from y
        azimuth = clockwise - np.radians((p["ring"] % 3 - 1.0) * 1.5)
        away = p["column"] - (np.pi / 2 + azimuth) * 240 / (2 * np.pi)
        assert np.abs((away + 120) % 240 - 120).max() < 1e-3
        np.testing.assert_array_equal(p["intensity"], p["ring"])
        keys = p["ring"].astype(int) * 240 + p["column"]
        assert len(np.unique(keys)) == len(keys)


def test_the_farthest_of_several_returns_is_kept(tmp_path):
    angles = table(tmp_path / "angles.csv", "PandarQT64")
    near, far = np.full(64, 500), np.full(64, 700)
    far[10:] = 500
    pairs = [np.stack([near, far] * 2), np.stack([far, near] * 2)]  # whichever comes first
    packets = [
        (0.1 * k, packet("PandarQT64", np.repeat([k * 1.2, k * 1.2 + 0.6], 2), pairs[k % 2]))
        for k in range(4)
    ]
    (turn,) = decoded(packets, angles)
    assert len(turn.points["x"]) == 8 * 64
    xyz = np.stack([turn.points[axis] for axis in "xyz"], axis=1)
    expected = np.where(turn.points["ring"] < 10, 2.8, 2.0)
    np.testing.assert_allclose(np.linalg.norm(xyz, axis=1), expected, rtol=1e-6)


def test_returns_from_the_window_are_left_out(tmp_path):
    angles = table(tmp_path / "angles.csv", "PandarQT64")
    steps = np.full((4, 64), 1000)
    steps[0], steps[1] = 0, 20
    (turn,) = decoded([(0.0, packet("PandarQT64", np.arange(4) * 0.6, steps))], angles)
    assert len(turn.points["x"]) == 2 * 64


def test_turns_begin_at_azimuth_0_and_after_a_pause(tmp_path):
    angles = table(tmp_path / "angles.csv", "PandarXT-32")
    packets = turns("PandarXT-32", 2, start=100)
    sizes = [len(turn.points["x"]) // 32 for turn in decoded(packets, angles)]
    assert sizes == [140, 240, 100]
    paused = [(t + 5 * (t > 0.05), p) for t, p in turns("PandarXT-32", 1)]
    parts = decoded(paused, angles)
    assert [len(turn.points["x"]) // 32 for turn in parts] == [128, 112]
    assert parts[1].time_s - parts[0].time_s > 5


def test_packets_that_overtake_each_other_stay_in_their_turn(tmp_path):
    angles = table(tmp_path / "angles.csv", "PandarXT-32")
    packets = turns("PandarXT-32", 3)
    for k in (10, 29, 59):  # within a turn, and across two ends
        packets[k], packets[k + 1] = packets[k + 1], packets[k]
    for number, turn in enumerate(decoded(packets, angles)):
        xyz = np.stack([turn.points[axis] for axis in "xyz"], axis=1)
        range_m = np.linalg.norm(xyz, axis=1)
        expected = 0.004 * (1000 + 10 * number + turn.points["ring"])
        np.testing.assert_allclose(range_m, expected, rtol=1e-6)
        assert len(xyz) == 240 * 32


def test_only_wanted_turns_are_decoded_and_each_is_itself(tmp_path):
    angles = table(tmp_path / "angles.csv", "PandarXT-32")
    packets = turns("PandarXT-32", 5, start=7)
    found = decode_hesai("p", "p", lambda: iter(packets), Options(metadata=angles), quiet)
    (sweeps,) = found.sweeps
    every = list(sweeps.read(np.ones(6, bool)))
    wanted = np.array([False, True, False, True, True, False])
    some = list(sweeps.read(wanted))
    assert [turn.time_s for turn in some] == list(sweeps.time_s[wanted])
    for turn, whole in zip(some, np.array(every, dtype=object)[wanted], strict=True):
        np.testing.assert_array_equal(turn.points["x"], whole.points["x"])


def test_a_capture_is_read_with_nothing_but_itself(tmp_path):
    packets = turns("PandarXT-32", 1)
    halves = [packets[:10], packets[10:]]
    files = [
        write_pcap(tmp_path / f"{k}.pcap", [(t, 2368, p) for t, p in half] + [(0.0, 8308, b"gps")])
        for k, half in enumerate(halves)
    ]
    found = read_hesai(files, Options(), quiet)
    (sweeps,) = found.sweeps
    assert len(sweeps.time_s) == 1 and found.lidar["model"] == "hesai_pandarxt32"
    assert any("no table of angles was given" in line for line in found.odd)
    assert any("optical centre 31.5 mm out" in line for line in found.odd)
    (turn,) = sweeps.read(np.array([True]))
    lidar = load_lidar("hesai_pandarxt32")
    elevation = lidar.elevation_rad[turn.points["ring"]]
    xyz = np.stack([turn.points[axis] for axis in "xyz"], axis=1)
    np.testing.assert_allclose(
        xyz[:, 2], np.linalg.norm(xyz, axis=1) * np.sin(elevation), atol=1e-5
    )


@pytest.mark.parametrize("model", LAYOUTS)
def test_every_model_has_angles_of_the_catalogue(model):
    """Without a table: as many rings as channels, and it is said that they are nominal."""
    found = decode_hesai("p", "p", lambda: iter(turns(model, 1)), Options(), quiet)
    lidar = load_lidar(found.lidar["model"])
    assert lidar.rings == LAYOUTS[model][3] == len(found.lidar["elevation_deg"])
    assert any("nominal" in line for line in found.odd)


def test_two_sensors_in_one_capture_must_be_told_apart(tmp_path):
    packets = [(t, 2368 + k % 2, p) for k, (t, p) in enumerate(turns("PandarXT-32", 1))]
    path = write_pcap(tmp_path / "a.pcap", packets)
    with pytest.raises(InputError, match=r"several LiDARs, 97\.98\.99\.100:2368 and"):
        read_hesai([path], Options(), quiet)
    options = Options(topics=("97.98.99.100:2369",))
    (sweeps,) = read_hesai([path], options, quiet).sweeps
    (turn,) = sweeps.read(np.ones(len(sweeps.time_s), bool))
    assert len(turn.points["x"]) == 120 * 32


def test_what_cannot_be_decoded_is_refused(tmp_path):
    wrong = Options(metadata=table(tmp_path / "angles.csv", "Pandar40P"))
    with pytest.raises(InputError, match="40 channels, but p comes from a PandarXT-32"):
        decode_hesai("p", "p", lambda: iter(turns("PandarXT-32", 1)), wrong, quiet)
    another = Options(metadata=table(tmp_path / "angles.csv", "Pandar64"))
    with pytest.raises(InputError, match=r"no table of a PandarQT64's angles.*deg off"):
        decode_hesai("p", "p", lambda: iter(turns("PandarQT64", 1)), another, quiet)
    newer = [(0.0, b"\xee\xff\x01\x04" + bytes(857))]
    with pytest.raises(InputError, match=r"861 bytes, Hesai's protocol 1\.4"):
        decode_hesai("p", "p", lambda: iter(newer), Options(), quiet)
    path = write_pcap(tmp_path / "a.pcap", [(0.0, 1, b"x" * 900)])
    with pytest.raises(InputError, match="packets of 900 bytes"):
        read_hesai([path], Options(), quiet)


@pytest.mark.parametrize("text", ["", "a,b,c\n", "1,2\n2,3\n", "1,0,0\n3,0,0\n", "1,0,x\n"])
def test_a_table_that_is_none_is_refused(text, tmp_path):
    (tmp_path / "t.csv").write_text(text)
    with pytest.raises(InputError, match=r"t\.csv is no table of angles"):
        read_angles(tmp_path / "t.csv")
    with pytest.raises(InputError, match="cannot be read"):
        read_angles(tmp_path / "none.csv")


@pytest.mark.parametrize("lost", [0, 1, 60])
def test_packets_that_are_missing_are_counted(lost, tmp_path):
    packets = turns("PandarXT-32", 20)
    gone = np.random.default_rng(0).choice(np.arange(90, 420), lost, replace=False)
    left = [(t, 2368, p) for k, (t, p) in enumerate(packets) if k not in gone]
    (sweeps,) = read_hesai([write_pcap(tmp_path / "a.pcap", left)], Options(), quiet).sweeps
    assert sweeps.lost == pytest.approx(lost / len(packets), rel=0.3)


def test_turns_that_a_pause_cuts_lack_nothing(tmp_path):
    """A capture for each hold: each begins and ends within a turn."""
    packets = turns("PandarXT-32", 9)[13:-13]
    parts = [
        write_pcap(tmp_path / f"hold_{k}.pcap", [(t + 10.0 * k, 2368, p) for t, p in packets])
        for k in range(6)
    ]
    (sweeps,) = read_hesai(parts, Options(), quiet).sweeps
    assert sweeps.lost == 0.0
