"""rig.yaml: what it says is what the rig is, and what is wrong in it is named with its line."""

import shutil

import numpy as np
import pytest

from calib.rig import load_rig
from calib.simulation import simulate
from chains import se3
from chains.errors import InputError
from sensors.documents import Format, read_yaml, write_yaml

URDF = """<robot name="arm">
<link name="arm_base"/><link name="arm_1"/><link name="arm_2"/><link name="arm_end"/>
<joint name="turn" type="revolute"><parent link="arm_base"/><child link="arm_1"/>
 <origin xyz="0 0 0.2"/><axis xyz="0 0 1"/>
 <limit lower="-3" upper="3" effort="1" velocity="1"/></joint>
<joint name="slide" type="prismatic"><parent link="arm_1"/><child link="arm_2"/>
 <axis xyz="1 0 0"/><limit lower="0" upper="1" effort="1" velocity="1"/></joint>
<joint name="tip" type="fixed"><parent link="arm_2"/><child link="arm_end"/>
 <origin xyz="0 0 0.1"/></joint>
</robot>
"""
RIG = """name: bench
lidar: {model: velodyne_vlp16, frame: lidar, sigma_range_m: 5e-3}
arm: {urdf: arm.urdf, base: arm_base, tip: arm_end, sigma_joint_rad: 1e-4}
frames:
  base_markers:
    parent: base
    xyz_m: [0.1, 0, 0.3]
    rpy_rad: [0, 0, 0.3]
    sigma_m: 0.001
    sigma_rad: [0.001, 0.002, 0]
  arm_base: {parent: base, xyz_m: [0.2, 0, 0.4], sigma_m: 0, sigma_rad: 0}
  lidar: {parent: arm_end, xyz_m: [0, 0, 0.1], rpy_rad: [0, 0.5, -0.7], sigma_m: 0, sigma_rad: 3e-3}
base: {moves: location}
tracker:
  frame: opti
  bodies: [base_markers]
  sigma_m: 0.0002
  sigma_rad: 0.0003
target: {sphere_below_lower_marker_m: 0.18, sigma_sphere_m: 0.0006, sigma_marker_m: 0.0002}
reference:
  frame: faro
  mesh: reference/mesh.ply
  sigma_m: 0.0006
shared: [mount]
"""


@pytest.fixture
def write(tmp_path):
    """A function that writes rig.yaml, with texts replaced, beside the files it names."""

    def write_rig(*changes, text=RIG):
        for old, new in changes:
            assert text.count(old) == 1, old
            text = text.replace(old, new)
        (tmp_path / "rig.yaml").write_text(text)
        (tmp_path / "arm.urdf").write_text(URDF)
        (tmp_path / "reference").mkdir(exist_ok=True)
        (tmp_path / "reference/mesh.ply").write_text("ply\n")
        return tmp_path

    return write_rig


def test_the_rig_is_what_the_file_says(write):
    folder = write()
    rig = load_rig(folder)
    assert (rig.name, rig.folder, rig.moves) == ("bench", folder, "location")
    assert rig.joint_names == ("turn", "slide") and rig.arm_edges == ("turn", "slide", "tip")
    assert rig.sigma_joint_rad == 1e-4 and rig.lidar_frame == "lidar"
    assert (rig.lidar.rings, rig.lidar.sigma_range_m) == (16, 0.005)
    assert list(rig.frame_sigma) == ["base_markers", "arm_base", "lidar"]
    np.testing.assert_array_equal(rig.frame_sigma["base_markers"], [0.001, 0.002, 0, *[0.001] * 3])
    np.testing.assert_array_equal(rig.frame_sigma["arm_base"], np.zeros(6))
    assert vars(rig.tracker) == {
        "frame": "opti", "bodies": ("base_markers",), "sigma_m": 0.0002, "sigma_rad": 0.0003
    }  # fmt: skip
    assert rig.target.sphere_below_lower_marker_m == 0.18
    assert rig.reference.mesh == folder / "reference/mesh.ply" and rig.reference.faces is None
    assert rig.reference.scanner_m == ((0.0, 0.0, 0.0),)
    assert (rig.shared, rig.own) == (("mount",), ())


@pytest.mark.parametrize(
    ("stood", "stations"),
    [
        ("[0, 0, 1.5]", ((0.0, 0.0, 1.5),)),
        ("[[0, 0, 1.5], [4, 2, 1]]", ((0.0, 0.0, 1.5), (4.0, 2.0, 1.0))),
        ("[]", ()),
    ],
)
def test_the_scanner_stood_at_one_station_at_several_or_nowhere_known(write, stood, stations):
    mesh = "mesh: reference/mesh.ply"
    rig = load_rig(write((mesh, f"{mesh}\n  scanner_m: {stood}")))
    assert rig.reference.scanner_m == stations


def test_frames_and_arm_make_one_chain(write):
    rig = load_rig(write())
    turn, slide = 0.4, 0.25
    expected = (
        se3.from_xyz_rpy([0.2, 0, 0.4], [0, 0, 0])
        @ se3.from_xyz_rpy([0, 0, 0.2], [0, 0, turn])
        @ se3.from_xyz_rpy([slide, 0, 0.1], [0, 0, 0])
        @ se3.from_xyz_rpy([0, 0, 0.1], [0, 0.5, -0.7])
    )
    placed = rig.tree.place("lidar", [[turn, slide]])
    np.testing.assert_allclose(placed.Ts_root_frame[0], expected, atol=1e-12)
    assert rig.tree.root == "base"


def test_what_hangs_from_the_arm_is_known(write):
    rig = load_rig(write())
    assert rig.beyond_arm == {"lidar"} and rig.world == "opti" and rig.reference_frame == "faro"
    assert rig.joints_to("lidar") == ("turn", "slide") and rig.joints_to("base_markers") == ()


def test_every_part_but_the_name_is_optional(write):
    rig = load_rig(write(text="name: bare\nlidar: {model: velodyne_vlp16, frame: sensor}\n"))
    assert rig.tree.root == rig.lidar_frame == "sensor" and rig.joint_names == rig.arm_edges == ()
    assert rig.tracker is rig.target is rig.reference is None and rig.moves == "stop"
    arm_only = load_rig(
        write(text="name: a\narm: {urdf: arm.urdf, base: arm_base, tip: arm_end}\n")
    )
    assert (
        arm_only.tree.root == "arm_base"
        and arm_only.lidar is None
        and arm_only.sigma_joint_rad == 0
    )


def test_a_lidar_model_may_lie_beside_the_rig(write):
    folder = write(("velodyne_vlp16", "mine.yaml"))
    with pytest.raises(InputError, match=r"rig\.yaml:2: lidar\.model: .*mine\.yaml does not exist"):
        load_rig(folder)
    catalog = load_rig(write()).lidar
    write(("velodyne_vlp16", "mine.yaml"))
    (folder / "mine.yaml").write_text(
        "maker: me\nsource: bench\nrings: 1\ncolumns: 10\nelevation_deg: [0]\nmin_range_m: 0\n"
        "max_range_m: 9\nsigma_range_m: 1\n"
    )
    mine = load_rig(folder).lidar
    assert (mine.name, mine.rings, mine.sigma_range_m) == ("mine", 1, catalog.sigma_range_m)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (("name: bench", ""), r"rig\.yaml: name is missing"),
        (("base: {moves", "bass: {moves"), r"rig\.yaml:13: unknown key bass; did you mean base\?"),
        (
            ("    rpy_rad: [0, 0, 0.3]", "    rpy_deg: [0, 0, 17]"),
            r"rig\.yaml:8: unknown key frames\.base_markers\.rpy_deg; did you mean rpy_rad\?",
        ),
        (
            ("sigma_range_m", "sigma_rnge_m"),
            r":2: unknown key lidar\.sigma_rnge_m; did you mean sigma_r",
        ),
        (
            ("velodyne_vlp16", "velodyne_vlp32"),
            r":2: lidar: .*vlp32 is unknown; did you mean velodyne_vlp16",
        ),
        (("sigma_range_m: 5e-3", "beam_origin_m: [27, 0]"), r":2: lidar: .*millimetres"),
        (("sigma_range_m: 5e-3", "rings: x"), r":2: lidar\.rings: .*integer, not 'x'"),
        (("[0.1, 0, 0.3]", "[0.1, 0]"), r":7: frames\.base_markers\.xyz_m\.2 is missing"),
        (("[0.1, 0, 0.3]", "[0.1, 0, up]"), r":7: frames\.base_markers\.xyz_m\.2: .*not 'up'"),
        (("[0.1, 0, 0.3]", "[100, 0, 320]"), r":7: .*xyz_m: 320 m looks like millimetres"),
        (
            ("rpy_rad: [0, 0, 0.3]", "rpy_rad: [0, 0, 17]"),
            r":8: .*rpy_rad: 17 rad looks like degrees",
        ),
        (("    sigma_m: 0.001\n", ""), r":5: frames\.base_markers\.sigma_m is missing"),
        (("[0.001, 0.002, 0]", "[0.001, -0.002, 0]"), r":10: .*sigma_rad: -0\.002 is negative"),
        (
            ("parent: arm_end", "parent: arm_tip"),
            r":4: frames: frames 'base', 'arm_tip' have no parent",
        ),
        (
            ("frame: lidar", "frame: lidr"),
            r":2: lidar\.frame: frame 'lidr' is unknown; did you mean 'lidar",
        ),
        (
            ("bodies: [base_markers]", "bodies: [base_marker]"),
            r":16: tracker\.bodies\.0: .*mean 'base_markers'",
        ),
        (("bodies: [base_markers]", "bodies: []"), r":16: tracker\.bodies: .*at least 1"),
        (("frame: opti", "frame: base"), r":15: tracker\.frame: 'base' is a frame of the rig"),
        (("frame: faro", "frame: arm_1"), r":21: reference\.frame: 'arm_1' is a frame of the rig"),
        (("sigma_m: 0.0002", "sigma_m: 0"), r":17: tracker\.sigma_m: .*greater than 0"),
        (
            ("moves: location", "moves: often"),
            r":13: base\.moves: .*'location' or 'never', not 'often'",
        ),
        (("urdf: arm.urdf", "urdf: leg.urdf"), r":3: arm\.urdf: .*leg\.urdf does not exist"),
        (
            ("tip: arm_end", "tip: arm_ende"),
            r"urdf: link 'arm_ende' is unknown; did you mean 'arm_end'",
        ),
        (
            ("reference/mesh.ply", "reference/msh.ply"),
            r":22: reference\.mesh: .*msh\.ply does not exist",
        ),
        (
            ("sigma_m: 0.0006\n", "sigma_m: 0.0006\n  scanner_m: [[0, 0, 1.5], [1, 2]]\n"),
            r":24: reference\.scanner_m\.1\.2 is missing",
        ),
    ],
)
def test_what_is_wrong_is_named_in_one_sentence_with_its_line(write, change, sentence):
    with pytest.raises(InputError, match=sentence) as error:
        load_rig(write(change))
    assert "\n" not in str(error.value)


def test_a_folder_without_rig_is_named(tmp_path):
    with pytest.raises(InputError, match=r"rig\.yaml does not exist"):
        load_rig(tmp_path)


def test_a_rig_survives_being_written_again(write):
    folder = write()
    before = load_rig(folder)
    write_yaml(folder / "rig.yaml", read_yaml(folder / "rig.yaml")[0])
    after = load_rig(folder)
    assert after.tree.edge_names == before.tree.edge_names and after.tracker == before.tracker
    for name, sigma in before.frame_sigma.items():
        np.testing.assert_array_equal(after.frame_sigma[name], sigma)


@pytest.mark.parametrize("name", ["known_nothing_hidden", "known_two_hidden", "mystery_a"])
def test_rigs_by_an_independent_simulator_are_read(shared, name):
    rig = load_rig(shared / "recordings" / name)
    assert len(rig.joint_names) == 6 and rig.tree.root == "base"
    assert rig.beyond_arm == {"mount", "mount_markers", "lidar"}
    np.testing.assert_array_equal(rig.lidar.beam_origin_m, [0, 0])


def test_the_rig_file_alone_is_not_enough_where_it_names_others(shared, tmp_path):
    shutil.copy(shared / "recordings/mystery_a/rig.yaml", tmp_path)
    with pytest.raises(InputError, match=r"arm\.urdf does not exist"):
        load_rig(tmp_path)


# ------------------------------------------------------------------------------------------ formats


def rewritten(folder, first_lines):
    """A rig of nothing but its name, with these lines above it."""
    (folder / "rig.yaml").write_text(f"{first_lines}name: bench\n")
    return folder


@pytest.mark.parametrize("line", ["", "format: 1\n"])
def test_a_recording_without_a_number_is_of_format_1(tmp_path, line):
    assert load_rig(rewritten(tmp_path, line)).name == "bench"


def test_a_newer_recording_is_refused_whatever_else_it_says(tmp_path):
    sentence = r"rig\.yaml: this recording is of format 2, .* up to 1; open it with a newer rigcal$"
    with pytest.raises(InputError, match=sentence):
        load_rig(rewritten(tmp_path, "format: 2\nnot_known_yet: 3\n"))


def test_an_older_recording_that_is_no_longer_read_names_the_version_that_does(
    tmp_path, monkeypatch
):
    now = Format(kind="recording", newest=3, former={1: "0.4.2"})
    monkeypatch.setattr("calib.rig.description.RECORDING_FORMAT", now)
    with pytest.raises(
        InputError, match=r"is of format 1, which is read by rigcal 0\.4\.2 and ear"
    ):
        load_rig(rewritten(tmp_path, ""))
    assert load_rig(rewritten(tmp_path, "format: 2\n")).name == "bench"


def test_what_rigcal_writes_has_the_number(tmp_path):
    simulate("arm-tracker", tmp_path / "rec")
    assert (tmp_path / "rec/rig.yaml").read_text().startswith("format: 1\n")
