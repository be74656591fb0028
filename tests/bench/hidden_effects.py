"""Does the diagnosis name what is hidden? Scored on simulated recordings, against the goals.

    python -m tests.bench.hidden_effects [--cases 100] [--only single-1mm,null] [-o FILE --resume]

Every case hides an effect, two or none in a small recording (six locations of five stops), fits the
default model, and asks the diagnosis. FILE gets a line of JSON per case as it is done; with
``--resume`` those that it holds are not run again. One table compares scores with goals.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
import traceback
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from calib import problem as problems
from calib.diagnosis.score import project, score_test
from calib.diagnosis.search import Search, search
from calib.diagnosis.search.confirmed import ALPHA_EFFECT
from calib.diagnosis.stand import Stand
from calib.diagnosis.suggest import hangs_on
from calib.diagnosis.verdict import conclude
from calib.effects import Effect
from calib.problem.model import Source
from calib.results.holdout import held_out
from calib.solve.fit import solve
from sensors.documents import plain

from .hidden_baselines import answers, silent
from .hidden_cases import FAMILIES, Case, Hidden, case, cases, record, written
from .hidden_table import table

LEFT_SIGMA = 0.5  # of a prior's sigma: a parameter known no better says nothing of its interval


def run(case: Case, baselines: bool = True) -> dict[str, Any]:
    """The case's recording, its diagnosis, and how that compares with the truth.

    Args:
        case: what to run.
        baselines: whether simpler ways are asked too.
    """
    with threadpool_limits(1), tempfile.TemporaryDirectory() as folder:
        start = time.perf_counter()
        if case.family == "detectable":
            source, truth, hidden = _at_the_limit(case, Path(folder))
        else:
            source, truth, hidden = record(case, Path(folder))
        ready = time.perf_counter()
        stand = fitted(source, case)
        fit = time.perf_counter()
        found = search(stand, silent)
        searched = time.perf_counter()
        result = {
            **_described(case, hidden, truth),
            **_said(found),
            "true": [_true(found, effect, truth) for effect in hidden.effects],
            "beside": _beside(stand, hidden.effects),
            "estimates": [_estimate(found, effect, truth) for effect in hidden.effects],
            "baselines": answers(found.looks[0]) if baselines else {},
        }
        seconds = np.diff([start, ready, fit, searched, time.perf_counter()]).round(2)
        return result | {"seconds": seconds.tolist()}


def fitted(source: Source, case: Case) -> Stand:
    """The case's model on its recording."""
    problem = problems.build([source], case.model)
    return Stand([source], case.model, problem, solve(problem))


def _at_the_limit(case: Case, folder: Path) -> tuple[Source, dict[str, Any], Hidden]:
    """A recording whose effect is as large as the one without it says it could just detect."""
    source, _, _ = written(case, folder, {})
    look = fitted(source, case).look(silent).named
    (name,) = case.hidden
    candidate = next(c for c in look.candidates if c.effect.family == name)
    alpha = -np.expm1(np.log1p(-ALPHA_EFFECT) / candidate.looks)
    size = candidate.test.smallest_detectable(look.common, alpha)
    sigma = [p.sigma for p in candidate.effect.params(source.rig) if p.sigma]
    return written(case, folder, {name: size / float(np.sqrt(np.mean(np.square(sigma))))})


def _described(case: Case, hidden: Hidden, truth: dict[str, Any]) -> dict[str, Any]:
    return {
        "case": case.name,
        "family": case.family,
        "seed": case.seed,
        "lidar": case.spec.lidar,
        "room": case.spec.room,
        "mesh_error_mm": 1e3 * case.spec.mesh_error_m,
        "hidden": [e.name for e in hidden.effects],
        "size_mm": [size * mm for size, mm in zip(hidden.texts.values(), hidden.mm, strict=False)],
        "sigmas": list(hidden.texts.values()),
    }


def _said(found: Search) -> dict[str, Any]:
    """What the diagnosis says, and the numbers behind it."""
    first = found.looks[0]
    stand = first.stand
    unseen = held_out(stand.sources, stand.model, "location", 2, silent, stand.estimate.start)
    rms_mm = dict.fromkeys(("held_out", "fit"), unseen.rms_mm)
    summary = {"misfit": {}, "rms_mm": {**rms_mm, "noise_floor": unseen.floor_mm}}
    said = conclude(found, {}, summary, ())
    named = first.named
    return {
        "verdict": said.verdict,
        "steps": [
            {
                "effect": step.effect.name,
                "p": step.p_adjusted,
                "mm": 1e3 * step.before.named.size_m(step.candidate),
                "rivals": [r.effect.family for r in step.rivals],
            }
            for step in found.found
        ],
        "unnamed": [[list(hangs_on(c.effect)), c.p_adjusted] for c in found.unnamed],
        "untestable": dict(said.untestable),
        "common": [look.named.common for look in found.looks],
        "candidates": [
            [c.effect.name, c.p_value, c.p_adjusted, c.evidence, c.test.statistic, c.test.dof]
            for c in named.candidates
        ],
        "structure": [
            [list(hangs_on(c.effect)), c.p_value, c.p_adjusted, c.evidence]
            for c in first.unnamed.candidates
        ],
        "rows": sum(len(a.part) for a in first.stand.estimate.associations),
        "passes": first.stand.estimate.iterations,
        "converged": first.stand.estimate.converged,
    }


def _true(found: Search, effect: Effect, truth: dict[str, Any]) -> dict[str, Any] | None:
    """How the hidden effect fared in the first look; None for one of no catalogue."""
    named = found.looks[0].named
    families = [c.effect.family for c in named.candidates]
    if effect.family not in families:
        return None
    place = families.index(effect.family)
    candidate = named.candidates[place]
    test = candidate.test
    theta = np.array(truth["effects"][effect.name])
    left = None
    if len(theta) == len(test.columns):
        block = named.scores.information[np.ix_(test.columns, test.columns)]
        left = 1e3 * float(np.sqrt(theta @ block @ theta / named.scores.weight_m2))
    return {
        "rank": place + 1,
        "p": candidate.p_value,
        "p_adjusted": candidate.p_adjusted,
        "left_mm": left,
        "explains_mm": 1e3 * named.rms_m(candidate),
        "inflation": test.inflation,
    }


def _beside(stand: Stand, effects: Sequence[Effect]) -> list[list[float]]:
    """Of several hidden effects, each one's statistic and directions, with all others in the model
    as they were hidden, and the inflation once all are; none of a single one."""
    if len(effects) < 2:
        return []
    out, common = [], stand.with_effects(effects, silent).look(silent).named.common
    for effect in effects:
        others = stand.with_effects([e for e in effects if e is not effect], silent)
        found = others.look(silent).named.candidates
        test = next((c.test for c in found if c.effect.family == effect.family), None)
        out.append([test.statistic, test.dof, common] if test else [0.0, 1, common])
    return out


def _estimate(found: Search, effect: Effect, truth: dict[str, Any]) -> dict[str, Any] | None:
    """Errors of the estimate, in the sigmas that are told and in those of its test, where the
    effect was named with its shape."""
    step = next((s for s in found.found if s.effect.name == effect.name), None)
    if step is None:
        return None
    stand = step.after.stand
    look = stand.look(silent)  # that of the step may have been left behind
    term = next(t for t in stand.problem.terms[0] if t.effect.name == effect.name)
    theta = np.array(truth["effects"][effect.name])[term.free]
    told, sigma = stand.sigma(effect), stand.problem.variables[term.variable].sigma
    by_test = score_test(project(look.linear, [term.variable]), np.arange(len(theta)))
    known = told < LEFT_SIGMA * sigma
    off = (stand.theta(effect) - theta)[known]
    return {
        "told": (off / told[known]).tolist(),
        "by_test": (off / by_test.sigma(look.named.common)[known]).tolist(),
    }


def main() -> None:
    """Run what is asked for, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cases", type=int, default=100, help="of each family")
    parser.add_argument("--first", type=int, default=0, help="number of the first of them")
    parser.add_argument("--only", help=f"families, with commas: {', '.join(FAMILIES)}")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("-o", dest="out", type=Path, help="a line of JSON per case is added here")
    parser.add_argument("--resume", action="store_true", help="keep what the file has")
    wanted = parser.parse_args()
    families = wanted.only.split(",") if wanted.only else list(FAMILIES)
    if unknown := set(families) - set(FAMILIES):
        parser.error(f"no such family: {', '.join(sorted(unknown))}")
    results = read(wanted.out) if wanted.resume and wanted.out else []
    done = {r["case"] for r in results}
    left = [c for c in cases(wanted.cases, families, wanted.first) if c.name not in done]
    if wanted.out and not wanted.resume:
        wanted.out.write_text("", encoding="utf-8")
    for result in finished(left, wanted.jobs):
        results.append(result)
        print(_line(result), flush=True)
        if wanted.out:
            with wanted.out.open("a", encoding="utf-8") as file:
                file.write(json.dumps(plain(result)) + "\n")
    print(table([r for r in results if r["family"] in families]))


def read(path: Path) -> list[dict[str, Any]]:
    """Results that a file holds; those of cases that failed are left out."""
    if not path.exists():
        return []
    lines = path.read_text(encoding="utf-8").splitlines()
    return [r for r in map(json.loads, lines) if "error" not in r]


def finished(wanted: Sequence[Case], jobs: int) -> Iterator[dict[str, Any]]:
    """Results as they come."""
    if jobs == 1:
        yield from map(_guarded, [(c.family, c.number) for c in wanted])
        return
    with ProcessPoolExecutor(jobs) as pool:
        yield from pool.map(_guarded, [(c.family, c.number) for c in wanted])


def _guarded(which: tuple[str, int]) -> dict[str, Any]:
    wanted = case(*which)
    try:
        return run(wanted)
    except Exception:
        error = traceback.format_exc()
        return {"case": wanted.name, "family": wanted.family, "error": error}


def _line(result: dict[str, Any]) -> str:
    if "error" in result:
        return f"{result['case']} failed:\n{result['error']}"
    named = ", ".join(s["effect"] for s in result["steps"]) or "-"
    hidden = ", ".join(result["hidden"]) or "nothing"
    seconds = "+".join(f"{s:.0f}" for s in result["seconds"])
    return f"{result['case']} {hidden}: {result['verdict']}, {named} ({seconds} s)"


if __name__ == "__main__":
    main()
