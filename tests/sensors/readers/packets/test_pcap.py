"""Captures written by hand, in every flavour, read back."""

import pytest

from chains.errors import InputError
from sensors.readers.packets.pcap import Capture

from .captures import ethernet, write_pcap, write_pcapng

DATAGRAMS = [(1_700_000_000.25 + k / 1000, 7502, bytes([k]) * (1000 + 900 * k)) for k in range(9)]


STREAM = "97.98.99.100:7502"  # the sender that captures.py writes


def same(found) -> bool:
    return [d[1:] for d in found] == [(STREAM, d[2]) for d in DATAGRAMS] and all(
        abs(a[0] - b[0]) < 1e-6 for a, b in zip(found, DATAGRAMS, strict=True)
    )


@pytest.mark.parametrize("link", [{}, {"mtu": 1500}, {"vlan": True}, {"mtu": 576, "vlan": True}])
@pytest.mark.parametrize("order", "<>")
@pytest.mark.parametrize("nanoseconds", [False, True])
def test_pcap_comes_back_as_written(link, order, nanoseconds, tmp_path):
    path = write_pcap(tmp_path / "a.pcap", DATAGRAMS, order, nanoseconds, **link)
    capture = Capture([path])
    assert same(list(capture)) and same(list(capture)) and not capture.cut_short


@pytest.mark.parametrize("link", [{}, {"mtu": 1500}])
def test_pcapng_comes_back_as_written(link, tmp_path):
    assert same(list(Capture([write_pcapng(tmp_path / "a.pcapng", DATAGRAMS, **link)])))


def test_fragments_in_any_order_make_one_datagram(tmp_path, monkeypatch):
    payload = bytes(range(256)) * 20
    shuffled = ethernet(payload, 7, mtu=1500)[::-1]
    assert len(shuffled) > 2
    monkeypatch.setattr(
        "tests.sensors.readers.packets.captures.ethernet", lambda *_, **__: shuffled
    )
    path = write_pcap(tmp_path / "a.pcap", [(1.0, 7, payload)])
    assert [d[2] for d in Capture([path])] == [payload]


def test_a_lost_fragment_loses_its_datagram_only(tmp_path, monkeypatch):
    payload = bytes(4000)
    frames = ethernet(payload, 7, mtu=1500)[:-1] + ethernet(b"whole", 7)
    monkeypatch.setattr(f"{write_pcap.__module__}.ethernet", lambda *_, **__: frames)
    path = write_pcap(tmp_path / "a.pcap", [(1.0, 7, b"")])
    assert [d[2] for d in Capture([path])] == [b"whole"]


@pytest.mark.parametrize("write", [write_pcap, write_pcapng])
def test_a_capture_cut_short_gives_what_is_whole(write, tmp_path):
    path = write(tmp_path / "a.pcap", DATAGRAMS)
    path.write_bytes(path.read_bytes()[:-100])
    capture = Capture([path])
    assert [d.payload for d in capture] == [d[2] for d in DATAGRAMS[:-1]]
    assert capture.cut_short == [path]


def test_what_is_no_capture_is_refused(tmp_path):
    for data, words in ((b"", "is empty"), (b"hello, world", "is no packet capture")):
        (tmp_path / "a.pcap").write_bytes(data)
        with pytest.raises(InputError, match=words):
            Capture([tmp_path / "a.pcap"])
    with pytest.raises(InputError, match="cannot be read"):
        Capture([tmp_path / "none.pcap"])
    path = write_pcap(tmp_path / "a.pcap", DATAGRAMS)
    data = bytearray(path.read_bytes())
    data[24 + 8 : 24 + 12] = b"\xff\xff\xff\x7f"
    path.write_bytes(data)
    with pytest.raises(InputError, match="damaged at byte 24"):
        list(Capture([path]))


def test_progress_is_of_all_files(tmp_path):
    data = [(float(k), 7, bytes(60_000)) for k in range(50)]
    capture = Capture([write_pcap(tmp_path / f"{k}.pcap", data) for k in "ab"])
    told: list[tuple[str, int, int]] = []
    progress = capture.progress(lambda *values: told.append(values))
    for _ in capture:
        progress("reading", 0, 0)
    assert told[0] == ("reading, MB", 0, 5) and told[-1] == ("reading, MB", 5, 5)
    assert [done for _, done, _ in told] == sorted(done for _, done, _ in told)


def test_files_are_read_in_the_order_of_their_packets_whatever_their_names_say(tmp_path):
    """part_10 comes before part_8 where a shell lists them: half of a hold was lost so."""
    names = ("part_8", "part_9", "part_10")
    parts = [
        write_pcap(tmp_path / f"{name}.pcap", DATAGRAMS[3 * k : 3 * k + 3])
        for k, name in enumerate(names)
    ]
    capture = Capture(sorted(parts))
    assert same(list(capture)) and capture.reordered and capture.back_s == 0.0
    assert not Capture(parts).reordered
    (tmp_path / "notes.txt").write_text("no capture")
    folder = Capture([tmp_path])
    assert same(list(folder)) and folder.paths == parts
    (tmp_path / "none").mkdir()
    with pytest.raises(InputError, match="a folder without captures"):
        Capture([tmp_path / "none"])


def test_a_clock_that_is_set_back_is_seen(tmp_path):
    moved = [(time_s - 3600 * (k > 4), *rest) for k, (time_s, *rest) in enumerate(DATAGRAMS)]
    capture = Capture([write_pcap(tmp_path / "a.pcap", moved)])
    assert len(list(capture)) == len(moved)
    assert capture.back_s == pytest.approx(3600, abs=0.01) and capture.overlap_s == 0.0


def test_files_that_overlap_are_no_clock_that_was_set_back(tmp_path):
    data = [(float(k), 7, b"x" * 50) for k in range(10)]
    paths = [write_pcap(tmp_path / "a.pcap", data), write_pcap(tmp_path / "b.pcap", data[2:])]
    capture = Capture([*paths, tmp_path / "a.pcap"])
    assert len(list(capture)) == 18 and capture.back_s == 0.0
    assert capture.overlap_s == pytest.approx(7.0)
