"""How blunders are told."""

from types import SimpleNamespace

import numpy as np
import pytest

from calib.blunders import judged, told
from calib.blunders.shifts import Shift
from calib.residuals.groups import CAD, Group
from calib.show.blunders import blunder_cells


def far_out(shift):
    """A blunder beyond doubt."""
    return judged.Blunder(
        shift=shift,
        p_value=1e-6,
        p_adjusted=1e-6,
        evidence=50.0,
        limit=20.0,
        enough=30.0,
        detectable={},
        looks=10,
    )


def test_a_recording_that_fits_nothing_has_no_size_in_tables():
    assert blunder_cells(told.of_recording("after", "before")) == ("recording of after", "", "")


@pytest.mark.parametrize(("turn", "possible"), [(3.13, True), (3.15, True), (4.0, False)])
def test_what_is_mounted_the_wrong_way_round_may_seem_turned_by_more_than_half_a_turn(
    turn, possible
):
    """By the part of half a turn that another frame takes up. Noise decides on which side it is."""
    shift = Shift(
        group=Group("frame", CAD, "lidar"),
        statistic=1e6,
        dof=1,
        offset=np.array([turn]),
        covariance=np.full((1, 1), 1e-6),
        information=np.full((1, 1), 1e6),
        axes=("rz",),
        units=("rad",),
    )
    blunder = far_out(shift)
    assert blunder.possible == blunder.found == possible


@pytest.mark.parametrize(
    ("along", "words"),
    [(20.0, "mm off in x"), (0.5, "none of which is"), (0.0, "0.1 ± 0.001 mm off in x")],
)
def test_a_blunder_of_which_no_part_is_known_is_told_without_a_size(along, words):
    """Its shift and its turn together are far out; how large either is, nothing tells."""
    sigma = np.array([1e-3, 1e-3])
    covariance = np.outer(sigma, sigma) * np.array([[1.0, 0.9999], [0.9999, 1.0]])
    offset = along * sigma * np.array([1.0, -1.0 if along < 1 else 0.01])
    units = ("m", "rad")
    if not along:  # one axis is known well, another is not
        offset, units = np.array([1e-4, 5e-3]), ("m", "m")
        covariance = np.diag([1e-6, 4.4e-3]) ** 2
    shift = Shift(
        group=Group("body", "s1", "base_markers"),
        statistic=float(offset @ np.linalg.solve(covariance, offset)),
        dof=2,
        offset=offset,
        covariance=covariance,
        information=np.linalg.inv(covariance),
        axes=("x", "rx"),
        units=units,
    )
    assert shift.statistic > 400
    source = SimpleNamespace(rig=SimpleNamespace(tree=None), reference=None)
    found = told.document(judged.LeftOut(far_out(shift), rivals=[]), [source])
    assert words in found["sentence"] and "against everything else" in found["sentence"]


@pytest.mark.parametrize(
    ("moves", "seen", "mirrored"),
    [("stop", 2, True), ("stop", 1, False), ("location", 2, False)],
)
def test_a_scan_that_is_off_may_be_bodies_that_are(moves, seen, mirrored):
    """Where the tracker alone says where the rig stood, it may have seen all of it elsewhere."""
    shift = Shift(
        group=Group("scan", "s1", "scan"),
        statistic=400.0,
        dof=1,
        offset=np.array([4e-3]),
        covariance=np.full((1, 1), 1e-8),
        information=np.full((1, 1), 1e8),
        axes=("x",),
        units=("m",),
    )
    bodies = {f"b{k}": np.full((1, 7), 0.0 if k < seen else np.nan) for k in range(2)}
    source = SimpleNamespace(
        rig=SimpleNamespace(tree=None, moves=moves),
        reference=None,
        recording=SimpleNamespace(stops=("s1",), bodies=bodies),
    )
    found = told.document(judged.LeftOut(far_out(shift), rivals=[]), [source])
    assert ("or it is b0 and b1 together: nothing" in found["sentence"]) == mirrored
