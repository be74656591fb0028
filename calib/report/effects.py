"""What an effect does, drawn over the covariate that it depends on: for the catalogue's pages."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from calib import outputs
from calib.effects import Effect, Site
from calib.effects.base import OneHot, Param, View
from calib.report import plots
from calib.rig import Rig, load_rig
from calib.simulation import simulate
from chains.errors import InputError

if TYPE_CHECKING:
    from calib.report.plots import Figure

# From where to where a covariate goes, by what its numbers are multiplied, and how it is written:
# a room, a day in it, and an arm's joint.
SPANS = {
    "range_m": (0.5, 12.0, 1.0, "range, m"),
    "incidence_rad": (0.0, 1.31, 180.0 / np.pi, "incidence, deg"),
    "intensity": (0.05, 3.0, 1.0, "intensity, of the median"),
    "elapsed_s": (0.0, 7200.0, 1.0 / 60.0, "time since the first stop, min"),
    "temperature_c": (10.0, 35.0, 1.0, "temperature, °C"),
    "azimuth_rad": (-np.pi, np.pi, 180.0 / np.pi, "azimuth, deg"),
    "elevation_rad": (-0.4, 0.4, 180.0 / np.pi, "elevation, deg"),
    "joints": (-np.pi, np.pi, 180.0 / np.pi, "angle of {}, deg"),
}
CURVE_POINTS = 400  # a choice: finer than a column of the page is drawn
MOST_CURVES = 4  # a choice: more hide each other
LEAST_ERROR = 0.02  # of the largest error: one that is smaller is not drawn
LIFTING_JOINT = 1  # the second, which lifts the arm: what gravity does shows at it
ERRORS_OF_SITES = {
    Site.BEAM: (("range", 1e3, "mm"), ("azimuth", 1e3, "mrad"), ("elevation", 1e3, "mrad")),
    Site.NOISE: (("log of sigma", 1.0, ""),),
}


def effect_figure(effect: Effect, rig: Rig) -> Figure | None:
    """The error that an effect makes at its site, each of its parameters at its prior sigma, over
    its covariate; None of an effect that does not act on beams or joints, or depends on nothing
    that can be drawn along one axis.

    Args:
        effect: of the catalogue, or a user's own.
        rig: on which it acts.
    """
    over = [name for name in effect.covariates if name in SPANS]
    if (
        effect.site not in (*ERRORS_OF_SITES, Site.JOINTS)
        or len(over) != 1
        or len(effect.covariates) != 1
    ):
        return None
    view = _view(rig, over[0])
    shapes = effect.shapes(view)
    if shapes:
        effect = effect.at(shapes[len(shapes) // 2])
    basis = effect.basis(view)
    params = effect.params(rig)
    if isinstance(basis, OneHot) or len(basis) != CURVE_POINTS or not params:
        return None
    error = basis * np.array([param.sigma for param in params])
    spans = np.ptp(error, axis=0)
    drawn = np.argwhere(spans > LEAST_ERROR * spans.max())[:MOST_CURVES]
    curves = [(part, params[k], error[:, part, k]) for part, k in drawn]
    return _figure(effect.site, rig, over[0], curves) if curves else None


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
                f"{effect.name} has no picture: it does not depend on one number alone"
            )
        plots.save(figure, file)


def _view(rig: Rig, name: str) -> View:
    """Rows along which one column goes from end to end, and the second joint with it."""
    low, high, _, _ = SPANS[name]
    column = np.linspace(low, high, CURVE_POINTS)
    joints = np.zeros((1, len(rig.joint_names)))
    if name == "joints":
        joints = np.zeros((CURVE_POINTS, len(rig.joint_names)))
        joints[:, LIFTING_JOINT] = column
    return View(rig, CURVE_POINTS, {name: column}, joints)


def _figure(
    site: Site, rig: Rig, name: str, curves: Sequence[tuple[int, Param, np.ndarray]]
) -> Figure:
    low, high, times, label = SPANS[name]
    with plots.styled():
        figure, grid = plots.axes(plots.HALF_IN, 2.6)
        ax, x = grid[0, 0], times * np.linspace(low, high, CURVE_POINTS)
        for (part, param, error), colour in zip(curves, plots.LINES, strict=False):
            what, scale, unit = _error(site, rig, part)
            amount = f"{param.sigma:g} {param.unit}".removesuffix(" 1")
            ax.plot(x, scale * error, color=colour, label=f"{what}: {param.name} = {amount}")
        ax.set_xlabel(label.format(rig.joint_names[LIFTING_JOINT]))
        ax.set_ylabel(f"error, {unit}" if unit else "error")
        figure.legend(loc="outside upper left", ncols=2)
        return plots.with_plain_text(figure)


def _error(site: Site, rig: Rig, part: int) -> tuple[str, float, str]:
    """What is in error, by what it is multiplied, and in which unit it then is."""
    if site is Site.JOINTS:
        turns = rig.joint_kinds[part] == "revolute"
        return rig.joint_names[part], 1e3, "mrad" if turns else "mm"
    return ERRORS_OF_SITES[site][part]
