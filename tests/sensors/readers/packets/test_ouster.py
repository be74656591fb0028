"""Packets built as Ouster's manuals lay them out; metadata of every firmware."""

import json
import struct
from pathlib import Path

import numpy as np
import pytest

from chains.errors import InputError
from sensors.lidar import beams
from sensors.readers.base import Options
from sensors.readers.packets.ouster import OusterDecoder, decode_ouster, read_metadata, read_ouster

from .captures import write_pcap

RINGS, COLUMNS = 16, 64
ALTITUDE = np.linspace(30, -30, RINGS)
AZIMUTH = np.tile([4.2, 1.4, -1.4, -4.2], 4)
ORIGIN_MM = 27.67
PROFILES = (
    "LEGACY",
    "RNG19_RFL8_SIG16_NIR16",
    "RNG19_RFL8_SIG16_NIR16_DUAL",
    "RNG15_RFL8_NIR8",
)


def facts(profile: str = "RNG15_RFL8_NIR8", **others: object) -> dict:
    """Metadata as firmware 2.x writes it."""
    return {
        "prod_line": "OS-1-16",
        "lidar_mode": f"{COLUMNS}x10",
        "beam_altitude_angles": ALTITUDE.tolist(),
        "beam_azimuth_angles": AZIMUTH.tolist(),
        "lidar_origin_to_beam_origin_mm": ORIGIN_MM,
        "data_format": {
            "pixels_per_column": RINGS,
            "columns_per_frame": COLUMNS,
            "columns_per_packet": 16,
            "udp_profile_lidar": profile,
        },
        **others,
    }


def range_mm(frame: int) -> np.ndarray:
    """Range (COLUMNS, RINGS) of a turn; whole steps of the coarsest profile."""
    column, ring = np.indices((COLUMNS, RINGS))
    return 8 * (200 + 7 * column + ring + 500 * frame)


def pixel(profile: str, mm: int, reflectivity: int) -> bytes:
    """One pixel; bits that are not the range are set."""
    if profile == "LEGACY":
        return struct.pack("<IHHHH", mm | 0xFFF << 20, reflectivity, 1, 7, 0)
    if profile == "RNG15_RFL8_NIR8":
        return struct.pack("<HBB", mm // 8 | 0x8000, reflectivity, 7)
    if profile.endswith("DUAL"):
        first = mm | reflectivity << 24 | 0x1F << 19
        return struct.pack("<IIHHHH", first, mm + 999, 1, 1, 7, 0)
    return struct.pack("<IBBHHH", mm | 0x1FFF << 19, reflectivity, 0, 1, 7, 0)


def packets(profile: str, frames: list[int], invalid: set[int] = frozenset()) -> list:
    """Packets of whole turns; columns of `invalid` ids are marked so."""
    found = []
    for number, frame in enumerate(frames):
        mm = range_mm(number)
        for first in range(0, COLUMNS, 16):
            legacy = profile == "LEGACY"
            data = b"" if legacy else struct.pack("<HH", 1, frame) + bytes(28)
            for column in range(first, first + 16):
                good = column not in invalid
                if legacy:
                    data += struct.pack("<QHHI", 0, column, frame, 0)
                else:
                    data += struct.pack("<QHH", 0, column, int(good))
                data += b"".join(pixel(profile, int(r), k) for k, r in enumerate(mm[column]))
                data += struct.pack("<I", 0xFFFFFFFF * good) if legacy else b""
            data += b"" if legacy else bytes(32)
            found.append((number * 0.1 + first / COLUMNS * 0.1, data))
    return found


def quiet(what: str, done: int, total: int) -> None:
    """No progress."""


def decoded(packets: list, facts: dict) -> list:
    metadata = read_metadata("m.json", json.dumps(facts))
    found = decode_ouster("p", "p", lambda: iter(packets), metadata, Options(), quiet)
    (sweeps,) = found.sweeps
    return list(sweeps.read(np.ones(len(sweeps.time_s), bool)))


@pytest.mark.parametrize("profile", PROFILES)
def test_every_profile_by_its_geometry(profile):
    for number, turn in enumerate(decoded(packets(profile, [65535, 0]), facts(profile))):
        p = turn.points
        assert len(p["x"]) == RINGS * COLUMNS
        xyz = np.stack([p[axis] for axis in "xyz"], axis=1).astype(float)
        encoder = np.pi - 2 * np.pi * p["column"] / COLUMNS
        n = ORIGIN_MM / 1000
        reach = xyz - n * np.stack([np.cos(encoder), np.sin(encoder), 0 * encoder], axis=1)
        along = np.linalg.norm(reach, axis=1)
        mm = range_mm(number)[p["column"], p["ring"]]
        np.testing.assert_allclose(along, mm / 1000 - n, atol=1e-6)
        elevation = np.degrees(np.arcsin(reach[:, 2] / along))
        np.testing.assert_allclose(elevation, ALTITUDE[p["ring"]], atol=1e-4)
        turned = np.arctan2(reach[:, 1], reach[:, 0]) - encoder + np.radians(AZIMUTH[p["ring"]])
        assert np.abs((turned + np.pi) % (2 * np.pi) - np.pi).max() < 1e-5
        np.testing.assert_array_equal(p["intensity"], p["ring"])
        np.testing.assert_array_equal(p["near_infrared"], 7)


def test_beams_start_where_the_rig_is_told_they_do():
    (turn,) = decoded(packets("LEGACY", [5]), facts("LEGACY", beam_azimuth_angles=[0] * RINGS))
    xyz = np.stack([turn.points[axis] for axis in "xyz"], axis=1)
    seen = beams(xyz, (ORIGIN_MM / 1000, 0))
    np.testing.assert_allclose(
        np.degrees(seen.elevation_rad), ALTITUDE[turn.points["ring"]], atol=1e-4
    )


@pytest.mark.parametrize("profile", PROFILES)
def test_columns_that_the_sensor_disowns_are_left_out(profile):
    (turn,) = decoded(packets(profile, [9], invalid={3, 40}), facts(profile))
    assert set(range(COLUMNS)) - set(turn.points["column"].tolist()) == {3, 40}


def test_turns_are_told_by_the_sensors_counter():
    lost = packets("LEGACY", [65534, 65535, 0, 2])
    del lost[5]
    turns = decoded(lost, facts("LEGACY"))
    assert [len(t.points["x"]) // RINGS for t in turns] == [64, 48, 64, 64]


def test_metadata_of_newer_firmware_says_the_same():
    old = facts()
    new = {
        "sensor_info": {"prod_line": "OS-1-16"},
        "beam_intrinsics": {
            key: old[key]
            for key in ("beam_altitude_angles", "beam_azimuth_angles")
        } | {"beam_to_lidar_transform": [1, 0, 0, ORIGIN_MM, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]},
        "lidar_data_format": old["data_format"],
        "config_params": {"lidar_mode": old["lidar_mode"]},
    }  # fmt: skip
    one, other = (read_metadata("m", json.dumps(text)) for text in (old, new))
    assert one.lidar == other.lidar and one.profile == other.profile and not other.odd


def test_a_beam_origin_that_is_not_stated_is_the_makers_and_said():
    text = facts(prod_line="OS-0-128-U1")
    del text["lidar_origin_to_beam_origin_mm"]
    metadata = read_metadata("m.json", json.dumps(text))
    assert metadata.beam_origin_m == pytest.approx(0.02767)
    assert any("27.67 mm from the axis is taken" in line for line in metadata.odd)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("{", "is no JSON"),
        ("[]", "holds no mapping"),
        ("{}", "lacks beam_altitude_angles and beam_azimuth_angles"),
        (json.dumps(facts("FUSA_RNG15")), "profile FUSA_RNG15, which cannot be decoded"),
        (json.dumps(facts(beam_azimuth_angles=[1, 2])), "2 azimuth angles for 16 rings"),
        (json.dumps(facts(lidar_mode="fast", data_format={})), "is no metadata"),
    ],
)
def test_metadata_that_does_not_do_is_refused(text, words):
    with pytest.raises(InputError, match=words):
        read_metadata("m.json", text)


def test_the_metadata_beside_a_capture_is_found(tmp_path):
    data = [(t, 7502, p) for t, p in packets("RNG15_RFL8_NIR8", [1])]
    capture = write_pcap(tmp_path / "drive_n3.pcap", data, mtu=1500)
    with pytest.raises(InputError, match="--metadata"):
        read_ouster([capture], Options(), quiet)
    (tmp_path / "drive.json").write_text(json.dumps(facts()))
    (tmp_path / "dri.json").write_text("{}")
    found = read_ouster([capture], Options(), quiet)
    (turn,) = found.sweeps[0].read(np.array([True]))
    assert len(turn.points["x"]) == RINGS * COLUMNS
    assert found.lidar["beam_origin_m"] == [0.02767, 0.0]
    with pytest.raises(InputError, match="right sensor"):
        other = tmp_path / "other.json"
        other.write_text(json.dumps(facts("LEGACY")))
        read_ouster([capture], Options(metadata=other), quiet)


def test_a_json_among_the_files_is_the_metadata(tmp_path):
    capture, told = tmp_path / "a.pcap", tmp_path / "sensor.json"
    write_pcap(capture, [(t, 7502, p) for t, p in packets("RNG19_RFL8_SIG16_NIR16", [1])])
    told.write_text(json.dumps(facts("RNG19_RFL8_SIG16_NIR16")))
    (sweeps,) = read_ouster([capture, told], Options(), quiet).sweeps
    assert len(sweeps.time_s) == 1
    with pytest.raises(InputError, match="one JSON too many"):
        read_ouster([capture, told], Options(metadata=told), quiet)
    with pytest.raises(InputError, match="its PCAP is not given"):
        read_ouster([told], Options(), quiet)


def test_packets_have_the_sizes_of_the_manual():
    """Of a 64-ring sensor: 12608 and 4352 bytes, as the manual lists them."""
    for profile, size in (("LEGACY", 12608), ("RNG15_RFL8_NIR8", 4352)):
        text = facts(profile, beam_altitude_angles=[0] * 64, beam_azimuth_angles=[0] * 64)
        text["data_format"]["pixels_per_column"] = 64
        assert OusterDecoder(read_metadata("m", json.dumps(text))).size == size


def test_an_osf_that_is_none_is_refused(tmp_path):
    for name, data in (
        ("empty", b""),
        ("text", b"hello, this is text"),
        ("head", b"\0" * 8 + b"OSF$"),
    ):
        path: Path = tmp_path / f"{name}.osf"
        path.write_bytes(data)
        with pytest.raises(InputError, match=f"{name}.osf"):
            read_ouster([path], Options(), quiet)
    with pytest.raises(InputError, match="cannot be read"):
        read_ouster([tmp_path / "none.osf"], Options(), quiet)
