"""Transforms for ROS 2, Autoware and Kalibr, the picture and the tables, as others read them."""

import re
import sys
from types import ModuleType
from xml.etree import ElementTree

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import RigidTransform, Rotation

from calib.effects import load_effects
from calib.exporters import export
from calib.rig import load_rig

from . import exports, rigs

SVG = "{http://www.w3.org/2000/svg}"
FORMATS = ("ros2", "autoware", "kalibr", "tree", "latex", "markdown")


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A run, what was exported, and T_parent_child of every fixed frame with its parent."""
    folder = tmp_path_factory.mktemp("frames")
    (folder / "sunk.yaml").write_text(
        "{name: sunk, site: mount.tz, unit: m, sigma: 0.01, basis: ['1']}"
    )
    names = ["arm_link_length", "ring_range_offset", "mount_creep", str(folder / "sunk.yaml")]
    recording = rigs.write(folder / "rec")
    run = exports.found_by_chance([recording], load_effects(names))
    done = export(run, folder / "out", FORMATS)
    true = {
        name: (frame.parent, frame.T_parent_child)
        for name, frame in run.solution.shared.frames.items()
    }
    # The mount's own effect along z of its CAD pose, and its twist, are one exponential.
    tree = load_rig(recording).tree
    cad = RigidTransform.from_matrix(tree.edges[tree.edge_names.index("mount")].T_parent_child)
    own = RigidTransform.from_matrix(true["mount"][1])
    twist = (cad.inv() * own).as_exp_coords()
    twist[5] += run.solution.shared.effects["sunk"].estimate[0]
    true["mount"] = ("arm_end", (cad * RigidTransform.from_exp_coords(twist)).as_matrix())
    return run, done, folder / "out", true


def assert_frames(found, true):
    assert {name: parent for name, (parent, _) in found.items()} == {
        name: parent for name, (parent, _) in true.items()
    }
    for name, (_, T) in found.items():
        np.testing.assert_allclose(T, true[name][1], rtol=0, atol=1e-12)


def test_the_launch_file_starts_a_publisher_for_every_frame(made, monkeypatch):
    """Executed with stand-ins for ROS, and its arguments read as the publisher reads them."""
    launch, ros = ModuleType("launch"), ModuleType("launch_ros")
    ros.actions = ModuleType("launch_ros.actions")
    launch.LaunchDescription, ros.actions.Node = list, dict
    for name, module in {
        "launch": launch, "launch_ros": ros, "launch_ros.actions": ros.actions
    }.items():  # fmt: skip
        monkeypatch.setitem(sys.modules, name, module)
    scope = {}
    exec((made[2] / "static_transforms.launch.py").read_text(), scope)
    found = {}
    for node in scope["generate_launch_description"]():
        assert (node["package"], node["executable"]) == ("tf2_ros", "static_transform_publisher")
        words = node["arguments"]
        assert all(isinstance(word, str) for word in words)
        said = dict(zip(words[::2], words[1::2], strict=True))
        xyz = [float(said[f"--{k}"]) for k in ("x", "y", "z")]
        quat = [float(said[f"--q{k}"]) for k in "xyzw"]
        T = RigidTransform.from_components(xyz, Rotation.from_quat(quat)).as_matrix()
        found[said["--child-frame-id"]] = (said["--frame-id"], T)
    assert_frames(found, made[3])


def test_the_yaml_is_a_message_of_ros(made):
    """As a tf2_msgs/TFMessage it goes through ROS's own serialisation and back."""
    rosbags = pytest.importorskip("rosbags.typesys")
    store = rosbags.get_typestore(rosbags.Stores.ROS2_HUMBLE)
    types, name = store.types, "tf2_msgs/msg/TFMessage"
    data = yaml.safe_load((made[2] / "static_transforms.yaml").read_text())

    def message(kind, **fields):
        return types[f"{kind.partition('/')[0]}/msg/{kind.partition('/')[2]}"](**fields)

    stamp = message("builtin_interfaces/Time", sec=0, nanosec=0)
    transforms = [
        message(
            "geometry_msgs/TransformStamped",
            header=message("std_msgs/Header", stamp=stamp, **each["header"]),
            child_frame_id=each["child_frame_id"],
            transform=message(
                "geometry_msgs/Transform",
                translation=message("geometry_msgs/Vector3", **each["transform"]["translation"]),
                rotation=message("geometry_msgs/Quaternion", **each["transform"]["rotation"]),
            ),
        )
        for each in data["transforms"]
    ]
    raw = store.serialize_cdr(message("tf2_msgs/TFMessage", transforms=transforms), name)
    found = {}
    for each in store.deserialize_cdr(raw, name).transforms:
        t, q = each.transform.translation, each.transform.rotation
        R = Rotation.from_quat([q.x, q.y, q.z, q.w])
        T = RigidTransform.from_components([t.x, t.y, t.z], R).as_matrix()
        found[each.child_frame_id] = (each.header.frame_id, T)
    assert_frames(found, made[3])


def from_autoware(pose):
    R = Rotation.from_euler("xyz", [pose[k] for k in ("roll", "pitch", "yaw")])
    return RigidTransform.from_components([pose[k] for k in "xyz"], R).as_matrix()


def test_autoware_finds_the_lidar_on_its_kit(made):
    _, done, out, true = made
    text = (out / "sensor_kit_calibration.yaml").read_text()
    kit = yaml.safe_load(text)["sensor_kit_base_link"]
    assert "sensor_kit_base_link stands for the rig's frame mount." in text
    assert kit.keys() == {"mount_markers", "lidar"}
    for name, pose in kit.items():
        np.testing.assert_allclose(from_autoware(pose), true[name][1], rtol=0, atol=1e-12)
    assert not (out / "sensors_calibration.yaml").exists()
    assert "place on the vehicle" in done.not_held["autoware"][0]


def test_without_an_arm_autoware_finds_the_kit_on_the_vehicle(tmp_path):
    frames = {
        name: {"parent": parent, "xyz_m": [0.1, 0.2, 0.3], "sigma_m": 0.01, "sigma_rad": 0.1}
        for name, parent in (("post", "base"), ("mount", "post"), ("lidar", "mount"))
    }
    tracker = {**rigs.drawing()["tracker"], "bodies": ["base_markers"]}
    frames["base_markers"] = {**frames["mount"], "parent": "base"}
    folder = rigs.write(tmp_path / "rec", arm=None, frames=frames, tracker=tracker)
    run = exports.found_by_chance([folder])
    export(run, tmp_path / "out", ["autoware"])
    data = yaml.safe_load((tmp_path / "out/sensors_calibration.yaml").read_text())
    found = from_autoware(data["base_link"]["sensor_kit_base_link"])
    T = {name: frame.T_parent_child for name, frame in run.solution.shared.frames.items()}
    np.testing.assert_allclose(found, T["post"] @ T["mount"], rtol=0, atol=1e-12)


def test_kalibr_has_every_frame_the_other_way_round(made):
    data = yaml.safe_load((made[2] / "kalibr.yaml").read_text())
    found = {
        name: (part["parent"], np.linalg.inv(part[f"T_{name}_{part['parent']}"]))
        for name, part in data.items()
    }
    assert_frames(found, made[3])


def test_what_the_transforms_do_not_hold_is_said_in_them(made):
    _, done, out, _ = made
    for name, file in (("ros2", "static_transforms.yaml"), ("kalibr", "kalibr.yaml")):
        said = [sentence.partition(":")[0] for sentence in done.not_held[name]]
        assert said == ["sigmas", "arm_link_length", "ring_range_offset", "mount_creep"]
        text = (out / file).read_text()
        assert all(f"#   {sentence}\n" in text for sentence in done.not_held[name])
        assert "#   mount.tz\n" in text


def test_the_picture_hangs_every_frame_below_its_parent(made):
    """Names stand one step to the right of the nearest name above that is further left."""
    run, _, out, true = made
    drawn = ElementTree.parse(out / "tree.svg").getroot()
    texts = [
        (float(t.get("x")), float(t.get("y")), t.text)
        for t in drawn.iter(f"{SVG}text")
        if "bold" in t.get("style", "") or "600" in t.get("style", "")
    ][1:]
    above, found = [], {}
    for x, _, name in texts:
        while above and above[-1][0] >= x:
            above.pop()
        found[name] = above[-1][1] if above else None
        above.append((x, name))
    chain = {child: parent for parent, child in zip(
        ["opti", "base", "arm_base", "arm_1", "arm_2", "arm_3"],
        ["base", "arm_base", "arm_1", "arm_2", "arm_3", "arm_end"], strict=True
    )}  # fmt: skip
    assert found == {"opti": None, **chain, **{n: parent for n, (parent, _) in true.items()}}
    for x, y, name in texts:
        row = [t for t in drawn.iter(f"{SVG}text") if t.get("y") == f"{y:.0f}"]
        if name in true:
            numbers = [float(v) for v in re.findall(r"-?\d+\.\d+", row[1].text)]
            np.testing.assert_allclose(numbers[:3], true[name][1][:3, 3], rtol=0, atol=5.1e-5)
            sigma_mm = 1e3 * run.solution.shared.frames[name].sigma_m.max()
            assert f"± {sigma_mm:.3f} mm" in row[2].text
            told = row[2].get("fill") == "#1f2933"
            assert told == (name != "mount")
        assert x < 1000


def tables(text, row, cell):
    """Rows of cells of every table of a text, one list of rows per table."""
    found = [[]]
    for line in text.splitlines():
        if (match := re.match(row, line)) is None:
            found += [[]] if found[-1] and not line.startswith("\\hline") else []
        else:
            found[-1].append([c.strip() for c in re.split(cell, match[1])])
    return [table for table in found if table]


def test_latex_and_markdown_tell_the_same(made):
    run, _, out, _ = made
    tex = (out / "calibration.tex").read_text()
    assert tex.count("{") == tex.count("}")
    for begun in re.findall(r"\\begin\{tabular\}\{(l+)\}[^\n]*\n\\hline\n([^\n]*)", tex):
        assert len(begun[0]) == begun[1].count("&") + 1
    said = re.sub(r"\$\\pm\$", "±", re.sub(r"\$\\to\$", "→", tex)).replace("$-$", "-")
    said = said.replace(r"\_", "_")
    md = [
        t[:1] + t[2:] for t in tables((out / "calibration.md").read_text(), r"\| (.*) \|$", r"\|")
    ]
    assert tables(said, r"([^%\\].*) \\\\$", "&") == md
    links, effects = md
    assert len(links) == 1 + 2 * len(run.solution.shared.frames)
    effect = run.solution.shared.effects["arm_link_length"]
    shown = [row for row in effects if row[0] == "arm_link_length"]
    for row, name, estimate, sigma in zip(
        shown, effect.names, effect.estimate, effect.sigma, strict=True
    ):
        value, spread = map(float, row[2].split(" ± "))
        assert row[1] == name and row[3] == "mm"
        np.testing.assert_allclose([value, spread], [1e3 * estimate, 1e3 * sigma], atol=0.0051)
    (tied,) = (row for row in links if row[0].endswith("→ mount") and row[4] == "mm")
    assert tied[5] == "z"
