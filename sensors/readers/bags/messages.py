"""ROS messages as rows of logs, clouds and packets, by the fields that their types define."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np

from chains.errors import InputError
from sensors.readers.clouds.fields import Cloud
from sensors.stops import POSE

# sensor_msgs/PointField: datatype -> numpy
_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
_XYZ = ("x", "y", "z")


class Channel(NamedTuple):
    """Whose values they are."""

    kind: str
    """Of a `Track`."""
    names: tuple[str, ...]
    """The columns."""
    body: str = ""
    """Empty where the topic names it."""
    parent: str = ""
    """The frame that a transform's body is in."""


class Sample(NamedTuple):
    """One message's values."""

    source: Channel
    stamp_s: float
    """What its header says."""
    values: tuple[float, ...]


def _stamp(header: Any) -> float:
    return header.stamp.sec + header.stamp.nanosec / 1e9


def _xyz(vector: Any) -> tuple[float, ...]:
    return vector.x, vector.y, vector.z


def _pose(position: Any, orientation: Any) -> tuple[float, ...]:
    q = orientation
    return (*_xyz(position), q.w, q.x, q.y, q.z)


def _row(kind: str, names: tuple[str, ...], values: Callable[[Any], tuple[float, ...]]) -> Callable:
    source = Channel(kind, names)
    return lambda message: [Sample(source, _stamp(message.header), values(message))]


def _joints(message: Any) -> list[Sample]:
    if not len(message.position):
        return []
    source = Channel("joints", tuple(message.name))
    return [Sample(source, _stamp(message.header), tuple(message.position))]


def _transform(message: Any) -> list[Sample]:
    frames = message.child_frame_id.lstrip("/"), message.header.frame_id.lstrip("/")
    pose = _pose(message.transform.translation, message.transform.rotation)
    return [Sample(Channel("pose", POSE, *frames), _stamp(message.header), pose)]


def _transforms(message: Any) -> list[Sample]:
    return [row for one in message.transforms for row in _transform(one)]


LOGS: dict[str, Callable[[Any], list[Sample]]] = {
    "sensor_msgs/msg/JointState": _joints,
    "geometry_msgs/msg/PoseStamped": _row(
        "pose", POSE, lambda m: _pose(m.pose.position, m.pose.orientation)
    ),
    "geometry_msgs/msg/PoseWithCovarianceStamped": _row(
        "pose", POSE, lambda m: _pose(m.pose.pose.position, m.pose.pose.orientation)
    ),
    "nav_msgs/msg/Odometry": _row(
        "pose", POSE, lambda m: _pose(m.pose.pose.position, m.pose.pose.orientation)
    ),
    "geometry_msgs/msg/TransformStamped": _transform,
    "tf2_msgs/msg/TFMessage": _transforms,
    "tf/msg/tfMessage": _transforms,
    "geometry_msgs/msg/PointStamped": _row("point", _XYZ, lambda m: _xyz(m.point)),
    "sensor_msgs/msg/Imu": _row("gyro", _XYZ, lambda m: _xyz(m.angular_velocity)),
    "sensor_msgs/msg/Temperature": _row(
        "covariate", ("temperature_c",), lambda m: (m.temperature,)
    ),
    "sensor_msgs/msg/RelativeHumidity": _row(
        "covariate", ("humidity",), lambda m: (m.relative_humidity,)
    ),
}
"""Types of messages that are logs -> their rows."""


def payloads_of(message: Any, arrival_s: float) -> Iterator[tuple[float, bytes]]:
    """Time [s] and payload of the packets in one message: its packets', or its own."""
    if hasattr(message, "buf"):
        yield arrival_s, bytes(message.buf)
        return
    for packet in message.packets:
        stamp = getattr(packet, "stamp", None)
        time_s = stamp.sec + stamp.nanosec / 1e9 if stamp and stamp.sec else arrival_s
        yield time_s, bytes(packet.data[: getattr(packet, "size", len(packet.data))])


def cloud_of(topic: str, message: Any) -> Cloud:
    """The points of a sensor_msgs/PointCloud2; InputError where it contradicts itself."""
    order = ">" if message.is_bigendian else "<"
    fields = [f for f in message.fields if f.datatype in _TYPES and f.count in (0, 1)]
    point = np.dtype(
        {
            "names": [f.name for f in fields],
            "formats": [order + _TYPES[f.datatype] for f in fields],
            "offsets": [f.offset for f in fields],
            "itemsize": message.point_step,
        }
    )
    if not {*_XYZ} <= set(point.names):
        raise InputError(f"{topic} has clouds without x, y and z: {', '.join(point.names)}")
    rows, columns = message.height, message.width
    if len(message.data) < rows * message.row_step or message.row_step < columns * point.itemsize:
        raise InputError(f"{topic} has a cloud of {len(message.data)} bytes, fewer than it states")
    data = np.ascontiguousarray(message.data)[: rows * message.row_step]
    data = data.reshape(rows, message.row_step)[:, : columns * point.itemsize]
    points = np.ascontiguousarray(data).view(point).reshape(-1)
    columns_of = {name: points[name] for name in point.names}
    return Cloud(columns_of, (rows, columns), _stamp(message.header))
