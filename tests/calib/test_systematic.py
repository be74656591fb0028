"""What is systematic is not called chance, and is not drawn as what it is not."""

import re

import numpy as np
import pytest

from calib import diagnose, fit

from ..worlds import World, write


@pytest.mark.long
def test_half_of_a_mesh_that_is_6_mm_off_is_no_scatter_of_the_targets(tmp_path):
    """Mesh and spheres contradict each other systematically. With wider sigmas for both the room
    slides away from where either has it, by decimetres, and no fit comes to an optimum."""
    write(World(seed=11), tmp_path / "rec")
    with_half_raised(tmp_path / "rec/reference/mesh.ply", 0.006)
    found = diagnose(fit(tmp_path / "rec", tmp_path / "run", hold_out="none"))
    assert found.verdict == "unexplained_structure"
    assert {each["effect"] for each in found.scatter} == {"reference_scatter"}
    assert max(each["sd"] for each in found.scatter) < 0.006
    (said,) = (s for s in found.sentences if "comes to an optimum" in s)
    assert said.startswith("Targets scatter") and "systematic" in said


def with_half_raised(path, by_m):
    """Write a binary mesh again, its vertices beyond the median of x higher."""
    raw = path.read_bytes()
    start = raw.index(b"end_header\n") + len(b"end_header\n")
    count = int(re.search(rb"element vertex (\d+)", raw)[1])
    at = np.frombuffer(raw, "<f8", 3 * count, start).reshape(-1, 3).copy()
    at[at[:, 0] > np.median(at[:, 0]), 2] += by_m
    path.write_bytes(raw[:start] + at.tobytes() + raw[start + at.nbytes :])
