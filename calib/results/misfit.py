"""Every row of trackers, targets and priors, and where among them the model does not fit.

A residual is smaller than its error where unknowns follow it. The redundancy of a row says how much
of an error of its own is left in its residual: ``1 - a C a^T``, with the row's whitened derivative
a and the covariance C of the unknowns (Baarda 1968). Over a group of rows the whitened residuals'
squares are then expected to add up to the sum of their redundancies.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from calib.effects import GEOMETRY, FrameOffset, Site
from calib.linear.layout import StopKey, key_of
from calib.problem.model import Source, recording_names
from calib.problem.unknowns import Role, Unknown
from calib.residuals.seen import evaluated
from calib.residuals.targets import TARGET_PARTS, HangingTarget
from calib.results.errors import Errors
from calib.solve.estimate import Estimate
from calib.solve.reweight import unweighted

# Mean redundancy of a group below which an error of its own cannot be seen in it (Foerstner 1987:
# below 0.01 observations are "not checkable").
UNCHECKED = 0.01
XYZ = ("x", "y", "z")
SEEN_BY = ("tracker", "level")  # instruments that see bodies at stops
# What says how the rig is built.
GEOMETRY_SITES = Site.EDGE, Site.ROOT, Site.JOINTS, Site.TARGET, Site.REFERENCE


@dataclass(frozen=True)
class InstrumentRows:
    """Rows of one kind as a table.

    Args:
        names: column -> (N,) text: what each row is of.
        unit: (N,) "m", "rad" or another.
        sigma: (N,) of each row, in its unit.
        whitened: (N,) residual over sigma.
        redundancy: (N,) 0 to 1; NaN where it was not computed.
    """

    names: Mapping[str, np.ndarray]
    unit: np.ndarray
    sigma: np.ndarray
    whitened: np.ndarray
    redundancy: np.ndarray

    def table(self) -> dict[str, np.ndarray]:
        """Columns (N,) as a run keeps them; ``residual`` is in the row's unit."""
        numbers = {"sigma": self.sigma, "whitened": self.whitened, "redundancy": self.redundancy}
        residual = {"residual": self.sigma * self.whitened, "unit": self.unit}
        return {**self.names, **residual, **numbers}

    def misfit(self, *by: str) -> dict[tuple[str, ...], float | None]:
        """Per group of equal names, how many times larger than expected its residuals are: the
        root of their squares' sum over that of their redundancies; None for what nothing checks."""
        groups, of = self._groups(by)
        squares, expected = np.bincount(of, np.square(self.whitened)), self.expected(*by)
        return {
            key: float(np.sqrt(square / expected[key])) if key in expected else None
            for key, square in zip(groups, squares, strict=True)
        }

    def expected(self, *by: str) -> dict[tuple[str, ...], float]:
        """Per group of equal names, the sum of its redundancies; without those that nothing
        checks."""
        groups, of = self._groups(by)
        sums = zip(groups, np.bincount(of, self.redundancy), np.bincount(of), strict=True)
        return {key: float(sum_) for key, sum_, count in sums if sum_ >= UNCHECKED * count}

    def _groups(self, by: Sequence[str]) -> tuple[list[tuple[str, ...]], np.ndarray]:
        """Groups of equal names, and the number (N,) of that of each row."""
        keys = list(zip(*(self.names[name].tolist() for name in by), strict=True))
        groups = list(dict.fromkeys(keys))
        number = {key: i for i, key in enumerate(groups)}
        return groups, np.array([number[key] for key in keys], int)


def seen_rows(estimate: Estimate, kind: str) -> InstrumentRows | None:
    """Rows of bodies as an instrument, "tracker" or "level", sees them: recording, stop, body, as
    `Group.what` has it, and axis; None where it sees none.

    The tracker's axes are those of the body as predicted, turn (rx, ry, rz) or shift (tx, ty, tz);
    a level's are two across what it felt.
    """
    names, out = _stop_names(estimate), _Gathered()
    bodies = [block for block in estimate.problem.seen if block.kind == kind]
    found = evaluated([unweighted(block) for block in bodies], estimate.values)
    variances = estimate.variances([d for _, d in found])
    for block, (residual, _), variance in zip(bodies, found, variances, strict=True):
        stops = [names[key] for key in block.stop_names]
        what = block.groups[0].what
        each = [(*stop, what, axis) for stop in stops for axis in block.dofs]
        sigma = np.tile(block.sigma, len(stops))
        out.add(each, block.units * len(stops), sigma, residual, 1.0 - variance)
    return out.rows(("recording", "stop", "body", "axis"))


def instrument_rows(estimate: Estimate) -> dict[str, InstrumentRows]:
    """Rows by kind, of those kinds that there are: "tracker", "level", "target" and "prior"."""
    found = {kind: seen_rows(estimate, kind) for kind in SEEN_BY}
    found |= {"target": target_rows(estimate), "prior": prior_rows(estimate)}
    return {kind: rows for kind, rows in found.items() if rows is not None}


def target_rows(estimate: Estimate) -> InstrumentRows | None:
    """Rows of targets: recording, target, part (its lower or upper marker, in the tracker's axes,
    or its sphere, in the reference's), axis; None where there are none."""
    blocks = [b for b in estimate.problem.blocks if isinstance(b, HangingTarget)]
    if not blocks:
        return None
    names = _target_names(estimate)
    whose = {id(block): names[block.marker] for block in blocks}
    out = _Gathered()
    for block, by, right in estimate.graph.linear_rows(estimate.values):
        if id(block) in whose:
            weight = block.weights
            root = np.sqrt(np.where(weight > 0, weight, np.inf))  # a part left out: 0
            (seen,), right = estimate.variances([by]), right / root
            left = np.where(np.isfinite(root), 1.0 - seen / np.square(root), 0.0)
            each = [(*whose[id(block)], part, axis) for part in TARGET_PARTS for axis in XYZ]
            out.add(each, ["m"] * block.rows, block.sigmas_m, -right, left)
    return out.rows(("recording", "target", "part", "axis"))


def prior_rows(estimate: Estimate) -> InstrumentRows | None:
    """Rows of what was known before: of every parameter of frames and effects, of what the encoders
    misreport at a stop, and of surfaces. Columns: recording and stop, empty where a parameter is
    not of one; unknown, parameter. The residual is the estimate less what was known."""
    owner, out = _owners(estimate), _Gathered()
    start = np.cumsum([0, *(v.dim for v in estimate.variables)])
    variance = np.diag(estimate.covariance)
    at = {v.name: variance[a : a + v.dim] for v, a in zip(estimate.variables, start, strict=False)}
    known = [u for u in estimate.problem.variables.values() if u.kind == "vector"]
    known = [u for u in known if u.role not in (Role.TARGET, Role.GRAVITY, Role.ZERO)]
    joints = [u for u in known if u.role is Role.JOINTS]
    variances = estimate.variances([{u.name: np.eye(u.dim)} for u in joints])
    at |= {u.name: seen for u, seen in zip(joints, variances, strict=True)}
    for unknown in known:
        seen = at.get(unknown.name, np.full(unknown.dim, np.nan))
        left = 1.0 - seen / np.square(unknown.sigma)
        each = [(*owner.get(unknown.name, ("", "")), unknown.name, dof) for dof in unknown.dofs]
        out.add(each, unknown.units, unknown.sigma, _moved(unknown, estimate), left)
    return out.rows(("recording", "stop", "unknown", "parameter"))


def misfit_by(
    estimate: Estimate,
    rows: Mapping[str, InstrumentRows],
    beams: Mapping[tuple[str, str], Errors],
) -> dict[str, Any]:
    """Where the model does not fit: by stop, body that is seen, target, and part of the geometry.

    Args:
        estimate: the solution.
        rows: its rows, by kind: "tracker", "level", "target" or "prior".
        beams: recording and stop -> errors of its beams.

    Returns:
        As summary.json holds it. ``stop``: stop -> ``tracker``, ``bodies`` (body or level ->
        number), ``joints``, ``beams``, those that it has; ``body`` and ``target``: name -> number.
        All of these say how many times larger than their sigmas allow the residuals are, about 1
        when all is well; null where nothing checks them. ``prior``: frame of CAD, or
        ``effect.parameter`` of geometry -> ``move_sigmas``, how many sigmas of CAD it moved;
        ``worst``, the parameter that moved furthest; its ``change`` and ``sigma``, in ``unit``.
        Of several recordings, a stop and a target bear the recording's name before theirs.
    """
    several = len(estimate.problem.sources) > 1

    def label(recording: str, name: str) -> str:
        return f"{recording}.{name}" if several else name

    stops: dict[str, dict[str, Any]] = {}
    if "tracker" in rows:
        for key, times in rows["tracker"].misfit("recording", "stop").items():
            stops[label(*key)] = {"tracker": times, "bodies": {}}
    for seen in _seen(rows):
        for (*key, body), times in seen.misfit("recording", "stop", "body").items():
            stops.setdefault(label(*key), {}).setdefault("bodies", {})[body] = times
    for key, times in _misfit(rows, "prior", "recording", "stop").items():
        if key[1]:
            stops.setdefault(label(*key), {})["joints"] = times
    for key, errors in beams.items():
        stops.setdefault(label(*key), {})["beams"] = errors.misfit
    bodies = {key: times for seen in _seen(rows) for key, times in seen.misfit("body").items()}
    targets = _misfit(rows, "target", "recording", "target")
    return {
        "stop": stops,
        "body": {body: times for (body,), times in bodies.items()},
        "target": {label(*key): times for key, times in targets.items()},
        "prior": dict(_moves(estimate)),
    }


def redundancies(rows: Mapping[str, InstrumentRows]) -> dict[str, list[float]]:
    """The redundancy of each group that `misfit_by` tells of, by kind: a body's name, "joints" or
    "target"; arguments as there."""
    found: dict[str, list[float]] = {}
    for seen in _seen(rows):
        for (*_, body), x in seen.expected("recording", "stop", "body").items():
            found.setdefault(body, []).append(x)
    if "prior" in rows:
        for (_, stop), x in rows["prior"].expected("recording", "stop").items():
            if stop:
                found.setdefault("joints", []).append(x)
    if "target" in rows:
        found["target"] = list(rows["target"].expected("recording", "target").values())
    return found


def _seen(rows: Mapping[str, InstrumentRows]) -> list[InstrumentRows]:
    """Those of bodies at stops."""
    return [rows[kind] for kind in SEEN_BY if kind in rows]


def _misfit(
    rows: Mapping[str, InstrumentRows], kind: str, *by: str
) -> dict[tuple[str, ...], float | None]:
    return rows[kind].misfit(*by) if kind in rows else {}


@dataclass
class _Gathered:
    """Rows, block by block."""

    keys: list[tuple[str, ...]] = field(default_factory=list)
    units: list[str] = field(default_factory=list)
    numbers: list[np.ndarray] = field(default_factory=list)

    def add(
        self,
        keys: Sequence[tuple[str, ...]],
        units: Sequence[str],
        sigma: np.ndarray,
        whitened: np.ndarray,
        redundancy: np.ndarray,
    ) -> None:
        self.keys += keys
        self.units += units
        self.numbers.append(np.stack([sigma, whitened, redundancy]))

    def rows(self, names: Sequence[str]) -> InstrumentRows | None:
        if not self.keys:
            return None
        columns = zip(names, zip(*self.keys, strict=True), strict=True)
        named = {name: np.array(column, np.str_) for name, column in columns}
        sigma, whitened, redundancy = np.hstack(self.numbers)
        return InstrumentRows(
            names=named,
            unit=np.array(self.units),
            sigma=sigma,
            whitened=whitened,
            redundancy=redundancy,
        )


def _stop_names(estimate: Estimate) -> dict[StopKey, tuple[str, str]]:
    """Recording and stop by name."""
    sources = estimate.problem.sources
    return {
        (source.recording.folder, k): (name, stop)
        for source, name in zip(sources, recording_names(sources), strict=True)
        for k, stop in enumerate(source.recording.stops)
    }


def _target_names(estimate: Estimate) -> dict[str, tuple[str, str]]:
    """Unknown of a target's marker -> recording and target by name."""
    sources = estimate.problem.sources
    several = len(sources) > 1
    return {
        f"{i}/target:{target}" if several else f"target:{target}": (name, target)
        for i, name in enumerate(recording_names(sources))
        for target in _names(sources[i])
    }


def _names(source: Source) -> Sequence[str]:
    targets = source.recording.targets
    return targets.names if targets else ()


def _owners(estimate: Estimate) -> dict[str, tuple[str, str]]:
    """Unknown of what encoders misreport -> the recording and stop that it is of."""
    names, problem = _stop_names(estimate), estimate.problem
    scans = [(scan.stops.noise, key_of(scan)) for scan in problem.scans]
    bodies = [(block.stops.noise, block.stop_names[0]) for block in problem.seen]
    return {noise: names[key] for noise, key in scans + bodies if noise is not None}


def _moved(unknown: Unknown, estimate: Estimate) -> np.ndarray:
    """How many of its sigmas each parameter moved from what was known before (dim,)."""
    return (estimate.values[unknown.name] - unknown.mean) / unknown.sigma


def _moves(estimate: Estimate) -> Iterator[tuple[str, dict[str, Any]]]:
    """How far frames as a whole, and parameters of geometry one by one, moved from paper."""
    terms = {t.variable: t.effect for terms in estimate.problem.terms for t in terms}
    for unknown in estimate.variables:
        effect = terms.get(unknown.name)
        if effect is None or effect.site not in GEOMETRY_SITES:
            continue
        moved = _moved(unknown, estimate)
        whole = isinstance(effect, FrameOffset)
        for i in [int(np.argmax(np.abs(moved)))] if whole else range(unknown.dim):
            yield (
                unknown.name if whole else f"{unknown.name}.{unknown.dofs[i]}",
                {
                    "move_sigmas": float(abs(moved[i])),
                    "worst": unknown.dofs[i],
                    "change": float(moved[i] * unknown.sigma[i]),
                    "sigma": float(unknown.sigma[i]),
                    "unit": unknown.units[i],
                    "drawn": effect.family in GEOMETRY,  # by the URDF
                },
            )
