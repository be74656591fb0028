"""A room without a mesh: what planes found in the scans can, and cannot, tell of the LiDAR."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest

from calib.runs.calibrate import calibrate
from calib.runs.diagnose import diagnose
from calib.simulation import Spec, simulate

# A furnished lab, whose whiteboard stands off the wall by 25 mm.
LAB = Spec(mesh=False, targets=0, locations=5, column_step=64)
BOARD_MM = 25.0
# What of an effect's size is unsure, as fits have it: the mean of 128 ring zeros.
MEAN_SIGMAS = 3.0


@pytest.fixture(scope="module")
def stretched(tmp_path_factory):
    """A run, its diagnosis and the truth, of a lab where slanted walls read long."""
    folder = tmp_path_factory.mktemp("no_mesh")
    simulate(LAB, folder / "rec", 1, hide={"incidence_angle_bias": 1.0})
    run = calibrate([folder / "rec"], folder / "run", hold_out="none")
    truth = json.loads((folder / "rec.truth.json").read_text(encoding="utf-8"))
    return run, diagnose(run), truth


def test_a_board_before_a_wall_is_no_error_of_the_lidar(stretched):
    _, found, _ = stretched
    assert found.rejected.explained and found.verdict == "adequate"
    (place,) = (p for p in found.rejected.places if p.beside_a_plane)
    assert -1e3 * place.residual_m == pytest.approx(BOARD_MM, abs=1.0)
    assert "before that plane" in found.rejected.sentence


@pytest.mark.parametrize(("share", "structured"), [(0.3, False), (0.7, True)])
def test_most_beams_of_a_plane_are_no_board_before_it(stretched, share, structured):
    _, found, _ = stretched
    (place,) = (p for p in found.rejected.places if p.beside_a_plane)
    assert replace(place, share=share).structured == structured
    assert replace(place, meshed=True).structured
    curtain = replace(place, share=share, coherent=False, short=0.5)
    assert not curtain.structured and curtain.no_plane == structured
    assert replace(curtain, meshed=True).structured == structured


def test_what_planes_take_in_wholly_is_said_with_what_it_does(stretched):
    """With walls elsewhere, ring zeros take in all of an effect of the incidence: none is right."""
    run, found, truth = stretched
    rings = run.solution.shared.effects["ring_range_offset"]
    off = (rings.estimate - np.array(truth["effects"]["ring_range_offset"])) / rings.sigma
    (said,) = (s for s in found.sentences if "Nothing here checks" in s)
    name, ring, sigmas = re.search(
        r"checks (\w+), .* would change ring_range_offset\.ring_(\d+) by (\d+) of its sigmas", said
    ).groups()
    assert name == "incidence_angle_bias" and "A mesh of the room" in said
    assert float(sigmas) == pytest.approx(abs(off[int(ring)]), abs=MEAN_SIGMAS)
    assert np.abs(off).min() > 10.0
