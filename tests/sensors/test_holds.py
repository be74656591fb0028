"""Raw holds: the average per direction is the definition's, whatever lies in between."""

import numpy as np
import pytest

from sensors.holds import average_hold
from sensors.recording import RecordedStops, write_table


def average(hold):
    """Average a hold that lies in memory, in one batch."""
    return average_hold(lambda names: iter([{n: hold[n] for n in names}]), list(hold))


def raw_hold(sweeps=100, rings=3, azimuths=8, seed=0):
    """A raw hold with noise of each direction's own, outliers, gaps and no-returns."""
    rng = np.random.default_rng(seed)
    sweep, ring, column = (
        g.ravel()
        for g in np.meshgrid(
            np.arange(sweeps), np.arange(rings), 7 * np.arange(azimuths), indexing="ij"
        )
    )
    azimuth, elevation = 0.1 * column, 0.2 * ring - 0.1
    sigma = 0.003 + 0.004 * ring
    range_m = 2 + 0.1 * column + sigma * rng.standard_normal(sweep.size)
    lost, outlier = rng.random(sweep.size) < 0.1, rng.random(sweep.size) < 0.05
    range_m[outlier] += rng.choice([-1.5, 0.8], outlier.sum())
    flat = np.cos(elevation)
    unit = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], axis=-1)
    xyz = (range_m[:, None] * unit).astype(np.float32)
    xyz[lost] = rng.choice([0, np.nan], lost.sum())[:, None]
    lonely = (ring == 0) & (column == 0)
    xyz[lonely & (sweep > 0)] = np.nan
    xyz[lonely & (sweep == 0)] = [2, 0, 0]
    xyz[(ring == 0) & (column == 7)] = 0
    columns = {
        "x": xyz[:, 0], "y": xyz[:, 1], "z": xyz[:, 2], "ring": ring.astype(np.uint16),
        "column": column.astype(np.uint16), "scan": sweep.astype(np.uint16) + 40,
        "intensity": rng.uniform(0, 100, sweep.size).astype(np.float32),
        "temperature": 20.0 + sweep,
    }  # fmt: skip
    shuffled = rng.permutation(sweep.size)
    return {name: values[shuffled] for name, values in columns.items()}


def averaged_plainly(hold):
    """The definition, one direction at a time."""
    xyz = np.stack([hold[axis] for axis in "xyz"], axis=-1).astype(float)
    range_m = np.linalg.norm(xyz, axis=-1)
    rows = []
    for ring, column in sorted({*zip(hold["ring"].tolist(), hold["column"].tolist(), strict=True)}):
        here = (hold["ring"] == ring) & (hold["column"] == column) & (range_m > 0)
        if here.any():
            median = np.median(range_m[here])
            limit = max(4 * 1.4826 * np.median(np.abs(range_m[here] - median)), 0.012)
            kept = here & (np.abs(range_m - median) <= limit)
            spread = np.std(range_m[kept], ddof=1) if kept.sum() > 1 else np.nan
            means = [
                *xyz[kept].mean(axis=0),
                hold["intensity"][kept].mean(),
                hold["temperature"][kept].mean(),
            ]
            rows.append([ring, column, *means, kept.sum(), spread, here.sum() - kept.sum()])
    return np.array(rows)


@pytest.mark.parametrize("batch_rows", [50, 10_000])
def test_a_raw_hold_is_averaged_as_defined(tmp_path, monkeypatch, batch_rows):
    hold = raw_hold()
    write_table(tmp_path / "scans/a.parquet", hold)
    (tmp_path / "stops.csv").write_text("stop,location,time_s\na,L0,0\n")
    monkeypatch.setattr("sensors.recording._BATCH_ROWS", batch_rows)
    scan = RecordedStops.open(tmp_path, [], []).scan(0)
    expected = averaged_plainly(hold)
    assert expected[:, -1].sum() > 50 and expected[:, -3].min() == 1
    assert (scan.ring.tolist(), scan.column.tolist()) == (
        expected[:, 0].tolist(),
        expected[:, 1].tolist(),
    )
    np.testing.assert_allclose(scan.xyz_m, expected[:, 2:5], atol=1e-9)
    np.testing.assert_allclose(scan.intensity, expected[:, 5], rtol=1e-6)
    np.testing.assert_allclose(scan.extra["temperature"], expected[:, 6], rtol=1e-9)
    np.testing.assert_array_equal(scan.count, expected[:, 7])
    np.testing.assert_allclose(scan.range_std_m, expected[:, 8], atol=1e-7)
    np.testing.assert_array_equal(scan.extra["set_aside"], expected[:, 9])
    assert set(scan.extra) == {"temperature", "set_aside"}


def test_the_mean_lies_on_the_beam_at_the_mean_range_wherever_the_beam_starts():
    rng = np.random.default_rng(1)
    origin, unit = np.array([0.02, 0.03, 0]), np.array([0.6, 0, 0.8])
    range_m = 3 + 0.01 * rng.standard_normal(100)
    range_m[0] = 1.0
    xyz = origin + range_m[:, None] * unit
    zero = np.zeros(100, int)
    hold = dict(zip("xyz", xyz.T, strict=True)) | {
        "ring": zero,
        "column": zero,
        "scan": np.arange(100),
    }
    mean = average(hold)
    assert mean["count"] == [99] and mean["set_aside"] == [1]
    reach = np.array([mean[axis][0] for axis in "xyz"]) - origin
    np.testing.assert_allclose(reach, range_m[1:].mean() * unit, atol=1e-12)


def test_clean_noise_keeps_nearly_all_and_its_spread():
    rng = np.random.default_rng(2)
    scan, column = (g.ravel() for g in np.meshgrid(np.arange(100), np.arange(400), indexing="ij"))
    x = 5 + 0.02 * rng.standard_normal(scan.size)
    hold = {"x": x, "y": 0 * x, "z": 0 * x, "ring": 0 * scan, "column": column, "scan": scan}
    mean = average(hold)
    assert mean["count"].min() >= 97 and mean["set_aside"].mean() < 0.1
    np.testing.assert_allclose(np.sqrt(np.mean(mean["range_std_m"] ** 2)), 0.02, rtol=0.02)
    np.testing.assert_allclose(np.std(mean["x"]), 0.02 / np.sqrt(100), rtol=0.15)


def test_two_returns_in_one_sweep_and_direction_are_both_counted():
    zero = np.zeros(4, int)
    hold = {"x": np.array([2.0, 2.002, 2.0, 2.004]), "y": zero, "z": zero}
    hold |= {"ring": zero, "column": zero, "scan": np.array([0, 0, 1, 1])}
    mean = average(hold)
    assert mean["count"] == [4]
    np.testing.assert_allclose(mean["x"], 2.0015)


@pytest.mark.parametrize(
    ("ranges", "set_aside"),
    [
        ([2.0] * 8 + [2.011, 1.989], 0),  # MAD 0: the floor of 12 mm decides
        ([2.0] * 8 + [2.013, 1.987], 2),
        ([2.0, 2.0, 2.0, 2.008, 2.008, 2.027], 0),  # median 2.004, MAD 4 mm: the limit is 23.7 mm
        ([2.0, 2.0, 2.0, 2.008, 2.008, 2.029], 1),
    ],
)
def test_a_return_is_set_aside_beyond_the_limit(ranges, set_aside):
    zero = np.zeros(len(ranges), int)
    hold = {"x": np.array(ranges), "y": zero, "z": zero, "ring": zero, "column": zero}
    mean = average(hold | {"scan": np.arange(len(ranges))})
    assert mean["set_aside"] == [set_aside] and mean["count"] == [len(ranges) - set_aside]
