"""Whole imports: logs of a moving arm as files, and the recording that must come of them."""

import csv

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import RigidTransform, Rotation

from calib.cli import main
from calib.intake import Choices, _asked, import_files, sources
from calib.problem.model import Source
from calib.rig import load_rig
from calib.runs.calibrate import calibrate
from chains.errors import InputError
from sensors.readers import READERS
from sensors.readers.base import Options, Sweeps

from .. import two_arms
from .moving import (
    JOINTS,
    T_BASE_FOOT,
    T_TIP_CUP,
    T_WORLD_BASE,
    dh,
    joint_log,
    logged,
    plan,
    tip,
    tum,
)  # fmt: skip

HELD, SPANS = plan(10, seed=5)
END_S = float(SPANS[-1, 1])
AHEAD_S = 12.345


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """A log of joints, a cup on the tip and a foot on the base on another clock, and the arm."""
    folder = tmp_path_factory.mktemp("logs")
    slow, fast = np.arange(0, END_S, 0.02), np.arange(0, END_S, 0.01)
    joint_log(folder / "log.csv", slow, logged(HELD, SPANS, slow))
    arm = tip(logged(HELD, SPANS, fast))
    tum(folder / "cup.txt", fast - AHEAD_S, T_WORLD_BASE * arm * T_TIP_CUP, 1e-4)
    tum(folder / "foot.txt", fast - AHEAD_S, moving_base(fast) * T_BASE_FOOT, 1e-4)
    tum(folder / "driven.txt", fast - AHEAD_S, moving_base(fast) * arm * T_TIP_CUP, 1e-4)
    dh(folder / "arm.yaml")
    return folder


def moving_base(time_s):
    """T_world_base of a base that stands elsewhere from the sixth hold on."""
    at = np.zeros((len(HELD), 6))
    at[5:] = [0, 0, 0.7, 1.5, 0, 0]
    return T_WORLD_BASE * RigidTransform.from_exp_coords(logged(at, SPANS, time_s))


def bring(folder, out, words, options=None, **choices):
    words = [str(folder / w) if "." in w else w for w in words.split()]
    return import_files(sources(words), out, options, Choices(**choices))


def stops_of(out):
    with (out / "stops.csv").open() as file:
        names, *rows = csv.reader(file)
    return dict(zip(names, zip(*rows, strict=True), strict=True))


def frame(out, name):
    at = yaml.safe_load((out / "rig.yaml").read_text())["frames"][name]
    return RigidTransform.from_components(at["xyz_m"], Rotation.from_euler("xyz", at["rpy_rad"]))


def apart(found, true):
    gap = found.inv() * true
    return np.linalg.norm(gap.translation), gap.rotation.magnitude()


def test_holds_clocks_and_a_first_rig(files, tmp_path):
    out = tmp_path / "rec"
    done = bring(files, out, "table log.csv tum cup.txt dh arm.yaml")
    assert done.check.folder == out  # which what it advises to type names
    table = stops_of(out)
    found = np.array([table[name] for name in JOINTS], float).T
    np.testing.assert_allclose(found, HELD, atol=1e-6)
    pose = T_WORLD_BASE * tip(HELD) * T_TIP_CUP
    xyz = np.array([table[f"cup.{axis}"] for axis in "xyz"], float).T
    np.testing.assert_allclose(xyz, pose.translation, atol=1e-4)
    shift_m, turn_rad = apart(frame(out, "cup"), T_TIP_CUP)
    assert shift_m < 1e-3 and turn_rad < 1e-3
    (said,) = [line for line in done.understood if line.startswith("clocks: cup")]
    assert float(said.split()[2]) == pytest.approx(AHEAD_S, abs=5e-3)
    assert "# guess" in (out / "rig.yaml").read_text()
    assert load_rig(out).moves == "never" and not done.check.problems


def test_two_bodies_are_told_apart_and_locations_found(files, tmp_path):
    out = tmp_path / "rec"
    bring(files, out, "table log.csv tum driven.txt foot.txt dh arm.yaml",
          Options(), clock_offsets={"foot": AHEAD_S})  # fmt: skip
    for name, true in (("driven", T_TIP_CUP), ("foot", T_BASE_FOOT)):
        shift_m, turn_rad = apart(frame(out, name), true)
        assert shift_m < 1e-3 and turn_rad < 1e-3
    assert stops_of(out)["location"] == ("L00",) * 5 + ("L01",) * 5
    assert load_rig(out).moves == "stop"


def test_a_rig_of_ones_own_is_taken_as_it_is(files, tmp_path):
    bring(files, tmp_path / "a", "table log.csv tum cup.txt dh arm.yaml")
    mine = tmp_path / "mine.yaml"
    mine.write_text((tmp_path / "a/rig.yaml").read_text().replace("cup", "mug") + "# mine\n")
    done = bring(files, tmp_path / "b", "table log.csv tum cup.txt dh arm.yaml", rig=mine)
    assert (tmp_path / "b/rig.yaml").read_text() == mine.read_text()
    assert "mug.x" in stops_of(tmp_path / "b")
    assert any("cup is mug" in line for line in done.understood)
    words = "table log.csv tum cup.txt foot.txt dh arm.yaml"
    with pytest.raises(InputError, match=r"mug was not tracked.*--body NAME=FRAME"):
        bring(files, tmp_path / "c", words, rig=mine, clock_offsets={"foot": AHEAD_S})
    assert not (tmp_path / "c").exists()
    options = Options(bodies={"cup": "mug"})
    done = bring(files, tmp_path / "c", words, options, rig=mine, clock_offsets={"foot": AHEAD_S})
    assert any("foot was tracked" in line for line in done.odd)


def test_joints_that_a_rig_calls_passive_need_no_column(files, tmp_path):
    bring(files, tmp_path / "a", "table log.csv tum cup.txt dh arm.yaml")
    passive, mine = JOINTS[1], tmp_path / "a" / "mine.yaml"
    rig = yaml.safe_load((tmp_path / "a/rig.yaml").read_text())
    table = stops_of(tmp_path / "a")
    lines = [",".join(n for n in table if n != passive)]
    lines += [",".join(row) for row in zip(*(table[n] for n in table if n != passive), strict=True)]
    (tmp_path / "stops.csv").write_text("\n".join(lines))
    mine.write_text(yaml.safe_dump(rig))
    with pytest.raises(InputError, match=f"the arm's joint {passive} is not among the columns"):
        bring(tmp_path, tmp_path / "b", "table stops.csv", rig=mine)
    rig["arm"]["passive"] = [passive]
    mine.write_text(yaml.safe_dump(rig))
    bring(tmp_path, tmp_path / "b", "table stops.csv", rig=mine)
    assert passive not in stops_of(tmp_path / "b")


def test_an_arm_of_several_tips_is_imported_with_the_joints_of_all(tmp_path):
    mine = tmp_path / "made" / "rec"
    mine.parent.mkdir()
    rng = np.random.default_rng(4)
    two_arms.write(mine, two_arms.drawn(rng), 12, rng)
    done = bring(mine, tmp_path / "b", "table stops.csv", rig=mine / "rig.yaml")
    before, after = (Source.open(f) for f in (mine, done.folder))
    assert after.rig.tips == two_arms.HANDS
    np.testing.assert_allclose(after.recording.joints, before.recording.joints)
    for body, pose in before.recording.bodies.items():
        np.testing.assert_allclose(after.recording.bodies[body], pose, atol=1e-9)
    text = (mine / "rig.yaml").read_text().replace("- right_hand\n", "- rihgt_hand\n", 1)
    (mine / "rig.yaml").write_text(text)
    with pytest.raises(InputError, match="link 'rihgt_hand' is unknown; did you mean"):
        bring(mine, tmp_path / "c", "table stops.csv", rig=mine / "rig.yaml")


def test_left_handed_axes_are_named(files, tmp_path):
    rows = np.loadtxt(files / "cup.txt")
    rows[:, [3, 4, 5]] *= -1  # z reversed: z, and the turns about x and y
    np.savetxt(tmp_path / "cup.txt", rows)
    given = [("table", [files / "log.csv"]), ("tum", [tmp_path / "cup.txt"])]
    with pytest.raises(InputError, match="left-handed"):
        import_files([*given, ("dh", [files / "arm.yaml"])], tmp_path / "rec")


@pytest.mark.parametrize(
    ("words", "options", "choices", "said"),
    [
        ("tabel log.csv", {}, {}, "'tabel' is no kind of file; did you mean table"),
        ("table", {}, {}, "no file is named after it"),
        ("table lgo.csv", {}, {}, "neither a file nor a kind"),
        ("tum cup.txt dh arm.yaml", {}, {}, "no source has values of the arm's joint j1"),
        ("table log.csv dh arm.yaml dh arm.yaml dh arm.yaml", {}, {}, "describe an arm; give one"),
        ("table log.csv tum cup.txt dh arm.yaml", {}, {"still": 1e-9}, "--still"),
        ("table log.csv tum cup.txt dh arm.yaml", {}, {"min_hold_s": 60.0}, "--min-hold"),
        ("table log.csv tum cup.txt dh arm.yaml", {}, {"clock_offsets": {"cap": 1.0}}, "mean cup"),
        ("dh arm.yaml", {}, {}, "the sources hold an arm, and no logs"),
        ("table log.csv log.csv dh arm.yaml", {}, {}, "two logs follow joints"),
        ("tum cup.txt tum cup.txt table log.csv dh arm.yaml", {}, {}, "two logs follow cup"),
        ("tum cup.txt", {}, {}, "no arm or LiDAR is there to be calibrated by cup"),
        ("tum cup.txt foot.txt", {}, {"clock_offsets": {"foot": 0.0}}, "no arm or LiDAR"),
    ],
)
def test_what_is_wrong_is_one_sentence_and_nothing_is_written(
    files, tmp_path, words, options, choices, said
):
    with pytest.raises(InputError, match=said):
        bring(files, tmp_path / "rec", words, Options(**options), **choices)
    assert list(tmp_path.iterdir()) == []


def test_an_empty_file_is_said_to_be(files, tmp_path):
    (tmp_path / "empty.csv").write_bytes(b"")
    with pytest.raises(InputError, match=r"empty.csv is empty \(0 bytes\)"):
        sources(["table", str(tmp_path / "empty.csv")])


@pytest.mark.parametrize(
    ("name", "said"), [("logs.zip", "logs.zip is packed; unpack it"), ("a.csv", "has no header")]
)
def test_a_packed_file_is_said_to_be(tmp_path, name, said):
    (tmp_path / name).write_text("1,2,3\n")
    with pytest.raises(InputError, match=said):
        import_files(sources(["table", str(tmp_path / name)]), tmp_path / "rec")


def test_metadata_that_no_source_reads_is_refused(files, tmp_path):
    options = Options(metadata=files / "arm.yaml")
    with pytest.raises(InputError, match=r"--metadata .*it is for bag, hesai, mesh, ouster"):
        bring(files, tmp_path / "rec", "table log.csv tum cup.txt dh arm.yaml", options)


@pytest.mark.parametrize("kind", ["mesh", "survey", "spheres"])
def test_a_room_alone_is_refused_before_it_is_read(tmp_path, kind):
    (tmp_path / "room.ply").write_text("ply")  # no whole file: it would be refused for that
    with pytest.raises(InputError, match=f"{kind} alone makes no recording"):
        import_files(sources([kind, str(tmp_path / "room.ply")]), tmp_path / "rec")


def test_a_room_in_which_the_rig_stood_anywhere_is_refused(tmp_path):
    """Said of the sources, and not of a stops.csv that nobody has written."""
    (tmp_path / "room.obj").write_text("v 0 0 0\nv 9 0 0\nv 0 9 0\nf 1 2 3\n")
    azimuth, ring = (a.ravel() for a in np.meshgrid(np.arange(0, 6.28, 0.1), np.arange(16)))
    up = np.tan(np.radians(2 * ring - 15))
    cloud = {"x": 3 * np.cos(azimuth), "y": 3 * np.sin(azimuth), "z": 3 * up, "ring": ring}
    np.savez(tmp_path / "s.npz", **cloud)
    given = [("mesh", [tmp_path / "room.obj"]), ("numpy", [tmp_path / "s.npz"])]
    with pytest.raises(InputError, match="nothing says where the rig stood in the scanned room"):
        import_files(given, tmp_path / "rec", Options(lidar="velodyne_vlp16"))


def test_stops_of_nothing_that_could_be_calibrated(tmp_path):
    """With a rig that has nothing either, and with an arm that nothing measures."""
    (tmp_path / "heat.csv").write_text("stop,heat\na,1\nb,2\n")
    (tmp_path / "rig.yaml").write_text("name: x\nbase: {moves: never}\n")
    given = sources(["table", str(tmp_path / "heat.csv")])
    with pytest.raises(InputError, match="no arm or LiDAR is there to be calibrated"):
        import_files(given, tmp_path / "rec")
    with pytest.raises(InputError, match="there is nothing to estimate"):
        import_files(given, tmp_path / "rec", None, Choices(tmp_path / "rig.yaml"))
    assert not (tmp_path / "rec").exists()
    dh(tmp_path / "arm.yaml")
    (tmp_path / "heat.csv").write_text(f"stop,{','.join(JOINTS)}\na,1,0,0,0\nb,2,1,0,0\n")
    import_files([*given, ("dh", [tmp_path / "arm.yaml"])], tmp_path / "rec")
    with pytest.raises(InputError, match="there is nothing to fit to"):
        calibrate([tmp_path / "rec"], tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_many_stops_are_thinned_evenly(tmp_path, files):
    joints = np.random.default_rng(2).uniform(-1, 1, (60, 4))
    pose = T_WORLD_BASE * tip(joints) * T_TIP_CUP
    quat = pose.rotation.as_quat(scalar_first=True)
    head = ["stop", *JOINTS, *(f"cup.{p}" for p in ("x", "y", "z", "qw", "qx", "qy", "qz"))]
    rows = np.hstack([joints, pose.translation, quat]).tolist()
    lines = [",".join(head), *(",".join([f"p{k}", *map(repr, r)]) for k, r in enumerate(rows))]
    (tmp_path / "stops.csv").write_text("\n".join(lines))
    given = [("table", [tmp_path / "stops.csv"]), ("dh", [files / "arm.yaml"])]
    import_files(given, tmp_path / "rec", None, Choices(most_stops=20, blocks=4))
    table = stops_of(tmp_path / "rec")
    assert len(table["stop"]) == 20 and table["stop"][0] == "p0" and table["stop"][-1] == "p59"
    assert len(set(table["location"])) == 4
    shift_m, turn_rad = apart(frame(tmp_path / "rec", "cup"), T_TIP_CUP)
    assert shift_m < 2e-5 and turn_rad < 2e-5  # as rig.yaml rounds


def test_the_command_prints_what_it_understood(files, tmp_path, monkeypatch, capsys):
    words = f"import table {files}/log.csv tum {files}/cup.txt dh {files}/arm.yaml"
    monkeypatch.setattr("sys.argv", ["rigcal", *words.split(), "-o", str(tmp_path / "rec")])
    with pytest.raises(SystemExit) as left:
        main()
    said = capsys.readouterr()
    assert left.value.code == 0 and not said.err
    for part in ("what was understood", "clocks: cup", "holds: 10", "what can be estimated"):
        assert part in said.out


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        ("--length-unit miles", "--length-unit miles: give m or cm or mm"),
        ("--clock-offset cup=soon", "--clock-offset cup=soon: give NAME=VALUE, with a number"),
        ("--body cup", "--body cup: give NAME=VALUE"),
        ("--first-ring 2", "--first-ring 2: give 0 or 1"),
        ("--rig nowhere.yaml", "--rig nowhere.yaml: there is no such file"),
    ],
)
def test_wrong_flags_are_one_sentence(files, tmp_path, monkeypatch, capsys, flags, said):
    words = f"import table {files}/log.csv dh {files}/arm.yaml {flags} -o {tmp_path}/rec"
    monkeypatch.setattr("sys.argv", ["rigcal", *words.split()])
    with pytest.raises(SystemExit) as left:
        main()
    out = capsys.readouterr()
    assert left.value.code == 2 and out.err.startswith(f"rigcal: {said}") and not out.out
    assert list(tmp_path.iterdir()) == []


def test_help_lists_the_kinds(monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["rigcal", "import", "--help"])
    with pytest.raises(SystemExit):
        main()
    out = capsys.readouterr().out
    assert all(f"  {kind} " in out for kind in READERS) and "rigcal[xacro]" in out


@pytest.mark.parametrize(
    "name",
    [
        *(
            "base_markers",
            "Rigid Body 1",
            "null",
            "true",
            "a: b",
            "x #y",
            "tail ",
            "-",
            "é 日本 😀",
        ),
        *("{x: 1}", 'quo"te', "back\\slash", "a\nb: 1", "\x1b[31m", "\u2028b: 1", "[bold]"),
    ],
)
def test_a_name_in_rig_yaml_is_read_back_as_it_was(name, tmp_path):
    from calib.intake.rigfile import _word
    from sensors.documents import read_yaml

    (tmp_path / "x.yaml").write_text(f"{_word(name)}: {{a: {_word(name)}}}\n", encoding="utf-8")
    assert read_yaml(tmp_path / "x.yaml")[0] == {name: {"a": name}}


def test_what_is_kept_of_an_import_is_of_these_files_and_turns(files, tmp_path):
    """The file beside a capture, of which no word is said, tells how its packets are decoded."""
    log = tmp_path / "a.pcap"
    log.write_bytes(b"packets")
    beside = tmp_path / "a.json"
    beside.write_text("{}")
    sweeps = Sweeps("a", "a", np.arange(3.0), lambda wanted: iter(()))

    def asked(stops=(0, 0, 1), **options):
        share = [(sweeps, np.array(stops))]
        return _asked([("ouster", [log])], Options(**options), Choices(), share)

    first = asked()
    assert asked() == first
    assert asked(stops=(0, 1, 1)) != first and asked(first_ring=1) != first
    (tmp_path / "import.log").write_text("what the command prints, in the same folder")
    assert asked() == first
    beside.write_text("{ }")
    assert asked() != first
