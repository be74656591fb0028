"""The simulator, against rays and chains computed here: geometry, noise, files."""

import re

import numpy as np
import pytest

from calib.problem.model import Source
from calib.results.check import check
from calib.simulation import PRESETS, Spec, load_spec, simulate
from chains.errors import InputError
from sensors.recording import read_table

from .simulated import BELOW_M, EXACT, changed, first_hit, made, nominal, off_mesh, pose, rays, seen


@pytest.fixture(scope="module")
def exact(tmp_path_factory: pytest.TempPathFactory) -> tuple[Source, dict]:
    return made(tmp_path_factory.mktemp("exact") / "rec", EXACT)


# ------------------------------------------------------------------------------ with nothing wrong


def test_perfect_hardware_puts_every_point_on_the_mesh(exact):
    source, truth = exact
    corners = source.reference.vertices_m[source.reference.triangles]
    rng = np.random.default_rng(0)
    for k, name in enumerate(source.recording.stops):
        # By the chain on paper, from where the tracker saw the base.
        joints = source.recording.joints[k]
        T_opti_base = (
            seen(source, "base_markers", k) * nominal(source, "base_markers", joints).inv()
        )
        T_faro_lidar = pose(truth["T_faro_opti"]) * T_opti_base * nominal(source, "lidar", joints)
        assert np.allclose(
            T_faro_lidar.as_matrix(), truth["stops"][name]["T_faro_lidar"], atol=1e-9
        )
        origin, direction, range_m = rays(source, k, T_faro_lidar.as_matrix())
        for i in rng.choice(len(range_m), 40, replace=False):
            assert range_m[i] == pytest.approx(
                first_hit(origin[i], direction[i], corners), abs=1e-5
            )
        assert np.abs(off_mesh(source, truth, k)[0]).max() < 1e-5


def test_both_ways_to_the_mount_agree_on_paper(exact):
    source, _ = exact
    for k, joints in enumerate(source.recording.joints):
        way = seen(source, "base_markers", k) * nominal(source, "base_markers", joints).inv()
        mount = way * nominal(source, "mount_markers", joints)
        assert np.allclose(
            mount.as_matrix(), seen(source, "mount_markers", k).as_matrix(), atol=1e-9
        )


def test_spheres_hang_below_their_markers(exact):
    source, truth = exact
    targets = source.recording.targets
    rod = targets.lower_m - targets.upper_m
    down = rod / np.linalg.norm(rod, axis=1, keepdims=True)
    sphere = pose(truth["T_faro_opti"]).apply(targets.lower_m + BELOW_M * down)
    assert np.allclose(sphere, targets.faro_m, atol=1e-9)
    assert np.allclose(pose(truth["T_faro_opti"]).rotation.apply(down), [0, 0, -1], atol=1e-9)


def test_stops_are_clear_of_everything_and_varied(tmp_path):
    source, truth = made(tmp_path / "rec", changed(EXACT, locations=6, stops_per_location=4))
    tilts = []
    for k, at in enumerate(truth["stops"].values()):
        T = np.array(at["T_faro_lidar"])
        floor = source.reference.vertices_m[:, 2].min()
        assert T[2, 3] - floor > 0.45
        assert rays(source, k, T)[2].min() > 0.4
        tilts.append(np.degrees(np.arccos(T[2, 2])))
    assert np.ptp(tilts) > 60


def test_level_keeps_the_spin_axis_upright(tmp_path):
    for name, spec in {"arm": EXACT, "held": changed(EXACT, arm=False)}.items():
        _, truth = made(tmp_path / name, changed(spec, level=True))
        for at in truth["stops"].values():
            assert at["T_faro_lidar"][2][2] > np.cos(np.radians(1.5))


# ------------------------------------------------------------------------------------------ noise


def test_averages_scatter_as_the_sensor_says(tmp_path):
    spec = changed(EXACT, noise=1, column_step=16)
    source, truth = made(tmp_path / "rec", spec)
    z, spread, lidar = [], [], source.rig.lidar
    for k in range(len(source.recording.stops)):
        scan = source.recording.scan(k)
        off_m, hits = off_mesh(source, truth, k)
        # Head-on only: there the beam's own angle noise moves no range.
        use = hits.incidence_rad < np.radians(15)
        sigma_m = lidar.sigma_range(hits.range_m, hits.incidence_rad)
        z.append((off_m / sigma_m * np.sqrt(scan.count))[use])
        spread.append((scan.range_std_m / sigma_m) ** 2)
        assert scan.count.max() <= spec.sweeps
    z, spread = np.concatenate(z), np.concatenate(spread)
    assert len(z) > 2000
    assert abs(z.mean()) < 4 / np.sqrt(len(z))
    assert z.std() == pytest.approx(1, abs=4 / np.sqrt(2 * len(z)))
    dof = 0.99 * spec.sweeps - 1
    assert spread.mean() == pytest.approx(1, abs=0.01)
    assert spread.var() == pytest.approx(2 / dof, rel=0.1)


def test_raw_sweeps_are_quantised_and_average_to_the_same(tmp_path):
    source, truth = made(tmp_path / "rec", changed(EXACT, noise=1, raw=True, sweeps=30))
    raw = read_table(source.recording.folder / "scans" / "L00P00.parquet")
    assert set(np.unique(raw["scan"])) == set(range(30))
    held = dict(check(source.recording.folder, graph=False).contents)
    assert held["per-point covariates"] == "set_aside (made by averaging)"
    ahead = source.rig.lidar.beam_origin_m[0]
    flat = np.hypot(raw["x"], raw["y"]).astype(float)
    range_m = np.hypot(flat - ahead, raw["z"].astype(float))
    steps = range_m / source.rig.lidar.quantum_m
    assert np.abs(steps - np.rint(steps)).max() < 0.01
    scan = source.recording.scan(0)
    off_m, hits = off_mesh(source, truth, 0)
    sigma_m = source.rig.lidar.sigma_range(hits.range_m, hits.incidence_rad)
    use = hits.incidence_rad < np.radians(15)
    assert (off_m / sigma_m * np.sqrt(scan.count))[use].std() == pytest.approx(1, abs=0.25)
    # The spread of the sweeps themselves: the average sets the farthest aside.
    key = raw["ring"].astype(int) * 10_000 + raw["column"]
    _, place, count = np.unique(key, return_inverse=True, return_counts=True)
    mean_m = np.bincount(place, range_m) / count
    variance = np.bincount(place, (range_m - mean_m[place]) ** 2) / (count - 1)
    assert np.mean(variance / sigma_m**2) == pytest.approx(1, abs=0.03)


def test_trackers_scatter_as_the_rig_says(tmp_path):
    spec = changed(
        PRESETS["arm-tracker"],
        locations=10,
        stops_per_location=20,
        build_error=0,
        occluded_share=0.1,
    )
    source, truth = made(tmp_path / "rec", spec)
    tracker, off = source.rig.tracker, []
    for k, at in enumerate(truth["stops"].values()):
        T_faro_body = pose(at["T_faro_root"]) * nominal(
            source, "base_markers", source.recording.joints[k]
        )
        off.append(
            (pose(truth["T_faro_opti"]).inv() * T_faro_body).inv() * seen(source, "base_markers", k)
        )
    turned = np.array([T.rotation.as_rotvec() for T in off])
    shifted = np.array([T.translation for T in off])
    assert turned.std() == pytest.approx(tracker.sigma_rad, rel=0.12)
    assert shifted.std() == pytest.approx(tracker.sigma_m, rel=0.12)
    hidden = np.isnan(source.recording.bodies["mount_markers"][:, 0])
    assert 0.03 < hidden.mean() < 0.2
    assert np.isfinite(source.recording.bodies["base_markers"]).all()


def test_mixed_pixels_are_as_many_as_asked(tmp_path):
    spec = changed(EXACT, mixed_pixel_share=0.05, column_step=16, locations=1)
    source, truth = made(tmp_path / "rec", spec)
    off_m = np.concatenate([off_mesh(source, truth, k)[0] for k in range(2)])
    wrong = np.abs(off_m) > 1e-5
    assert wrong.mean() == pytest.approx(0.05, abs=0.01)
    assert 0.05 < np.median(np.abs(off_m[wrong])) < 0.3


# ------------------------------------------------------------------------- presets, files, errors


@pytest.mark.parametrize("name", [n for n in PRESETS if not n.startswith(("paper", "default"))])
def test_presets_hold_what_their_names_say(tmp_path, name):
    spec = changed(PRESETS[name], column_step=250, locations=2, stops_per_location=2)
    source, truth = made(tmp_path / name, spec)
    recording, rig = source.recording, source.rig
    assert recording.has_scan.all() == bool(spec.lidar)
    assert (source.reference is not None) == spec.mesh
    assert (recording.targets is not None) == bool(spec.targets)
    assert bool(rig.joint_names) == spec.arm == (tmp_path / name / "arm.urdf").exists()
    rates = {f"rate.{joint}" for joint in rig.joint_names} if spec.poses == "moving" else set()
    assert set(recording.covariates) == {"temperature_c", "humidity"} | rates
    if spec.tracker == "points":
        assert len(recording.bodies) == 3
        assert all(np.isnan(b[:, 3:]).all() for b in recording.bodies.values())
    if spec.tracker is None:
        for guess, at in zip(recording.base_guess, truth["stops"].values(), strict=True):
            off_m = np.linalg.norm(guess[:3] - np.array(at["T_faro_root"])[:3, 3])
            assert 0.001 < off_m < 0.1
    roots = np.array([at["T_faro_root"] for at in truth["stops"].values()])
    places = len(np.unique(roots.round(12), axis=0))
    assert places == {"stop": 4, "location": 2, "never": 1}[rig.moves]


def test_paper_presets_have_the_paper_s_size():
    for name in ("qt64", "xt32", "os0-rev6", "os0-rev7"):
        spec = PRESETS[f"paper-{name}"]
        size = spec.locations, spec.stops_per_location, spec.column_step, spec.sweeps
        assert size == (9, 10, 1, 100)


def test_same_seed_same_files(tmp_path):
    for name, seed in (("a", 1), ("b", 1), ("c", 2)):
        simulate("tiny", tmp_path / name, seed)
    files = sorted(
        p.relative_to(tmp_path / "a") for p in (tmp_path / "a").rglob("*") if p.is_file()
    )
    assert len(files) > 15
    for file in files:
        content = (tmp_path / "a" / file).read_bytes()
        assert content == (tmp_path / "b" / file).read_bytes()
        fixed = file.name in ("rig.yaml", "arm.urdf", "labels.yaml")
        assert (content == (tmp_path / "c" / file).read_bytes()) == fixed
    assert (tmp_path / "a.truth.json").read_text() == (tmp_path / "b.truth.json").read_text()
    assert sorted(p.name for p in tmp_path.iterdir() if p.name.startswith(".")) == []


def test_a_recording_is_replaced_and_nothing_else(tmp_path):
    mine = tmp_path / "mine"
    mine.mkdir()
    (mine / "notes.txt").write_text("keep")
    with pytest.raises(InputError, match="mine exists and is no recording"):
        simulate("tiny", mine, 0)
    assert [p.name for p in mine.iterdir()] == ["notes.txt"]
    simulate("arm-tracker", tmp_path / "rec", 0)
    before = (tmp_path / "rec" / "stops.csv").read_bytes()
    with pytest.raises(InputError, match="did you mean 'arm_link_length'"):
        simulate("arm-tracker", tmp_path / "rec", 0, {"arm_link_lenght": 1})
    assert (tmp_path / "rec" / "stops.csv").read_bytes() == before
    simulate("tiny", tmp_path / "rec", 0)
    assert (tmp_path / "rec" / "scans").is_dir()
    assert {p.name for p in tmp_path.iterdir()} == {"mine", "rec", "rec.truth.json"}


def test_specs_are_read_strictly(tmp_path):
    path = tmp_path / "spec.yaml"
    path.write_text("lidar: hesai_pandarxt32\nsweeps: 5\n")
    assert load_spec(str(path)) == Spec(lidar="hesai_pandarxt32", sweeps=5)
    path.write_text("lidar: hesai_pandarxt32\nsweep: 5\n")
    with pytest.raises(InputError, match=r"spec.yaml:2: unknown key sweep; did you mean sweeps"):
        load_spec(str(path))
    path.write_text("tracker: null\n")
    with pytest.raises(InputError, match="targets are seen by a tracker"):
        load_spec(str(path))
    for wrong, said in (
        ("lidar: nope\n", r"spec\.yaml: lidar: LiDAR model nope is unknown"),
        ("levels: [nope]\n", r"spec\.yaml: levels\.frames\.0: .*nope"),
    ):
        path.write_text(wrong)
        with pytest.raises(InputError, match=f"{re.escape(str(tmp_path))}/{said}"):
            simulate(str(path), tmp_path / "rec")
    with pytest.raises(InputError, match="neither a YAML file nor a preset; did you mean tiny"):
        load_spec("tinny")


def test_hiding_needs_something_to_act_on(tmp_path):
    with pytest.raises(InputError, match="'arm_joint_offset' has nothing to act on"):
        simulate("lidar-tracker", tmp_path / "rec", 0, {"arm_joint_offset": 1})
    with pytest.raises(InputError, match="seed -1 is negative"):
        simulate("tiny", tmp_path / "rec", -1)
    assert list(tmp_path.iterdir()) == []


# ----------------------------------------------------------------------- what the arm does


def test_one_joint_turns_at_each_location(tmp_path):
    source, _ = made(tmp_path / "rec", changed(PRESETS["one-joint"], locations=7))
    joints = source.recording.joints
    turning = np.abs(joints) > 0
    expected = np.arange(7) % 6  # after the last joint the first again
    assert [set(np.flatnonzero(row)) for row in turning] == [
        {int(j)} for j in np.repeat(expected, PRESETS["one-joint"].stops_per_location)
    ]


def test_what_acts_has_the_value_it_is_given(tmp_path):
    spec = Spec(
        locations=2,
        stops_per_location=2,
        column_step=128,
        acting={"incidence_angle_bias": -0.004, "arm_link_length": 0.001},
    )
    source, truth = made(tmp_path / "rec", spec)
    assert truth["effects"]["incidence_angle_bias"] == [-0.004]
    lengths = truth["effects"]["arm_link_length"]
    nonzero = [np.any(e.T_parent_child[:3, 3]) for e in source.rig.tree.edges]
    by_name = dict(zip(source.rig.tree.edge_names, nonzero, strict=True))
    assert lengths == [0.001 if by_name[n] else 0.0 for n in source.rig.arm_edges]


def test_what_acts_needs_something_to_act_on(tmp_path):
    spec = changed(PRESETS["lidar-tracker"], acting={"arm_gravity_sag": 1e-4})
    with pytest.raises(InputError, match="'arm_gravity_sag' has nothing to act on"):
        simulate(spec, tmp_path / "rec", 0)


@pytest.mark.parametrize(
    "fields, says",
    [
        ({"poses": "moving"}, "are of an arm alone"),
        ({"lidar": None, "mesh": False, "arm": False, "poses": "one_joint"}, "are of an arm alone"),
        (
            {"lidar": None, "mesh": False, "poses": "one_joint", "base_moves": "never"},
            "another joint turns",
        ),
    ],
)
def test_poses_that_cannot_be_are_refused(fields, says):
    with pytest.raises(ValueError, match=says):
        Spec(**fields)
