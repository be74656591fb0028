"""Parts of a report that need no run: the light, correlations, arrows."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from calib.problem.unknowns import Key
from calib.report.charts.bodies import Arrows, magnification
from calib.report.charts.groups import groups
from calib.report.charts.knowledge import tied
from calib.results.solution import Part, Solution
from calib.runs.run import Run
from calib.show.verdict import judge

from .exports import none_of


def test_correlations_are_those_of_the_covariance_and_large_effects_are_summed_up():
    keys = tuple(map(Key, "aab", "xyz")) + tuple(Key("rings", f"ring_{i:03}") for i in range(20))
    covariance = np.eye(23)
    covariance[0, 1] = covariance[1, 0] = 0.9
    covariance[3:, 3:] += 1.0
    covariance[2, 3:] = covariance[3:, 2] = -0.7
    names = {"a": ("x", "y"), "b": ("z",), "rings": tuple(key.dof for key in keys[3:])}
    effects = {n: none_of("m", some) for n, some in names.items()}
    shared = Part(effects=effects)
    chosen, matrix = tied(
        Solution(
            shared=shared,
            recordings={},
            not_estimated=[],
            keys=keys,
            covariance=covariance,
        ),
        None,
    )
    assert chosen == ["a.x", "a.y", "b.z", "mean of rings"]
    assert matrix[0, 1] == pytest.approx(0.9)
    assert matrix[2, 3] == pytest.approx(-0.7 / np.sqrt(1 + 1 / 20))
    weak = {"weak_directions": [{"parameters": ["b.z"]}]}
    alone = tied(
        Solution(
            shared=shared,
            recordings={},
            not_estimated=[],
            keys=keys[:3],
            covariance=covariance[:3, :3],
        ),
        weak,
    )
    assert alone[0] == ["a.x", "a.y", "b.z"]


def test_arrows_are_drawn_by_a_round_number_and_none_leaves_the_picture():
    rng = np.random.default_rng(0)
    for size in (1e-5, 3e-4, 0.02):
        arrows = Arrows(rng.uniform(0, 4, (30, 3)), rng.normal(0, size, (30, 3)))
        scale = magnification([arrows])
        assert f"{scale:.0e}"[0] in "125"
        drawn = scale * np.linalg.norm(arrows.off_m, axis=1).max()
        assert 0.05 < drawn / 4 < 0.16


def run_like(**changes) -> Run:
    """A run of which a verdict sees the summary alone."""
    summary = {
        "rms_mm": {"fit": 0.9, "held_out": 1.1, "noise_floor": 1.0},
        "misfit": {"beams": 0.9},
        "converged": True,
    }
    return Run(Path("run"), model={}, summary=summary | changes, solution=None)


def found(verdict="adequate", sigma_mm=0.5):
    weak = [{"parameters": ["a.x"], "sigma_mm": sigma_mm}]
    return {
        "verdict": verdict,
        "too_few_stops": False,
        "sentences": ["It is so."],
        "weak_directions": weak,
    }


def rms(held_out):
    return {"rms_mm": {"fit": 0.9, "held_out": held_out, "noise_floor": 1.0}}


MOVED = {"move_sigmas": 100.2, "worst": "tz", "change": -0.133, "sigma": 0.001, "unit": "m"}


def apart(part, what):
    """A misfit of one part."""
    return {"misfit_by": {"stop": {}, "body": {}, "target": {}, "prior": {}} | {part: what}}


@pytest.mark.parametrize(
    ("changes", "diagnosis", "light", "reason"),
    [
        ({}, found(), "green", "as well as noise allows"),
        ({}, None, "amber", "not diagnosed"),
        ({}, found("unexplained_structure"), "amber", "something that no known"),
        ({}, found(sigma_mm=3.5), "amber", "a.x may still be off by 3.5 mm"),
        (rms(1.5), found(), "amber", "1.5 times as large as expected"),
        (rms(None), found(), "amber", "no stops were held out"),
        ({"misfit": {"reference": 2.0}}, found(), "amber", "errors of the reference"),
        (
            apart("stop", {"a": {"bodies": {"b": 4.0}}}),
            found(),
            "amber",
            "a, b: residuals 4.0 times",
        ),
        (
            apart("prior", {"a": MOVED}),
            found(),
            "amber",
            "a.tz: -133 mm from CAD, 100 of its sigmas",
        ),
        ({"misfit": {"tracker": 4.0}}, found(), "red", "residuals of the tracker"),
        ({"misfit": {"cad": 1.4}}, found(), "green", "as well as noise allows"),
        ({"misfit": {"cad": 2.0}}, found(), "amber", "frames are 2.0 times further from CAD"),
        (
            {"misfit": {"cad": 3.1}} | apart("prior", {"a": MOVED, "b.c": MOVED}),
            found(),
            "red",
            "frames are 3.1 times further from CAD than its sigmas allow, a by 100.2 of them",
        ),
        (rms(4.0), found(), "red", "4.0 times as large as expected"),
        ({"converged": False}, found(), "red", "not converged"),
        ({}, found("missing_effect"), "red", "worth adding"),
        ({}, found("bad_data"), "red", "has to be corrected or left out"),
    ],
)
def test_the_light_follows_its_rule(changes, diagnosis, light, reason):
    verdict = judge(run_like(**changes), diagnosis)
    assert verdict.light == light
    assert any(reason in told for told in verdict.reasons)


def test_what_was_left_out_is_not_the_verdict():
    """It stands above the sentences of a diagnosis, and has a place of its own on the page."""
    run = replace(run_like(), model={"without": ["s1:base"]})
    diagnosis = found() | {"sentences": [*run.warning, "It is so."]}
    assert run.warning == ["Left out: s1:base"]
    assert judge(run, diagnosis).sentence == "It is so."
    assert judge(run, diagnosis).light == "green"


# ---------------------------------------------------------------------------------------- groups


def group(token, kind, times_as_far):
    return {"token": token, "kind": kind, "statistic": times_as_far**2 * 40.0, "limit": 40.0}


SOUND = [
    group("b/s10:base", "body", 0.5),
    group("b/s2:base", "body", 0.0),
    group("b/s2:scan", "scan", 0.2),
    group("a/s2:joints", "joints", 0.3),
    group("a/s2:joint_1", "joints", 0.3),
    group("T1:rod", "target", 0.1),
    group("cad:lidar", "frame", 0.6),
    group("mesh:surface_3", "surface", 0.4),
]


def drawn(groups_found):
    """The chart of groups of a run of two recordings, a and b, with stops s2 and s10."""
    recording = SimpleNamespace(stops=["s2", "s10"])
    sources = [SimpleNamespace(recording=recording)] * 2
    diagnosis = {"groups": groups_found} if groups_found is not None else None
    evidence = SimpleNamespace(diagnosis=diagnosis, sources=sources, run=run_like())
    (chart,) = groups(evidence)
    return chart


def test_the_wild_group_stands_alone_above_the_line():
    chart = drawn([group("b/s2:base", "body", 7.0), *SOUND[:1], *SOUND[2:]])
    assert chart.title == "b/s2:base is 7.0 times further off than chance allows"
    (ax,) = chart.figure().axes
    names = [tick.get_text() for tick in ax.get_xticklabels()]
    assert names == ["a/s2", "b/s2", "b/s10", "T1", "cad", "surface"]
    rings = [line for line in ax.lines if line.get_markerfacecolor() == "none"]
    assert [(line.get_xdata()[0], line.get_ydata()[0]) for line in rings] == [(1, 7.0)]
    assert [text.get_text() for text in ax.texts] == ["b/s2:base"]
    by_name = {line.get_label(): line for line in ax.lines}
    assert sorted(by_name["base"].get_ydata()) == pytest.approx([0.5, 7.0])
    assert {"joints", "scan", "a single joint", "others"} <= by_name.keys()
    assert ax.get_ylim()[1] > 7.0


def test_where_nothing_is_wild_the_furthest_is_named():
    chart = drawn(SOUND)
    assert chart.title.startswith("Of 8 groups of rows none is further off than chance allows")
    assert "cad:lidar, at 0.6 of it" in chart.title
    assert not chart.figure().axes[0].texts


def test_of_many_wild_groups_the_worst_are_named():
    wild = [group(f"a/s{k}:base", "body", 2.0 + k) for k in range(9)]
    chart = drawn([*SOUND, *wild])
    assert chart.title.startswith("a/s8:base is 10.0 times") and "8 more stand out" in chart.title
    assert len(chart.figure().axes[0].texts) == 5


def test_without_a_diagnosis_or_groups_there_is_no_such_figure():
    assert "not diagnosed" in drawn(None).why
    assert "could contradict" in drawn([]).why
