"""False alarms, intervals and p-values of nulls, counted.

A false alarm is a verdict other than adequate, or a name. What truly is there may be named: where
stops scatter, or the tracker, joints, targets or the mesh are worse than on paper, an effect whose
name ends in ``_scatter``; where a wall is warped, a surface of the mesh. These cases have a column
of their own.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from fnmatch import fnmatch
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table
from scipy import stats

Result = dict[str, Any]
NO_ANSWER = ("refused", "endless", "fault", "not converged")
CALM = ("adequate", "too few stops")
# Family -> what may be named there.
THERE = {
    "scatter-*": ("*_scatter",),
    "tracker": ("*_scatter",),
    "joints": ("*_scatter",),
    "spheres": ("*_scatter",),
    "mount": ("*_scatter",),
    "mesh": ("*_scatter",),
    "warped": ("mesh:*", "moved_surface", "*_scatter"),
}
SHARES = (0.50, 0.90, 0.95)
KINDS = ("links", "zeros", "rings", "alignment", "frames")
SIZE = 0.05
GOAL, GOAL_OF_FAMILY = 0.05, 0.08
# The worlds' noise grows by a law of its own, so these find what is there; and a spread, which lies
# on the edge of what it may be where there is none, has p-values of 1 as well.
TRUE_EFFECTS = ("noise_*", "*_scatter")


def class_of(result: Result) -> str:
    """ "alarm", "named what is there", "no answer", "too few stops" or "calm"."""
    if result["outcome"] in NO_ANSWER:
        return "no answer"
    named = [*result["blunders"], *result["names"]]
    if result["outcome"] in CALM and not named:
        return "calm" if result["outcome"] == "adequate" else result["outcome"]
    may = [p for family, some in THERE.items() if fnmatch(result["family"], family) for p in some]
    if named and all(any(fnmatch(name, pattern) for pattern in may) for name in named):
        return "named what is there"
    return "alarm"


def interval(count: int, cases: int) -> tuple[float, float]:
    """The 95 % interval of a share, by Clopper and Pearson (1934)."""
    found = stats.binomtest(count, cases).proportion_ci(method="exact")
    return float(found.low), float(found.high)


def covered(
    results: Iterable[Result], kind: str, of: str = "z"
) -> tuple[int, list[float], list[float]]:
    """How many intervals of a kind there are, the shares that hold the truth, and these shares'
    standard errors, rigs taken as clusters; for each of `SHARES`. Of the fit; or, as "z_added", of
    the one with all that was named."""
    each = [np.array(r.get(of, r["z"]).get(kind, [])) for r in results]
    each = [z for z in each if len(z)]
    count = sum(map(len, each))
    if not count:
        return 0, [], []
    held, spread = [], []
    for share in SHARES:
        hits = [(np.abs(z) <= stats.norm.isf((1 - share) / 2)).sum() for z in each]
        mean = sum(hits) / count
        off = np.array([h - mean * len(z) for h, z in zip(hits, each, strict=True)])
        held.append(mean)
        spread.append(float(np.sqrt(np.sum(off**2)) / count))
    return count, held, spread


def p_values(result: Result) -> list[float]:
    """Of effects that are not there, in the order of their names."""
    kept = (n for n in sorted(result["p"]) if not any(fnmatch(n, t) for t in TRUE_EFFECTS))
    return [result["p"][name] for name in kept if result["p"][name] is not None]


def one_each(results: Sequence[Result]) -> list[float]:
    """One p-value of each case, of one effect after another: those of a case depend on each other,
    and a test of uniformity needs independent ones."""
    listed = [p for p in map(p_values, results) if p]
    return [p[7 * k % len(p)] for k, p in enumerate(listed)]


def show(results: Sequence[Result], console: Console | None = None) -> None:
    """Print all tables, and every case that is not calm."""
    console = console or Console(width=150)
    good = [r for r in results if "error" not in r]
    console.print(_alarms(good))
    console.print(_intervals(good, "z", "of the fit"))
    console.print(_intervals(good, "z_added", "once what was named is added"))
    console.print(_p_values(good))
    for r in (r for r in good if class_of(r) not in ("calm", "too few stops")):
        named = ", ".join([*r["blunders"], *r["names"]]) or "no name"
        console.print(
            f"{class_of(r)}: {r['case']} {r['lidar']}: {r['outcome']}: {named}", markup=False
        )
    for r in (r for r in results if "error" in r):
        console.print(f"FAILED: {r['case']}: {r['error'].splitlines()[-1]}", markup=False)


def _rows(results: Sequence[Result]) -> Iterable[tuple[str, list[Result]]]:
    """Each family, then all."""
    for family in dict.fromkeys(r["family"] for r in results):
        yield family, [r for r in results if r["family"] == family]
    if results:
        yield "all", list(results)


def _table(title: str, *head: str) -> Table:
    out = Table(title=title, box=None, header_style="bold", title_justify="left")
    for name in head:
        out.add_column(name, no_wrap=True)
    return out


def _alarms(results: Sequence[Result]) -> Table:
    classes = ("named what is there", "too few stops", "no answer")
    title = f"false alarms; goal {GOAL:.0%} of all, {GOAL_OF_FAMILY:.0%} of a family at most"
    verdicts = ("missing_effect", "unexplained_structure", "bad_data")
    head = ("cases", "alarms", "share", "95 % interval", *classes, *verdicts)
    out = _table(title, "family", *head)
    for family, each in _rows(results):
        count = Counter(map(class_of, each))
        of_alarms = Counter(r["outcome"] for r in each if class_of(r) == "alarm")
        answered = len(each) - count["no answer"]
        low, high = interval(count["alarm"], answered) if answered else (0.0, 1.0)
        share = f"{count['alarm'] / answered:.3f}" if answered else ""
        rest = [count[c] for c in classes] + [of_alarms[v] for v in verdicts]
        numbers = [str(n or ".") for n in rest]
        row = (str(len(each)), str(count["alarm"] or "."), share, f"{low:.3f} to {high:.3f}")
        out.add_row(family, *row, *numbers)
    return out


def _intervals(results: Sequence[Result], of: str, what: str) -> Table:
    title = f"intervals that hold the truth, {what}; ± of rigs; nominal 50, 90, 95 %"
    out = _table(title, "family", *KINDS)
    for family, each in _rows(results):
        out.add_row(family, *(_shares(*covered(each, kind, of)) for kind in KINDS))
    return out


def _shares(count: int, held: Sequence[float], spread: Sequence[float]) -> str:
    if not count:
        return ""
    shown = " ".join(f"{100 * share:.0f}" for share in held)
    return f"{shown} ±{100 * spread[-1]:.0f} of {count}"


def _p_values(results: Sequence[Result]) -> Table:
    title = "p-values of effects that are not there"
    head = ("p-values", f"share below {SIZE}", "distance from uniform", "p of it, one of each case")
    out = _table(title, "family", *head)
    for family, each in _rows(results):
        every = np.concatenate([[], *map(p_values, each)])
        if len(every):
            below = f"{np.mean(every < SIZE):.3f} ± {_clustered(each, lambda p: p < SIZE):.3f}"
            distance = f"{stats.kstest(every, 'uniform').statistic:.3f}"
            alone = stats.kstest(one_each(each), "uniform").pvalue
            out.add_row(family, str(len(every)), below, distance, f"{alone:.3f}")
    return out


def _clustered(results: Sequence[Result], holds: Callable[[np.ndarray], np.ndarray]) -> float:
    """Standard error of a share of all p-values, cases taken as clusters."""
    each = [holds(np.array(p)) for p in map(p_values, results) if p]
    count = sum(map(len, each))
    mean = sum(map(np.sum, each)) / count
    return float(np.sqrt(sum((np.sum(x) - mean * len(x)) ** 2 for x in each)) / count)
