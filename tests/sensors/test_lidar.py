"""LiDAR models: where beams point and start, how they scatter, and what the catalogue says."""

import csv
import json

import numpy as np
import pytest
from scipy.stats import linregress

from chains.errors import InputError
from sensors.lidar import beams, catalog, load_lidar
from sensors.recording import read_table

# channels, azimuth steps, vertical field of view in degrees: data sheets, as the study's Table 1.
DATA_SHEETS = {
    "hesai_pandarqt64": (64, 600, 104.2),
    "hesai_pandarxt32": (32, 2000, 31.0),
    "ouster_os0_128_rev6": (128, 1024, 90.0),
    "ouster_os0_128_rev7": (128, 1024, 90.0),
}


@pytest.mark.parametrize("name", catalog())
def test_every_model_of_the_catalogue_is_complete(name):
    lidar = load_lidar(name)
    assert lidar.elevation_rad.shape == lidar.azimuth_offset_rad.shape == (lidar.rings,)
    steps = np.diff(lidar.elevation_rad)
    if name == "hesai_qt128":  # its last 32 rings look between others
        assert (np.delete(steps, 95) > 0).all() and steps[95] < 0
        assert np.diff(np.sort(lidar.elevation_rad)).min() > np.radians(0.4)
    else:
        assert (steps > 0).all() or (steps < 0).all()
    assert 0 < lidar.min_range_m < lidar.max_range_m
    assert 0 < lidar.sigma_range_m < 0.05 and lidar.maker and lidar.source


@pytest.mark.parametrize(("name", "sheet"), DATA_SHEETS.items())
def test_the_studys_sensors_are_as_in_its_table(name, sheet):
    lidar = load_lidar(name)
    fov_deg = np.degrees(np.ptp(lidar.elevation_rad))
    assert (lidar.rings, lidar.columns) == sheet[:2] and abs(fov_deg - sheet[2]) < 0.1


@pytest.mark.parametrize(
    ("recording", "name"),
    [
        ("known_nothing_hidden", "ouster_os0_128_rev6"),
        ("known_incidence", "ouster_os0_128_rev7"),
        ("mystery_a", "hesai_pandarxt32"),
    ],
)
def test_elevations_agree_with_an_independent_simulator(shared, recording, name):
    columns = read_table(min((shared / "recordings" / recording / "scans").iterdir()))
    xyz = np.stack([columns[axis] for axis in "xyz"], axis=-1).astype(float)
    lidar = load_lidar(name, {"azimuth_offset_deg": (0.0,)})
    nominal = lidar.directions(columns["ring"], columns["column"])
    cosine = np.sum(nominal * xyz, axis=-1) / np.linalg.norm(xyz, axis=-1)
    assert np.degrees(np.arccos(np.clip(cosine, -1, 1))).max() < 0.1


@pytest.mark.parametrize(
    ("name", "table"),
    [
        ("hesai_pandarqt64", "PandarQT64"),
        ("hesai_pandarxt32", "PandarXT32"),
        ("hesai_pandar64", "Pandar64"),
        ("hesai_pandar40p", "Pandar40P"),
        ("hesai_qt128", "PandarQT128"),
        ("hesai_xt16", "PandarXT16"),
        ("hesai_xt32m2x", "PandarXT32M"),
    ],
)
def test_hesai_angles_agree_with_the_makers_tables(shared, name, table):
    with open(shared / "lidar/hesai_nebula/calibration" / f"{table}.csv") as file:
        rows = np.array([row[1:3] for row in csv.reader(file)][1:], float)
    lidar = load_lidar(name)
    np.testing.assert_allclose(np.degrees(lidar.elevation_rad), rows[:, 0], atol=0.1)
    np.testing.assert_allclose(np.degrees(lidar.azimuth_offset_rad), -rows[:, 1], atol=0.17)


@pytest.mark.parametrize(
    ("name", "file", "atol_deg"),
    [
        ("ouster_os0_128_rev6", "OS-0-128-U1_v2.3.0_1024x10.json", 2.2),
        ("ouster_os0_32", "OS-0-32-U1_v2.2.0_1024x10.json", 2.2),
        ("ouster_os1_128", "OS-1-128_v2.3.0_1024x10.json", 0.5),
        ("ouster_os1_64", "OS-1-64_sensor_config_reduced.json", 0.3),
    ],
)
def test_ouster_angles_agree_with_units_metadata(shared, name, file, atol_deg):
    unit = json.loads((shared / "lidar/ouster_sdk_tests" / file).read_text())
    lidar = load_lidar(name)
    elevation, azimuth = unit["beam_altitude_angles"], unit["beam_azimuth_angles"]
    np.testing.assert_allclose(np.degrees(lidar.elevation_rad), elevation, atol=atol_deg)
    np.testing.assert_allclose(
        np.degrees(lidar.azimuth_offset_rad), -np.array(azimuth), atol=atol_deg
    )
    origin_mm = unit.get("lidar_origin_to_beam_origin_mm", 15.806)
    np.testing.assert_allclose(lidar.beam_origin_m, [origin_mm / 1000, 0])


def test_columns_turn_clockwise_from_behind():
    lidar = load_lidar("ouster_os0_128_rev6", {"rings": 1, "elevation_deg": (0,), "columns": 4,
                                               "azimuth_offset_deg": (0,)})  # fmt: skip
    expected = [[-1, 0, 0], [0, 1, 0], [1, 0, 0], [0, -1, 0]]
    np.testing.assert_allclose(
        lidar.directions(np.zeros(4, int), np.arange(4)), expected, atol=1e-12
    )


def test_directions_are_unit_at_the_angles_of_their_ring():
    lidar = load_lidar("hesai_pandar64")
    rings, columns = np.mgrid[:64, :1800:100]
    directions = lidar.directions(rings, columns)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=-1), 1)
    elevation = np.arcsin(directions[..., 2])
    np.testing.assert_allclose(
        elevation, np.broadcast_to(lidar.elevation_rad[:, None], rings.shape)
    )
    azimuth = np.arctan2(directions[..., 1], directions[..., 0])
    turned = azimuth - (np.pi - 2 * np.pi * columns / 1800) - lidar.azimuth_offset_rad[rings]
    np.testing.assert_allclose(np.exp(1j * turned), 1)


def test_beams_give_back_what_made_the_points():
    rng = np.random.default_rng(0)
    azimuth = rng.uniform(-np.pi, np.pi, 500)
    elevation = rng.uniform(-1.2, 1.2, 500)
    range_m = rng.uniform(0.5, 40, 500)
    for radial, tangential in ((0, 0), (0.02767, 0), (0.0315, 0.013), (-0.01, -0.05)):
        out = np.stack([np.cos(azimuth), np.sin(azimuth), np.zeros(500)], axis=-1)
        left = np.stack([-np.sin(azimuth), np.cos(azimuth), np.zeros(500)], axis=-1)
        origin = radial * out + tangential * left
        direction = np.cos(elevation)[:, None] * out + np.sin(elevation)[:, None] * [0, 0, 1]
        found = beams(origin + range_m[:, None] * direction, [radial, tangential])
        np.testing.assert_allclose(found.origin_m, origin, atol=1e-9)
        np.testing.assert_allclose(found.direction, direction, atol=1e-9)
        np.testing.assert_allclose(found.range_m, range_m, atol=1e-9)
        np.testing.assert_allclose(np.exp(1j * (found.azimuth_rad - azimuth)), 1, atol=1e-9)
        np.testing.assert_allclose(found.elevation_rad, elevation, atol=1e-9)


def test_a_point_above_the_sensor_still_has_a_beam():
    found = beams([[0.0, 0.0, 2.0]], [0.0, 0.01])
    assert all(np.isfinite(values).all() for values in vars(found).values())


def test_range_noise_follows_its_formula():
    lidar = load_lidar("ouster_os0_128_rev6")
    sigma = lidar.sigma_range(np.array([4.0]), np.array([1.0]))
    terms = [0.006, 0.0008 * 4, 0.0008 * 4 * np.tan(1.0), 0.003 / np.sqrt(12)]
    np.testing.assert_allclose(sigma, np.linalg.norm(terms))
    assert np.isfinite(lidar.sigma_range(5.0, np.pi / 2))


def test_range_noise_grows_no_further_beyond_grazing():
    """Its variance asks the cosine of incidence; 1.5 rad is where tan stops."""
    lidar = load_lidar("ouster_os0_128_rev6")
    r, g = np.array([0.0, 2.0, 7.0])[:, None], np.array([0.0, 0.7, 1.4999, 1.5001, np.pi / 2])
    slant = 0.0008 * r * np.tan(np.minimum(g, 1.5))
    expected = 0.006**2 + (0.0008 * r) ** 2 + slant**2 + 0.003**2 / 12
    np.testing.assert_allclose(lidar.range_variance(r, np.cos(g)), expected, rtol=1e-9)


def test_a_readout_step_scatters_as_the_noise_model_says():
    lidar = load_lidar("hesai_pandarxt32", {"sigma_range_m": 0.0, "sigma_range_incidence": 0.0})
    true_m = np.random.default_rng(1).uniform(2, 3, 200_000)
    read_m = np.round(true_m / lidar.quantum_m) * lidar.quantum_m
    np.testing.assert_allclose(np.std(read_m - true_m), lidar.sigma_range(2.0, 0.0), rtol=0.01)


def test_evenly_spread_elevations_need_only_their_ends():
    elevation = np.degrees(load_lidar("velodyne_vlp16").elevation_rad)
    fit = linregress(np.arange(16), elevation)
    np.testing.assert_allclose([fit.intercept, fit.slope, elevation[-1]], [-15, 2, 15], atol=1e-9)


def test_overrides_replace_fields_and_a_path_serves_as_a_name(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text(
        "maker: me\nsource: bench\nrings: 2\ncolumns: 10\nelevation_deg: [1, -1]\n"
        "min_range_m: 0\nmax_range_m: 9\nsigma_range_m: 1e-3\n"
    )
    lidar = load_lidar(path, {"beam_origin_m": [0.01, 0.02]})
    assert (lidar.name, lidar.rings, lidar.sigma_range_m) == ("mine", 2, 0.001)
    np.testing.assert_array_equal(lidar.beam_origin_m, [0.01, 0.02])


@pytest.mark.parametrize(
    ("name", "overrides", "sentence"),
    [
        ("ouster_os0_128_rev8", {}, r"did you mean ouster_os0_128_rev"),
        ("missing.yaml", {}, r"missing\.yaml does not exist"),
        (
            "velodyne_vlp16",
            {"sigma_rnge_m": 1},
            r"unknown key sigma_rnge_m; did you mean sigma_range_m",
        ),
        ("velodyne_vlp16", {"rings": 5, "elevation_deg": (1, 2, 3)}, r"3 values for 5 rings"),
        ("velodyne_vlp16", {"azimuth_offset_deg": (1, 2, 3)}, r"3 values, which do not repeat"),
        ("velodyne_vlp16", {"beam_origin_m": (27.67, 0)}, r"millimetres"),
        ("velodyne_vlp16", {"elevation_deg": (-150, 150)}, r"beyond 90"),
        ("velodyne_vlp16", {"sigma_range_m": -1}, r"sigma_range_m.*greater than or equal to 0"),
    ],
)
def test_complaints_say_what_would_be_right(name, overrides, sentence):
    with pytest.raises(InputError, match=sentence):
        load_lidar(name, overrides)
