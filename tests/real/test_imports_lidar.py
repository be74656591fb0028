"""Real LiDAR files of other projects, read by rigcal and compared with their makers' decoders."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from chains.errors import InputError
from sensors.meshes import read_cloud
from sensors.readers import READERS
from sensors.readers.base import Options
from sensors.readers.clouds.origin import fit_beam_origin

from .foreign import HESAI, quiet

LIDAR_KINDS = (
    *("bag", "e57", "hesai", "kitti", "las", "numpy", "nuscenes", "ouster", "pcd", "ply"),
)


def turns(found) -> list[dict[str, np.ndarray]]:
    """The points of every turn."""
    (sweeps,) = found.sweeps
    return [turn.points for turn in sweeps.read(np.ones(len(sweeps.time_s), bool))]


def xyz(points: dict[str, np.ndarray]) -> np.ndarray:
    return np.stack([points[axis] for axis in "xyz"], axis=1).astype(float)


@pytest.fixture(scope="module")
def hesai(shared):
    """By model: what its bag of packets holds, and the maker-side decoder's cloud (N, 3)."""
    source, read = shared / "lidar/hesai_nebula", {}

    def of(model: str):
        if model not in read:
            options = Options(metadata=source / f"calibration/{HESAI[model]}.csv")
            found = READERS["bag"].read([source / model], options, quiet)
            cloud = next((source / model).glob("*.pcd"))
            read[model] = found, turns(found), cloud
        return read[model]

    return of


# Of the decoder's points how many are ours to 0.01 mm; the rest are nearer of two returns.
@pytest.mark.parametrize(
    ("model", "rings", "columns", "same"),
    [
        ("40p", 40, 1800, 0.960),
        ("64", 64, 1800, 0.960),
        ("qt64", 64, 600, 0.957),
        ("qt128", 128, 900, 0.951),
        ("xt16", 16, 2000, 0.951),
        ("xt32", 32, 2000, 0.966),
        ("xt32m", 32, 2000, 0.984),
    ],
)
@pytest.mark.long
def test_hesai_packets_are_the_decoders_points(model, rings, columns, same, hesai):
    found, decoded, cloud = hesai(model)
    assert found.lidar["columns"] == columns and len(found.lidar["elevation_deg"]) == rings
    points = np.concatenate([xyz(p) for p in decoded])
    theirs = xyz(read_cloud(cloud))
    gap_m, _ = cKDTree(points).query(theirs[::4])
    assert np.mean(gap_m < 1e-5) >= same - 0.005 and np.median(gap_m) < 1e-6
    # the decoder's cloud is the last turn but the scrap at the end, with both returns
    nearest_m = np.linalg.norm(theirs, axis=1).min()
    count = np.sum(np.linalg.norm(xyz(decoded[-2]), axis=1) >= nearest_m)
    assert 0.94 * len(theirs) < count <= len(theirs)
    assert all(p["ring"].max() < rings and p["column"].max() < columns for p in decoded)
    # one return for every direction of a turn; older models' azimuths wander between columns
    wanders = model in ("40p", "64")
    for p in decoded:
        keys = p["ring"].astype(int) * columns + p["column"]
        assert len(np.unique(keys)) >= (0.95 if wanders else 1) * len(keys)


@pytest.mark.parametrize("model", HESAI)
def test_rings_told_by_elevation_are_those_of_the_packets(model, hesai):
    _, decoded, cloud = hesai(model)
    found = READERS["pcd"].read([cloud], Options(), quiet)
    theirs = {name: values[::4] for name, values in turns(found)[0].items()}
    ring = np.concatenate([p["ring"] for p in decoded])
    gap_m, nearest = cKDTree(np.concatenate([xyz(p) for p in decoded])).query(xyz(theirs))
    same = gap_m < 1e-5
    np.testing.assert_array_equal(theirs["ring"][same], ring[nearest[same]])
    assert any("inferred from elevation" in line for line in found.odd)


@pytest.mark.parametrize(
    ("model", "wrong"),
    [
        ("qt64", "Pandar64_Angle Correction File"),
        ("qt64", "Pandar64E3X_Firetime Correction File"),
        ("qt128", "JT128_Angle Correction File"),
        ("qt128", "QT128C2X_Channel_Cofig"),
        ("xt32", "PandarXT-16_Angle Correction File"),
    ],
)
def test_the_table_of_another_model_is_refused(model, wrong, shared):
    """Though it has as many channels, or columns of numbers that are no angles."""
    path = shared / "lidar/hesai_corrections" / f"{wrong}.csv"
    with pytest.raises(InputError, match=r"deg off that model|no table of angles|angles of 16"):
        READERS["bag"].read([shared / "lidar/hesai_nebula" / model], Options(metadata=path), quiet)


# By ouster-sdk 1.0.1 on the same files: XYZLut without extrinsics, valid columns, ranges beyond
# the beams' origin, less the sensor frame's height: count, mean and standard deviation, last turn.
OUSTER = {
    "OS-0-128-U1_v2.3.0_1024x10.pcap": (
        *(1, 97299, (-0.46398953, 0.82576326, 1.22832808), (7.47890923, 6.62436137, 2.99932919)),
        *(0.02767, "ouster_os0_128_rev6"),
    ),
    "OS-0-32-U1_v2.2.0_1024x10.pcap": (
        *(1, 21631, (-0.17944908, -1.12636784, 0.03684724), (4.88990822, 6.34257883, 2.25531543)),
        *(0.02767, "ouster_os0_32"),
    ),
    "OS-1-128_v2.3.0_1024x10_lb_n3.pcap": (
        *(3, 107532, (0.198492, 1.82901558, 0.56125569), (14.65448799, 12.02232624, 3.27953059)),
        *(0.015806, "ouster_os1_128"),
    ),
    "OS-1-64_1024x10_fw20.pcap": (
        *(1, 16749, (0.1912476, 1.24895144, 0.39069203), (4.75546093, 3.73239409, 1.33453328)),
        *(0.012163, "ouster_os1_64"),
    ),
    "OS-0-128_v3.0.1_1024x10_20241017_141645.osf": (
        *(3, 33623, (-0.4692604, 0.9924067, -0.70820355), (2.54189591, 11.33130946, 7.76788699)),
        *(0.027116, "ouster_os0_128_rev7"),
    ),
    "single_scan_016.osf": (
        *(1, 101762, (-0.00259143, 0.37274523, 0.67669212), (8.87248041, 7.01031488, 3.39865741)),
        *(0.027116, "ouster_os0_128_rev7"),
    ),
    "pose_delta_1_128.osf": (
        *(1, 110987, (4.01882266, -0.28303094, 0.61333238), (6.15979773, 7.31158271, 2.48978729)),
        *(0.027116, "ouster_os0_128_rev7"),
    ),
}


@pytest.mark.parametrize("name", OUSTER)
def test_ouster_captures_are_the_makers_points(name, shared):
    count, size, mean, deviation, origin_m, model = OUSTER[name]
    source = shared / "lidar/ouster_sdk_tests"
    reduced = source / "OS-1-64_sensor_config_reduced.json"
    options = Options(
        metadata=reduced if "fw20" in name else None,
        topics=("OS-0-128",) if "delta" in name else (),
    )
    found = READERS["ouster"].read([source / name], options, quiet)
    decoded = turns(found)
    assert len(decoded) == count
    points = xyz(decoded[-1])
    assert len(points) == size
    np.testing.assert_allclose(points.mean(axis=0), mean, atol=1e-6)
    np.testing.assert_allclose(points.std(axis=0), deviation, atol=1e-6)
    assert found.lidar["beam_origin_m"] == [origin_m, 0.0] and found.lidar["model"] == model


def test_a_bag_of_ouster_packets_brings_its_metadata(shared):
    bag = shared / "lidar/ouster_sdk_tests/512x10_raw.bag"
    found = READERS["bag"].read([bag], Options(), quiet)
    (points,) = turns(found)
    assert found.lidar["columns"] == 512 and found.lidar["beam_origin_m"] == [0.02767, 0.0]
    assert len(points["x"]) == 28751  # ouster-sdk 1.0.1, as above
    np.testing.assert_allclose(
        xyz(points).mean(axis=0), (0.01240041, -0.36722312, 0.00459188), atol=1e-6
    )
    np.testing.assert_allclose(
        xyz(points).std(axis=0), (1.01493658, 0.93862735, 0.29356852), atol=1e-6
    )


def test_where_an_ousters_beams_start_is_seen_in_its_points(shared):
    """A driver that leaves it out would be found out by its clouds alone."""
    source = shared / "lidar/ouster_sdk_tests"
    for name in ("OS-0-128-U1_v2.3.0_1024x10.pcap", "single_scan_016.osf"):
        found = READERS["ouster"].read([source / name], Options(), quiet)
        (points,) = turns(found)
        origin = fit_beam_origin(xyz(points), points["ring"].astype(int))
        # as seen from the axis, by the cosine of how far beams look aside of it
        aside = np.cos(np.radians(found.lidar["azimuth_offset_deg"])).mean()
        expected_m = aside * found.lidar["beam_origin_m"][0]
        assert origin.radial_m == pytest.approx(expected_m, abs=1e-4)
        assert origin.height_m == pytest.approx(0, abs=1e-4)


@pytest.mark.long
def test_no_file_ends_in_a_traceback(shared):
    """Whatever kind it is called."""
    files = sorted(path for path in (shared / "lidar").rglob("*") if path.is_file())
    assert len(files) > 50
    for path in files:
        for kind in LIDAR_KINDS:
            try:
                found = READERS[kind].read([path], Options(), quiet)
                for sweeps in found.sweeps[:3]:
                    assert sum(1 for _ in sweeps.read(np.ones(len(sweeps.time_s), bool)))
            except InputError as error:
                assert "\n" not in str(error)
