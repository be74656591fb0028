"""What every ring measures wrongly, as a table and as two makers' files, read back."""

import csv
import io
import json

import numpy as np
import pandas
import pytest

from calib.effects import OneHot, View, load_effects
from calib.exporters import export
from calib.problem.model import Model
from calib.rig import load_rig
from chains.errors import InputError
from sensors.lidar import load_lidar

from . import exports, rigs

BY_RING = ("ring_range_offset", "ring_azimuth_offset", "ring_elevation_offset", "range_offset")
FORMULA = "{name: fan, site: range, unit: m, sigma: 0.01, basis: ['sin(ring)', 'elevation']}"
OTHERS = ("range_scale", "encoder_eccentricity", "noise_range", "arm_link_length")


def recording(folder, lidar, **changes):
    model = {"model": lidar, "frame": "lidar", **changes}
    if "rings" not in changes:
        model |= {"beam_origin_m": load_lidar(lidar).beam_origin_m.tolist()}
    return rigs.write(folder, lidar=model)


def exported(folder, effects, formats, lidar="hesai_pandarqt64", size=1.0, **changes):
    """A run whose rings lie, what was exported, and where to."""
    rec = recording(folder / "rec", lidar, **changes)
    run = exports.found_by_chance([rec], load_effects(effects), size=size)
    return run, export(run, folder / "out", formats), folder / "out"


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("rings")
    (folder / "fan.yaml").write_text(FORMULA)
    effects = [*BY_RING, *OTHERS, str(folder / "fan.yaml")]
    return exported(folder, effects, ["rings", "hesai"])


def errors(run, rings, names):
    """(R, 3) measured less true of every ring, and (R, 3, P) by the unknowns, effect by effect."""
    lidar = load_rig(run.model["recordings"][0]["path"]).lidar
    rig = load_rig(run.model["recordings"][0]["path"])
    columns = {"ring": np.arange(rings), "elevation_rad": lidar.elevation_rad}
    total, parts, unknowns = np.zeros((rings, 3)), [], []
    for effect in Model.read(run.model).effects:
        if effect.name in names:
            basis = effect.basis(View(rig, rings, columns, np.zeros((1, 3))))
            if isinstance(basis, OneHot):
                basis = np.einsum("rd,rp->rdp", basis.values, np.eye(rings)[basis.index])
            basis = np.broadcast_to(basis, (rings, *basis.shape[1:]))
            estimate = run.solution.shared.effects[effect.name]
            total += basis @ estimate.estimate
            parts.append(basis)
            unknowns += [f"{effect.name}.{name}" for name in estimate.names]
    return total, np.concatenate(parts, axis=-1), unknowns


def test_subtracting_the_table_leaves_the_truth(made):
    run, _, out = made
    table = pandas.read_csv(out / "rings.csv", comment="#")
    assert table["ring"].tolist() == list(range(64))
    columns = ["range_offset_m", "azimuth_offset_rad", "elevation_offset_rad"]
    lies, J, unknowns = errors(run, 64, (*BY_RING, "fan"))
    np.testing.assert_allclose(table[columns], lies, rtol=0, atol=1e-15)
    assert np.abs(lies).max(axis=0).min() > 1e-3
    # One sigma of a ring's whole offset, drawn from the joint covariance.
    at = [run.solution.names.index(name) for name in unknowns]
    covariance = run.solution.covariance[np.ix_(at, at)]
    drawn = np.random.default_rng(0).multivariate_normal(np.zeros(len(at)), covariance, 4000)
    spread = np.einsum("rdp,np->nrd", J, drawn).std(axis=0)
    sigma = table[[c.replace("offset", "sigma") for c in columns]].to_numpy()
    np.testing.assert_allclose(sigma, spread, rtol=0.06)


def test_the_table_says_how_to_use_it_and_what_it_leaves(made):
    _, done, out = made
    head = [line for line in (out / "rings.csv").read_text().splitlines() if line[0] == "#"]
    assert any("measured = true + offset" in line for line in head)
    assert any(line.startswith(f"# The sum of {', '.join((*BY_RING, 'fan'))};") for line in head)
    assert [s.partition(":")[0] for s in done.not_held["rings"]] == list(OTHERS)


def test_only_columns_of_what_was_fitted_are_there(tmp_path):
    _, _, out = exported(tmp_path, ["ring_range_offset"], ["rings"])
    table = pandas.read_csv(out / "rings.csv", comment="#")
    assert list(table.columns) == ["ring", "range_offset_m", "range_sigma_m"]


def test_every_rig_has_its_own_rings(tmp_path):
    folders = [
        rigs.write(tmp_path / name, name=name, seed=k) for k, name in enumerate(("one", "two"))
    ]
    run = exports.found_by_chance(folders, ["ring_range_offset"])
    files = export(run, tmp_path / "out", ["rings"]).files
    for file, name in zip(files, ("one", "two"), strict=True):
        assert file.name == f"rings.{name}.csv"
        effect = run.solution.recordings[name].effects["ring_range_offset"]
        table = pandas.read_csv(file, comment="#")
        assert table["range_offset_m"].tolist() == effect.estimate.tolist()
        at = [run.solution.names.index(f"{name}/ring_range_offset.{n}") for n in effect.names]
        sigma = np.sqrt(np.diag(run.solution.covariance))[at]
        np.testing.assert_allclose(table["range_sigma_m"], sigma, rtol=1e-9)


# ------------------------------------------------------------------------------------------ Hesai


def hesai_table(text):
    """Elevation up and azimuth counter-clockwise, rad, as a driver reads the file."""
    rows = list(csv.DictReader(io.StringIO(text)))
    assert [int(row["Channel"]) for row in rows] == list(range(1, len(rows) + 1))
    elevation = np.radians([float(row["Elevation"]) for row in rows])
    return elevation, -np.radians([float(row["Azimuth"]) for row in rows])


def test_the_hesai_table_points_where_the_beams_do(made):
    """A driver that reads it gives the truth where it gave the lie before."""
    run, done, out = made
    lidar = load_lidar("hesai_pandarqt64")
    lies, *_ = errors(run, 64, BY_RING)
    elevation, azimuth = hesai_table((out / "hesai_angle_correction.csv").read_text())
    np.testing.assert_allclose(elevation + lies[:, 2], lidar.elevation_rad, rtol=0, atol=1e-15)
    np.testing.assert_allclose(azimuth + lies[:, 1], lidar.azimuth_offset_rad, rtol=0, atol=1e-15)
    said = [sentence.partition(":")[0] for sentence in done.not_held["hesai"]]
    assert said == ["a unit's own angles", "sigmas", "ring_range_offset", "range_offset",
                    *OTHERS, "fan"]  # fmt: skip


def test_without_errors_it_is_the_makers_own_table(tmp_path, shared):
    effects = ["ring_elevation_offset", "ring_azimuth_offset"]
    _, _, out = exported(tmp_path, effects, ["hesai"], size=0.0)
    theirs = shared / "lidar/hesai_corrections/PandarQT_Angle Correction File.csv"
    ours = (out / "hesai_angle_correction.csv").read_text()
    text = theirs.read_text(encoding="utf-8-sig")
    assert ours.splitlines()[0] == text.splitlines()[0].strip()
    np.testing.assert_allclose(hesai_table(ours), hesai_table(text), rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("lidar", "effects", "why"),
    [
        ("hesai_pandarqt64", ["ring_range_offset"], r"the model has none; .* in rings\.csv"),
        ("ouster_os0_32", ["ring_elevation_offset"], "ouster_os0_32 is by Ouster, not Hesai"),
    ],
)
def test_what_the_hesai_table_cannot_hold_is_refused_or_left_out(tmp_path, lidar, effects, why):
    rec = recording(tmp_path / "rec", lidar)
    run = exports.found_by_chance([rec], effects)
    with pytest.raises(InputError, match=f"--format hesai: .*{why}"):
        export(run, tmp_path / "out", ["hesai"])
    assert not (tmp_path / "out").exists()
    done = export(run, tmp_path / "out")
    assert set(done.left_out) == {"hesai"} | ({"ouster"} if lidar.startswith("hesai") else set())


# ----------------------------------------------------------------------------------------- Ouster


def ouster_points(metadata, range_m):
    """(R, C, 3) m: the formula of Ouster's software manual, from its metadata, lidar to sensor."""
    columns = metadata["data_format"]["columns_per_frame"]
    n = metadata["lidar_origin_to_beam_origin_mm"]
    encoder = 2 * np.pi * (1 - np.arange(columns) / columns)
    azimuth = -2 * np.pi * np.array(metadata["beam_azimuth_angles"])[:, None] / 360
    altitude = 2 * np.pi * np.array(metadata["beam_altitude_angles"])[:, None] / 360
    reach = 1e3 * range_m - n
    x = reach * np.cos(encoder + azimuth) * np.cos(altitude) + n * np.cos(encoder)
    y = reach * np.sin(encoder + azimuth) * np.cos(altitude) + n * np.sin(encoder)
    z = np.broadcast_to(reach * np.sin(altitude), x.shape)
    T = np.reshape(metadata["lidar_to_sensor_transform"], (4, 4))
    points = np.stack([x, y, z, np.ones_like(x)], axis=-1) @ T.T
    return points[..., :3] / 1e3


def test_the_ouster_metadata_puts_points_where_they_are(tmp_path):
    """A beam that lies by its ring's angles and starts further out than told."""
    effects = ["ring_elevation_offset", "ring_azimuth_offset", "beam_origin_offset"]
    lidar = load_lidar("ouster_os0_32")
    run, done, out = exported(tmp_path, [*effects, "ring_range_offset"], ["ouster"], lidar.name)
    metadata = json.loads((out / "ouster_metadata.json").read_text())
    lies, *_ = errors(run, lidar.rings, effects[:2])
    moved = run.solution.shared.effects["beam_origin_offset"].estimate
    n = lidar.beam_origin_m[0] + moved[0]
    encoder = np.pi - 2 * np.pi * np.arange(lidar.columns) / lidar.columns
    ring, column = np.meshgrid(np.arange(lidar.rings), np.arange(lidar.columns), indexing="ij")
    true = (lidar.elevation_rad - lies[:, 2])[:, None]
    aside = encoder + (lidar.azimuth_offset_rad - lies[:, 1])[:, None]
    beams = np.stack(np.broadcast_arrays(
        np.cos(true) * np.cos(aside), np.cos(true) * np.sin(aside), np.sin(true)
    ), axis=-1)  # fmt: skip
    start = n * np.stack([np.cos(encoder), np.sin(encoder), 0 * encoder], axis=-1)
    found = ouster_points(metadata, 3.0)
    np.testing.assert_allclose(found, start + (3.0 - n) * beams, rtol=0, atol=1e-12)
    # Without the lies these are the catalogue's own directions.
    straight = (found - start) / (3.0 - n)
    off = np.linalg.norm(straight - lidar.directions(ring, column), axis=-1)
    np.testing.assert_allclose(
        off.max(axis=1), np.hypot(lies[:, 2], np.cos(true[:, 0]) * lies[:, 1]), rtol=0.02
    )
    said = [sentence.partition(":")[0] for sentence in done.not_held["ouster"]]
    assert said == ["a unit's own angles", "sigmas", "ring_range_offset",
                    f"beams start {1e3 * moved[1]:.3f} mm to the left"]  # fmt: skip
    assert metadata["rigcal"]["about"] and metadata["rigcal"]["angles"]


def test_a_units_own_table_comes_back(tmp_path, shared):
    """With the angles of a real unit in rig.yaml, its metadata come back."""
    real = json.loads(
        (shared / "lidar/ouster_sdk_tests/OS-0-128-U1_v2.3.0_1024x10.json").read_text()
    )
    changes = {
        "elevation_deg": real["beam_altitude_angles"],
        "azimuth_offset_deg": [-angle for angle in real["beam_azimuth_angles"]],
        "beam_origin_m": [real["lidar_origin_to_beam_origin_mm"] / 1e3, 0],
        "rings": 128,
    }
    _, done, out = exported(tmp_path, [], ["ouster"], "ouster_os0_128_rev6", **changes)
    found = json.loads((out / "ouster_metadata.json").read_text())
    for key in (
        "beam_altitude_angles", "beam_azimuth_angles", "lidar_origin_to_beam_origin_mm"
    ):  # fmt: skip
        np.testing.assert_allclose(found[key], real[key], rtol=0, atol=1e-12)
    ours, theirs = (d["data_format"]["pixel_shift_by_row"] for d in (found, real))
    assert len(set(np.subtract(theirs, ours))) == 1
    assert done.not_held["ouster"]


def test_a_rig_without_a_lidar_has_no_rings(tmp_path):
    drawing = rigs.drawing()
    frames = {k: v for k, v in drawing["frames"].items() if k != "lidar"}
    folder = rigs.write(tmp_path / "rec", lidar=None, frames=frames)
    (folder / "scans").rename(tmp_path / "scans")
    run = exports.found_by_chance([folder], ["arm_link_length"])
    done = export(run, tmp_path / "out")
    assert set(done.left_out) == {"autoware", "rings", "hesai", "ouster"}
    assert {file.name for file in done.files} >= {"arm.urdf", "rig.urdf", "tree.svg"}
