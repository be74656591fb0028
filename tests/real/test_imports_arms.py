"""Real files of arms, trackers and robots' descriptions, read by every kind that might."""

import zipfile
from pathlib import Path

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from calib.intake import Choices, import_files
from calib.intake.clocks import align
from chains.arm import read_arm
from chains.errors import InputError
from sensors.readers import READERS
from sensors.readers.base import Contents, Options

from . import foreign
from .foreign import quiet

KINDS = (
    *("dh", "euroc", "industrial_calibration", "motive", "table", "tum", "urdf", "vicon"),
)  # fmt: skip
FOLDERS = ("arms/ur10_tmac", "arms/rosi_positioner_2axis", "tracking", "urdf")


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("folder", FOLDERS)
def test_no_file_ends_in_a_traceback(kind, folder, shared, tmp_path):
    """Of the wrong kind, whole or cut off: a reader finds something or says what is wrong."""
    for path in sorted(p for p in (shared / folder).rglob("*") if p.is_file()):
        cut = tmp_path / path.name
        content = path.read_bytes()[:200_000]
        for part in (content, content[: len(content) // 2], content[:100]):
            cut.write_bytes(part)
            try:
                assert isinstance(READERS[kind].read([cut], Options(), quiet), Contents)
            except InputError as error:
                assert "\n" not in str(error)


def test_where_a_tracker_hangs_on_a_ur10_is_found_without_cad(shared, tmp_path):
    source = shared / "arms/ur10_tmac"
    given = [("table", [source / foreign.UR10_FILES["A"]])]
    given += [("dh", [foreign.EXAMPLES / "ur10.yaml"])]
    options = Options(columns=foreign.UR10_COLUMNS, euler="XYZ")
    import_files(given, tmp_path / "rec", options, Choices(most_stops=300, blocks=12))
    mount = yaml.safe_load((tmp_path / "rec/rig.yaml").read_text())["frames"]["mount_markers"]
    # The planned tool turned half a turn, its origin 16 mm nearer: see foreign.ur10.
    np.testing.assert_allclose(mount["xyz_m"], [0, 0, 0.093], atol=2e-3)
    turn = Rotation.from_euler("xyz", mount["rpy_rad"]) * Rotation.from_euler("z", np.pi / 2)
    assert turn.magnitude() < 0.01


def test_a_tool_that_keeps_its_direction_asks_for_cad(shared, tmp_path):
    given = [("table", [shared / "arms/ur10_tmac" / foreign.UR10_FILES["D"]])]
    given += [("dh", [foreign.EXAMPLES / "ur10.yaml"])]
    options = Options(columns=foreign.UR10_COLUMNS, euler="XYZ")
    with pytest.raises(InputError, match="--rig"):
        import_files(given, tmp_path / "rec", options)


def test_lines_that_end_in_a_zero_are_read(shared):
    path = shared / "arms/ur10_tmac/Series_D/calibration_handeye.csv"
    columns = {"tmac.*": "measurement_*[mm]", "flange.*": "flange_q*", "time_s": "none"}
    columns = {"tmac.*": "measurement_*[mm]", "flange.*": "flange_*"}
    found = READERS["table"].read([path], Options(columns=columns, euler="XYZ"), quiet)
    assert len(found.stops["flange.qw"]) == 26 and found.stops["tmac.x"].max() < 3


@pytest.mark.parametrize(
    ("name", "offset_ms", "within_ms"),
    [("prime_sense_color_w_vicon_1", -27, 15), ("prime_sense_color_w_vicon_2", -27, 20)],
)
def test_the_clock_of_a_vicon_is_behind(name, offset_ms, within_ms, shared, tmp_path):
    """By some 27 ms, as found by others; the camera is noisy, and says so."""
    with zipfile.ZipFile(shared / f"arms/handeye_ethz/{name}.zip") as archive:
        archive.extractall(tmp_path)
    files = sorted(tmp_path.rglob("*.csv"))
    found = READERS["tum"].read(files, Options(), quiet)
    (line,) = [
        line for line in align(found.tracks, [], (), {}).understood if "from the motion" in line
    ]
    offset, sigma = (1e3 * float(line.split()[k]) for k in (2, 4))
    assert "vicon" in line.split()[1]
    assert abs(offset - offset_ms) < within_ms and 1 < sigma < 10


def test_a_take_of_motive(shared):
    (path,) = (shared / "tracking").rglob("*.csv")
    found = READERS["motive"].read([path], Options(), quiet)
    (body,) = found.tracks
    assert body.name == "Rigid Body 1" and body.values.shape == (250, 7)
    # The first frame in the file: -1 is W, 0.019150 is Y, which is up.
    np.testing.assert_allclose(body.values[0, :3], [0.060002, -0.076611, 0.019150], atol=1e-9)
    turn = Rotation.from_quat(body.values[:, 3:], scalar_first=True)
    assert (Rotation.from_euler("x", np.pi / 2).inv() * turn).magnitude().max() < 1e-3
    assert np.median(np.diff(body.time_s)) == pytest.approx(1 / 120, abs=1e-6)


@pytest.mark.parametrize("folder", ["tracking/motive_csv_sample", "arms/handeye_ethz"])
def test_what_a_tracker_saw_is_no_rig_alone(folder, shared, tmp_path):
    """A body, or two on each other, with no arm and no LiDAR: said so, and nothing is written."""
    kind, files = "motive", sorted((shared / folder).glob("*.csv"))
    if not files:
        with zipfile.ZipFile(shared / folder / "prime_sense_color_w_vicon_1.zip") as archive:
            archive.extractall(tmp_path)
        kind, files = "tum", sorted(tmp_path.rglob("*.csv"))
    with pytest.raises(InputError, match="no arm or LiDAR is there to be calibrated"):
        import_files([(kind, files)], tmp_path / "rec")
    assert not (tmp_path / "rec").exists()


@pytest.mark.parametrize(("name", "joints"), [("lwa4p", 6), ("lwa4p_extended", 7)])
def test_an_arm_that_is_only_macros(name, joints, shared, tmp_path):
    """Without ROS and its package of constants; joint 5 stands 5.263 mm aside in the LWA4P."""
    path = shared / f"urdf/lwa4p_ipa320/{name}.urdf.xacro"
    found = READERS["urdf"].read([path], Options(), quiet)
    (tmp_path / "arm.urdf").write_text(found.arm.urdf)
    edges = read_arm(tmp_path / "arm.urdf", found.arm.base, found.arm.tip)
    assert [edge.name for edge in edges] == [f"arm_{k + 1}_joint" for k in range(joints)]
    if name == "lwa4p":
        assert np.abs(edges[4].T_parent_child[:3, 3]).min() < 1e-9
        assert any(np.isclose(np.abs(e.T_parent_child[:3, 3]), 0.005263).any() for e in edges)
    assert any("--package schunk_description=" in line for line in found.odd)


def test_what_a_base_lacks_is_named(shared):
    path = shared / "urdf/husky/husky.urdf.xacro"
    with pytest.raises(InputError, match="--package husky_description="):
        READERS["urdf"].read([path], Options(), quiet)
    assert not list(Path.cwd().glob("nowhere*"))
