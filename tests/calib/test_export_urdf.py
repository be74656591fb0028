"""The calibrated URDF: two libraries that read it find every frame where the fit has it."""

import numpy as np
import pinocchio
import pytest
import yaml
import yourdfpy

from calib.effects import CATALOGUE, load_effects
from calib.exporters import export
from calib.exporters.fitted import Fitted
from calib.problem.model import Source
from chains.errors import InputError

from . import exports, rigs

MINE = """
import numpy as np
from calib.effects import Effect, Param, Site

class Bent(Effect):
    name, site, unit = "bent", Site.EDGE, "rad"

    def params(self, rig):
        return (Param("amount", "rad", 0.01),)

    def basis(self, view):
        basis = np.zeros((view.rows, len(view.rig.tree.edges), 6, 1))
        basis[:, view.rig.tree.edge_names.index("lift"), :3, 0] = (1, 2, 3)
        return basis
"""
FORMULAS = """
- {name: leans, site: tip.ry, unit: rad, sigma: 0.01, basis: ["1"]}
- {name: late, site: "joint:turn", unit: rad, sigma: 0.01, basis: ["0.5 + 0.5"]}
- {name: sunk, site: mount.tz, unit: m, sigma: 0.01, basis: ["1"]}
- {name: swings, site: "joint:lift", unit: rad, sigma: 0.01, basis: ["sin(lift)"]}
- {name: warms, site: mount.tx, unit: m/K, sigma: 0.01, basis: ["temperature - 20"]}
"""
FIXED = ("arm_link_length", "arm_joint_offset", "arm_axis_tilt", "arm_geometry")
FIXED += ("bent", "leans", "late", "sunk")
MOVING = ("arm_joint_scale", "arm_thermal_growth", "mount_slip", "swings", "warms")


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A run with all kinds of effects, its recording, and what was exported."""
    folder = tmp_path_factory.mktemp("urdf")
    (folder / "mine.py").write_text(MINE)
    (folder / "mine.yaml").write_text(FORMULAS)
    names = [*FIXED[:3], *MOVING[:3], "ring_range_offset", "faro_scale"]
    effects = load_effects([*names, str(folder / "mine.py"), str(folder / "mine.yaml")])
    recording = rigs.write(folder / "rec")
    run = exports.found_by_chance([recording], effects)
    return run, Source.open(recording), export(run, folder / "out", ["urdf"]), folder / "out"


def poses(count=6):
    return np.random.default_rng(2).uniform(-1, 1, (count, len(rigs.JOINTS)))


@pytest.mark.parametrize(("file", "frame"), [("arm", "arm_end"), ("rig", "lidar")])
def test_yourdfpy_reproduces_the_fitted_kinematics(made, file, frame):
    run, source, _, out = made
    robot = yourdfpy.URDF.load(out / f"{file}.urdf", load_meshes=False)
    base = {"arm": "arm_base", "rig": "base"}[file]
    T_root = exports.as_fitted(run, source, base, poses(), FIXED).T
    fitted = np.linalg.inv(T_root) @ exports.as_fitted(run, source, frame, poses(), FIXED).T
    for joints, T in zip(poses(), fitted, strict=True):
        robot.update_cfg(dict(zip(rigs.JOINTS, joints, strict=True)))
        np.testing.assert_allclose(robot.get_transform(frame, base), T, rtol=0, atol=1e-9)


@pytest.mark.parametrize("frame", ["arm_end", "mount_markers", "base_markers", "lidar"])
def test_pinocchio_reproduces_the_fitted_kinematics(made, frame):
    run, source, _, out = made
    model = pinocchio.buildModelFromUrdf(str(out / "rig.urdf"))
    data = model.createData()
    order = [model.joints[model.getJointId(name)].idx_q for name in rigs.JOINTS]
    fitted = exports.as_fitted(run, source, frame, poses(), FIXED).T
    for joints, T in zip(poses(), fitted, strict=True):
        q = np.zeros(model.nq)
        q[order] = joints
        pinocchio.framesForwardKinematics(model, data, q)
        found = data.oMf[model.getFrameId(frame)].homogeneous
        np.testing.assert_allclose(found, T, rtol=0, atol=1e-9)


def test_the_calibration_is_far_from_the_drawing(made):
    """Else the tests above would say nothing."""
    run, source, *_ = made
    nominal = source.rig.tree.place("arm_end", poses()).Ts_root_frame
    fitted = exports.as_fitted(run, source, "arm_end", poses(), FIXED).T
    assert np.abs(fitted - nominal).max() > 1e-3


def test_what_changes_with_pose_time_or_weather_is_named(made):
    _, _, done, out = made
    said = [sentence.partition(":")[0] for sentence in done.not_held["urdf"]]
    assert said == ["sigmas", *MOVING[:3], "ring_range_offset", "faro_scale", *MOVING[3:], "faro"]
    assert any("changes with temperature" in sentence for sentence in done.not_held["urdf"])
    for file in ("arm.urdf", "rig.urdf"):
        comment = (out / file).read_text().partition("-->")[0]
        assert all(f"    {name}: " in comment for name in MOVING)
        assert not any(f"    {name}: " in comment for name in FIXED)


def test_only_origins_and_a_comment_differ(made):
    _, source, _, out = made
    original = source.rig.arm_urdf.read_text()
    head, _, written = (out / "arm.urdf").read_text().partition("-->\n")
    assert head.startswith("<!--")
    pieces = original.split("<origin ")
    others = written.split("<origin ")
    assert [p.partition("/>")[2] for p in pieces] == [p.partition("/>")[2] for p in others]
    assert pieces[0] == others[0] and pieces != others


def test_every_rig_of_several_has_its_own_file(tmp_path):
    folders = [
        rigs.write(tmp_path / name, name=name, seed=k) for k, name in enumerate(("one", "two"))
    ]
    run = exports.found_by_chance(folders, ["arm_link_length", "ring_range_offset"])
    done = export(run, tmp_path / "out", ["urdf"])
    files = [f"{kind}.{name}.urdf" for name in ("one", "two") for kind in ("arm", "rig")]
    assert [file.name for file in done.files] == files
    assert "one/ring_range_offset: an error of the LiDAR's beams" in done.not_held["urdf"]
    for folder in folders:
        robot = yourdfpy.URDF.load(tmp_path / f"out/arm.{folder.name}.urdf", load_meshes=False)
        robot.update_cfg(dict.fromkeys(rigs.JOINTS, 0.3))
        T = exports.as_fitted(
            run, Source.open(folder), "arm_end", np.full((1, 3), 0.3), ["arm_link_length"]
        ).T[0]
        T_base = run.solution.part(folder.name).frames["arm_base"].T_parent_child
        found = robot.get_transform("arm_end", "arm_base")
        np.testing.assert_allclose(T_base @ found, T, rtol=0, atol=1e-9)


@pytest.fixture
def fixed_rig(tmp_path):
    """A rig without an arm."""
    frames = {
        "mount": {"parent": "base", "xyz_m": [0, 0.5, 1], "sigma_m": 0.01, "sigma_rad": 0.01},
        "lidar": {"parent": "mount", "xyz_m": [0.1, 0, 0], "sigma_m": 0.01, "sigma_rad": 0.01},
    }
    tracker = {**rigs.drawing()["tracker"], "bodies": ["mount"]}
    folder = rigs.write(tmp_path / "rec", arm=None, frames=frames, tracker=tracker)
    lines = (folder / "stops.csv").read_text().replace("mount_markers.", "mount.")
    (folder / "stops.csv").write_text(lines)
    return folder


def test_a_rig_without_an_arm_is_its_frames(fixed_rig, tmp_path):
    run = exports.found_by_chance([fixed_rig])
    (file,) = export(run, tmp_path / "out", ["urdf"]).files
    robot = yourdfpy.URDF.load(file, load_meshes=False)
    T = exports.as_fitted(run, Source.open(fixed_rig), "lidar", np.zeros((1, 0)), ()).T[0]
    np.testing.assert_allclose(robot.get_transform("lidar", "base"), T, rtol=0, atol=1e-9)


def test_an_arm_in_the_middle_of_a_robot_keeps_its_place(tmp_path):
    """What the URDF holds already is not added a second time."""
    folder = rigs.write(tmp_path / "rec")
    text = (folder / "arm.urdf").read_text()
    more = '<link name="world"/><joint name="stand" type="fixed"><parent link="world"/>'
    more += '<child link="arm_base"/></joint></robot>'
    (folder / "arm.urdf").write_text(text.replace("</robot>", more))
    done = export(exports.found_by_chance([folder]), tmp_path / "out", ["urdf"])
    said = [s.partition(":")[0] for s in done.not_held["urdf"]]
    assert said == ["sigmas", "base_markers", "arm_base", "faro"]
    robot = yourdfpy.URDF.load(tmp_path / "out/rig.urdf", load_meshes=False)
    assert robot.base_link == "world" and "lidar" in robot.link_map


def test_without_its_recording_a_run_has_no_urdf(tmp_path):
    folder = rigs.write(tmp_path / "rec")
    run = exports.found_by_chance([folder])
    stops = (folder / "stops.csv").read_text()
    (folder / "stops.csv").write_text(stops + "\n")
    with pytest.raises(InputError, match=r"--format urdf: .*has changed since"):
        export(run, tmp_path / "out", ["urdf"])
    done = export(run, tmp_path / "out")
    assert "has changed since" in done.left_out["urdf"]
    assert yaml.safe_load((tmp_path / "out/extrinsics.yaml").read_text())["frames"]


def test_every_effect_of_the_catalogue_is_put_where_it_belongs(tmp_path):
    """What is fixed by the rig's geometry, by the ring, and what by neither: told by probing."""
    folder = rigs.write(tmp_path / "rec")
    effects = [e.at(e.shape) if e.shape_name else e for e in CATALOGUE]
    (rig,) = Fitted(exports.found_by_chance([folder], effects)).rigs
    assert len(rig.effects) > 35
    fixed = {"arm_link_length", "arm_joint_offset", "arm_axis_tilt", "arm_geometry"}
    assert set(rig.fixed) == fixed
    assert set(rig.by_ring) == {
        *("range_offset", "ring_range_offset", "elevation_scale"),
        *("ring_azimuth_offset", "ring_elevation_offset"),
    }
