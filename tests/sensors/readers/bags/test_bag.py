"""Bags written by rosbags' own writers, in all three formats, read back."""

from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from chains.errors import InputError
from sensors.lidar import load_lidar
from sensors.readers.bags.bag import read_bag
from sensors.readers.base import Options
from sensors.stops import POSE

from ..room import box_scan

FORMATS = ("ros1", "sqlite3", "mcap")
START_NS = 1_700_000_000_000_000_000
ELEVATION = load_lidar("velodyne_vlp16").elevation_rad
POINTS, RING, COLUMN = box_scan(ELEVATION, 90)
TYPES = {"x": "<f4", "y": "<f4", "z": "<f4", "intensity": "<f4", "ring": "<u2", "time": "<f4"}
DATATYPES = {"<f4": 7, "<u2": 4}


class Bag:
    """Writes messages of ROS's own types to a bag of any format."""

    def __init__(self, path: Path, storage: str) -> None:
        self.one = storage == "ros1"
        self.store = get_typestore(Stores.ROS1_NOETIC if self.one else Stores.ROS2_HUMBLE)
        if self.one:
            frames = "geometry_msgs/TransformStamped[] transforms\n"
            self.store.register(get_types_from_msg(frames, "tf2_msgs/msg/TFMessage"))
            self.path = path.with_suffix(".bag")
            self.writer = Writer1(self.path)
        else:
            self.path = path
            plugin = StoragePlugin.MCAP if storage == "mcap" else StoragePlugin.SQLITE3
            self.writer = Writer2(path, version=9, storage_plugin=plugin)
        self.connections = {}

    def __enter__(self) -> "Bag":
        self.writer.open()
        return self

    def __exit__(self, *_: object) -> None:
        self.writer.close()

    def make(self, kind: str, **fields: object) -> object:
        return self.store.types[kind](**fields)

    def header(self, time_ns: int, frame: str = "") -> object:
        time = self.make(
            "builtin_interfaces/msg/Time", sec=time_ns // 10**9, nanosec=time_ns % 10**9
        )
        fields = {"seq": 0} if self.one else {}
        return self.make("std_msgs/msg/Header", stamp=time, frame_id=frame, **fields)

    def write(self, topic: str, time_ns: int, message: object) -> None:
        kind = message.__msgtype__
        if topic not in self.connections:
            self.connections[topic] = self.writer.add_connection(topic, kind, typestore=self.store)
        pack = self.store.serialize_ros1 if self.one else self.store.serialize_cdr
        self.writer.write(self.connections[topic], time_ns, pack(message, kind))

    def cloud(self, topic: str, time_ns: int, points: np.ndarray, stamp_ns: int | None = None):
        kinds = {n: points.dtype.fields[n] for n in points.dtype.names}
        fields = [
            self.make(
                "sensor_msgs/msg/PointField",
                name=name, offset=at, datatype=DATATYPES[kind.str], count=1,
            )
            for name, (kind, at) in kinds.items()
        ]  # fmt: skip
        size = points.dtype.itemsize
        self.write(
            topic,
            time_ns,
            self.make(
                "sensor_msgs/msg/PointCloud2",
                header=self.header(stamp_ns or time_ns, "velodyne"),
                height=1, width=len(points), fields=fields, is_bigendian=False,
                point_step=size, row_step=size * len(points),
                data=np.frombuffer(points.tobytes(), np.uint8), is_dense=True,
            ),
        )  # fmt: skip

    def joints(self, time_ns: int, names: list[str], position: list[float]) -> None:
        empty = np.zeros(0)
        message = self.make(
            "sensor_msgs/msg/JointState",
            header=self.header(time_ns), name=names, position=np.array(position, float),
            velocity=empty, effort=empty,
        )  # fmt: skip
        self.write("/joint_states", time_ns, message)

    def pose(self, xyz: np.ndarray, wxyz: np.ndarray, transform: bool = False) -> object:
        w, x, y, z = wxyz
        turn = self.make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)
        kind = "Vector3" if transform else "Point"
        place = self.make(f"geometry_msgs/msg/{kind}", **dict(zip("xyz", xyz, strict=True)))
        if transform:
            return self.make("geometry_msgs/msg/Transform", translation=place, rotation=turn)
        return self.make("geometry_msgs/msg/Pose", position=place, orientation=turn)


def cloud_points(first_ring: int = 0) -> np.ndarray:
    points = np.zeros(len(POINTS), [("pad", "V4"), *TYPES.items()])
    points = points[["x", "y", "z", "intensity", "ring", "time"]]  # a gap, as drivers leave
    for k, axis in enumerate("xyz"):
        points[axis] = POINTS[:, k]
    points["ring"] = RING + first_ring
    points["intensity"] = COLUMN
    points["time"] = COLUMN / 90 * 0.1
    return points


def quiet(what: str, done: int, total: int) -> None:
    """No progress."""


def write_session(bag: Bag) -> None:
    """10 clouds at 10 Hz, joints at 100 Hz in two messages, a tracked body, a tree of frames."""
    for k in range(10):
        bag.cloud("/points", START_NS + k * 10**8, cloud_points())
    for k in range(100):
        time_ns = START_NS + k * 10**7
        bag.joints(time_ns, ["a", "b"], [0.01 * k, 1.0])
        bag.joints(time_ns + 10**6, ["gripper"], [0.5])
        turn = np.array([np.cos(0.01 * k), 0, 0, np.sin(0.01 * k)]) * (k != 50)
        place = np.array([0.1 * k, 2, 3])
        header = bag.header(time_ns, "world")
        seen = bag.make("geometry_msgs/msg/PoseStamped", header=header, pose=bag.pose(place, turn))
        bag.write("/vrpn/rig/pose", time_ns, seen)
        moves = bag.make(
            "geometry_msgs/msg/TransformStamped",
            header=header, child_frame_id="tool",
            transform=bag.pose(place, np.array([1, 0, 0, 0]), transform=True),
        )  # fmt: skip
        for topic in ("/tf", "/tf_static")[: 1 + (k == 0)]:
            bag.write(topic, time_ns, bag.make("tf2_msgs/msg/TFMessage", transforms=[moves]))


@pytest.fixture(scope="module", params=FORMATS)
def session(request, tmp_path_factory) -> Path:
    with Bag(tmp_path_factory.mktemp("bags") / "session", request.param) as bag:
        write_session(bag)
    return bag.path


def test_clouds_come_back_as_written(session):
    (sweeps,) = read_bag([session], Options(), quiet).sweeps
    middle_s = START_NS / 1e9 + np.arange(10) * 0.1 + 0.1 * 89 / 90 / 2
    np.testing.assert_allclose(sweeps.time_s, middle_s, atol=1e-3)
    wanted = np.zeros(10, bool)
    wanted[[2, 7]] = True
    turns = list(sweeps.read(wanted))
    assert [turn.time_s for turn in turns] == list(sweeps.time_s[wanted])
    for turn in turns:
        xyz = np.stack([turn.points[axis] for axis in "xyz"], axis=1)
        np.testing.assert_array_equal(xyz, POINTS.astype(np.float32))
        np.testing.assert_array_equal(turn.points["ring"], RING)
        np.testing.assert_array_equal(turn.points["column"], COLUMN)
        np.testing.assert_array_equal(turn.points["intensity"], COLUMN)


def test_only_wanted_clouds_are_decoded(session, monkeypatch):
    (sweeps,) = read_bag([session], Options(), quiet).sweeps
    decoded = []
    monkeypatch.setattr(
        "sensors.readers.bags.bag.cloud_of", lambda topic, message: decoded.append(1) or 1 / 0
    )
    assert list(sweeps.read(np.zeros(10, bool))) == [] and not decoded
    with pytest.raises(ZeroDivisionError):
        list(sweeps.read(np.arange(10) == 4))
    assert len(decoded) == 1


def test_logs_come_back_on_the_clock_of_the_clouds(session):
    found = read_bag([session], Options(), quiet)
    tracks = {track.name: track for track in found.tracks}
    assert {t.clock for t in found.tracks} == {s.clock for s in found.sweeps} == {"session"}
    joints = tracks["/joint_states"]
    assert joints.kind == "joints" and joints.names == ("a", "b", "gripper")
    assert np.all(np.diff(joints.time_s) >= 0) and len(joints.time_s) == 200
    np.testing.assert_allclose(joints.values[::2, :2], np.c_[0.01 * np.arange(100), np.ones(100)])
    assert np.isnan(joints.values[::2, 2]).all() and (joints.values[1::2, 2] == 0.5).all()
    body = tracks["/vrpn/rig/pose"]
    assert body.kind == "pose" and body.names == POSE
    unseen = np.arange(100) == 50
    assert np.isnan(body.values[unseen]).all()
    np.testing.assert_allclose(body.values[~unseen, 0], 0.1 * np.flatnonzero(~unseen))
    np.testing.assert_allclose(body.values[~unseen, 6], np.sin(0.01 * np.flatnonzero(~unseen)))
    assert tracks["tool"].values.shape == (100, 7)
    said = "\n".join(found.understood)
    assert "tool in world" in said and "stands still at 0.0000 2.0000 3.0000" in said
    assert "100 rows at 100 Hz" in said and "10 clouds at 10 Hz" in said


@pytest.mark.parametrize("storage", FORMATS)
def test_what_is_ambiguous_is_refused_with_the_topics(storage, tmp_path):
    with Bag(tmp_path / "two", storage) as bag:
        for topic in ("/front", "/rear", "/rear"):
            bag.cloud(topic, START_NS, cloud_points())
    with pytest.raises(InputError, match=r"several topics of clouds, /front .*--topic /rear"):
        read_bag([bag.path], Options(), quiet)
    (sweeps,) = read_bag([bag.path], Options(topics=("/front",)), quiet).sweeps
    assert sweeps.name == "/front" and len(sweeps.time_s) == 1
    with pytest.raises(InputError, match=r"no topic /frnt .*did you mean /front\?"):
        read_bag([bag.path], Options(topics=("/frnt",)), quiet)


def test_a_bag_of_nothing_useful_lists_what_it_holds(tmp_path):
    with Bag(tmp_path / "talk", "mcap") as bag:
        bag.write("/chatter", START_NS, bag.make("std_msgs/msg/String", data="hello"))
    with pytest.raises(InputError, match=r"its topics are /chatter \(std_msgs/String, 1\)"):
        read_bag([bag.path], Options(), quiet)


def test_headers_of_another_clock_give_way_to_arrivals(tmp_path):
    with Bag(tmp_path / "boot", "ros1") as bag:
        for k in range(3):
            bag.cloud("/points", START_NS + k * 10**8, cloud_points(), 17 * 10**9 + k * 10**8)
    found = read_bag([bag.path], Options(), quiet)
    assert any("times of arrival are taken" in line for line in found.odd)
    np.testing.assert_allclose(
        found.sweeps[0].time_s - START_NS / 1e9, [0.05, 0.15, 0.25], atol=2e-3
    )


def test_several_bags_of_one_session_are_one(tmp_path):
    for part in range(2):
        with Bag(tmp_path / f"part{part}", "ros1") as bag:
            bag.cloud("/points", START_NS + part * 10**9, cloud_points())
    parts = [tmp_path / f"part{k}.bag" for k in range(2)]
    (sweeps,) = read_bag(parts, Options(), quiet).sweeps
    assert np.diff(sweeps.time_s) == pytest.approx(1.0)
    assert len(list(sweeps.read(np.ones(2, bool)))) == 2


@pytest.mark.parametrize("storage", FORMATS)
@pytest.mark.parametrize("part", [0, 0.02, 0.5, 0.9])
def test_a_bag_cut_short_is_one_sentence(storage, part, tmp_path):
    """Or is read as far as it goes: a chunk of MCAP is whole or not there."""
    with Bag(tmp_path / "cut", storage) as bag:
        for k in range(40):
            bag.cloud("/points", START_NS + k * 10**8, cloud_points())
    file = bag.path if bag.path.is_file() else next(bag.path.glob("cut*"))
    data = file.read_bytes()
    file.write_bytes(data[: int(part * len(data))])
    with pytest.raises(InputError) as told:
        (sweeps,) = read_bag([bag.path], Options(), quiet).sweeps
        list(sweeps.read(np.ones(len(sweeps.time_s), bool)))
    assert str(tmp_path) in str(told.value) and "\n" not in str(told.value)


def test_what_is_no_bag_is_refused(tmp_path):
    (tmp_path / "cloud.pcd").write_text("x")
    (tmp_path / "folder").mkdir()
    for path, words in (
        (tmp_path / "none.bag", "does not exist"),
        (tmp_path / "cloud.pcd", "is no bag"),
        (tmp_path / "folder", "holds no bag"),
    ):
        with pytest.raises(InputError, match=words):
            read_bag([path], Options(), quiet)
