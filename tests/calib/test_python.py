"""What Python asks of a run: tables, residuals, figures, its graph, and what it prints."""

from pathlib import Path

import gtsam
import numpy as np
import pytest
from matplotlib.figure import Figure

import calib
from calib import outputs
from calib.report.charts.graph import graph_rows
from calib.runs.asked.factors import estimate_of
from calib.solve.without import kinds_of
from chains.errors import InputError

from .bumps import bumped

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def folder(once):
    return once(bumped)


@pytest.fixture(scope="module", params=["a", "from_a"])
def run(folder, request):
    """A run, and one that was fitted from another."""
    return calib.Run.open(folder / request.param)


@pytest.fixture(scope="module")
def plain(folder):
    return calib.Run.open(folder / "a")


def blocks(run):
    """Unknown -> where it stands among the run's parameters."""
    owners = [name.rpartition(".")[0] for name in run.solution.names]
    return {name: np.flatnonzero(np.array(owners) == name) for name in dict.fromkeys(owners)}


# ------------------------------------------------------------------------------------- the graph


def test_the_error_of_the_graph_is_half_the_chi_square_of_the_fit(run):
    graph, values, keys = run.graph()
    assert isinstance(graph, gtsam.NonlinearFactorGraph) and isinstance(values, gtsam.Values)
    assert graph.error(values) == pytest.approx(run.summary["cost"], rel=1e-6)
    assert keys.keys() >= blocks(run).keys() and values.size() == len(keys)


def test_the_marginals_of_the_graph_are_those_of_the_run(run):
    graph, values, keys = run.graph()
    marginals, found = gtsam.Marginals(graph, values), run.solution.graph
    for name, at in blocks(run).items():
        mine = found[np.ix_(at, at)]
        sigma = np.sqrt(np.diag(mine))
        off = (marginals.marginalCovariance(keys[name]) - mine) / np.outer(sigma, sigma)
        assert np.abs(off).max() < 1e-6, name


def test_the_graph_is_one_to_go_on_from(run):
    """Away from the optimum it costs more, as its curvature says, and the way back is found."""
    graph, values, keys = run.graph()
    hessian, _ = graph.linearize(values).hessian()
    moved, still, step = np.full(6, 1e-4), values.zeroVectors(), gtsam.VectorValues()
    for key in keys.values():
        step.insert(key, moved if key == keys["lidar"] else still.at(key))
    # In the Hessian keys ascend.
    at = sum(len(still.at(key)) for key in keys.values() if key < keys["lidar"])
    away, part = values.retract(step), hessian[at : at + 6, at : at + 6]
    rise = graph.error(away) - graph.error(values)
    assert rise == pytest.approx(moved @ part @ moved / 2, rel=0.05) and rise > 1.0
    back = gtsam.LevenbergMarquardtOptimizer(graph, away).optimize()
    assert graph.error(back) == pytest.approx(graph.error(values), abs=1e-3)
    assert np.abs(back.atVector(keys["lidar"]) - values.atVector(keys["lidar"])).max() < 1e-5


def test_what_targets_tell_is_what_the_graph_loses_without_them(plain):
    """By GTSAM alone: their factors are those that name one."""
    graph, values, keys = plain.graph()
    targets = {key for name, key in keys.items() if name.startswith("target:")}
    left = gtsam.NonlinearFactorGraph()
    for i in range(graph.size()):
        factor = graph.at(i)
        of_target = targets & set(factor.keys()) and len(factor.keys()) > 1
        if not of_target:
            left.add(factor)
    estimate = estimate_of(plain)
    rows = {row.name: row for row in graph_rows(estimate, kinds_of(estimate))}
    some = [gtsam.Marginals(each, values) for each in (left, graph)]
    for name in ("faro", "lidar"):
        before, after = (np.linalg.det(m.marginalCovariance(keys[name])) for m in some)
        bits = np.log2(before / after) / 2 / 6
        assert rows[name].bits["target"] == pytest.approx(bits, abs=1e-4)
    assert rows["faro"].bits["target"] > 0.01
    assert rows["faro"].kinds == {"beams", "target"}
    assert rows["arm_link_length"].bits["tracker"] > rows["arm_link_length"].bits["beams"]
    assert rows["ring_range_offset"].bits["beams"] > 3
    assert all(bits > -1e-6 for row in rows.values() for bits in row.bits.values())


# ------------------------------------------------------------------------------------------ tables


def test_the_table_has_every_parameter(run):
    table = run.table()
    sigma = dict(zip(run.solution.names, np.sqrt(np.diag(run.solution.covariance)), strict=True))
    named = {f"{row.variable}.{row.parameter}": row for row in table.itertuples()}
    assert sigma.keys() <= named.keys()
    for name, each in sigma.items():
        assert named[name].sigma == pytest.approx(each, rel=1e-9), name
    lidar = named["lidar.tx"]
    assert (lidar.unit, lidar.cad_sigma) == ("m", 0.001)
    assert lidar.cad_sigmas == pytest.approx(lidar.estimate / 0.001)
    if run.prior is None:
        assert "moved" not in table
    else:
        assert set(table.variable[table.moved]) == {"lidar"}


def test_residuals_are_those_that_the_summary_tells_of(run):
    beams = run.residuals()
    assert (beams.weight > 0).sum() == run.summary["points"] <= len(beams)
    assert set(beams.stop) == {
        f"L0{k + 3 * (run.prior is not None)}P0{i}" for k in range(3) for i in range(3)
    }
    used = beams[beams.weight > 0]
    rms = 1e3 * np.sqrt(np.mean(used.residual_m.astype(float) ** 2))
    assert rms == pytest.approx(run.summary["rms_mm"]["fit"], rel=1e-3)
    tracker = run.residuals("tracker")
    turns = tracker.axis.str.startswith("r")
    assert (tracker.residual_rad.notna() == turns).all()
    assert (tracker.residual_m.notna() == ~turns).all()
    assert np.allclose(tracker.residual_m[~turns], (tracker.whitened * tracker.sigma_m)[~turns])
    assert "unit" not in tracker and {"residual_m", "sigma_m"} <= set(run.residuals("target"))
    with pytest.raises(InputError, match="did you mean tracker"):
        run.residuals("trackers")


def test_figures_are_matplotlibs(plain):
    for name in ("chain", "graph"):
        assert isinstance(plain.plot(name), Figure)
    drawn = {
        text.get_text() for text in plain.plot("graph").findobj(lambda a: hasattr(a, "get_text"))
    }
    assert {"lidar (6)", "ring_range_offset (32)", "lost\nwithout\ntracker"} <= drawn
    with pytest.raises(InputError, match="no figure"):
        plain.plot("ladders")


# ------------------------------------------------------------------------------ what is printed


def test_what_is_printed_is_short(run, folder):
    lines = str(run).splitlines()
    assert max(map(len, lines)) <= 80 and len(lines) <= 45
    assert lines[0] == str(run.folder) and lines[-1].startswith("next: rigcal diagnose")
    assert any(line.startswith("lidar moved +") for line in lines) == (run.prior is not None)
    assert repr(run) == f"Run('{run.folder}')"


def test_what_moved_is_printed_as_the_command_prints_it(folder, rigcal):
    a, b = (calib.Run.open(folder / name) for name in "ab")
    _, out, _ = rigcal("moved", a.folder, b.folder)
    assert str(calib.moved(a, b)) == "\n".join(line.rstrip() for line in out.rstrip().splitlines())


def test_one_folder_is_given_as_well_as_several(folder, tmp_path):
    """A text is one path, and no list of letters."""
    assert outputs.each("rec") == outputs.each(Path("rec")) == outputs.each(["rec"])
    for call in (calib.fit, calib.explain):
        with pytest.raises(InputError, match=r"nowhere.rig\.yaml does not exist"):
            call(str(tmp_path / "nowhere"), tmp_path / "out")
    with pytest.raises(InputError, match=r"nowhere\.pcd"):
        calib.apply(calib.Run.open(folder / "a"), "nowhere.pcd", tmp_path / "out")
    assert not (tmp_path / "out").exists()
