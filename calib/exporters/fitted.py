"""A run's rigs as the fit has them: what is fixed geometry, what is fixed by ring, what is not.

What an effect does is asked of the effect itself: one whose basis is the same wherever the arm
stands and whatever the time bends an edge for good, and one whose basis knows a beam by its ring
alone shifts that ring for good. All others change from stop to stop, or from point to point.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from calib.effects import Effect, OneHot, Site, View
from calib.exporters.written import Unheld, Written, head
from calib.problem.model import owned
from calib.results.rings import harmful
from calib.results.solution import FrameEstimate, Part
from calib.rig import Rig
from calib.runs.reopen import effects_that_may_run, reopened
from calib.runs.run import Run
from chains import se3
from chains.errors import InputError

WHERE = {
    Site.BEAM: "the LiDAR's beams",
    Site.JOINTS: "the arm's joints",
    Site.EDGE: "links and frames",
    Site.ROOT: "where the rig stands",
    Site.TRACKER: "what the tracker says",
    Site.TARGET: "the targets",
    Site.REFERENCE: "the reference",
    Site.NOISE: "how much ranges scatter",
}
_ROUNDING = 1e-9  # relative, of a basis that is the same as another but for double precision
_PROBES = 16  # poses at which a basis must be the same to count as fixed


@dataclass(frozen=True)
class FittedRig:
    """One rig of a run, with what the fit found of it.

    Args:
        run: the run.
        rig: as on paper.
        part: what was estimated of it.
        effects: of the model, by name.
        several: whether the run has more rigs.
        closed: effects that are not known here, as their Python file may not run -> that sentence.
    """

    run: Run
    rig: Rig
    part: Part
    effects: Mapping[str, Effect]
    several: bool
    closed: Mapping[str, str] = field(default_factory=dict)

    def file(self, folder: Path, name: str) -> Path:
        """Where a file of this rig goes: ``arm.urdf``, or ``arm.<rig>.urdf`` of several rigs."""
        stem, dot, ending = name.partition(".")
        return folder / (f"{stem}.{self.rig.name}{dot}{ending}" if self.several else name)

    @cached_property
    def fixed(self) -> dict[str, np.ndarray]:
        """Effects that bend the rig alike at every stop: (E, 6) twists, or (J,) of joints."""
        shifts = {}
        for name, effect in self.effects.items():
            if effect.site in (Site.EDGE, Site.JOINTS):
                basis = _known(effect, self._view(_PROBES, {}))
                if basis is not None and not np.ptp(basis, axis=0).any():
                    shifts[name] = basis[0] @ self.part.effects[name].estimate
        return shifts

    @cached_property
    def ratios(self) -> dict[str, dict[str, float]]:
        """Of each effect by which joints that follow others go further, and no more than that: by
        how much, by joint, for each rad or m of the joint that is followed."""
        tree, view, out = self.rig.tree, self._view(_PROBES, {}), {}
        for name, effect in self.effects.items():
            basis = _known(effect, view) if effect.site is Site.EDGE else None
            if basis is None or name in self.fixed:
                continue
            left, rates = basis @ self.part.effects[name].estimate, {}
            size = np.abs(left).max()
            for edge in self.rig.followers:
                e = tree.edge_names.index(edge.name)
                q = view.joints[:, self.rig.joint_names.index(edge.joint.name)]
                rates[edge.name] = float(q @ left[:, e] @ edge.joint.along / (q @ q))
                left[:, e] -= rates[edge.name] * np.outer(q, edge.joint.along)
            if np.abs(left).max() <= _ROUNDING * size:
                out[name] = rates
        return out

    @property
    def mimics(self) -> dict[str, tuple[str, float, float]]:
        """Joints that follow others otherwise than drawn: which, and by what multiplier and offset
        of the URDF."""
        out = {}
        for name in dict.fromkeys(name for rates in self.ratios.values() for name in rates):
            joint = self.rig.edge(name).joint
            more = sum(rates.get(name, 0.0) for rates in self.ratios.values())
            out[name] = (joint.name, joint.factor + more, joint.shift)
        return out

    @cached_property
    def frames(self) -> dict[str, FrameEstimate]:
        """Every frame of rig.yaml and the worlds, as the fit has it, fixed effects included."""
        twists = self._sum(Site.EDGE, (len(self.rig.tree.edges), 6))
        frames = dict(self.part.frames)
        for edge, twist in zip(self.rig.tree.edges, twists, strict=True):
            if edge.name in frames and twist.any():
                frame = frames[edge.name]
                moved = se3.log(se3.inverse(edge.T_parent_child) @ frame.T_parent_child)
                T = edge.T_parent_child @ se3.exp(moved + twist)
                frames[edge.name] = FrameEstimate(frame.parent, T, frame.sigma_m, frame.sigma_rad)
        return frames

    @cached_property
    def origins(self) -> dict[str, np.ndarray]:
        """T_parent_child (4, 4) of the arm's URDF joints at a reported 0, as the fit has them.

        A joint's offset goes into its origin, as a motion is one about the same axis:
        ``origin exp(twist) exp(axis offset)``.
        """
        twists = self._sum(Site.EDGE, (len(self.rig.tree.edges), 6))
        offsets = self._sum(Site.JOINTS, (len(self.rig.joint_names),))
        origins = {}
        for edge, twist in zip(self.rig.tree.edges, twists, strict=True):
            if edge.name in self.rig.arm_edges:
                T = edge.T_parent_child @ se3.exp(twist)
                if edge.joint is not None:
                    turn = offsets[self.rig.joint_names.index(edge.joint.name)]
                    T = T @ se3.exp(turn * edge.joint.screw) @ edge.joint.unshifted
                origins[edge.name] = T
        return origins

    @property
    def odd_rings(self) -> Mapping[str, Any] | None:
        """How its rings are numbered otherwise than its LiDAR's model has them, as summary.json
        holds it; None where they are not."""
        found = self.run.summary.get("rings", ())
        return next((each for each in found if each["rig"] == self.rig.name), None)

    @property
    def channels(self) -> np.ndarray:
        """(R,) of every ring, as the recording counts, its row in the table of the LiDAR's model.

        Rings may be counted from the other end; the table's order is that of the maker's channels.
        """
        channels, odd = np.arange(self.rig.lidar.rings), self.odd_rings
        return channels[::-1] if odd and not harmful(odd["what"]) else channels

    @cached_property
    def by_ring(self) -> dict[str, np.ndarray]:
        """Effects that shift every ring for good: basis (R, 3, P), of range, azimuth, elevation."""
        if self.rig.lidar is None:
            return {}
        rings, bases = self.rig.lidar.rings, {}
        columns = {
            "ring": np.tile(np.arange(rings), 2),
            "elevation_rad": np.tile(self.rig.lidar.elevation_rad[self.channels], 2),
        }
        for name, effect in self.effects.items():
            if effect.site is Site.BEAM:
                basis = _known(effect, self._view(2 * rings, columns))
                if basis is not None and np.array_equal(basis[:rings], basis[rings:]):
                    bases[name] = basis[:rings]
        return bases

    def ring_errors(self) -> tuple[np.ndarray, np.ndarray]:
        """(R, 3) range m, azimuth and elevation rad of every ring, measured less true, and sigma.

        The sum of all effects by ring; sigma from their joint covariance. ValueError without any.
        """
        basis = np.concatenate(list(self.by_ring.values()), axis=-1)
        estimates = {name: self.part.effects[name] for name in self.by_ring}
        theta = np.concatenate([estimate.estimate for estimate in estimates.values()])
        names = [
            f"{self._variable(name)}.{parameter}"
            for name, estimate in estimates.items()
            for parameter in estimate.names
        ]
        at = {name: i for i, name in enumerate(self.run.solution.names)}
        free = [i for i, name in enumerate(names) if name in at]
        told = [at[names[i]] for i in free]
        covariance = self.run.solution.covariance[np.ix_(told, told)]
        J = basis[..., free]
        variance = np.einsum("rdi,ij,rdj->rd", J, covariance, J, optimize=True)
        return basis @ theta, np.sqrt(variance)

    def head(self, conventions: Iterable[str], not_held: Iterable[str]) -> list[str]:
        """The lines that explain a file of this rig to its reader."""
        return head(self.run, self.rig.name, conventions, not_held)

    def not_held(self, held: Iterable[str] = ()) -> list[str]:
        """A sentence for each effect of the rig that a format has no place for."""
        held, out = set(held), [f"{name}: {why}" for name, why in self.closed.items()]
        for name, effect in self.effects.items():
            if name not in held:
                what = f"{name}: an error of {WHERE[effect.site]}"
                if effect.covariates and name not in self.fixed and name not in self.by_ring:
                    what += f" that changes with {', '.join(effect.covariates)}"
                out.append(what)
        return out

    def _view(self, rows: int, columns: Mapping[str, np.ndarray]) -> View:
        """Rows at poses all over the place, of which an effect sees these columns only."""
        joints = np.random.default_rng(0).uniform(-np.pi, np.pi, (rows, len(self.rig.joint_names)))
        return View(self.rig, rows, columns, joints)

    def _sum(self, site: Site, shape: tuple[int, ...]) -> np.ndarray:
        values = (value for name, value in self.fixed.items() if self.effects[name].site is site)
        return sum(values, np.zeros(shape))

    def _variable(self, name: str) -> str:
        own = self.several and owned(self.effects[name], self.rig)
        return f"{self.rig.name}/{name}" if own else name


@dataclass(frozen=True)
class Fitted:
    """A run, and its rigs once they are asked for."""

    run: Run

    @cached_property
    def rigs(self) -> list[FittedRig]:
        """Every rig, from its recording; raises Unheld where one is gone or has changed."""
        try:
            return [self._rig(source.rig) for source in reopened(self.run)]
        except InputError as error:
            raise Unheld(str(error)) from None

    def _rig(self, rig: Rig) -> FittedRig:
        several = len(self.run.model["recordings"]) > 1
        part = self.run.solution.part(rig.name if several else None)
        known, why = effects_that_may_run(self.run)
        effects = {effect.name: effect for effect in known if effect.name in part.effects}
        closed = {name: why for name in part.effects if why and name not in effects}
        return FittedRig(
            run=self.run, rig=rig, part=part, effects=effects, several=several, closed=closed
        )


Format = Callable[[Fitted, Path], Written]


def for_every_rig(write: Callable[[FittedRig, Path], Written]) -> Format:
    """The format that writes files of its own for every rig of a run.

    A rig that has nothing for it is said; where none has, Unheld is raised.
    """

    def write_all(fitted: Fitted, folder: Path) -> Written:
        out, empty = Written(), []
        for rig in fitted.rigs:
            name = rig.rig.name
            try:
                written = write(rig, folder)
            except Unheld as error:
                empty.append(f"{name}: {error}" if rig.several else str(error))
                continue
            out.files.extend(written.files)
            before = f"{name}/" if rig.several else ""
            out.not_held.extend(before + sentence for sentence in written.not_held)
        if not out.files:
            raise Unheld("; ".join(empty))
        return Written(out.files, out.not_held + empty)

    return write_all


def _known(effect: Effect, view: View) -> np.ndarray | None:
    """An effect's basis (rows, ..., P) where it looks at nothing that the view lacks, else None."""
    try:
        basis = effect.basis(view)
    except (InputError, KeyError):
        return None
    if not isinstance(basis, OneHot):
        return np.broadcast_to(basis, (view.rows, *basis.shape[1:]))
    dense = np.zeros((view.rows, basis.values.shape[1], basis.size + 1))
    dense[np.arange(view.rows), :, basis.index] = basis.values  # index -1 is the spare column
    return dense[..., :-1]
