"""Small files that are made to fill the memory, the disk or the time of who reads them."""

import bz2
import io
import json
import sqlite3
import struct
import zipfile
import zlib

import lz4.frame
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from backports import zstd

from chains.errors import InputError
from sensors.readers.bags.bounded import check_database, unpack_bz2, unpack_lz4, unpack_zstd
from sensors.readers.packets.osf import _png, _zpng

from ..calib import rigs
from .outcomes import Sample, zygote

MOST_MB = 300  # of any of these
BYTES = 300 << 20  # more than any file may unpack to


@pytest.fixture(scope="module")
def reader():
    with zygote() as process:
        yield process


def refused(reader, kind, path, *words, **options):
    """That a file is refused in a sentence with its name and these words, at little cost."""
    found = reader.read(Sample(kind, path, options))
    assert not found.fault(path), found
    assert found.outcome == "refused", found
    assert all(word in found.said for word in words), found.said
    assert found.mb < MOST_MB and found.seconds < 10, found


# ------------------------------------------------------------------------------------------- texts


def laughs(levels=40):
    """Each list holds the one before twice."""
    return "a0: &a0 [x, x]\n" + "".join(
        f"a{k + 1}: &a{k + 1} [*a{k}, *a{k}]\n" for k in range(levels)
    )


def merges(levels=40):
    """Each mapping merges the one before twice."""
    return "a0: &a0 {x: 1}\n" + "".join(
        f"a{k + 1}: &a{k + 1} {{<<: [*a{k}, *a{k}]}}\n" for k in range(levels)
    )


@pytest.mark.parametrize(
    ("text", "word"),
    [
        (laughs(), "aliases"),
        ("&a [*a, *a]\n", "aliases"),
        (merges(), "aliases"),
        ("[" * 100_000, "nested"),
        ("{a: " * 5000, "nested"),
        ("- " * 5000 + "x", "nested"),
        ("x: " + "1" * 100_000, "digits"),
        ("x: !!timestamp 'x'\n", "tag"),
        ("x: !!python/object/apply:os.system ['true']\n", "tag"),
        ("? [a]\n: 1\n", "key"),
        ("x: " + "a" * 11_000_000, "MB"),
    ],
    ids=["laughs", "itself", "merge", "lists", "maps", "items", "digits", "tag", "python", "key",
         "long"],
)  # fmt: skip
def test_yaml_is_bounded(reader, tmp_path, text, word):
    path = tmp_path / "effects.yaml"
    path.write_text(text)
    refused(reader, "effects", path, word)


def test_aliases_as_people_use_them_are_read(tmp_path):
    from sensors.documents import read_yaml

    (tmp_path / "a.yaml").write_text("a: &a {x: [1, 2]}\nb: *a\nc: {<<: *a, y: 3}\n")
    data = read_yaml(tmp_path / "a.yaml")[0]
    assert data["c"] == {"x": [1, 2], "y": 3} and data["b"] == data["a"]


@pytest.mark.parametrize(
    "text", ["[" * 200_000, '{"a":' * 200_000, "1" * 100_000], ids=["lists", "maps", "digits"]
)
def test_json_is_bounded(tmp_path, text):
    path = tmp_path / "sensor.json"
    path.write_text(text)
    from sensors.documents import read_json

    with pytest.raises(InputError, match=r"sensor\.json is no JSON"):
        read_json(path)


ENTITIES = {
    "laughs": '<!DOCTYPE r [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;&a;&a;">]>',
    "outside": '<!DOCTYPE r [<!ENTITY a SYSTEM "file:///etc/passwd">]>',
    "parameter": "<!DOCTYPE r [<!ENTITY % a \"<!ENTITY b SYSTEM 'x'>\"> %a;]>",
    "long": f'<!DOCTYPE r [<!ENTITY a "{"a" * 100_000}">]>',
}


@pytest.mark.parametrize("entity", ENTITIES.values(), ids=ENTITIES)
@pytest.mark.parametrize("name", ["arm.urdf", "arm.xacro", "arm.srdf"])
def test_xml_defines_nothing(reader, tmp_path, name, entity):
    path = tmp_path / name
    path.write_text(f'{entity}<robot name="&a;"><xacro:x/><link name="x"/></robot>')
    (tmp_path / "plain.urdf").write_text("<robot><link name='a'/></robot>")
    beside = (tmp_path / "plain.urdf",) if name.endswith("srdf") else ()
    found = reader.read(Sample("urdf", path, beside=beside))
    assert found.outcome == "refused" and "entity" in found.said and name in found.said


@pytest.mark.parametrize("name", ["arm.urdf", "arm.xacro"])
def test_xml_is_not_deep(reader, tmp_path, name):
    path = tmp_path / name
    path.write_text("<robot>" + "<a>" * 100_000 + "</a>" * 100_000 + "</robot>")
    refused(reader, "urdf", path, "deep")


def test_one_long_cell_takes_no_memory_for_all(reader, tmp_path):
    rec = rigs.write(tmp_path / "rec", seed=4)
    stops = (rec / "stops.csv").read_text().splitlines()
    rows = [f"{k}{row}" for k in range(20_000) for row in stops[1:2]]
    wide = ["x" * 100_000, *["y"] * (len(rows) - 1)]
    lines = [stops[0] + ",note", *(f"{r},{w}" for r, w in zip(rows, wide, strict=True))]
    (rec / "stops.csv").write_text("\n".join(lines))
    refused(reader, "recording", rec / "stops.csv", "note")


def test_many_columns_are_looked_through_at_once(reader, tmp_path):
    rec = rigs.write(tmp_path / "rec", seed=4)
    (rec / "stops.csv").write_text(",".join(f"c{k}" for k in range(100_000)) + "\n")
    refused(reader, "recording", rec / "stops.csv")


# ----------------------------------------------------------------------------------------- binary


def test_a_parquet_file_of_rows_without_end(reader, tmp_path):
    """Runs of one number: 60 million rows in 200 kilobytes."""
    path = tmp_path / "points.parquet"
    part = pa.table({"x": pa.array(np.zeros(20_000_000, np.float32))})
    with pq.ParquetWriter(path, part.schema, compression="zstd") as file:
        for _ in range(3):
            file.write_table(part)
    assert path.stat().st_size < 1_000_000
    refused(reader, "table of points", path, "claims to hold 60000000 rows")


def test_a_parquet_file_of_one_long_text(reader, tmp_path):
    path = tmp_path / "points.parquet"
    text = pa.array(["a" * 1_000_000, *["b"] * 100_000]).dictionary_encode()
    pq.write_table(pa.table({"note": text}), path)
    refused(reader, "table of points", path, "texts as long as one of note")


def npy(shape, dtype="<f8", data=b""):
    head = str({"descr": dtype, "fortran_order": False, "shape": shape}).encode()
    head += b" " * (-(len(head) + 11) % 64) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(head)) + head + data


@pytest.mark.parametrize("shape", [(10**12, 3), (10**30,), (2**62, 4), (-1, 3)])
def test_an_array_of_any_claim(reader, tmp_path, shape):
    (tmp_path / "cloud.npy").write_bytes(npy(shape, data=bytes(240)))
    refused(reader, "numpy", tmp_path / "cloud.npy")
    with zipfile.ZipFile(tmp_path / "clouds.npz", "w") as archive:
        archive.writestr("points.npy", npy(shape, data=bytes(240)))
    refused(reader, "numpy", tmp_path / "clouds.npz")


def test_an_archive_that_unpacks_without_end(reader, tmp_path):
    path = tmp_path / "clouds.npz"
    squeezed = zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED)
    with squeezed as archive, archive.open("points.npy", "w") as member:
        member.write(npy((BYTES // 8,)))
        for _ in range(BYTES >> 24):
            member.write(bytes(1 << 24))
    assert path.stat().st_size < 2_000_000
    refused(reader, "numpy", path, "claims to hold")


def test_objects_are_not_unpickled(reader, tmp_path):
    np.save(tmp_path / "cloud.npy", np.array([{"a": 1}], object), allow_pickle=True)
    refused(reader, "numpy", tmp_path / "cloud.npy", "objects")


def png(width, height):
    """A PNG of black that claims to be of this size."""

    def chunk(kind, data):
        return (
            struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        )

    head = struct.pack(">2I5B", width, height, 8, 0, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", head)
        + chunk(b"IDAT", zlib.compress(bytes(1000), 9))
        + chunk(b"IEND", b"")
    )


def test_a_png_of_any_size():
    with pytest.raises(ValueError, match="60000 x 60000"):
        _png(png(60_000, 60_000))


def test_a_zpng_of_any_size():
    head = struct.pack("<HHHBB", 0xFBF8, 65535, 65535, 8, 8)
    with pytest.raises(ValueError, match="claim"):
        _zpng(head + zstd.compress(bytes(1000)))


@pytest.mark.parametrize(
    ("pack", "unpack"),
    [
        (bz2.BZ2Compressor(), unpack_bz2),
        (lz4.frame.LZ4FrameCompressor(), unpack_lz4),
        (zstd.ZstdCompressor(), unpack_zstd),
    ],
    ids=["bz2", "lz4", "zstd"],
)
def test_a_chunk_that_unpacks_without_end(pack, unpack, monkeypatch):
    monkeypatch.setattr("chains.sizes.FREELY", 1 << 20)
    packed = pack.begin() if hasattr(pack, "begin") else b""
    packed += b"".join(pack.compress(bytes(1 << 20)) for _ in range(8)) + pack.flush()
    with pytest.raises(ValueError, match="more than it may"):
        unpack(packed)
    with pytest.raises((ValueError, RuntimeError)):
        unpack(packed[:100])


VIEWS = {
    "view": "CREATE VIEW messages AS WITH RECURSIVE c(x) AS"
    " (SELECT 1 UNION ALL SELECT x + 1 FROM c)"
    " SELECT x AS id, 1 AS topic_id, x AS timestamp, zeroblob(1000000) AS data FROM c",
    "column": "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id, timestamp,"
    " data AS (zeroblob(1000000000)))",
    "trigger": "CREATE TABLE messages(id, topic_id, timestamp, data);"
    " CREATE TRIGGER t AFTER INSERT ON messages BEGIN SELECT 1; END",
}


@pytest.mark.parametrize("sql", VIEWS.values(), ids=VIEWS)
def test_a_database_of_rows_that_are_calculated(reader, tmp_path, sql):
    path = tmp_path / "bag.db3"
    base = sqlite3.connect(path)
    base.executescript(f"CREATE TABLE topics(id, name, type, serialization_format); {sql};")
    base.commit()
    base.close()
    with pytest.raises(InputError, match="is calculated"):
        check_database(path)
    refused(reader, "bag", path)


def test_a_las_file_of_points_without_end(reader, tmp_path):
    import laspy

    las = laspy.LasData(laspy.LasHeader(point_format=0, version="1.4"))
    las.x = las.y = las.z = np.arange(10.0)
    las.write(tmp_path / "cloud.las")
    data = bytearray((tmp_path / "cloud.las").read_bytes())
    struct.pack_into("<Q", data, 247, 10**10)  # LAS 1.4: the number of point records
    (tmp_path / "cloud.las").write_bytes(data)
    refused(reader, "las", tmp_path / "cloud.las", "should hold 10000000000 points")


@pytest.mark.parametrize("kind", ["ascii", "binary", "binary_compressed"])
def test_a_pcd_file_of_points_without_end(reader, tmp_path, kind):
    head = "VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH {n}\nHEIGHT 1\n"
    head += "VIEWPOINT 0 0 0 1 0 0 0\nPOINTS {n}\nDATA {kind}\n"
    text = head.format(n=10**9, kind=kind).encode()
    tail = struct.pack("<2I", 20, 12 * 10**9 % 2**32) + bytes(20)
    (tmp_path / "cloud.pcd").write_bytes(text + tail)
    refused(reader, "pcd", tmp_path / "cloud.pcd")


@pytest.mark.parametrize("rows", ["10000000000", "3"])
def test_a_ply_file_of_lists_without_end(reader, tmp_path, rows):
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {rows}\n"
    head += "property float x\nproperty float y\nproperty float z\n"
    head += "element face 2\nproperty list uint int vertex_indices\nend_header\n"
    data = np.zeros(9, "<f4").tobytes() + struct.pack("<I", 4_000_000_000) + bytes(100)
    (tmp_path / "room.ply").write_bytes(head.encode() + data)
    refused(reader, "mesh", tmp_path / "room.ply")


def test_a_ply_file_of_one_long_list_among_many(reader, tmp_path):
    head = "ply\nformat binary_little_endian 1.0\nelement face 20001\n"
    head += "property list uint int vertex_indices\nend_header\n"
    data = struct.pack("<I", 100_000) + bytes(400_000) + struct.pack("<I3i", 3, 0, 1, 2) * 20_000
    (tmp_path / "room.ply").write_bytes(head.encode() + data)
    refused(reader, "mesh", tmp_path / "room.ply", "lists as long")


def test_a_capture_of_fragments_without_end(reader, tmp_path):
    """Every fragment of a datagram had all others joined anew: n of them took n^2 bytes."""
    head = struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 65535, 1)
    frames = io.BytesIO()
    for at in range(8000):
        ip = struct.pack(
            ">BBHHHBBH4s4s", 0x45, 0, 1220, 77, 0x2000 | at, 64, 17, 0, b"a" * 4, b"b" * 4
        )
        frame = b"\0" * 12 + b"\x08\x00" + ip + bytes(1200)
        frames.write(struct.pack("<4I", at, 0, len(frame), len(frame)) + frame)
    (tmp_path / "packets.pcap").write_bytes(head + frames.getvalue())
    refused(reader, "hesai", tmp_path / "packets.pcap")


def test_metadata_of_a_sensor_with_pixels_without_end():
    from sensors.readers.packets.ouster import read_metadata

    facts = {"beam_altitude_angles": [0.0] * 4, "beam_azimuth_angles": [0.0] * 4}
    facts["data_format"] = {"columns_per_frame": 10**9, "pixels_per_column": 4}
    with pytest.raises(InputError, match="1000000000 columns"):
        read_metadata("sensor.json", json.dumps(facts))
