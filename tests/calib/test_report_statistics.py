"""The sums behind a report's curves, against pandas; their bands, against drawn errors."""

import numpy as np
import pandas as pd
import pytest

from calib.report.charts.residuals import _title
from calib.report.statistics import Axis, StopResiduals, residual_statistics

RINGS, AZIMUTHS = 8, 12
RNG = np.random.default_rng


def table(
    rng: np.random.Generator,
    stop: float,
    rows: int = 400,
    surfaces: int = 6,
    mean_m: float = 0.0,
) -> StopResiduals:
    """A stop of random rows; one in ten was thrown out by the fit."""
    weight = np.where(rng.random(rows) < 0.1, 0.0, rng.uniform(0.2, 1.0, rows))
    columns = {
        "ring": rng.integers(0, RINGS, rows),
        "azimuth_rad": rng.uniform(-np.pi, np.pi, rows),
        "range_m": rng.uniform(1.0, 6.0, rows),
        "incidence_rad": rng.uniform(0.0, 1.2, rows),
        "surface": rng.integers(0, surfaces, rows),
        "residual_m": rng.normal(mean_m, 0.002, rows),
        "sigma_m": rng.uniform(0.001, 0.003, rows),
        "weight": weight,
    }
    return StopResiduals(
        columns=columns,
        stop={"stop": stop, "temperature_c": 20.0 + stop},
        room=0,
        sigma_angle_rad=0.0005,
        sigma_reference_m=0.0004,
    )


@pytest.fixture(scope="module")
def tables() -> list[StopResiduals]:
    rng = RNG(1)
    return [table(rng, float(k), rows=300 + 50 * k) for k in range(5)]


@pytest.fixture(scope="module")
def frame(tables: list[StopResiduals]) -> pd.DataFrame:
    """All rows that count, as pandas has them."""
    parts = [pd.DataFrame(dict(t.columns)).assign(**t.stop) for t in tables]
    return pd.concat(parts).query("weight > 0")


def gathered(tables, *axes):
    return residual_statistics(tables, axes, RINGS, AZIMUTHS)


@pytest.mark.parametrize("name", ["range_m", "ring", "temperature_c"])
def test_curves_are_those_of_pandas(tables, frame, name):
    axis = Axis.of_values(name, frame[name].to_numpy())
    curve = gathered(tables, axis).curves[name]
    bins = np.searchsorted(axis.edges, frame[name])
    for b, rows in frame.groupby(bins):
        mean = np.average(rows.residual_m, weights=rows.weight)
        spread = np.average(np.square(rows.residual_m - mean), weights=rows.weight)
        assert curve.count[b] == len(rows)
        np.testing.assert_allclose(curve.mean_m[b], mean, rtol=1e-9)
        np.testing.assert_allclose(curve.std_m[b], np.sqrt(spread), rtol=1e-9)
        np.testing.assert_allclose(curve.at[b], rows[name].mean(), rtol=1e-9)
    assert curve.count.sum() == len(frame)


def test_the_order_of_stops_changes_nothing(tables):
    axis = Axis.of_values("range_m", np.linspace(1, 6, 100))
    one, other = gathered(tables, axis), gathered(tables[::-1], axis)
    np.testing.assert_allclose(
        one.curves["range_m"].band_m, other.curves["range_m"].band_m, rtol=1e-9
    )
    np.testing.assert_array_equal(one.z, other.z)


def test_the_map_is_a_pivot_table(tables, frame):
    shown = gathered(tables).map_m
    turn = ((frame.azimuth_rad / (2 * np.pi) + 0.5) * AZIMUTHS).astype(int)
    parts = frame.assign(turn=turn, wr=frame.weight * frame.residual_m)
    sums = parts.groupby(["ring", "turn"])[["wr", "weight"]].sum()
    for (ring, column), row in sums.iterrows():
        np.testing.assert_allclose(shown[ring, column], row.wr / row.weight, rtol=1e-9)
    assert np.isfinite(shown).sum() == len(sums)


def test_counts_and_sigmas_of_rows_that_were_thrown_out_do_not_count(tables, frame):
    found = gathered(tables)
    assert (found.rows, found.kept) == (sum(len(t.columns["ring"]) for t in tables), len(frame))
    assert found.z.sum() == (np.abs(frame.residual_m / frame.sigma_m) <= 5).sum()


def test_a_sigma_is_taken_apart_into_what_it_was_made_of():
    rng = RNG(2)
    made = table(rng, 0.0)
    columns = dict(made.columns)
    angle = 0.0005 * columns["range_m"] * np.tan(columns["incidence_rad"])
    reference = 0.0004 / np.cos(columns["incidence_rad"])
    columns["sigma_m"] = np.sqrt(0.0015**2 + angle**2 + reference**2)
    kept = columns["weight"] > 0
    found = gathered(
        [
            StopResiduals(
                columns=columns, stop={}, room=0, sigma_angle_rad=0.0005, sigma_reference_m=0.0004
            )
        ]
    ).variance_m2
    expected = {
        "range noise": 0.0015**2,
        "angle noise": np.mean(angle[kept] ** 2),
        "reference": np.mean(reference[kept] ** 2),
    }
    for name, variance in expected.items():
        np.testing.assert_allclose(found[name], variance, rtol=1e-9)


def clustered(rng: np.random.Generator, stops: int = 12, surfaces: int = 12) -> list[StopResiduals]:
    """Rows whose errors are those of their stop and of their surface, and hardly their own."""
    of_surface = rng.normal(0.0, 0.001, surfaces)
    out = []
    for k in range(stops):
        made = table(rng, float(k), rows=500, surfaces=surfaces)
        residual = rng.normal(0.0, 0.001) + of_surface[made.columns["surface"]]
        residual = residual + rng.normal(0.0, 0.0005, 500)
        out.append(StopResiduals({**made.columns, "residual_m": residual}, made.stop))
    return out


def test_bands_hold_the_mean_where_stops_and_surfaces_err_together():
    """All bins see all stops and surfaces: counting points, bands would be ten times too narrow."""
    axis = Axis.of_values("range_m", np.linspace(1, 6, 50), bins=4)
    held, narrow, trials = 0, 0, 60
    for seed in range(trials):
        curve = gathered(clustered(RNG(100 + seed)), axis).curves["range_m"]
        held += (np.abs(curve.mean_m) <= curve.band_m).sum()
        narrow += (np.abs(curve.mean_m) <= 1.96 * curve.std_m / np.sqrt(curve.count)).sum()
    assert 0.88 < held / (4 * trials) <= 1.0
    assert narrow / (4 * trials) < 0.4


def test_a_bin_of_one_stop_counts_its_surfaces_and_one_of_a_single_cluster_has_no_band():
    rng = RNG(3)
    two = [table(rng, 0.0), table(rng, 1.0, surfaces=1)]
    curve = gathered(two, Axis.of_things("stop", range(2), ("a", "b"))).curves["stop"]
    assert curve.band_m[0] > 0
    assert np.isnan(curve.band_m[1])


def test_what_hangs_on_a_covariate_is_measured_without_what_chance_gives():
    rng = RNG(4)
    axis = Axis.of_values("incidence_rad", np.linspace(0, 1.2, 100), bins=10)
    sizes = []
    for size_m in (0.0, 0.004):
        made = [table(rng, float(k), rows=2000) for k in range(8)]
        bent = []
        for t in made:
            wave = np.where(t.columns["incidence_rad"] > 0.6, size_m, -size_m)
            bent.append(
                StopResiduals({**t.columns, "residual_m": t.columns["residual_m"] + wave}, t.stop)
            )
        sizes.append(gathered(bent, axis).curves["incidence_rad"].rms_m)
    assert sizes[0] < 0.0001
    np.testing.assert_allclose(sizes[1], 0.004, rtol=0.05)


def test_a_curve_that_a_fit_has_absorbed_is_told_by_stops_held_out():
    """Its title said that nothing is left, above a curve of 7 mm."""
    rng, axis = RNG(5), Axis.of_values("incidence_rad", np.linspace(0, 1.2, 100), bins=10)
    fitted, unseen = (
        gathered([table(rng, float(k), rows=2000, mean_m=m) for k in range(8)], axis).curves[
            axis.name
        ]
        for m in (0.0, 0.007)
    )
    title = _title("incidence_rad", fitted, None, unseen, "before")
    off = f"{1e3 * unseen.rms_m:.2f}"  # 7 mm, less what chance adds
    assert title == f"Over incidence, stops held out are off by {off} mm rms; the fit absorbs it"
    title = _title("incidence_rad", fitted, None, fitted, "before")
    assert title.startswith("No significant dependence on incidence is left")
