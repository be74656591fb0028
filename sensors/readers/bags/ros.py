"""Bag files opened: ROS 1, ROS 2 and MCAP, without ROS. This is the rosbags door."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

from chains.errors import InputError
from sensors.documents import read_text, read_yaml
from sensors.readers.bags.bounded import (
    check_database,
    databases,
    open_zstd,
    unpack_bz2,
    unpack_lz4,
    unpack_zstd,
)

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader
    from rosbags.typesys.store import Typestore

OUSTER_TYPES = (
    "ouster_msgs/msg/PacketMsg",
    "ouster_ros/msg/PacketMsg",
    "ouster_sensor_msgs/msg/PacketMsg",
)
"""Types of one packet of an Ouster."""
_TIME = "builtin_interfaces/Time"
# Bags of ROS 2 before Iron do not say what their messages look like; ROS's own are known.
_DEFINITIONS = {
    "pandar_msgs/msg/PandarPacket": f"{_TIME} stamp\nuint8[1500] data\nuint32 size\n",
    "pandar_msgs/msg/PandarScan": "std_msgs/Header header\npandar_msgs/PandarPacket[] packets\n",
    "nebula_msgs/msg/NebulaPacket": f"{_TIME} stamp\nuint8[] data\n",
    "nebula_msgs/msg/NebulaPackets": "std_msgs/Header header\nnebula_msgs/NebulaPacket[] packets\n",
    **dict.fromkeys(OUSTER_TYPES, "uint8[] buf\n"),
}


@dataclass(frozen=True)
class Topic:
    """A topic, its messages' type (package/msg/Name) and how many there are."""

    name: str
    kind: str
    count: int

    def __str__(self) -> str:
        return f"{self.name} ({self.kind.replace('/msg/', '/')}, {self.count})"


@dataclass(frozen=True)
class Message:
    """One message, not decoded yet."""

    topic: str
    kind: str
    arrival_ns: int
    """When the bag got it."""
    raw: bytes
    reader: AnyReader

    def decode(self) -> Any:
        """Return it with its fields; InputError where its bytes do not fit its type."""
        try:
            return self.reader.deserialize(self.raw, self.kind)
        except Exception as error:  # whatever broken bytes make numpy and struct raise
            why = f"{type(error).__name__} {error}"
            raise InputError(
                f"{self.topic} has a message that does not fit its type {self.kind}: {why}"
            ) from None


def bag_files(paths: Sequence[Path]) -> list[Path]:
    """Return what rosbags opens: files, and of a folder itself or, without metadata, its files.

    Raises InputError where one is missing, empty or no bag, and where ROS 1 meets ROS 2.
    """
    bags = [file for path in paths for file in _files_of(path)]
    for file in bags:
        if file.is_file() and not file.stat().st_size:
            raise InputError(f"{file} is empty (0 bytes); a bag was wanted")
    if len({file.suffix == ".bag" for file in bags}) > 1:
        raise InputError(
            "bags of ROS 1 and ROS 2 are no one source; write the kind before each: bag A bag B"
        )
    return bags


def topics_of(paths: Sequence[Path]) -> list[Topic]:
    """Return the topics of bags that `bag_files` gave; InputError where they cannot be read."""
    with _opened(paths) as reader:
        return [
            Topic(topic, info.msgtype or "several types", info.msgcount)
            for topic, info in sorted(reader.topics.items())
        ]


def messages(
    paths: Sequence[Path],
    topics: Iterable[str],
    start_ns: int | None = None,
    stop_ns: int | None = None,
) -> Iterator[Message]:
    """Yield the messages of some topics in the order of arrival, those from start up to stop."""
    wanted = set(topics)
    with _opened(paths) as reader:
        connections = [c for c in reader.connections if c.topic in wanted]
        if not connections:
            return
        stream = reader.messages(connections=connections, start=start_ns, stop=stop_ns)
        try:
            for connection, arrival_ns, raw in stream:
                yield Message(
                    topic=connection.topic,
                    kind=connection.msgtype,
                    arrival_ns=arrival_ns,
                    raw=raw,
                    reader=reader,
                )
        except InputError:
            raise
        except Exception as error:
            raise _unreadable(paths, error) from None


def _files_of(path: Path) -> list[Path]:
    if not path.exists():
        raise InputError(f"{path} does not exist")
    if path.is_file():
        if path.suffix in (".bag", ".db3", ".mcap"):
            return [path]
        raise InputError(
            f"{path} is no bag: a .bag, .db3 or .mcap file is, or the folder of a ROS 2 bag"
        )
    inside = [*sorted(path.glob("*.db3")), *sorted(path.glob("*.mcap"))]
    if _names_its_storage(path / "metadata.yaml"):
        return [path]
    if not inside:
        raise InputError(f"{path} is a folder that holds no bag: neither .db3 nor .mcap")
    return inside


def _names_its_storage(metadata: Path) -> bool:
    """Whether a bag's metadata does: some recorders leave it empty, and rosbags then gives up."""
    if not metadata.exists():
        return False
    line = next((s for s in read_text(metadata).splitlines() if "storage_identifier" in s), "")
    return line.partition(":")[2].strip(" \"'") in ("sqlite3", "mcap")


@contextmanager
def _opened(paths: Sequence[Path]) -> Iterator[AnyReader]:
    try:
        from rosbags.highlevel import AnyReader
    except ImportError:
        raise InputError("reading bags needs rosbags: pip install 'rigcal[ros]'") from None
    for path in databases(paths):
        if path.suffix == ".db3":
            check_database(path)
    for path in paths:
        if (path / "metadata.yaml").is_file():
            read_yaml(path / "metadata.yaml")
    with _bounded():
        try:
            reader = AnyReader(list(paths), default_typestore=_known_types())
            reader.open()
        except Exception as error:  # rosbags, its SQLite and its decompressors each have their own
            raise _unreadable(paths, error) from None
        try:
            yield reader
        finally:
            reader.close()


@contextmanager
def _bounded() -> Iterator[None]:
    """Where rosbags unpacks no more than a file may hold."""
    from rosbags.rosbag1 import reader as one
    from rosbags.rosbag2 import reader as two
    from rosbags.rosbag2 import storage_mcap as mcap

    by_name = {"bz2": unpack_bz2, "lz4": unpack_lz4}
    by_size = {"lz4": lambda data, _: unpack_lz4(data), "zstd": lambda data, _: unpack_zstd(data)}
    zstd = SimpleNamespace(decompress=unpack_zstd, open=open_zstd)
    kept = dict(one.decompressors), dict(mcap.DECOMPRESSORS), two.zstd
    one.decompressors.update(by_name)
    mcap.DECOMPRESSORS.update(by_size)
    two.zstd = zstd
    try:
        yield
    finally:
        one.decompressors.update(kept[0])
        mcap.DECOMPRESSORS.update(kept[1])
        two.zstd = kept[2]


@cache
def _known_types() -> Typestore:
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.LATEST)
    for kind, text in _DEFINITIONS.items():
        store.register(get_types_from_msg(text, kind))
    return store


def _unreadable(paths: Sequence[Path], error: Exception) -> InputError:
    why = " ".join(str(error).split()) or type(error).__name__
    return InputError(
        f"{paths[0]} cannot be read as a bag: {why}; if it was cut short, repair it with rosbag"
        " reindex (ROS 1), ros2 bag reindex or mcap recover"
    )
