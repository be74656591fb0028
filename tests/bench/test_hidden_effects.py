"""A few cases of the scored benchmark, few stops in a bare room: what must always hold."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from .hidden_baselines import NAMES
from .hidden_cases import Case, case, cases, record
from .hidden_effects import run
from .hidden_table import hangs, named, table

SMALL = {
    "lidar": "hesai_pandarxt32",
    "column_step": 60,
    "room": "box",
    "locations": 3,
    "stops_per_location": 3,
}
LARGE_MM = 2.0
# Of range, of the arm and the reference; of the beam's angles, the mount, and range once more.
MORE = {"stops_per_location": 5}  # nine stops say of this much growth p = 0.2 after all looks
SHOWN = ("incidence_angle_bias", "arm_thermal_growth", "faro_scale")
SHOWN_TOO = ("elevation_scale", "mount_bending", "intensity_range_walk")


def small(family: str, number: int = 0, **fields: object) -> Case:
    wanted = case(family, number)
    return replace(wanted, spec=wanted.spec.model_copy(update=SMALL), **fields)


@pytest.mark.slow
@pytest.mark.parametrize(
    "number", [0, 1, *(pytest.param(n, marks=pytest.mark.long) for n in (2, 3))]
)
def test_nothing_is_found_where_nothing_is_hidden(number):
    result = run(small("null", number), baselines=number == 0)
    assert result["verdict"] == "adequate", result["steps"]
    assert set(result["baselines"]) == (set(NAMES) if number == 0 else set())
    assert result["untestable"]["range_offset"].startswith("not identifiable")


@pytest.mark.long
@pytest.mark.parametrize(
    "effect", [*SHOWN, *(pytest.param(e, marks=pytest.mark.long) for e in SHOWN_TOO)]
)
def test_what_is_hidden_is_named(effect):
    wanted = small("single-1mm", hidden=(effect,), size_mm=LARGE_MM)
    if effect == "arm_thermal_growth":
        wanted = replace(wanted, spec=wanted.spec.model_copy(update=MORE))
    result = run(wanted, baselines=False)
    assert named(result), (result["verdict"], result["steps"])


@pytest.mark.long
def test_what_has_no_name_is_called_so():
    result = run(small("unknown", hidden=("lobe",), size_mm=LARGE_MM), baselines=False)
    assert hangs(result), (result["verdict"], result["steps"], result["unnamed"])


def test_a_case_is_the_same_every_time():
    again = [(c.name, c.seed, c.hidden, c.spec) for c in cases(3, ("pair", "null"))]
    assert again == [(c.name, c.seed, c.hidden, c.spec) for c in cases(3, ("pair", "null"))]
    assert len({seed for _, seed, _, _ in again}) == len(again)


def test_an_effect_has_the_size_that_is_asked_for(tmp_path):
    """A range scale k lengthens ranges by k r: its size is the ranges' root mean square times k."""
    wanted = small("single-1mm", hidden=("range_scale",), size_mm=2.0)
    source, truth, _ = record(wanted, tmp_path)
    scans = [source.recording.scan(k) for k in range(len(source.recording.stops))]
    ranges_m = np.concatenate([np.linalg.norm(scan.xyz_m, axis=1) for scan in scans])
    size_mm = 1e3 * abs(truth["effects"]["range_scale"][0]) * np.sqrt(np.mean(ranges_m**2))
    assert size_mm == pytest.approx(2.0, rel=0.03)


def test_the_table_counts():
    step = {"effect": "range_step@2.5", "p": 0.01, "mm": 1.0, "rivals": ["range_cyclic"]}
    common = {
        "verdict": "missing_effect",
        "hidden": ["range_cyclic@0.8"],
        "unnamed": [],
        "lidar": "x",
        "room": "box",
        "estimates": [None],
        "baselines": {key: [] for key in NAMES},
        "candidates": [["range_cyclic@0.8", 0.2, 0.9, 4.0, 30.0, 2]],
        "common": [0.8],
        "true": [{"rank": 2, "p": 1e-9, "left_mm": None, "explains_mm": 0.5}],
    }
    right = {**common, "case": "single-1mm/000", "family": "single-1mm", "steps": [step]}
    wrong = {**right, "case": "single-1mm/001", "steps": [{**step, "rivals": []}]}
    failed = {"case": "null/000", "family": "null", "error": "Traceback\nValueError: no"}
    # Of two effects one is named, and beside it the data do not show the other.
    pair = {**right, "case": "pair/000", "family": "pair", "hidden": ["range_step@2", "faro_scale"]}
    pair |= {"true": 2 * common["true"], "beside": [[40.0, 1, 2.0], [3.0, 1, 2.0]]}
    shown = {**pair, "case": "pair/001", "beside": [[40.0, 1, 2.0], [30.0, 1, 2.0]]}
    second = {**step, "effect": "faro_scale", "rivals": []}
    both = {**shown, "case": "pair/002", "steps": [step, second]}
    more = {**shown, "case": "pair/003", "steps": [step, {**second, "effect": "base_flex"}]}
    lines = table([right, wrong, pair, shown, both, more, failed]).splitlines()
    counts = {line.split("  ")[0]: line.split() for line in lines if line.startswith("pair: ")}
    expected = {
        "all found": ["4", "0.250"],
        "another named, and not as a rival": ["4", "0.250"],
        "the data show all": ["4", "0.750"],
        "all found, where they do": ["3", "0.333"],
    }
    for what, numbers in expected.items():
        assert " ".join(numbers) in " ".join(counts[f"pair: {what}"])
    (first,) = (line for line in lines if line.startswith("single-1mm: named first  "))
    assert first.split()[3:5] == ["2", "0.500"]
    assert any(line.startswith("single-1mm/001") for line in lines)
    assert lines[-1] == "null/000 failed: ValueError: no"
