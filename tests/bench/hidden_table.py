"""One table of scores against goals, and every case that missed."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np
from scipy import stats

from .hidden_baselines import NAMES
from .hidden_cases import TOGETHER, UNKNOWN

Result = dict[str, Any]
SINGLES = ("single-1mm", "single-half", "single-shot")
GOALS = {"single-1mm": 0.97, "single-half": 0.85, "single-shot": 0.98}
SEEN = 0.01  # p-value of the one true effect, below which the data show it
WITHIN = float(stats.norm.isf(0.025))  # sigmas of a 95 % interval


def family(name: str) -> str:
    """The name without a shape."""
    return name.partition("@")[0]


def group(step: dict[str, Any]) -> set[str]:
    """An effect named, and what cannot be told from it."""
    return {family(step["effect"]), *step["rivals"]}


def named(result: Result) -> bool:
    """Whether the hidden effect was named first, alone or in its group."""
    steps = result["steps"]
    first = result["verdict"] == "missing_effect" and bool(steps)
    return first and family(result["hidden"][0]) in group(steps[0])


def named_beyond_doubt(result: Result) -> bool:
    """Whether the hidden effect was named first, and it alone."""
    return named(result) and len(group(result["steps"][0])) == 1


def wrongly_named(result: Result) -> bool:
    """Whether another effect was named first, and the hidden one was not said to be a rival."""
    steps = result["steps"]
    return bool(steps) and not set(map(family, result["hidden"])) & group(steps[0])


def quiet(result: Result) -> bool:
    """Whether nothing else was found once the first was in."""
    return len(result["steps"]) == 1 and not result["unnamed"]


def seen(result: Result) -> bool:
    """Whether the oracle sees it: a test of the hidden effect alone, clusters free of its signal.

    The inflation is the one that candidates have in common once what was found is in the model.
    """
    wanted = family(result["hidden"][0])
    for name, _, _, _, statistic, dof in result["candidates"]:
        if family(name) == wanted:
            return _beyond_chance(statistic, dof, result["common"][-1])
    return False


def all_seen(result: Result) -> bool:
    """Whether the oracle sees each of several, those beside it being known."""
    return "beside" in result and all(_beyond_chance(*each) for each in result["beside"])


def any_wrong(result: Result) -> bool:
    """Whether any name is not hidden, and has no rival that is."""
    hidden = set(map(family, result["hidden"]))
    return any(not hidden & group(step) for step in result["steps"])


def _beyond_chance(statistic: float, dof: int, common: float) -> bool:
    return float(stats.chi2.sf(statistic / common, dof)) < SEEN


def all_named(result: Result) -> bool:
    """Whether each of several effects has a step of its own."""
    left = [group(step) for step in result["steps"]]
    for hidden in map(family, result["hidden"]):
        found = next((g for g in left if hidden in g), None)
        if found is None:
            return False
        left.remove(found)
    return True


def unexplained(result: Result) -> bool:
    """Whether what has no name was called so."""
    return result["verdict"] == "unexplained_structure"


def hangs(result: Result) -> bool:
    """Whether the covariates of what has no name come first, among one more at most."""
    wanted = UNKNOWN[result["hidden"][0]][0]
    first = set(result["unnamed"][0][0]) if result["unnamed"] else set()
    return unexplained(result) and wanted <= first and len(first) <= 2


def table(results: Sequence[Result]) -> str:
    """The table of all families that there are results of."""
    failed = [r for r in results if "error" in r]
    of = {r["family"]: [] for r in results}
    for r in results:
        if "error" not in r:
            of[r["family"]].append(r)
    lines = [("score", "cases", "value", "95 % interval", "goal")]
    lines += _null(of.get("null", []))
    for name in SINGLES:
        lines += _single(name, of.get(name, []))
    lines += _others(of)
    lines += _estimates([r for name in SINGLES for r in of.get(name, [])])
    lines += _baselines(of)
    widths = [max(len(line[i]) for line in lines) for i in range(5)]
    shown = ["  ".join(c.ljust(w) for c, w in zip(line, widths, strict=True)) for line in lines]
    out = [line.rstrip() for line in shown]
    out += ["", *misses(r for each in of.values() for r in each)]
    out += [f"{r['case']} failed: {r['error'].splitlines()[-1]}" for r in failed]
    return "\n".join(out)


def share(
    what: str, results: Sequence[Result], good: Callable[[Result], bool], goal: str
) -> list[tuple[str, ...]]:
    """A line: the share of cases of which something holds."""
    n = len(results)
    if not n:
        return []
    k = sum(map(good, results))
    low, high = stats.binomtest(k, n).proportion_ci(method="wilson")
    return [(what, str(n), f"{k / n:.3f}", f"{low:.2f} to {high:.2f}", goal)]


def _null(results: Sequence[Result]) -> list[tuple[str, ...]]:
    if not results:
        return []
    lines = share("null: adequate", results, lambda r: r["verdict"] == "adequate", ">= 0.95")
    lines += share("null: a named effect", results, lambda r: bool(r["steps"]), "<= 0.05")
    lines += share(
        "null: range_offset not identifiable",
        results,
        lambda r: r["untestable"].get("range_offset", "").startswith("not identifiable"),
        "1",
    )
    for key, what in (("candidates", "p of named"), ("structure", "p of structure")):
        smallest = [min(c[2] for c in r[key]) for r in results]
        own = _by_candidate(results, key)
        pooled = [p for ps in own.values() for p in ps]
        odd = [stats.kstest(ps, "uniform").pvalue < 0.05 for ps in own.values() if len(ps) > 9]
        n = str(len(results))
        lines += [
            (f"null: {what}, KS p of all", n, _ks(pooled), f"{_under(pooled)} below 0.05", ""),
            (f"null: {what}, smallest adjusted, KS p", n, _ks(smallest), "", "> 0.01"),
        ]
        if odd:
            value = f"{np.mean(odd):.3f}"
            lines.append((f"null: {what}, candidates with KS p < 0.05", n, value, "", "near 0.05"))
    return lines


def _by_candidate(results: Sequence[Result], key: str) -> dict[str, list[float]]:
    own: dict[str, list[float]] = {}
    for r in results:
        for name, p, *_ in r[key]:
            name = family(name) if isinstance(name, str) else ",".join(name)
            own.setdefault(name, []).append(p)
    return own


def _ks(values: Sequence[float]) -> str:
    return f"{stats.kstest(values, 'uniform').pvalue:.2g}"


def _under(values: Sequence[float]) -> str:
    return f"{np.mean(np.array(values) < 0.05):.3f}"


def _single(name: str, results: Sequence[Result]) -> list[tuple[str, ...]]:
    lines = share(f"{name}: named first", results, named, f">= {GOALS[name]:.2f}")
    lines += share(f"{name}: and without a rival", results, named_beyond_doubt, "")
    lines += share(f"{name}: nothing more found after it", results, quiet, "")
    lines += share(f"{name}: another named, and not as a rival", results, wrongly_named, "")
    lines += share(f"{name}: the data show it", results, seen, "")
    shown = [r for r in results if seen(r)]
    return lines + share(f"{name}: named first, where they do", shown, named, "")


def _others(of: dict[str, list[Result]]) -> list[tuple[str, ...]]:
    unknown, rival = of.get("unknown", []), of.get("rival", [])
    return [
        *share("unknown: unexplained_structure", unknown, unexplained, ">= 0.90"),
        *share("unknown: and right covariates first", unknown, hangs, ">= 0.90"),
        *_several("pair", of, ""),
        *_several("pair-shot", of, ">= 0.85"),
        *_several("triple-shot", of, ">= 0.85"),
        *share("rival: named, or in its group", rival, named, ""),
        *share("rival: a single wrong name", rival, wrongly_named, "<= 0.05"),
        *share("at the smallest detectable size: found", of.get("detectable", []), named, "0.8"),
    ]


def _several(name: str, of: dict[str, list[Result]], goal: str) -> list[tuple[str, ...]]:
    results = of.get(name, [])
    shown = [r for r in results if all_seen(r)]
    lines = share(f"{name}: all found", results, all_named, goal)
    lines += share(f"{name}: another named, and not as a rival", results, any_wrong, "")
    lines += share(f"{name}: the data show all", results, all_seen, "")
    return lines + share(f"{name}: all found, where they do", shown, all_named, "")


def _estimates(results: Sequence[Result]) -> list[tuple[str, ...]]:
    """Per sigma, how often the truth is within; every case counts alike."""
    lines = []
    for key, what in (("told", "the sigma told"), ("by_test", "the test's sigma")):
        off = [np.abs(e[key]) for r in results for e in r["estimates"] if e and e[key]]
        if off:
            value = np.mean([np.mean(z < WITHIN) for z in off])
            rms = np.sqrt(np.mean([np.mean(z**2) for z in off]))
            what = f"estimates within 95 % by {what}"
            row = (what, str(len(off)), f"{value:.3f}", f"rms {rms:.2f} sigma", "0.93 to 0.97")
            lines.append(row)
    return lines


def _baselines(of: dict[str, list[Result]]) -> list[tuple[str, ...]]:
    lines = []
    for name in NAMES:
        null = of.get("null", [])
        lines += share(f"{name}: null, alarm", null, lambda r, n=name: bool(r["baselines"][n]), "")
        for size in SINGLES:

            def first(r: Result, n: str = name) -> bool:
                return r["baselines"][n][:1] == [family(r["hidden"][0])]

            lines += share(f"{name}: {size}, named first", of.get(size, []), first, "")
    for size in SINGLES:
        lines += share(f"oracle: {size}, seen", of.get(size, []), seen, "")
    return lines


def misses(results: Iterable[Result]) -> list[str]:
    """A line for each case whose answer is wrong."""
    right = {
        "null": lambda r: r["verdict"] == "adequate",
        "unknown": hangs,
        **dict.fromkeys(TOGETHER, all_named),
        "rival": lambda r: not wrongly_named(r),
    }
    return [_miss(r) for r in results if not right.get(r["family"], named)(r)]


def _miss(r: Result) -> str:
    hidden = " + ".join(r["hidden"]) or "nothing"
    steps = "; ".join(
        f"{s['effect']} p {s['p']:.1g} {s['mm']:.2f} mm"
        + (f" (or {', '.join(s['rivals'])})" if s["rivals"] else "")
        for s in r["steps"]
    )
    bins = "; ".join(f"{','.join(names)} p {p:.1g}" for names, p in r["unnamed"][:2])
    true = [t for t in r["true"] if t]
    told = "; ".join(
        f"rank {t['rank']}, p {t['p']:.1g}, explains {t['explains_mm']:.2f} mm"
        + ("" if t["left_mm"] is None else f", {t['left_mm']:.2f} mm left by the fit")
        for t in true
    )
    where = f"{r['lidar']}, {r['room']}"
    return (
        f"{r['case']} ({where}) {hidden} [{told}]: {r['verdict']}: {steps or '-'} | {bins or '-'}"
    )
