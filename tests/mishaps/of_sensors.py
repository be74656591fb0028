"""Mishaps of the LiDAR's points, of what is said of noise, and of columns beside the geometry."""

from __future__ import annotations

import numpy as np

from sensors.recording import read_table, write_table

from .kinds import Done, done, mishap
from .scene import XYZ, Scene

SECTOR_RAD = 0.7


# ----------------------------------------------------------------------------------------- rings


def _rings(scene: Scene) -> int:
    return 1 + max(
        int(read_table(scene.scan_path(n))["ring"].max())
        for n in scene.names
        if scene.scan_path(n).is_file()
    )


@mishap("lidar")
def rings_numbered_from_the_other_end(scene: Scene, times: float) -> Done:
    last = _rings(scene) - 1
    scene.each_scan(lambda c: c.update(ring=last - c["ring"].astype(int)))
    return done({"rings*", "*:rings"})


@mishap("lidar", sized=True)
def rings_numbered_one_off(scene: Scene, times: float) -> Done:
    """By one, three or ten, around the end."""
    count = _rings(scene)
    scene.each_scan(lambda c: c.update(ring=(c["ring"].astype(int) + int(times)) % count))
    return done({"rings*", "*:rings"})


@mishap("lidar")
def rings_in_the_order_of_firing(scene: Scene, times: float) -> Done:
    """Even ones first, then odd ones."""
    count = _rings(scene)
    order = np.argsort(np.r_[0:count:2, 1:count:2])
    scene.each_scan(lambda c: c.update(ring=order[c["ring"].astype(int)]))
    return done({"rings*", "*:rings"})


@mishap("lidar")
def two_rings_exchanged(scene: Scene, times: float) -> Done:
    """They bear each other's numbers in the driver."""
    count = _rings(scene)
    ring = np.arange(count)
    ring[[count // 4, 3 * count // 4]] = 3 * count // 4, count // 4
    scene.each_scan(lambda c: c.update(ring=ring[c["ring"].astype(int)]))
    return done({"rings*", "*:rings"})


@mishap("lidar")
def all_returns_of_ring_zero(scene: Scene, times: float) -> Done:
    scene.each_scan(lambda c: c.update(ring=0 * c["ring"].astype(int)))
    return done({"rings*", "*:rings"})


@mishap("lidar", sized=True, harmless=True)
def one_ring_reads_long(scene: Scene, times: float) -> Done:
    """By 5, 15 or 50 mm: a ring's zero, which is estimated."""
    ring, size = _rings(scene) // 2, 0.005 * times
    scene.each_scan(lambda c: _lengthen(c, size * (c["ring"] == ring)))
    return done((), {"ring_range_offset"}, {("ring_range_offset", f"ring_{ring:03d}"): size})


# ---------------------------------------------------------------------------------------- ranges


def _lengthen(columns: dict[str, np.ndarray], by_m: np.ndarray) -> None:
    xyz = np.stack([columns[c] for c in XYZ], axis=1).astype(float)
    xyz *= 1 + (by_m / np.linalg.norm(xyz, axis=1))[:, None]
    columns.update(zip(XYZ, xyz.T, strict=True))


@mishap("lidar", sized=True)
def a_sector_of_azimuth_reads_long(scene: Scene, times: float) -> Done:
    """By 2.5, 7.5 or 25 mm: a scratch in the window."""
    first, size = scene.rng.uniform(-np.pi, np.pi - SECTOR_RAD), 0.0025 * times

    def longer(c: dict[str, np.ndarray]) -> None:
        azimuth = np.arctan2(c["y"], c["x"])
        _lengthen(c, size * ((azimuth > first) & (azimuth < first + SECTOR_RAD)))

    scene.each_scan(longer)
    return done({"azimuth_rad"}, {"azimuth_range_harmonic", "column*"})


@mishap("lidar", sized=True)
def ranges_scaled(scene: Scene, times: float) -> Done:
    """0.05 %, 0.15 %, 0.5 %: the speed of light in a wrong medium."""
    factor = 1 + 5e-4 * times
    scene.each_scan(lambda c: c.update({axis: factor * c[axis] for axis in XYZ}))
    return done({"range_scale"}, {"faro_scale", "mesh:scale"})


@mishap("lidar", sized=True)
def ranges_long_at_one_stop(scene: Scene, times: float) -> Done:
    """All beams of one stop by 1, 3 or 10 mm: a power cycle."""
    stop = scene.stop(*scene.bodies)
    scene.each_scan(lambda c: _lengthen(c, np.full(len(c["x"]), 1e-3 * times)), stop)
    return done({f"{stop}:scan"}, {"stop_range_scatter", *scene.group(f"{stop}:scan")})


@mishap("lidar")
def points_mirrored(scene: Scene, times: float) -> Done:
    """A left-handed frame: y points the other way."""
    scene.each_scan(lambda c: c.update(y=-c["y"]))
    return done()


@mishap("lidar")
def points_with_axes_exchanged(scene: Scene, times: float) -> Done:
    scene.each_scan(lambda c: c.update(x=c["y"], y=-c["x"]))
    return done({"cad:lidar"}, {"cad:mount*"}, unsure={"lidar"})


@mishap("lidar")
def points_in_millimetres(scene: Scene, times: float) -> Done:
    scene.each_scan(lambda c: c.update({axis: 1000 * c[axis] for axis in XYZ}))
    return done()


@mishap("lidar")
def points_in_feet(scene: Scene, times: float) -> Done:
    scene.each_scan(lambda c: c.update({axis: c[axis] / 0.3048 for axis in XYZ}))
    return done({"range_scale"}, {"faro_scale", "mesh:scale"})


@mishap("lidar", sized=True)
def a_person_stands_in_some_scans(scene: Scene, times: float) -> Done:
    """Half a radian of azimuth at 1.5 m, in so many scans."""
    stops = [n for n in scene.some(times) if scene.scan_path(n).is_file()]

    def stand(c: dict[str, np.ndarray]) -> None:
        xyz = np.stack([c[a] for a in XYZ], axis=1).astype(float)
        far = np.linalg.norm(xyz, axis=1)
        azimuth = np.arctan2(xyz[:, 1], xyz[:, 0])
        hit = (np.abs(azimuth - 1) < 0.25) & (far > 1.6)
        _lengthen(c, np.where(hit, 1.5 - far, 0))

    scene.each_scan(stand, *stops)
    return done({f"{stop}:scan" for stop in stops}, {"*"})


@mishap("lidar", sized=True)
def many_returns_are_spurious(scene: Scene, times: float) -> Done:
    """2, 6 or 20 % of the beams return anything."""

    def spoil(c: dict[str, np.ndarray]) -> None:
        xyz = np.stack([c[a] for a in XYZ], axis=1)
        far = np.linalg.norm(xyz, axis=1)
        wrong = scene.rng.random(len(far)) < 0.02 * times
        _lengthen(c, wrong * (scene.rng.uniform(0.5, 8, len(far)) - far))

    scene.each_scan(spoil)
    return done((), {"rejected*"})


@mishap("lidar", harmless=True)
def returns_in_any_order(scene: Scene, times: float) -> Done:
    def shuffle(c: dict[str, np.ndarray]) -> None:
        order = scene.rng.permutation(len(c["x"]))
        c.update({name: column[order] for name, column in c.items()})

    scene.each_scan(shuffle)
    return done()


@mishap("lidar", harmless=True)
def one_scan_is_missing(scene: Scene, times: float) -> Done:
    scene.scan_path(scene.stop(*scene.bodies)).unlink()
    return done()


@mishap("lidar", harmless=True)
def one_scan_lost_half_of_its_returns(scene: Scene, times: float) -> Done:
    path = scene.scan_path(scene.stop(*scene.bodies))
    columns = read_table(path)
    write_table(path, {name: c[: len(c) // 2] for name, c in columns.items()})
    return done()


# ----------------------------------------------------------------------- sigmas and other columns


@mishap("tracker", sized=True)
def tracker_worse_than_stated(scene: Scene, times: float) -> Done:
    """Twice, four and eleven times."""
    with scene.description() as rig:
        for key in ("sigma_m", "sigma_rad"):
            if key in rig["tracker"]:
                rig["tracker"][key] /= 1 + times
    return done((), {"noise_*", "*scatter*"})


@mishap("targets", sized=True)
def spheres_worse_than_stated(scene: Scene, times: float) -> Done:
    with scene.description() as rig:
        for key in ("sigma_sphere_m", "sigma_marker_m"):
            rig["target"][key] /= 1 + times
    return done((), {"noise_*", "*scatter*", "target*"})


@mishap("lidar", sized=True, harmless=True)
def intensity_in_other_units(scene: Scene, times: float) -> Done:
    """Times 3, 9 or 30: it serves as a covariate alone."""
    scene.each_scan(lambda c: c.update(intensity=3 * times * c["intensity"]))
    return done()


@mishap(harmless=True)
def times_shuffled(scene: Scene, times: float) -> Done:
    with scene.sheet("stops.csv") as sheet:
        order = scene.rng.permutation(len(sheet))
        sheet.put(sheet.numbers("time_s")[order], "time_s")
    return done()


@mishap(harmless=True)
def stops_in_any_order(scene: Scene, times: float) -> Done:
    with scene.sheet("stops.csv") as sheet:
        sheet.keep(scene.rng.permutation(len(sheet)).tolist())
    return done()


@mishap(harmless=True)
def times_in_milliseconds(scene: Scene, times: float) -> Done:
    with scene.sheet("stops.csv") as sheet:
        sheet.put(1000 * sheet.numbers("time_s"), "time_s")
    return done()


@mishap(harmless=True)
def a_column_of_one_value(scene: Scene, times: float) -> Done:
    with scene.sheet("stops.csv") as sheet:
        sheet.columns["fan_rpm"] = ["1200"] * len(sheet)
    return done()


@mishap(harmless=True)
def a_column_with_holes(scene: Scene, times: float) -> Done:
    with scene.sheet("stops.csv") as sheet:
        values = scene.rng.normal(20, 1, (len(sheet), 1))
        values[::3] = np.nan
        sheet.put(values, "oil_c")
    return done()


@mishap("tracker", "base")
def a_base_that_moves_said_to_stand(scene: Scene, times: float) -> Done:
    with scene.description() as rig:
        rig["base"]["moves"] = "never"
    return done({"*:*"})
