"""Parts of a report that need no run: the light, correlations, arrows."""

from pathlib import Path

import numpy as np
import pytest

from calib.report.charts.bodies import Arrows, magnification
from calib.report.charts.knowledge import tied
from calib.report.verdict import judge
from calib.results.solution import Solution
from calib.runs.run import Run


def test_correlations_are_those_of_the_covariance_and_large_effects_are_summed_up():
    names = ("a.x", "a.y", "b.z", *(f"rings.ring_{i:03}" for i in range(20)))
    covariance = np.eye(23)
    covariance[0, 1] = covariance[1, 0] = 0.9
    covariance[3:, 3:] += 1.0
    covariance[2, 3:] = covariance[3:, 2] = -0.7
    chosen, matrix = tied(
        Solution(shared=None, recordings={}, not_estimated=[], names=names, covariance=covariance),
        None,
    )
    assert chosen == ["a.x", "a.y", "b.z", "mean of rings"]
    assert matrix[0, 1] == pytest.approx(0.9)
    assert matrix[2, 3] == pytest.approx(-0.7 / np.sqrt(1 + 1 / 20))
    weak = {"weak_directions": [{"parameters": ["b.z"]}]}
    alone = tied(
        Solution(
            shared=None,
            recordings={},
            not_estimated=[],
            names=names[:3],
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
        ({}, found("unexplained_structure"), "amber", "structure"),
        ({}, found(sigma_mm=3.5), "amber", "a.x may still be off by 3.5 mm"),
        (rms(1.5), found(), "amber", "1.5 times the noise floor"),
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
        (rms(4.0), found(), "red", "4.0 times the noise floor"),
        ({"converged": False}, found(), "red", "not converged"),
        ({}, found("missing_effect"), "red", "worth adding"),
    ],
)
def test_the_light_follows_its_rule(changes, diagnosis, light, reason):
    verdict = judge(run_like(**changes), diagnosis)
    assert verdict.light == light
    assert any(reason in told for told in verdict.reasons)
