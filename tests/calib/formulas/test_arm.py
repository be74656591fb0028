"""Formulas of an arm's joints: tables of poses against dense least squares, and a planted error."""

import shutil
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pandas as pd
import pytest
from scipy.sparse import csr_array
from threadpoolctl import threadpool_limits

from calib.diagnosis.formulas import find
from calib.diagnosis.formulas.arm import _shared, _table, _without_own
from calib.diagnosis.stand import Stand
from calib.problem import build
from calib.problem.model import Model, Source
from calib.solve.fit import solve

STOPS, ROWS, UNKNOWNS = 60, 6, 9
WILD = "p141"  # x of it is 0.5 m off
MODEL = Model(("arm_link_length", "arm_joint_offset"))


@dataclass
class Sized:
    """As much of a layout as tells which columns a stop has for itself."""

    size: int
    own: Mapping[int, np.ndarray]


@pytest.fixture
def rows():
    """Whitened rows of bodies and targets: A, b, stop, place, and functions of the stop (K, 2)."""
    rng = np.random.default_rng(3)
    count = STOPS * ROWS + 20
    stop = np.concatenate([np.repeat(np.arange(STOPS), ROWS), np.full(20, -1)])
    order = rng.permutation(count)
    A, b = rng.standard_normal((count, UNKNOWNS + 1)), rng.standard_normal(count)
    return A, b, stop[order], np.where(stop[order] < 0, 7, -1), rng.standard_normal((STOPS, 2))


def test_a_table_of_poses_explains_what_dense_least_squares_does(rows):
    """The lever of a stop times a function of the stop, beside all unknowns but the lever."""
    A, b, stop, place, functions = rows
    lever, model = UNKNOWNS, np.arange(UNKNOWNS)
    wind = {"wind": np.arange(STOPS, dtype=float)}
    table = _table(A[:, model], A[:, lever], b, stop, place, wind)
    assert len(table) == STOPS
    columns = np.where(stop[:, None] >= 0, A[:, [lever]] * functions[np.maximum(stop, 0)], 0.0)

    def chi2(more):
        beside = np.hstack([A[:, model], more])
        return np.square(b - beside @ np.linalg.lstsq(beside, b, rcond=None)[0]).sum()

    at = table.covariates["wind"].astype(int)
    flat = np.full(STOPS, 1.0) / table.sigma_m**2  # weights that no residual widens
    projection = type(table.projection()).of(table, flat)
    (one, both), dof = projection.explained([functions[at][:, :1], functions[at]])
    assert dof.tolist() == [1, 2]
    assert one == pytest.approx(chi2(columns[:, :0]) - chi2(columns[:, :1]), rel=1e-6)
    assert both == pytest.approx(chi2(columns[:, :0]) - chi2(columns), rel=1e-6)
    _, amount = projection.fitted(functions[at])
    dense = np.linalg.lstsq(np.hstack([A[:, model], columns]), b, rcond=None)[0][-2:]
    assert amount == pytest.approx(dense, rel=1e-6)


def test_what_stops_have_for_themselves_is_taken_out_of_their_rows(rows):
    """As readings' errors are: what is left explains what dense least squares with them does."""
    A, b, stop, place, _ = rows
    rng = np.random.default_rng(4)
    own = {k: np.arange(2) + UNKNOWNS + 1 + 2 * k for k in range(STOPS) if k % 5}
    size = UNKNOWNS + 1 + 2 * STOPS
    wide = np.hstack([A, np.zeros((len(b), 2 * STOPS))])
    for k, columns in own.items():
        wide[np.ix_(stop == k, columns)] = rng.standard_normal((ROWS, 2))
    layout = Sized(size=size, own=own)
    less, right, stops, places = _without_own(
        layout, _shared(layout), csr_array(wide), b, stop, place
    )
    counts = [ROWS - 2 * (k in own) for k in range(STOPS)]
    assert np.bincount(stops[stops >= 0]).tolist() == counts
    np.testing.assert_array_equal(places[stops < 0], 7)
    whole = np.linalg.lstsq(wide, b, rcond=None)[0]
    few = np.linalg.lstsq(less[:, : UNKNOWNS + 1], right, rcond=None)[0]
    np.testing.assert_allclose(few, whole[: UNKNOWNS + 1], rtol=1e-9)
    left = np.square(right - less[:, : UNKNOWNS + 1] @ few).sum()
    assert left == pytest.approx(np.square(b - wide @ whole).sum(), rel=1e-9)


def test_a_joint_that_no_body_feels_has_no_table(rows):
    A, b, stop, place, _ = rows
    assert _table(A, np.zeros(len(b)), b, stop, place, {}) is None


def fitted(folder) -> Stand:
    source = Source.open(folder)
    problem = build([source], MODEL)
    return Stand([source], MODEL, problem, solve(problem))


def planted(shared, folder, error):
    """The recording of a good arm, a joint of which is further than it reads by an error."""
    shutil.copytree(shared / "recordings/arm_one_wild_row", folder)
    for path in (folder, *folder.rglob("*")):
        path.chmod(0o755 if path.is_dir() else 0o644)
    stops = pd.read_csv(folder / "stops.csv")
    stops = stops[stops["stop"] != WILD]
    stops = stops.assign(joint_3=stops["joint_3"] - error(stops))
    stops.to_csv(folder / "stops.csv", index=False)
    return folder


@pytest.mark.long
def test_an_error_of_a_joint_is_found_with_its_formula(shared, tmp_path):
    """In a recording of another simulator: of two other joints, as no catalogue has it."""
    folder = planted(
        shared, tmp_path / "arm", lambda c: 1.2e-3 * (c["joint_1"] > 0.5) * c["joint_5"]
    )
    with threadpool_limits(1):
        first, *_ = find(fitted(folder), lambda *_: None)
    assert first.site == "joint:joint_3" and set(first.covariates) == {"joint_1", "joint_5"}
    (part,) = first.parts
    assert {f.kind for f in part.term.factors} <= {"step", "line", "proportional"}
    edge, sigma = part.term.constants[0], part.constants_sigma[0]
    assert abs(edge - 0.5) < 4 * sigma < 0.1
    at = {"joint_1": np.array([0.0, 1.0, 1.0]), "joint_5": np.array([1.0, -1.0, 1.0])}
    assert first.value_m(at) == pytest.approx([0.0, -1.2e-3, 1.2e-3], abs=1e-4)
    assert first.says.startswith("joint_3 = read ") and " mrad * " in first.says
    document = first.effect((), "a page")
    assert document["name"] == "empirical_joint_3_joint_1_joint_5"
    assert (document["site"], document["unit"]) == ("joint:joint_3", "rad")
    assert first.picture["unit"] == "mrad"


def test_a_good_arm_has_no_formula(shared):
    with threadpool_limits(1):
        assert find(fitted(shared / "recordings/arm_one_wild_row"), lambda *_: None) == []
