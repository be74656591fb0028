"""The chain: every link with its estimate, its sigma, and how far it is from CAD; the effects."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from calib.forward import named
from calib.report import plots
from calib.report.chart import Absent, Chart
from calib.report.evidence import Evidence
from calib.report.numbers import give
from calib.results.outstanding import shown
from calib.rig import Rig
from calib.runs.estimates import VariableEstimate
from calib.runs.run import RING_NAME
from calib.show.tables import LISTED_PARAMETERS

if TYPE_CHECKING:
    from calib.report.plots import Axes, Figure

BEYOND_CAD = 3.0  # sigmas of CAD
SHIFT_PART, TURN_PART = slice(3, 6), slice(0, 3)
CHAIN_COLUMNS = (
    *("frame", "hangs from", "origin moved, mm", "its sigma, mm", "turned, mrad"),
    *("its sigma, mrad", "sigmas of CAD", "note"),
)


@dataclass(frozen=True)
class ChainLink:
    """A frame as the chain shows it.

    Args:
        name: of the frame.
        depth: how many links it hangs below the world.
        parent: what it hangs from; empty of the world.
        what: what ties it to its parent, where no estimate does.
        fitted: the estimate; None where the link was not estimated.
        cad_sigma: (6,) how sure CAD was; NaN where it says nothing, 0 where it is exact.
    """

    name: str
    depth: int
    parent: str = ""
    what: str = ""
    fitted: VariableEstimate | None = None
    cad_sigma: np.ndarray | None = None

    @property
    def moved(self) -> float | None:
        """The largest of the six moves, in sigmas of CAD."""
        if self.fitted is None or self.cad_sigma is None:
            return None
        z = np.abs(self.fitted.estimate) / np.where(self.cad_sigma > 0, self.cad_sigma, np.inf)
        return float(np.nanmax(z)) if np.isfinite(z).any() else None


def _links(evidence: Evidence, rig: Rig) -> list[ChainLink]:
    """The frames of one rig, parents before children, the arm drawn together."""
    fitted = {f.variable: f for f in evidence.estimates if f.parent is not None}
    own = {frame: fitted.get(named(frame, rig.name)) for frame in rig.frame_sigma}
    fitted |= {frame: f for frame, f in own.items() if f is not None}
    out = [
        ChainLink(
            rig.world, 0, what="the tracker's frame" if rig.tracker else "the reference's frame"
        )
    ]
    if rig.reference_frame in fitted and rig.reference_frame != rig.world:
        far = fitted[rig.reference_frame]
        what = "the scanned mesh and the targets"
        out.append(ChainLink(rig.reference_frame, 1, parent=rig.world, what=what, fitted=far))
    stands = f"stands elsewhere {BASE_MOVES[rig.moves]}"
    out.append(ChainLink(rig.tree.root, 1, parent=rig.world, what=stands))
    _children(rig, rig.tree.root, 2, fitted, evidence.prior_sigma, out)
    return out


BASE_MOVES = {"stop": "at every stop", "location": "at every location", "never": "at no stop"}


def _children(
    rig: Rig,
    parent: str,
    depth: int,
    fitted: dict[str, VariableEstimate],
    prior: dict[str, float],
    out: list[ChainLink],
) -> None:
    for tip in rig.tips if parent == rig.arm_base else ():
        what = f"the arm: {len(rig.joints_to(tip))} joints, from its URDF"
        out.append(ChainLink(tip, depth, parent=parent, what=what))
        _children(rig, tip, depth + 1, fitted, prior, out)
    for edge in rig.tree.edges:
        if edge.parent == parent and edge.name in rig.frame_sigma:
            mine = fitted.get(edge.child)
            held = mine is None or not mine.sigma.any()
            sigma = None
            if not held:
                names = (f"{mine.variable}.{dof}" for dof in mine.parameters)
                sigma = np.array([prior.get(n, 0.0) for n in names])
            out.append(
                ChainLink(
                    name=edge.child,
                    depth=depth,
                    parent=parent,
                    what="held as in CAD",
                    fitted=None if held else mine,
                    cad_sigma=sigma,
                )
            )
            _children(rig, edge.child, depth + 1, fitted, prior, out)


def chain(evidence: Evidence) -> Iterator[Chart | Absent]:
    """The chain as a diagram, one for each rig."""
    rigs = {source.rig.name: source.rig for source in evidence.sources}
    for i, rig in enumerate(rigs.values(), 1):
        links = _links(evidence, rig)
        moved = {link.name: link.moved for link in links if link.moved is not None}
        title = "No link of the chain was estimated against CAD"
        if moved:
            worst = max(moved, key=moved.get)
            count = sum(z > BEYOND_CAD for z in moved.values())
            title = (
                f"No link is more than {BEYOND_CAD:.0f} sigmas from CAD; the furthest is {worst}, "
                f"{moved[worst]:.1f} sigmas"
                if not count
                else f"{count} of {len(moved)} links lie more than {BEYOND_CAD:.0f} sigmas from "
                f"CAD: {worst} by {moved[worst]:.1f}"
            )
        yield Chart(
            "chain" if len(rigs) == 1 else f"chain-{i}",
            f"{rig.name}: {title}" if len(rigs) > 1 else title,
            "Every frame hangs from the one above it to the left. Beside it: how far its origin "
            "and its axes are from where CAD has them, with the 68 % uncertainty of the length, "
            "and the largest of the six moves in sigmas of CAD; orange from 3 on.",
            lambda links=links: _chain(links),
            wide=True,
        )


def _chain(links: Sequence[ChainLink]) -> Figure:
    figure, grid = plots.axes(plots.WIDE_IN, 0.7 + 0.34 * len(links))
    ax = grid[0, 0]
    ax.set_axis_off()
    ax.set_xlim(0, 100)
    ax.set_ylim(len(links) - 0.4, -1.1)
    for x, text in ((47, "origin moved, mm"), (66, "turned, mrad"), (84, "sigmas of CAD")):
        ax.text(x, -0.8, text, color="#555555", va="center")
    trunk: dict[int, int] = {}
    for row, link in enumerate(links):
        x = 1 + 4.5 * link.depth
        if link.depth:
            ax.plot([x - 3, x - 3, x], [trunk[link.depth - 1], row, row], color=plots.PALE, lw=1.2)
        trunk[link.depth] = row
        far = (link.moved or 0.0) > BEYOND_CAD
        box = {"boxstyle": "round,pad=0.35", "facecolor": "#f5f7fa", "edgecolor": "#777777"}
        if far:
            box |= {"edgecolor": plots.BEFORE, "linewidth": 1.6}
        ax.text(x, row, link.name, va="center", weight="bold", bbox=box)
        _estimate(ax, row, link, far)
    give(ax, CHAIN_COLUMNS, [_numbers(link) for link in links])
    return figure


def _numbers(link: ChainLink) -> list[str]:
    """A link as the CSV of the diagram has it, by `CHAIN_COLUMNS`."""
    fitted = link.fitted
    if fitted is None:
        return [link.name, link.parent, *[""] * 5, link.what]
    if np.isnan(fitted.estimate).any():  # CAD says nothing of it
        sizes = (1e3 * np.linalg.norm(fitted.sigma[part]) for part in (SHIFT_PART, TURN_PART))
        shift, turn = (f"{size:.5g}" for size in sizes)
        return [link.name, link.parent, "", shift, "", turn, "", link.what]
    told = (_length(fitted.estimate[part], fitted.sigma[part]) for part in (SHIFT_PART, TURN_PART))
    moved = "" if link.moved is None else f"{link.moved:.5g}"
    return [link.name, link.parent, *(f"{x:.5g}" for pair in told for x in pair), moved, ""]


def _estimate(ax: Axes, row: int, link: ChainLink, far: bool) -> None:
    if link.fitted is None or np.isnan(link.fitted.estimate).any():
        ax.text(47, row, link.what, va="center", style="italic", color="#555555")
        if link.fitted is not None:
            sizes = (
                1e3 * np.linalg.norm(link.fitted.sigma[part]) for part in (SHIFT_PART, TURN_PART)
            )
            text = "known to {:.2f} mm, {:.2f} mrad".format(*sizes)
            ax.text(84, row, text, va="center", fontsize=8, ha="left", color="#555555")
        return
    for x, part in ((47, SHIFT_PART), (66, TURN_PART)):
        length, sigma = _length(link.fitted.estimate[part], link.fitted.sigma[part])
        ax.text(x, row, f"{length:.2f} ± {sigma:.2f}", va="center")
    if link.moved is not None:
        ax.plot([84, 84 + min(link.moved, 8.0)], [row, row], lw=7, solid_capstyle="butt",
                color=plots.BEFORE if far else plots.AFTER)  # fmt: skip
        ax.text(85 + min(link.moved, 8.0), row, f"{link.moved:.1f}", va="center")


def _length(vector: np.ndarray, sigma: np.ndarray) -> tuple[float, float]:
    """Length of a vector and its sigma along itself, in thousandths."""
    length = float(np.linalg.norm(vector))
    along = vector / length if length > 0 else np.full(3, 1 / np.sqrt(3))
    return 1e3 * length, 1e3 * float(np.linalg.norm(along * sigma))


def moves(evidence: Evidence) -> Iterator[Chart | Absent]:
    """Every link's six numbers against CAD."""
    prior = evidence.prior_sigma
    rows = []
    for f in evidence.estimates:
        if f.parent is None or np.isnan(f.estimate).any():
            continue
        known = np.array([prior.get(f"{f.variable}.{dof}", 0.0) for dof in f.parameters])
        if known.any():
            rows.append((f, known))
    if not rows:
        yield Absent("moves", "no link was estimated against CAD")
        return
    told = sum(int(((f.sigma < 0.5 * known) & (known > 0)).sum()) for f, known in rows)
    free = sum(int((known > 0).sum()) for _, known in rows)
    yield Chart(
        "moves",
        f"The data halved the uncertainty, or better, of {told} of {free} numbers of the links",
        "A dot per axis of each link: how far from CAD, in sigmas of CAD, with its 95 % interval. "
        "The grey band is what CAD allows (95 %). An interval as wide as the band is "
        "prior-dominated: the data add nothing to CAD.",
        lambda: _moves(rows),
        wide=True,
        quiet=True,
    )


def _moves(rows: Sequence[tuple[VariableEstimate, np.ndarray]]) -> Figure:
    figure, grid = plots.axes(plots.WIDE_IN, 0.8 + 0.5 * len(rows), 1, 2, sharey=True, sharex=True)
    names, shades = [f.variable for f, _ in rows], (plots.AFTER, plots.LINES[4], plots.FLOOR)
    for ax, part, what in zip(grid[0], (SHIFT_PART, TURN_PART), ("origin", "axes"), strict=True):
        ax.axvspan(-1.96, 1.96, color="#eeeeee", zorder=0)
        ax.axvline(0, color=plots.PALE, linewidth=1)
        for k, axis in enumerate("xyz"):
            at = [(r, f.estimate[part][k] / s[part][k], f.sigma[part][k] / s[part][k])
                  for r, (f, s) in enumerate(rows) if s[part][k] > 0]  # fmt: skip
            if at:
                y, z, sigma = np.array(at).T
                ax.errorbar(z, y + 0.22 * (k - 1), xerr=1.96 * sigma, fmt="o", ms=4, lw=1.2,
                            color=shades[k], label=axis)  # fmt: skip
        ax.set_xlabel(f"{what}: moved from CAD, sigmas of CAD")
    grid[0, 0].set_yticks(range(len(rows)), names)
    grid[0, 0].set_ylim(len(rows) - 0.5, -0.5)
    handles, labels = grid[0, 0].get_legend_handles_labels()
    if handles:
        figure.legend(handles, labels, loc="outside upper left", ncols=3)
    return figure


def effects(evidence: Evidence) -> Iterator[Chart | Absent]:
    """Effects of few parameters as dots, of many as curves; per-ring corrections are of these."""
    drawn = [f for f in evidence.estimates if f.parent is None and (f.sigma > 0).any()]
    few = [f for f in drawn if len(f.parameters) <= LISTED_PARAMETERS]
    many = [f for f in drawn if len(f.parameters) > LISTED_PARAMETERS]
    if few:
        z = {
            f"{f.variable}.{p}": abs(e / s)
            for f in few
            for p, e, s in zip(f.parameters, f.estimate, f.sigma, strict=True)
            if s > 0
        }
        clear = sum(v > BEYOND_CAD for v in z.values())
        yield Chart(
            "effects",
            f"{clear} of {len(z)} parameters of effects differ clearly from zero; the clearest is "
            f"{max(z, key=z.get)}",
            "A panel per effect, a dot per parameter with its 95 % interval. Zero is the nominal "
            "value; instruments are corrected by taking the effect off, geometry by adding it.",
            lambda: _few(few),
            quiet=True,
        )
    else:
        yield Absent("effects", "the model has no effect of few parameters")
    per_ring = [f for f in many if _per_ring(f)]
    for i, f in enumerate(per_ring, 1):
        yield _rings_chart(f, "rings" if len(per_ring) == 1 else f"rings-{i}")
    if not per_ring:
        yield Absent("rings", "the model has no correction per ring")
    for i, f in enumerate((f for f in many if not _per_ring(f)), 1):
        yield _many_chart(f, f"parameters-{i}")


def _per_ring(fitted: VariableEstimate) -> bool:
    return all(map(RING_NAME.fullmatch, fitted.parameters))


def _rings_chart(fitted: VariableEstimate, name: str) -> Chart:
    return Chart(
        name,
        f"{fitted.variable}: rings differ by {_spread(fitted)}",
        "The estimate of each ring with its 95 % band. Where the band holds zero, no correction is "
        "called for; elsewhere subtract the value from the ring's ranges.",
        lambda: _curve(fitted, "ring"),
    )


def _many_chart(fitted: VariableEstimate, name: str) -> Chart:
    return Chart(
        name,
        f"{fitted.variable}: its parameters differ by {_spread(fitted)}",
        "The estimate of each parameter, in the order of solution.yaml, with its 95 % band; zero "
        "is the nominal value.",
        lambda: _curve(fitted, "parameter"),
        quiet=True,
    )


def _spread(fitted: VariableEstimate) -> str:
    scale, unit = shown(fitted.units[0])
    values = scale * fitted.estimate[fitted.sigma > 0]
    sigma = scale * np.median(fitted.sigma[fitted.sigma > 0])
    ends = f"from {values.min():+.2f} to {values.max():+.2f}"
    return f"{values.std():.2f} {unit} rms, {ends}, known to {sigma:.2f}"


def _curve(fitted: VariableEstimate, along: str) -> Figure:
    figure, grid = plots.axes(plots.HALF_IN, 2.7)
    ax, (scale, unit) = grid[0, 0], shown(fitted.units[0])
    x = np.arange(len(fitted.parameters))
    value, half = scale * fitted.estimate, 1.96 * scale * fitted.sigma
    plots.band(ax, x, value, half, plots.AFTER)
    ax.plot(x, value, ".-", ms=4, lw=1, color=plots.AFTER)
    ax.axhline(0, color=plots.PALE, linewidth=1)
    ax.set_xlabel(along)
    ax.set_ylabel(f"{fitted.variable}, {unit}".rstrip(", "))
    return figure


def _few(drawn: Sequence[VariableEstimate]) -> Figure:
    count = sum(int((f.sigma > 0).sum()) for f in drawn)
    heights = [max(1, int((f.sigma > 0).sum())) for f in drawn]
    figure, grid = plots.axes(
        plots.HALF_IN, 0.6 * len(drawn) + 0.22 * count, len(drawn), height_ratios=heights
    )
    for ax, f in zip(grid[:, 0], drawn, strict=True):
        free = f.sigma > 0
        scale = np.array([shown(u)[0] for u in f.units])[free]
        units = list(dict.fromkeys(shown(u)[1] for u in f.units))
        names = [p for p, is_free in zip(f.parameters, free, strict=True) if is_free]
        y = np.arange(len(names))
        ax.errorbar(scale * f.estimate[free], y, xerr=1.96 * scale * f.sigma[free], fmt="o", ms=4,
                    color=plots.AFTER)  # fmt: skip
        ax.axvline(0, color=plots.PALE, linewidth=1)
        ax.set_yticks(y, names)
        ax.set_ylim(len(names) - 0.4, -0.6)
        ax.set_title(f"{f.variable}, {' and '.join(units)}".rstrip(", "))
    return figure
