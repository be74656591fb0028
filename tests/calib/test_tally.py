"""Sums over stops against the points themselves, and evaluations of several runs."""

import numpy as np
import pandas as pd
import pytest

from calib.cli import main
from calib.evaluation import evaluate, evaluate_all
from calib.runs.calibrate import calibrate
from calib.runs.run import Run
from calib.simulation import Spec
from chains.errors import InputError

from .simulated import QUICK, made

SPEC = Spec(**{**QUICK, "column_step": 100}, lidar="hesai_pandarxt32")


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run of a small recording."""
    folder = tmp_path_factory.mktemp("tally")
    made(folder / "rec", SPEC, seed=6)
    return calibrate([folder / "rec"], folder / "run", hold_out="none")


@pytest.fixture(scope="module", params=[False, True], ids=["corrected", "raw"])
def evaluated(run, request):
    """evaluation.json's content, the points, and the column of errors that it speaks of."""
    found = evaluate(run, raw=request.param)
    column = "raw_signed_error_m" if request.param else "signed_error_m"
    return found, pd.read_parquet(run.folder / "points.parquet"), column


def test_the_middle_and_its_width_are_those_of_all_directions(evaluated):
    found, points, column = evaluated
    low, middle, high = 1e3 * np.quantile(points[column], (0.15865, 0.5, 0.84135))
    signed = found["signed_error_mm"]
    assert signed["median"] == pytest.approx(middle, abs=0.3)
    assert signed["half_68"] == pytest.approx((high - low) / 2, abs=0.3)


def test_returns_that_are_far_off_are_counted_and_told_apart(evaluated):
    found, points, column = evaluated
    far, count = found["signed_error_mm"]["far"], points["count"].to_numpy()
    beyond = points[column].abs().to_numpy() >= 0.2
    assert beyond.sum() == far["directions"] > 0 and count[beyond].sum() == far["returns"]
    near, n = 1e3 * points[column].to_numpy(float)[~beyond], count[~beyond]
    assert far["mean_without_mm"] == pytest.approx(np.average(near, weights=n), abs=1e-3)
    spread = 1e3 * np.nan_to_num(points["precision_m"].to_numpy(float)[~beyond])
    squares = n * near**2 + (n - 1) * spread**2
    std = np.sqrt(squares.sum() / n.sum() - far["mean_without_mm"] ** 2)
    assert far["std_without_mm"] == pytest.approx(std, rel=1e-3)


def test_histograms_are_numpy_s(evaluated):
    found, points, column = evaluated
    histogram = found["histograms"]["signed_error_mm"]
    count = histogram["directions"]
    edges = histogram["left"] + histogram["width"] * np.arange(len(count) + 1)
    values = np.clip(1e3 * points[column].astype(float), -200, 199.9)
    expected, _ = np.histogram(values, edges)
    assert sum(count) == len(points)
    assert np.abs(np.subtract(count, expected)).sum() <= 4  # of values on an edge


def test_planes_are_as_thick_as_their_points_say(run, evaluated):
    """Each surface's returns, by a principal component of numpy's."""
    found, points, column = evaluated
    floor = next(p for p in found["planes"] if p["label"] == "floor")
    on = points[(points["label"] == 0) & (points[column].abs() < 0.05)]
    assert floor["n"] == on["count"].sum()
    assert floor["stops"] == on["stop"].nunique()
    xyz = on[["x_m", "y_m", "z_m"]].to_numpy(float)
    if column.startswith("raw"):  # the table's points are corrected; these lie as measured
        at = origins(run)
        beam = xyz - np.stack([at[stop] for stop in on["stop"]])
        beam /= np.linalg.norm(beam, axis=1, keepdims=True)
        taken_m = (on["raw_signed_error_m"] - on["signed_error_m"]).to_numpy()
        xyz = xyz + beam * taken_m[:, None]
    n = on["count"].to_numpy(int)
    away = xyz - np.average(xyz, axis=0, weights=n)
    normal = np.linalg.svd(np.sqrt(n)[:, None] * away, full_matrices=False)[2][-1]
    within = on["precision_m"] * np.cos(on["incidence_rad"])
    thick = np.sqrt(np.average((away @ normal) ** 2 + within**2, weights=n))
    assert floor["thickness_mm"] == pytest.approx(1e3 * thick, rel=1e-3)


def origins(run):
    """Where the LiDAR was at each stop: of this one, beams start there."""
    from calib import problem as problems
    from calib.problem.model import Model
    from calib.runs.reopen import reopened
    from calib.solve.estimate import values_of

    sources = reopened(run)
    problem = problems.build(sources, Model.read(run.model))
    values = values_of(problem, run.state())
    return {scan.name: scan.pose(values)[:3, 3] for scan in problem.scans}


def test_only_flat_surfaces_are_planes(evaluated):
    assert "curtain" not in {plane["label"] for plane in evaluated[0]["planes"]}


def test_several_runs_are_evaluated_side_by_side(run, tmp_path, capsys):
    other = calibrate(run.recordings, tmp_path / "other", hold_out="none")
    found = evaluate_all([run, other], tmp_path / "out")
    assert [*found] == [str(run.folder), str(other.folder)]
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["other", "run"]
    with pytest.raises(SystemExit) as done, pytest.MonkeyPatch.context() as patch:
        patch.setattr("sys.argv", ["rigcal", "evaluate", str(run.folder), str(other.folder)])
        main()
    assert done.value.code == 0
    said = capsys.readouterr().out.splitlines()
    assert said[0].split() == ["mm", "run", "other"]
    mean = f"{found[str(run.folder)]['signed_error_mm']['mean']:+.2f}"
    assert next(line for line in said if "mean" in line).split()[-2] == mean


def test_runs_of_one_name_are_not_written_over_each_other(run, tmp_path):
    with pytest.raises(InputError, match="two runs are called run"):
        evaluate_all([run, Run.open(run.folder)], tmp_path / "out")
    assert not (tmp_path / "out").exists()
