"""What check sees before any fit: each mishap named, and nothing in recordings that are sound."""

import json
import shlex
import shutil
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calib.problem.model import Source
from calib.problem.without import leave_out
from calib.results.check import check
from calib.rig import load_rig
from calib.rig.recording import Recording
from calib.rig.scale import odd_mesh, odd_targets
from calib.rig.scanned import ScanSums, odd_scans, step_of
from calib.rig.tracked import odd_bodies
from calib.show.tables import print_check
from sensors.recording import read_scan

from . import broken

SOUND = ("known_nothing_hidden", "known_incidence", "known_stop_scatter", "known_two_hidden")
ARMS = ("arm_axes_miss_each_other", "arm_base_creeps", "arm_payload")
REVERSED = ("known_ring_by_temperature", "known_sector", "known_two_hidden")  # PandarQT64
BASE, MOUNT = "base_markers", "mount_markers"


def opened(shared, name):
    folder = shared / "recordings" / name
    return load_rig(folder), Recording.open(folder)


@pytest.fixture(scope="module")
def sound(shared):
    return opened(shared, "known_nothing_hidden")


def changed(recording, body, rows, change):
    """The recording with some rows (K, 7) of a body changed."""
    poses = recording.bodies[body].copy()
    poses[rows] = change(poses[rows])
    return replace(recording, bodies={**recording.bodies, body: poses})


def shifted(*by_m):
    return lambda pose: pose + np.r_[by_m, 0, 0, 0, 0]


def only(found):
    (one,) = found
    return one


def seen_stops(recording, count):
    """Indices of stops at which both bodies are seen."""
    seen = [np.isfinite(recording.bodies[b]).all(axis=1) for b in (BASE, MOUNT)]
    return np.flatnonzero(np.all(seen, axis=0))[3 : 3 + count]


# ------------------------------------------------------------------------------- tracked bodies


@pytest.mark.parametrize("name", [*SOUND, *ARMS])
def test_sound_bodies_are_no_suspects(shared, name):
    """Frames off by their sigma, links by 3 mm, joints by 3 mrad; some sag, or creep."""
    assert list(odd_bodies(*opened(shared, name))) == []


def test_what_was_done_to_recordings_is_found(shared):
    wild = only(odd_bodies(*opened(shared, "arm_one_wild_row")))
    assert wild.size == pytest.approx(0.5, abs=1e-3) and wild.stops == ("p141",)
    zero = only(odd_bodies(*opened(shared, "arm_zero_rows")))
    assert len(zero.stops) == 13 and "(0, 0, 0)" in zero.sentence
    moved = only(odd_bodies(*opened(shared, "known_base_moved_at_one_stop")))
    truth = (shared / "recordings/known_base_moved_at_one_stop.truth.json").read_text()
    assert moved.size == pytest.approx(0.003, abs=3e-4) and moved.stops[0] in truth
    assert moved.name == f"{BASE} or {MOUNT}"


def test_placeholders(sound):
    rig, recording = sound
    a, b = seen_stops(recording, 2)
    names = recording.stops
    gone = changed(recording, BASE, [a], lambda p: p * 0 + [0, 0, 0, 1, 0, 0, 0])
    found = only(odd_bodies(rig, gone))
    assert (found.name, found.stops) == (BASE, (names[a],)) and "(0, 0, 0)" in found.sentence
    level = changed(
        recording, MOUNT, [a, b], lambda p: np.c_[p[:, :3], np.tile([1, 0, 0, 0], (2, 1))]
    )
    found = only(odd_bodies(rig, level))
    assert found.stops == (names[a], names[b]) and "turned by exactly" in found.sentence
    old = changed(recording, MOUNT, [b], lambda p: recording.bodies[MOUNT][[a]])
    found = only(odd_bodies(rig, old))
    assert found.stops == (names[b],) and "to the last digit" in found.sentence


@pytest.mark.parametrize(
    ("order", "sign", "named"),
    [
        ((1, 2, 3, 0), 1, "hold qx, qy, qz, qw"),
        ((3, 0, 1, 2), 1, "hold qz, qw, qx, qy"),
        ((0, 1, 2, 3), -1, "hold qw, -qx, -qy, -qz (the inverse turn)"),
    ],
)
def test_quaternions_written_otherwise(sound, shared, order, sign, named):
    def otherwise(poses):
        q = poses[:, 3 + np.array(order)]
        return np.hstack([poses[:, :3], q * ([1, sign, sign, sign] if sign < 0 else 1)])

    def turned(recording, bodies):
        for body in bodies:
            recording = changed(recording, body, slice(None), otherwise)
        return recording

    rig, recording = sound
    found = only(odd_bodies(rig, turned(recording, (BASE, MOUNT))))
    assert named in found.sentence and found.stops == ()
    assert found.name == f"{BASE} and {MOUNT}"
    found = only(odd_bodies(rig, turned(recording, [MOUNT])))
    assert named in found.sentence and found.name == MOUNT
    rig, recording = opened(shared, "arm_base_creeps")
    found = only(odd_bodies(rig, turned(recording, recording.bodies)))
    assert named in found.sentence


def test_bodies_exchanged_at_all_stops_or_at_one(sound):
    rig, recording = sound
    bodies = recording.bodies
    swapped = replace(recording, bodies={BASE: bodies[MOUNT], MOUNT: bodies[BASE]})
    found = only(odd_bodies(rig, swapped))
    assert "exchanged" in found.sentence and found.stops == ()
    (a,) = seen_stops(recording, 1)
    once = changed(recording, BASE, [a], lambda p: bodies[MOUNT][[a]])
    once = changed(once, MOUNT, [a], lambda p: bodies[BASE][[a]])
    found = only(odd_bodies(rig, once))
    assert "exchanged" in found.sentence and found.stops == (recording.stops[a],)


def test_one_of_two_bodies_on_the_base_is_off_at_one_stop(sound):
    """A second body on the base, which no joint parts from the first: a millimetre is seen."""
    rig, recording = sound
    pose = recording.bodies[BASE]
    turn = Rotation.from_quat(np.nan_to_num(pose[:, 3:], nan=0.5), scalar_first=True)
    T_first_second = [0.2, 0.1, 0.0]
    noise = 2e-4 * np.random.default_rng(0).normal(size=(len(pose), 3))
    second = np.hstack([pose[:, :3] + turn.apply(T_first_second) + noise, pose[:, 3:]])
    edge = next(e for e in rig.tree.edges if e.child == BASE)
    T = edge.T_parent_child.copy()
    T[:3, 3] += T[:3, :3] @ T_first_second
    tree = type(rig.tree)(
        [*rig.tree.edges, replace(edge, name="second", child="second", T_parent_child=T)]
    )
    rig = replace(
        rig,
        tree=tree,
        frame_sigma={**rig.frame_sigma, "second": rig.frame_sigma[BASE]},
        tracker=replace(rig.tracker, bodies=(BASE, "second", MOUNT)),
    )
    recording = replace(recording, bodies={**recording.bodies, "second": second})
    assert list(odd_bodies(rig, recording)) == []
    (a,) = seen_stops(recording, 1)
    found = only(odd_bodies(rig, changed(recording, "second", [a], shifted(0, 0.004, 0))))
    assert "second" in found.name and found.stops == (recording.stops[a],)
    found = only(odd_bodies(rig, changed(recording, BASE, [a], shifted(0, 0.006, 0))))
    assert found.name == BASE and found.size == pytest.approx(0.006, abs=1e-3)


# ----------------------------------------------------------------------------------------- scans


@pytest.fixture(scope="module")
def scans(shared):
    rig, recording = opened(shared, "known_nothing_hidden")
    paths = sorted((recording.folder / "scans").iterdir())[:3]
    return rig, recording, {path.stem: read_scan(path, rig.lidar.rings) for path in paths}


def said(scans, **changes):
    """What is said of scans, of which some are changed, besides those that are missing."""
    rig, recording, read = scans
    sums = ScanSums(rig.lidar)
    for name, scan in read.items():
        sums.add(name, changes.get(name, changes.get("each", lambda s: s))(scan))
    return [one for one in odd_scans(rig, recording, sums) if "there is no scan" not in str(one)]


def test_sound_scans_are_no_suspects(scans):
    assert said(scans) == []


def test_rings_from_the_other_end_are_a_finding(scans, shared):
    found = only(said(scans, each=lambda s: replace(s, ring=127 - s.ring)))
    assert found.kind == "rings" and "from the other end" in found.sentence
    for name in REVERSED:  # whoever made these counted from the top, and the maker does not
        found = check(shared / "recordings" / name, graph=False)
        assert [each["kind"] for each in found.suspects] == ["rings"]


def test_scans_and_columns_that_are_there_twice(scans):
    a, b, c = scans[2]
    found = only(said(scans, **{b: lambda s: scans[2][a]}))
    assert found.kind == "scan" and found.stops == (a, b) and "one and the same" in found.sentence
    ticks = np.linspace(0, 1, 50)

    def timed(scan, start):
        return replace(scan, extra={"t": start + np.resize(ticks, len(scan.ring))})

    length = min(len(scan.ring) for scan in scans[2].values())

    def cut(scan, start):
        rows = {n: getattr(scan, n)[:length] for n in
                ("xyz_m", "ring", "column", "intensity", "count", "range_std_m")}  # fmt: skip
        return timed(replace(scan, **rows), start)

    assert said(scans, **{n: lambda s, k=k: cut(s, k) for k, n in enumerate((a, b, c))}) == []
    found = only(said(scans, **{n: lambda s, k=k: cut(s, k) for k, n in enumerate((a, b))},
                      **{c: lambda s: cut(s, 1)}))  # fmt: skip
    assert found.stops == (b, c) and "column t" in found.sentence


def test_a_column_that_all_scans_have_alike_numbers_points(scans):
    length = min(len(scan.ring) for scan in scans[2].values())

    def numbered(scan):
        rows = ("xyz_m", "ring", "column", "intensity", "count", "range_std_m")
        cut = {name: getattr(scan, name)[:length] for name in rows}
        return replace(scan, **cut, extra={"number": np.arange(length)})

    assert said(scans, each=numbered) == []


def test_scans_at_one_time(scans):
    rig, recording, read = scans
    time_s = recording.time_s.copy()
    time_s[5] = time_s[4]
    said_of_it = only(said((rig, replace(recording, time_s=time_s), read)))
    assert f"{recording.stops[4]} and {recording.stops[5]} were made at one time" in said_of_it
    assert said((rig, replace(recording, time_s=time_s * np.nan), read)) == []


def test_spreads_of_nought_are_told(scans):
    """Those of a scan half of which has none; what scatters less here and there is left alone."""
    a, b, _ = scans[2]

    def spread(scan, still):
        nought = np.arange(len(scan.ring)) < still * len(scan.ring)
        known = replace(scan, count=np.full(len(scan.ring), 20.0))
        return replace(known, range_std_m=np.where(nought, 0.0, 0.01))

    said_of_it = only(said(scans, **{a: lambda s: spread(s, 0.6), b: lambda s: spread(s, 0.4)}))
    assert f"half of range_std_m is 0 at {a}, so" in said_of_it


def test_points_that_are_there_twice_are_told(scans):
    """All of a scan; some that are there by chance are not."""
    a, b, _ = scans[2]

    def again(scan, count):
        at = np.r_[np.arange(len(scan.ring)), np.arange(count)]
        rows = {name: getattr(scan, name)[at] for name in
                ("xyz_m", "ring", "column", "intensity", "count", "range_std_m")}  # fmt: skip
        return replace(scan, **rows, extra={})

    found = said(scans, **{a: lambda s: again(s, len(s.ring)), b: lambda s: again(s, 10)})
    assert f"points of {a} are there twice" in only(found)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda i: i * 255, "is a reflectance of 0 to 1 at"),
        (lambda i: i * 1e6, "is a reflectance of 0 to 1 at"),
        (lambda i: i - 0.5, "lies between -0"),
    ],
)
def test_intensities_of_unclear_unit(scans, change, sentence):
    a, *_ = scans[2]
    found = only(said(scans, **{a: lambda s: replace(s, intensity=change(s.intensity))}))
    assert found.kind == "intensity" and sentence in found.sentence


# ----------------------------------------------------------------------------------------- scale


@pytest.mark.parametrize(
    ("factor", "words"),
    [
        (1.0, None),
        (1.003, "out of scale"),
        (0.998, "out of scale"),
        (39.37, "is faro in inches"),
        (1 / 3.281, "is upper and lower in feet"),
    ],
)
def test_lengths_that_differ_between_tracker_and_scanner(sound, factor, words):
    rig, recording = sound
    targets = replace(recording.targets, faro_m=factor * recording.targets.faro_m)
    found = list(odd_targets(targets, rig.target))
    if words is None:
        assert found == []
    else:
        assert words in only(found).sentence and only(found).name == "scale"
    swapped = targets.faro_m[[1, 0, *range(2, len(targets.names))]]
    if words is None:
        names = targets.names
        found = only(odd_targets(replace(targets, faro_m=swapped), rig.target)).sentence
        one, other = names[:2]
        assert (
            f"the scanner's {other} is the tracker's {one}, {one} is the tracker's {other}" in found
        )


def test_targets_that_both_number_otherwise(sound):
    """Or of which one lies elsewhere, which no other order sets right."""
    rig, recording = sound
    targets, order = recording.targets, np.roll(np.arange(len(recording.targets.names)), 1)
    found = only(odd_targets(replace(targets, faro_m=targets.faro_m[order]), rig.target)).sentence
    assert found.startswith("scanner and tracker number targets otherwise: the scanner's ")
    here = [targets.names[k] for k in np.argsort(order)]  # where the scanner has each of them now
    assert all(
        f"{b} is the tracker's {a}" in found for a, b in zip(targets.names, here, strict=True)
    )
    moved = targets.faro_m.copy()
    moved[0] += [0.5, 0.0, 0.0]
    found = only(odd_targets(replace(targets, faro_m=moved), rig.target))
    assert found.name == targets.names[0] and "is it the same target" in found.sentence


def test_markers_that_are_exchanged_on_all_rods(sound):
    rig, recording = sound
    rods = recording.targets
    upside_down = replace(rods, upper_m=rods.lower_m, lower_m=rods.upper_m)
    assert "upper and lower" in only(odd_targets(upside_down, rig.target))


@pytest.mark.parametrize("step_m", [0.0, 0.002, 0.004, 0.02])
def test_ranges_that_were_rounded(shared, step_m):
    """As float32 holds their points: the step is found, and told where it is more than noise."""
    rng = np.random.default_rng(1)
    range_m = rng.uniform(0.5, 9.0, 5000)
    if step_m:
        range_m = step_m * np.round(range_m / step_m)
    way = rng.normal(size=(5000, 3))
    points = (range_m[:, None] * way / np.linalg.norm(way, axis=1, keepdims=True)).astype("f4")
    assert step_of(np.linalg.norm(points, axis=1)) == pytest.approx(step_m, rel=1e-3)
    rig, recording = opened(shared, "known_nothing_hidden")
    scans = ScanSums(rig.lidar, points={"L00P00": 1}, rounded_m={"L00P00": step_m})
    scans.rings[:] = 1
    told = [odd for odd in odd_scans(rig, recording, scans) if "multiples" in str(odd)]
    known_m = max(rig.lidar.sigma_range_m, rig.lidar.quantum_m)
    assert len(told) == (step_m > known_m) and all(f"{1e3 * step_m:g} mm" in t for t in told)


@pytest.mark.parametrize(
    ("factor", "unit"), [(1.0, None), (39.37, "inches"), (1000.0, "millimetres"), (0.001, "1000")]
)
def test_a_mesh_in_another_unit(factor, unit):
    corners = factor * np.array([[0.0, 0, 0], [8, 6, 3]])
    found = list(odd_mesh(SimpleNamespace(vertices_m=corners), reach_m=4.0))
    assert found == [] if unit is None else unit in only(found).sentence


# -------------------------------------------------------------------------------------- together


def test_the_document_holds_an_entry_for_each_stop(shared, tmp_path):
    rec = shutil.copytree(shared / "recordings/arm_zero_rows", tmp_path / "rec")
    broken.cells("stops.csv", r"tool\.(x|y|z)", "0", row=7)(rec)
    document = json.loads(json.dumps(check(rec, graph=False).document()))
    assert len(document["suspects"]) == 14 and len(document["odd"]) == 1
    assert document["suspects"][0].keys() == {"kind", "name", "stop", "size", "unit", "without"}
    assert {each["kind"] for each in document["suspects"]} == {"body"}
    tokens = [each["without"] for each in document["suspects"]]
    assert tokens == [f"{each['stop']}:tool" for each in document["suspects"]]
    words = shlex.split(document["command"])
    assert words[:3] == ["rigcal", "fit", str(rec)] and words[6::2] == tokens


def test_a_suspect_that_may_be_one_of_two_has_no_name_to_leave_out(shared, capsys):
    found = check(shared / "recordings/known_base_moved_at_one_stop", graph=False)
    assert [each["without"] for each in found.suspects] == [None]
    assert found.command == "" and found.document()["command"] is None
    print_check(found)
    assert "--without" not in capsys.readouterr().out


def test_scans_and_targets_are_left_out_by_their_names(shared, tmp_path, capsys):
    rec = shutil.copytree(shared / "recordings/known_nothing_hidden", tmp_path / "rec")
    shutil.copy(rec / "scans/L00P00.parquet", rec / "scans/L01P00.parquet")
    broken.cells("targets.csv", "faro_x", lambda x: x + 0.1, row=1)(rec)
    found = check(rec, graph=False)
    tokens = {each["without"] for each in found.suspects}
    assert tokens == {"L00P00:scan", "L01P00:scan", "T2:rod"}
    assert leave_out([Source.open(rec)], list(tokens))  # as a fit takes them
    print_check(found)
    assert found.command in capsys.readouterr().out.splitlines()
