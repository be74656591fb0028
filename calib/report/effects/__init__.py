"""What an effect does, drawn over what it depends on: for the catalogue's pages."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from calib import outputs
from calib.effects import Effect
from calib.effects.base import OneHot, Param, View
from calib.report import plots
from calib.report.effects.errors import ShownError, errors
from calib.report.effects.views import MAP_CELLS, SPANS, Walk, grid_of, walk_of
from calib.rig import Rig, load_rig
from calib.show.scale import round_up
from calib.simulation import simulate
from chains.errors import InputError

if TYPE_CHECKING:
    from calib.report.plots import Figure

MOST_CURVES = 4
LEAST = 0.02  # of the largest error: one that is smaller is not drawn
LONG = 26  # letters, from which on a curve's name has a line of its own
TURNED = 12  # names along an axis, from which on they are turned


def effect_figure(effect: Effect, rig: Rig) -> Figure | None:
    """The error that an effect makes at its site, over what it depends on; None where it has
    nothing to act on, or depends on what cannot be drawn.

    Of few parameters each is drawn at its prior sigma. Where every ring, material or stop has one,
    a draw from their priors is. What moves a frame is drawn as how far the LiDAR moves and turns.

    Args:
        effect: of the catalogue, or a user's own.
        rig: on which it acts.
    """
    params = [param for param in effect.params(rig) if param.sigma > 0]
    if not params:
        return None
    with plots.styled():
        figure = _drawn(effect, rig)
        return None if figure is None else plots.with_plain_text(figure)


def example_rig() -> Rig:
    """The simulated rig on which the catalogue's pictures are drawn."""
    with tempfile.TemporaryDirectory() as made:
        simulate("tiny", Path(made) / "rec", 1, {})
        return load_rig(Path(made) / "rec")


def draw_effect(effect: Effect, out: Path | str) -> None:
    """Write `effect_figure` on the example rig to a file.

    Raises:
        InputError: there is no such picture, or the file cannot be written.
    """
    plots.check_format(out)
    with outputs.file(out) as file:
        figure = effect_figure(effect, example_rig())
        if figure is None:
            raise InputError(
                f"{effect.name} has no picture: the example rig has nothing that it acts on, or "
                "it depends on columns that only recordings have"
            )
        plots.save(figure, file)


def _drawn(effect: Effect, rig: Rig) -> Figure | None:
    if grid := grid_of(effect, rig):
        return _map(effect, rig, *grid)
    walk = walk_of(effect, rig)
    if walk is None:
        return _arrows(effect, rig) if not effect.covariates else None
    if effect.by_chance:
        effect = effect.among(walk.names)
    elif shapes := effect.shapes(walk.view):
        effect = effect.at(shapes[len(shapes) // 2])
    basis, params = effect.basis(walk.view), effect.params(rig)
    sigma = np.array([param.sigma for param in params])
    if effect.by_chance or isinstance(basis, OneHot):
        draw = sigma * np.random.default_rng(0).standard_normal(len(sigma))
        size = f"a draw, sd {' and '.join(dict.fromkeys(map(_amount, params)))}"
        parts = errors(effect, walk.view, basis, draw[:, None])
        return _figure(walk, parts, [size], dots=True)
    parts = errors(effect, walk.view, basis, np.diag(sigma))
    return _figure(walk, parts, [f"{param.name} = {_amount(param)}" for param in params])


def _amount(param: Param) -> str:
    return f"{param.sigma:g} {param.unit}".removesuffix(" 1")


def _figure(
    walk: Walk, parts: Sequence[ShownError], settings: Sequence[str], dots: bool = False
) -> Figure | None:
    """A panel for each unit, over one axis."""
    units: dict[str, list[ShownError]] = {}
    for part in parts:
        units.setdefault(f"{part.what if part.is_size else 'error'}, {part.unit}", []).append(part)
    panels = {name: curves for name, some in units.items() if (curves := _curves(some, settings))}
    if not panels:
        return None
    figure, grid = plots.axes(plots.HALF_IN, 1.0 + 1.6 * len(panels), len(panels), sharex=True)
    style = "o" if dots else "o-" if walk.names else "-"
    for ax, (name, curves) in zip(grid[:, 0], panels.items(), strict=True):
        for (label, y), colour in zip(curves, plots.LINES, strict=False):
            ax.plot(walk.x, y, style, ms=4, color=colour, label=label)
        ax.update_datalim([(walk.x[0], 0.0)])  # so that a constant is seen to be none
        ax.autoscale_view()
        ax.set_ylabel(name.removesuffix(", "))
        ncols = 2 if max(len(label) for label, _ in curves) <= LONG else 1
        ax.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=ncols)
    ax.set_xlabel(walk.label)
    if walk.names:
        turned = {"rotation": 45, "ha": "right"} if len(walk.names) > TURNED else {}
        ax.set_xticks(walk.x, walk.names, **turned)
    return figure


def _curves(parts: Sequence[ShownError], settings: Sequence[str]) -> list[tuple[str, np.ndarray]]:
    """What is drawn of errors in one unit: those that change most, or where none changes those that
    are largest; settings that do the same are one curve."""
    each = [(part.what, setting, part.values[:, k])
            for part in parts for k, setting in enumerate(settings)]  # fmt: skip
    spans = np.array([np.ptp(y) for _, _, y in each])
    sizes = np.array([np.abs(y).max() for _, _, y in each])
    changes = spans.max() > LEAST * sizes.max() and not parts[0].is_size
    measure = spans if changes else sizes
    curves: list[tuple[str, list[str], np.ndarray]] = []
    for (what, setting, y), size in zip(each, measure, strict=True):
        if not size > LEAST * measure.max():
            continue
        same = next((c for c in curves if c[0] == what and np.allclose(c[2], y, atol=1e-9)), None)
        if same:
            same[1].append(setting)
        else:
            curves.append((what, [setting], y))
    told = [(what, _together(some), y) for what, some, y in curves[:MOST_CURVES]]
    several = not parts[0].is_size
    return [(f"{what}: {some}" if several else some, y) for what, some, y in told]


def _together(settings: Sequence[str]) -> str:
    """Names that are set alike, and how."""
    names, amounts = zip(*(each.rpartition(" = ")[::2] for each in settings), strict=True)
    if len(set(amounts)) > 1 or not names[0]:
        return ", ".join(settings)
    told = names if len(names) <= 3 else (names[0], "…", names[-1])
    return f"{', '.join(told)} = {amounts[0]}"


def _map(effect: Effect, rig: Rig, view: View, names: Sequence[str]) -> Figure | None:
    """What each parameter does over two covariates."""
    params = effect.params(rig)
    basis = effect.basis(view)
    if isinstance(basis, OneHot):
        return None
    parts = errors(effect, view, basis, np.diag([param.sigma for param in params]))
    shown = [(part, param, part.values[:, k].reshape(MAP_CELLS, MAP_CELLS))
             for part in parts for k, param in enumerate(params)]  # fmt: skip
    shown = [each for each in shown if np.abs(each[2]).max() > 0][:MOST_CURVES]
    if not shown:
        return None
    spans = [SPANS[name] for name in names]
    edges = [t * np.linspace(low, high, MAP_CELLS + 1) for low, high, t, _ in spans]
    size = (plots.WIDE_IN, 3.0, 1, len(shown))
    figure, grid = plots.axes(*size, sharey=True)
    for ax, (part, param, values) in zip(grid[0], shown, strict=True):
        limit = round_up(float(np.quantile(np.abs(values), 0.95)))
        drawn = plots.signed_cells(ax, edges[0], edges[1], values.T, limit)
        figure.colorbar(drawn, ax=ax, extend="both", label=f"error, {part.unit}".rstrip(", "))
        ax.set(title=f"{part.what}: {param.name} = {_amount(param)}", xlabel=spans[0][3])
    grid[0, 0].set_ylabel(spans[1][3])
    return figure


def _arrows(effect: Effect, rig: Rig) -> Figure | None:
    """What each parameter does along x, y and z, of an effect that depends on nothing."""
    params = effect.params(rig)
    basis = effect.basis(View(rig, 1, {}, np.zeros((1, len(rig.joint_names)))))
    figure, grid = plots.axes(plots.HALF_IN, 2.4)
    ax, wide = grid[0, 0], 0.8 / len(params)
    for k, (param, colour) in enumerate(zip(params, plots.LINES, strict=False)):
        x = np.arange(3) + wide * (k - 0.5 * (len(params) - 1))
        values = 1e3 * param.sigma * basis[0, :, k]
        ax.bar(x, values, wide, color=colour, label=f"{param.name} = {_amount(param)}")
    ax.axhline(0, color=plots.PALE, linewidth=1)
    ax.set_xticks(range(3), [f"along {axis}" for axis in "xyz"])
    ax.set_ylabel("the sphere lies off, mm")
    ax.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=2)
    return figure
