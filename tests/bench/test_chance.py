"""The benchmark of nulls counts what it says, and runs a case from the world to the count."""

from __future__ import annotations

import io
import json

import numpy as np
import pytest
from rich.console import Console

from . import chance
from .chance import FAMILIES, LIMIT_S, Case, cases, read, run, said
from .chance_table import KINDS, class_of, covered, interval, one_each, p_values, show

CALM = {
    "case": "plain/000",
    "family": "plain",
    "lidar": "x",
    "outcome": "adequate",
    "names": [],
    "blunders": [],
    "p": {"a": 0.5, "b": 0.01, "noise_range": 1e-9},
    "z": {"links": [0.5, 1.0, 2.5]},
}


@pytest.mark.parametrize(
    ("change", "wanted"),
    [
        ({}, "calm"),
        ({"outcome": "too few stops"}, "too few stops"),
        ({"outcome": "too few stops", "names": ["range_scale"]}, "alarm"),
        ({"outcome": "unexplained_structure"}, "alarm"),
        ({"outcome": "missing_effect", "names": ["range_scale"]}, "alarm"),
        ({"outcome": "bad_data", "blunders": ["L00P01:scan"]}, "alarm"),
        ({"blunders": ["L00P01:scan"]}, "alarm"),
        ({"outcome": "not converged"}, "no answer"),
        ({"outcome": "refused"}, "no answer"),
        ({"names": ["stop_range_scatter"]}, "alarm"),  # stops do not scatter here
        ({"family": "scatter-1", "names": ["stop_range_scatter"]}, "named what is there"),
        (
            {"family": "scatter-1", "outcome": "missing_effect", "names": ["stop_range_scatter"]},
            "named what is there",
        ),
        ({"family": "scatter-1", "names": ["stop_range_scatter", "range_scale"]}, "alarm"),
        ({"family": "scatter-1", "outcome": "missing_effect"}, "alarm"),
        ({"family": "warped", "blunders": ["mesh:surface_3"]}, "named what is there"),
        ({"family": "mesh", "blunders": ["mesh:surface_3"]}, "alarm"),
    ],
)
def test_a_case_has_its_class(change, wanted):
    assert class_of(CALM | change) == wanted


def test_an_interval_of_a_share_is_clopper_and_pearsons():
    """With none of n, the upper end u has (1 - u)^n = 0.025."""
    low, high = interval(0, 20)
    assert low == 0 and (1 - high) ** 20 == pytest.approx(0.025)
    low, high = interval(20, 20)
    assert high == 1 and low**20 == pytest.approx(0.025)


def test_intervals_are_counted():
    count, held, spread = covered([CALM, CALM | {"z": {"links": [0.1]}}, CALM | {"z": {}}], "links")
    assert count == 4
    assert held == [0.5, 0.75, 0.75]  # 0.67, 1.64 and 1.96 sigmas
    # Of 95 %: 2 of 3 and 1 of 1, so hits are off 3/4 of their numbers by -1/4 and +1/4.
    assert spread[-1] == pytest.approx(np.sqrt(2) * 0.25 / 4)
    assert covered([CALM], "rings") == (0, [], [])


def test_intervals_of_independent_errors_hold_as_often_as_they_say():
    rng = np.random.default_rng(0)
    results = [CALM | {"z": {"rings": list(rng.standard_normal(32))}} for _ in range(300)]
    count, held, spread = covered(results, "rings")
    assert count == 9600 and np.allclose(held, [0.5, 0.9, 0.95], atol=0.015)
    assert spread[-1] == pytest.approx(np.sqrt(0.05 * 0.95 / 9600), rel=0.15)


def test_p_values_are_of_what_is_not_there():
    assert p_values(CALM) == [0.5, 0.01]
    assert p_values(CALM | {"p": {"a": None}}) == []
    many = [CALM | {"p": {f"e{i:02d}": i / 40 for i in range(40)}} for _ in range(40)]
    assert len(set(one_each(many))) == 40  # one effect after another


def test_the_table_counts():
    alarm = CALM | {"case": "tracker/000", "family": "tracker", "outcome": "bad_data"}
    lost = CALM | {"case": "tracker/001", "family": "tracker", "outcome": "endless"}
    failed = {"case": "mesh/000", "family": "mesh", "error": "Traceback\nValueError: no"}
    text = io.StringIO()
    show([CALM, alarm, lost, failed], Console(file=text, width=200))
    lines = [line.split() for line in text.getvalue().splitlines()]
    first = {line[0]: line[1:] for line in reversed(lines) if line}
    assert first["plain"][:3] == ["1", ".", "0.000"]
    # The lost case is no alarm and no calm one: 1 of 1, within 0.025 to 1.
    assert first["tracker"][:6] == ["2", "1", "1.000", "0.025", "to", "1.000"]
    assert first["tracker"][6:] == [*"..1", *"..1"]
    assert first["all"][:3] == ["3", "1", "0.500"]
    assert ["alarm:", "tracker/000", "x:", "bad_data:", "no", "name"] in lines
    assert lines[-1] == ["FAILED:", "mesh/000:", "ValueError:", "no"]


def test_cases_come_in_turn_and_are_worlds_of_their_own(tmp_path):
    listed = cases(list(FAMILIES), 3)
    assert [c.family for c in listed[: len(FAMILIES)]] == list(FAMILIES)
    assert len({c.world.seed for c in listed}) == len(listed)
    assert len({c.world.lidar for c in listed[:: len(FAMILIES)]}) == 3
    assert Case("plain", 1).world == Case("plain", 1).world
    file = tmp_path / "file"
    file.write_text('{"case": "a", "error": "x"}\n{"case": "b"}\n')
    assert read(file) == {"b": {"case": "b"}} and read(tmp_path / "none") == {}


def test_what_was_cut_short_is_no_answer():
    cut = chance.Said(code=None, document={}, complaint="", seconds=float(LIMIT_S))
    assert class_of(CALM | said(cut)) == "no answer"
    fit = chance.Said(code=0, document={"converged": True}, complaint="", seconds=1.0)
    assert class_of(CALM | said(fit, cut)) == "no answer"
    scattered = {"verdict": "adequate", "scatter": [{"effect": "stop_range_scatter"}]}
    done = chance.Said(code=0, document=scattered, complaint="", seconds=1.0)
    assert said(fit, done)["names"] == ["stop_range_scatter"]


@pytest.mark.long
def test_a_case_is_run_from_the_world_to_the_count(monkeypatch):
    monkeypatch.setitem(FAMILIES, "small", {"locations": 3, "stops": 2, "beams": 500})
    result = run(Case("small", 0))
    assert json.loads(json.dumps(result)) == result
    assert result["outcome"] in ("adequate", "too few stops"), result["sentences"]
    assert set(result["z"]) <= set(KINDS) and len(result["z"]["rings"]) == 32
    assert max(max(z) for z in result["z"].values()) < 6
    assert len(result["p"]) > 20
