"""What may be missing, what hangs together, and what each part of the model contributes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from calib.problem.unknowns import Key
from calib.report import plots
from calib.report.budget import Budget
from calib.report.chart import Absent, Chart
from calib.report.evidence import Evidence
from calib.results.solution import Solution
from calib.show.tables import LISTED_PARAMETERS, small

if TYPE_CHECKING:
    from calib.report.plots import Figure

DRAWN_CANDIDATES = 10  # candidates that are drawn
TIED = 0.5  # correlation from which a parameter matters
MOST_PARAMETERS = 30  # parameters in the map
NEGLIGIBLE = 1e-6  # m: contributions below are not drawn


def findings(evidence: Evidence) -> Iterator[Chart | Absent]:
    """The leading candidates of the diagnosis and what each explains."""
    if evidence.diagnosis is None:
        yield Absent("findings", f"not diagnosed; 'rigcal diagnose {evidence.run.folder}' does it")
        return
    candidates = [c for c in evidence.diagnosis["candidates"] if c["unabsorbed_rms_mm"] is not None]
    if not candidates:
        yield Absent("findings", "the diagnosis tested no effect")
        return
    confirmed = [c["add"] for c in candidates if c["step"] and not c["dressed_up"]]
    yield Chart(
        "findings",
        f"Missing: {', '.join(confirmed)}"
        if confirmed
        else "No effect that was tested is confirmed",
        "How much each effect would explain of what the model does not absorb, as they rank, "
        "with its p-value adjusted for multiple testing. Blue: confirmed. Many of the others "
        "explain part of the same residuals as a confirmed one.",
        lambda: _findings(candidates[:DRAWN_CANDIDATES]),
        answer=True,
    )


def _findings(candidates: Sequence[dict[str, Any]]) -> Figure:
    figure, grid = plots.axes(plots.HALF_IN, 0.9 + 0.3 * len(candidates))
    ax = grid[0, 0]
    sizes = [c["unabsorbed_rms_mm"] for c in candidates]
    sure = [c["step"] and not c["dressed_up"] for c in candidates]
    bars = ax.barh([c["add"] for c in candidates], sizes, height=0.6,
                   color=[plots.AFTER if s else "#c9c9c9" for s in sure])  # fmt: skip
    ax.bar_label(bars, [f"p {small(c['p_adjusted'])}" for c in candidates], padding=3, fontsize=8)
    ax.invert_yaxis()
    ax.margins(x=0.22)
    ax.grid(False, axis="y")
    ax.locator_params(axis="x", nbins=5)
    ax.set_xlabel("would explain, mm rms")
    return figure


def budget(evidence: Evidence) -> Iterator[Chart | Absent]:
    """What each link and effect contributes to what is measured."""
    spent = evidence.budget
    what = "range" if evidence.has_beams else "tracked position"
    looked = f"{spent.rows} tracked positions"
    if evidence.has_beams:
        looked = f"{spent.rows} beams of {spent.stops} stops"
    moved = {n: v for n, v in spent.moved_m.items() if v > NEGLIGIBLE}
    if moved:
        most = max(moved, key=moved.get)
        told = f"What changed {what}s most is {most}: by {1e3 * moved[most]:.2f} mm rms"
    else:
        told = f"No estimate of a link or an effect changes a {what}"
    yield Chart(
        "budget",
        told,
        f"Left: by how much the estimate of each link or effect changed a {what} from its nominal "
        f"value. Right: how uncertain it leaves a {what}, all others held fixed. Correlated parts "
        f"count in each, so these may exceed the uncertainty of the whole. rms over {looked}.",
        lambda: _budget(spent, what),
        wide=True,
    )


def _budget(spent: Budget, what: str) -> Figure:
    sides = (spent.moved_m, spent.uncertain_m)
    names = [n for n in spent.uncertain_m if max(s.get(n, 0.0) for s in sides) > NEGLIGIBLE]
    figure, grid = plots.axes(plots.WIDE_IN, 1.0 + 0.3 * max(len(names), 1), 1, 2, sharey=True)
    labels = (f"changed the {what} by, mm rms", "leaves it uncertain by, mm rms")
    for ax, side, label, colour in zip(grid[0], sides, labels, (plots.LINES[5], plots.AFTER),
                                       strict=True):  # fmt: skip
        bars = ax.barh(names, [1e3 * side.get(n, 0.0) for n in names], height=0.6, color=colour)
        texts = [f"{1e3 * side[n]:.2f}" if n in side else "no CAD" for n in names]
        ax.bar_label(bars, texts, padding=3, fontsize=8)
        ax.grid(False, axis="y")
        ax.margins(x=0.15)
        ax.set_xlabel(label)
    grid[0, 0].invert_yaxis()
    return figure


def correlation(evidence: Evidence) -> Iterator[Chart | Absent]:
    """How the parameters that matter hang together."""
    names, matrix = tied(evidence.run.solution, evidence.diagnosis)
    if len(names) < 2:
        yield Absent("correlation", f"no two parameters are correlated by more than {TIED}")
        return
    off = np.abs(matrix - np.eye(len(names)))
    i, k = np.unravel_index(off.argmax(), off.shape)
    yield Chart(
        "correlation",
        f"{names[i]} and {names[k]} are the most correlated: {matrix[i, k]:+.3f}",
        f"Correlation of the estimates that are tied to another by more than {TIED}, or lie in a "
        f"weak direction: near +1 or -1 the data see only a sum or a difference of the two. Of an "
        f"effect with many parameters their mean stands for all.",
        lambda: _correlation(names, matrix),
        wide=True,
        quiet=True,
    )


def tied(solution: Solution, diagnosis: Any) -> tuple[list[str], np.ndarray]:
    """The parameters most tied to others (n,), and their correlations (n, n)."""
    names, A = _summarised(solution.keys, solution.units)
    covariance = A @ solution.covariance @ A.T
    sigma = np.sqrt(np.diag(covariance))
    known = np.flatnonzero(sigma > 0)
    matrix = (covariance / np.outer(sigma, sigma))[np.ix_(known, known)]
    names = [names[i] for i in known]
    strongest = np.abs(matrix - np.eye(len(names))).max(axis=1, initial=0.0)
    weak = {p for d in (diagnosis or {}).get("weak_directions", ()) for p in d["parameters"]}
    strength = [2.0 if n in weak else s for n, s in zip(names, strongest, strict=True)]
    chosen = [i for i in np.argsort(strength)[::-1][:MOST_PARAMETERS] if strength[i] > TIED]
    chosen = sorted(int(i) for i in chosen)
    return [names[i] for i in chosen], matrix[np.ix_(chosen, chosen)]


def _summarised(keys: Sequence[Key], units: Sequence[str]) -> tuple[list[str], np.ndarray]:
    """Names of parameters, those of large effects replaced by their mean where they have one unit,
    and what makes those of these."""
    owners: dict[str, list[int]] = {}
    for i, key in enumerate(keys):
        owners.setdefault(key.unknown, []).append(i)
    out, rows = [], []
    for owner, at in owners.items():
        if len(at) > LISTED_PARAMETERS and len({units[i] for i in at}) == 1:
            out.append(f"mean of {owner}")
            rows.append(np.isin(np.arange(len(keys)), at) / len(at))
        else:
            out += [keys[i].name for i in at]
            rows += [np.arange(len(keys)) == i for i in at]
    return out, np.array(rows, float)


def _correlation(names: Sequence[str], matrix: np.ndarray) -> Figure:
    side = min(plots.WIDE_IN, 2.6 + 0.2 * len(names))
    figure, grid = plots.axes(side + 0.4, side)
    ax, n = grid[0, 0], len(names)
    picture = plots.signed_map(ax, matrix[::-1], (-0.5, n - 0.5, -0.5, n - 0.5), 1.0)
    ax.set_yticks(range(n), names[::-1], fontsize=8)
    ax.set_xticks(range(n), names, rotation=90, fontsize=8)
    figure.colorbar(picture, ax=ax, shrink=0.7, label="correlation")
    return figure
