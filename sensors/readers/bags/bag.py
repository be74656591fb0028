"""ROS 1 and ROS 2 bags, MCAP too: their LiDAR, joints, poses and rates.

A bag is read once for its logs and for when each cloud or packet came; clouds are decoded when
they are asked for. Times are those of the messages' headers, where these agree with the bag's own
to a second, so that all topics share one clock.
"""

from __future__ import annotations

import struct
from array import array
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from chains.errors import InputError
from sensors.documents import read_text
from sensors.readers.bags.messages import LOGS, Channel, cloud_of, payloads_of
from sensors.readers.bags.ros import OUSTER_TYPES, Message, Topic, bag_files, messages, topics_of
from sensors.readers.base import Array, Contents, Options, Progress, Sweep, Sweeps, Track, together
from sensors.readers.clouds.fields import Cloud
from sensors.readers.clouds.rings import find_format
from sensors.readers.packets.hesai import decode_hesai, rate
from sensors.readers.packets.ouster import decode_ouster, read_metadata
from sensors.readers.packets.turns import Packets

_CLOUD = "sensor_msgs/msg/PointCloud2"
_HESAI = (
    "pandar_msgs/msg/PandarScan",
    "nebula_msgs/msg/NebulaPackets",
    "hesai_ros_driver/msg/UdpFrame",
)
_TEXT = "std_msgs/msg/String"
# A choice: messages arrive within a second of their stamps, and clocks that nobody has set are
# minutes to decades off.
_SAME_CLOCK_S = 1.0


@dataclass
class _Log:
    """What one pass through the bag gathers."""

    rows: dict[tuple[str, Channel], array] = field(default_factory=lambda: defaultdict(_doubles))
    """By topic and source (rows, 2 + columns), flat: stamp, arrival, values."""
    arrivals_ns: list[int] = field(default_factory=list)
    """Of clouds."""
    stamps_s: list[float] = field(default_factory=list)
    texts: list[str] = field(default_factory=list)

    def sources(self, topic: str) -> dict[tuple[str, str], list[tuple[Channel, Array]]]:
        """Of one topic by body and parent: the sources with their rows (N, 2 + columns)."""
        parts: dict[tuple[str, str], list[tuple[Channel, Array]]] = defaultdict(list)
        for (name, source), flat in self.rows.items():
            if name == topic:
                table = np.frombuffer(flat).reshape(-1, 2 + len(source.names))
                parts[source.body, source.parent].append((source, table))
        return parts


def _doubles() -> array:
    return array("d")


def read_bag(files: Sequence[Path], options: Options, progress: Progress) -> Contents:
    """Read bags that belong together: their one LiDAR, and every log of joints, poses and rates.

    `options.topics` decides among topics of one sort: naming a cloud leaves out other clouds, and
    no joints. Raises InputError where a file is missing, empty, cut short or no bag, where nothing
    in it is of use, where a topic is not there, and where several LiDARs are and none is named.
    """
    paths = bag_files(files)
    name = files[0].stem or files[0].name
    topics = topics_of(paths)
    lidar, logs = _choose(name, topics, options)
    with _of_bag(paths):
        log = _pass(paths, lidar, logs, topics, progress)
    parts = []
    if lidar is not None:
        parts.append(_lidar(name, paths, lidar, log, options, progress))
    parts += [_tracks(name, topic.name, log) for topic in logs]
    unused = [str(t) for t in topics if t not in logs and t != lidar]
    rest = (
        Contents(understood=(f"{name}: not used: {', '.join(unused)}",)) if unused else Contents()
    )
    return together([*parts, rest])


@contextmanager
def _of_bag(paths: Sequence[Path]) -> Iterator[None]:
    """Name the bag where a sentence names only its topic."""
    try:
        yield
    except InputError as error:
        if paths[0].name in str(error):
            raise
        raise InputError(f"{paths[0]}: {error}") from None


# ------------------------------------------------------------------------- topics


def _choose(name: str, topics: list[Topic], options: Options) -> tuple[Topic | None, list[Topic]]:
    """The LiDAR's topic, if there is one, and the topics of logs."""
    listed = ", ".join(map(str, topics)) or "none"
    names = [topic.name for topic in topics]
    if options.topics and not set(options.topics) & set(names):
        wanted = options.topics[0]
        hint = get_close_matches(wanted, names, n=1, cutoff=0)
        likely = f"; did you mean {hint[0]}?" if hint else ""
        raise InputError(f"{name} has no topic {wanted} among its topics {listed}{likely}")
    full = [topic for topic in topics if topic.count]
    lidars = [t for t in full if t.kind in (_CLOUD, *_HESAI)]
    lidars += [t for t in full if t.kind in OUSTER_TYPES and "imu" not in t.name]
    lidars = [t for t in lidars if t.name in options.topics] or lidars
    if len(lidars) > 1:
        raise InputError(
            f"{name} has several topics of clouds, {', '.join(map(str, lidars))}; choose one by"
            f" --topic, such as --topic {max(lidars, key=lambda t: t.count).name}"
        )
    logs: list[Topic] = []
    for kind in LOGS:
        of_kind = [t for t in full if t.kind == kind]
        logs += [t for t in of_kind if t.name in options.topics] or of_kind
    if not lidars and not logs:
        raise InputError(
            f"{name} has nothing that can be used: no clouds or packets of a LiDAR, no joints, no"
            f" poses; its topics are {listed}"
        )
    return (lidars[0] if lidars else None), logs


# --------------------------------------------------------------------------------- one pass


def _pass(
    paths: Sequence[Path],
    lidar: Topic | None,
    logs: list[Topic],
    topics: list[Topic],
    progress: Progress,
) -> _Log:
    """Gather the logs; of a LiDAR only when its clouds came, for packets are surveyed apart."""
    of_use = list(logs)
    if lidar and lidar.kind == _CLOUD:
        of_use.append(lidar)
    elif lidar and lidar.kind in OUSTER_TYPES:
        of_use += [t for t in topics if t.kind == _TEXT]
    total = sum(t.count for t in of_use)
    log = _Log()
    for done, message in enumerate(messages(paths, {t.name for t in of_use})):
        if not done % 1000:
            progress("reading the bag", done, total)
        if message.kind == _CLOUD:
            log.arrivals_ns.append(message.arrival_ns)
            log.stamps_s.append(_stamp(message))
        elif message.kind == _TEXT:
            log.texts.append(message.decode().data)
        else:
            for row in LOGS[message.kind](message.decode()):
                numbers = row.stamp_s, message.arrival_ns / 1e9, *row.values
                log.rows[message.topic, row.source].extend(numbers)
    progress("reading the bag", total, total)
    return log


def _stamp(message: Message) -> float:
    """The header's stamp, s, without decoding what follows it."""
    raw = message.raw
    if len(raw) < 12:
        raise InputError(f"{message.topic} has a message of {len(raw)} bytes; it is cut short")
    if message.reader.is2:
        seconds, nanoseconds = struct.unpack_from("<iI" if raw[1] else ">iI", raw, 4)
    else:
        seconds, nanoseconds = struct.unpack_from("<2I", raw, 4)
    return seconds + nanoseconds / 1e9


def _times(name: str, stamps_s: Array, arrivals_s: Array) -> tuple[Array, tuple[str, ...]]:
    """The stamps, or the arrivals where stamps are of another clock or run backwards."""
    off_s = float(np.median(stamps_s - arrivals_s))
    if abs(off_s) > _SAME_CLOCK_S:
        return arrivals_s, (
            f"{name}: its headers' clock is {off_s:+.6g} s from the bag's; times of arrival are"
            " taken",
        )
    if np.any(np.diff(stamps_s) < 0):
        return arrivals_s, (f"{name}: its headers run backwards; times of arrival are taken",)
    return stamps_s, ()


def _tracks(name: str, topic: str, log: _Log) -> Contents:
    """The tracks of one topic, each body's its own; static transforms are only told."""
    tracks: list[Track] = []
    said: list[str] = []
    odd: list[str] = []
    for (body, parent), sources in log.sources(topic).items():
        of_what = f"{topic}: {body} in {parent}" if body else topic
        kind, names, stamps_s, arrivals_s, values = _merged(sources)
        if topic.endswith("tf_static"):
            x, y, z = values[-1, :3]
            said.append(f"{of_what}: stands still at {x:.4f} {y:.4f} {z:.4f} m; not a track")
            continue
        time_s, misfit = _times(of_what, stamps_s, arrivals_s)
        tracks.append(
            Track(
                name=body or topic, kind=kind, clock=name, time_s=time_s, names=names, values=values
            )
        )
        columns = f" ({', '.join(names)})" if kind in ("joints", "covariate") else ""
        said.append(f"{of_what}: {kind}{columns}, {len(time_s)} rows{rate(time_s)}")
        odd += misfit
    if not said:
        odd.append(f"{topic}: its messages hold no values")
    return Contents(tracks=tuple(tracks), understood=tuple(said), odd=tuple(odd))


def _merged(
    sources: list[tuple[Channel, Array]],
) -> tuple[Any, tuple[str, ...], Array, Array, Array]:
    """Kind, columns, stamps, arrivals and values of one body; NaN where a message lacked a column.

    Publishers of one topic may each tell some joints. A quaternion far from unit length means that
    the body was not seen.
    """
    names = tuple(dict.fromkeys(name for source, _ in sources for name in source.names))
    tables = []
    for source, table in sources:
        whole = np.full((len(table), 2 + len(names)), np.nan)
        whole[:, [0, 1, *(2 + names.index(name) for name in source.names)]] = table
        tables.append(whole)
    whole = np.concatenate(tables)
    whole = whole[np.argsort(whole[:, 1], kind="stable")]
    values, kind = whole[:, 2:], sources[0][0].kind
    if kind == "pose":
        length = np.linalg.norm(values[:, 3:], axis=1, keepdims=True)
        values = np.where(np.abs(length - 1) < 0.1, values, np.nan)
        values[:, 3:] /= np.where(length > 0, length, 1)
    return kind, names, whole[:, 0], whole[:, 1], values


# --------------------------------------------------------------------------------- the LiDAR


def _lidar(
    name: str,
    paths: list[Path],
    topic: Topic,
    log: _Log,
    options: Options,
    progress: Progress,
) -> Contents:
    if topic.kind == _CLOUD:
        return _clouds(name, paths, topic, log, options)
    seen = [0]
    packets = _packets(paths, topic, seen)

    def progress_in_messages(what: str, done: int, total: int) -> None:
        progress(what, seen[0], topic.count)

    if topic.kind in _HESAI:
        return decode_hesai(topic.name, name, packets, options, progress_in_messages)
    if options.metadata is not None:
        metadata = read_metadata(options.metadata.name, read_text(options.metadata))
    else:
        text = next((text for text in log.texts if "beam_altitude_angles" in text), None)
        if text is None:
            raise InputError(
                f"{name} holds packets of an Ouster in {topic.name}, but no metadata; give the"
                " sensor's JSON by --metadata"
            )
        metadata = read_metadata("the bag's own metadata", text)
    return decode_ouster(topic.name, name, packets, metadata, options, progress_in_messages)


def _packets(paths: list[Path], topic: Topic, seen: list[int]) -> Packets:
    """The packets of one topic; `seen` has the message that iterating has come to."""

    def packets() -> Iterator[tuple[float, bytes]]:
        with _of_bag(paths):
            for seen[0], message in enumerate(messages(paths, [topic.name])):
                yield from payloads_of(message.decode(), message.arrival_ns / 1e9)

    return packets


def _clouds(name: str, paths: list[Path], topic: Topic, log: _Log, options: Options) -> Contents:
    arrivals_ns = np.array(log.arrivals_ns)
    time_s, odd = _times(topic.name, np.array(log.stamps_s), arrivals_ns / 1e9)
    stream = _cloud_stream(paths, topic, arrivals_ns)
    everything = np.ones(len(time_s), bool)
    first = next((c for _, c in stream(everything) if _has_points(c)), None)
    if first is None:
        raise InputError(f"{name}: the {topic.count} clouds of {topic.name} hold no points")
    seen = find_format(topic.name, first, options)
    time_s = time_s + seen.middle_s

    def read(wanted: NDArray[np.bool_]) -> Iterator[Sweep]:
        for s, cloud in stream(wanted):
            yield Sweep(float(time_s[s]), seen.layout.points(cloud))

    stamp = f"their stamps{f' + {seen.middle_s:.3f} s' if seen.middle_s else ''}"
    line = f"{topic.name}: {len(time_s)} clouds{rate(time_s)}; the middle of a turn is {stamp}"
    return Contents(
        sweeps=(Sweeps(topic.name, name, time_s, read),),
        lidar=seen.lidar,
        understood=(line, *seen.understood),
        odd=(*odd, *seen.odd),
    )


def _cloud_stream(
    paths: list[Path], topic: Topic, arrivals_ns: NDArray[np.int64]
) -> Callable[[NDArray[np.bool_]], Iterator[tuple[int, Cloud]]]:
    """Of the wanted clouds the number and the cloud, in order."""

    def stream(wanted: NDArray[np.bool_]) -> Iterator[tuple[int, Cloud]]:
        if not wanted.any():
            return
        first, last = arrivals_ns[wanted][[0, -1]].tolist()
        k = int(np.searchsorted(arrivals_ns, first))
        with _of_bag(paths):
            for s, message in enumerate(messages(paths, [topic.name], first, last + 1), k):
                if wanted[s]:
                    yield s, cloud_of(topic.name, message.decode())

    return stream


def _has_points(cloud: Cloud) -> bool:
    xyz = np.stack([cloud.fields[axis] for axis in "xyz"])
    return bool((np.isfinite(xyz).all(axis=0) & (xyz != 0).any(axis=0)).any())
