"""What an instrument says of a body at stops: the rows, weights and groups that all such share."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import ClassVar, NamedTuple, Self

import numpy as np

from calib.effects import Site, View
from calib.forward import BySite, Derivatives, Placed, Stops, Term, Values, stacked
from calib.residuals.groups import Group
from chains import se3

STEP = 1e-4  # m and rad, for the derivative of a basis; of a quadratic one it is exact


class Compared(NamedTuple):
    """Measured less predicted, in the rows' units.

    Args:
        rows: (K, n).
        by_twist: (K, n, 6) by the body's right increment.
        direct: variable -> (K, n, P), of what else is predicted with.
    """

    rows: np.ndarray
    by_twist: np.ndarray
    direct: Derivatives


@dataclass(frozen=True)
class ByPlace:
    """What an instrument adds to a body's pose by where that is, at K stops.

    The place is that of the model. What is measured errs, and an effect of it could explain its own
    errors: a tracker that scatters would have a scale.

    Args:
        terms: variable -> the effect as it stands in the model.
        view: what effects look at; the bodies as measured in its column ``tracked`` (K, B, 4, 4).
        number: of the body, among these.
    """

    terms: Mapping[str, Term]
    view: View
    number: int

    def bases(self, T_world_body: np.ndarray) -> dict[str, np.ndarray]:
        """Variable -> (K or 1, 6, P), of a body that is there (K, 4, 4), per unit."""
        tracked = self.view["tracked"].copy()
        tracked[:, self.number] = T_world_body
        view = replace(self.view, columns={**self.view.columns, "tracked": tracked})
        return {v: term.basis(view)[:, self.number] for v, term in self.terms.items()}

    def turned(self, T_world_body: np.ndarray, values: Values) -> np.ndarray:
        """Derivative (K, 6, 6) of what is added by the body's right increment."""
        out = np.zeros((len(T_world_body), 6, 6))
        there = {v: term for v, term in self.terms.items() if np.any(values[v])}
        for i, step in enumerate(STEP * np.eye(6) if there else ()):
            some = replace(self, terms=there)
            ends = (some.bases(T_world_body @ se3.exp(by)) for by in (step, -step))
            after, before = (sum(b @ values[v] for v, b in end.items()) for end in ends)
            out[:, :, i] = (after - before) / (2 * STEP)
        return out

    @classmethod
    def together(cls, some: Sequence[ByPlace]) -> ByPlace:
        """Of stops that share every variable, taken together."""
        first, views = some[0], [each.view for each in some]
        known = [n for n in first.view.columns if all(n in v.columns for v in views)]
        columns = {n: np.concatenate([v[n] for v in views]) for n in known}
        joints = np.concatenate([v.joints for v in views])
        view = View(first.view.rig, sum(v.rows for v in views), columns, joints)
        return cls(first.terms, view, first.number)


@dataclass(frozen=True, kw_only=True)
class SeenBody(ABC):
    """One body at K stops that share every variable, as an instrument has it.

    Rows of stops where the instrument said nothing are left out by the caller.

    Args:
        name: for messages.
        stops: the K stops.
        body: the body's frame.
        measured: (K, ...) what the instrument says.
        bases: variable -> (K or 1, 6, P), what the instrument adds to the body's pose, per unit.
        by_place: what it adds by where the body is; None for nothing.
        stop_names: (K,) recording and number of each stop: rows of one err together.
        groups: (K,) the names of those rows.
        weight: (K,) robust weight of each stop's rows, 0 where set aside; 1 where None.
    """

    name: str
    stops: Stops
    body: str
    measured: np.ndarray
    bases: Mapping[str, np.ndarray] = field(default_factory=dict)
    by_place: ByPlace | None = None
    stop_names: Sequence[tuple[Path, int]] = ()
    groups: tuple[Group, ...] = ()
    weight: np.ndarray | None = None

    kind: ClassVar[str]

    @property
    @abstractmethod
    def axes(self) -> tuple[str, ...]:
        """(n,) of the rows of a stop."""

    @property
    @abstractmethod
    def dofs(self) -> tuple[str, ...]:
        """(n,) what tables call these axes."""

    @property
    @abstractmethod
    def units(self) -> tuple[str, ...]:
        """(n,) of these rows."""

    @property
    @abstractmethod
    def sigma(self) -> np.ndarray:
        """(n,) of these rows, in their units."""

    @abstractmethod
    def compare(self, T_world_body: np.ndarray, values: Values) -> Compared:
        """Measured less predicted, of a body that is seen there (K, 4, 4)."""

    @abstractmethod
    def predicted(self, values: Values) -> np.ndarray:
        """What the instrument should say (K, ...)."""

    def turn(self, k: int) -> np.ndarray:
        """(n, n) from the rows' axes at a stop to those in which people are told an offset."""
        return np.eye(len(self.axes))

    @cached_property
    def variables(self) -> tuple[str, ...]:
        return (*self.stops.variables, *self.bases, *(self.by_place.terms if self.by_place else ()))

    @property
    def rows(self) -> int:
        return len(self.measured) * len(self.axes)

    def setting_aside(self, tokens: Collection[str]) -> Self:
        """The block with these stops' rows, and no others, set aside; see `Group.token`."""
        now = np.ones(len(self.groups)) if self.weight is None else self.weight
        gone = np.array([group.token in tokens for group in self.groups])
        weight = np.where(gone, 0.0, np.where(now > 0, now, 1.0))
        return replace(self, weight=None if (weight == 1.0).all() else weight)

    def as_predicted(self, values: Values, where: np.ndarray) -> Self:
        """The block with what the instrument should say at some of its stops, (K,) bool."""
        if not where.any():
            return self
        chosen = where.reshape(-1, *(1,) * (self.measured.ndim - 1))
        return replace(self, measured=np.where(chosen, self.predicted(values), self.measured))

    def seen(self, values: Values, derivatives: bool = False) -> Placed:
        """T_world_body as the instrument should see it, all that it adds included."""
        placed = self.stops.in_world(self.body, values, derivatives)
        of_place = self.by_place.bases(placed.T) if self.by_place else {}
        bases = {**self.bases, **of_place}
        if not bases:
            return placed
        added = sum(basis @ values[name] for name, basis in bases.items())
        d = placed.d
        if derivatives:
            back, by = se3.adjoint(se3.inverse(se3.exp(added))), se3.right_jacobian(added)
            if self.by_place:
                back = back + by @ self.by_place.turned(placed.T, values)
            d = d.then(back).at_site(Site.TRACKER, by, bases)
        return Placed(placed.T @ se3.exp(added), d)

    def evaluate(self, values: Values, derivatives: bool) -> tuple[np.ndarray, Derivatives | None]:
        """Whitened rows (K n,), stop by stop, and their derivatives (K n, P)."""
        rows, d = self.whitened(values, derivatives)
        if not derivatives:
            return rows.ravel(), None
        return rows.ravel(), {n: each.reshape(rows.size, -1) for n, each in d.items()}

    def whitened(self, values: Values, derivatives: bool) -> tuple[np.ndarray, BySite | None]:
        """Whitened rows (K, n), and their derivatives (K, n, P)."""
        seen = self.seen(values, derivatives)
        rows, by_twist, direct = self.compare(seen.T, values)
        weight = 1.0 / self.sigma
        if self.weight is not None:
            weight = weight * np.sqrt(self.weight)[:, None]
        if not derivatives:
            return rows * weight, None
        direct = {name: each * weight[..., None] for name, each in direct.items()}
        return rows * weight, seen.d.then(by_twist * weight[..., None]).beside(direct)


@dataclass(frozen=True)
class BodiesTogether:
    """Blocks of one body at single stops, evaluated in one go.

    Args:
        blocks: as they are in the problem.
        whole: all of them as one block, see `Stops.together`.
    """

    blocks: Sequence[SeenBody]
    whole: SeenBody

    @classmethod
    def of(cls, blocks: Sequence[SeenBody]) -> list[BodiesTogether]:
        """Blocks, grouped by what they share."""
        groups: dict[object, list[SeenBody]] = {}
        for block in blocks:
            own = block.stops.own
            shared = tuple(n for n in block.variables if n not in own)
            like = (block.kind, block.body, block.axes, id(block.stops.rig), len(block.measured))
            groups.setdefault((*like, shared, block.stops.noise is None), []).append(block)
        return [cls(found, _whole(found)) for found in groups.values()]

    def residuals(self, values: Values) -> Iterator[np.ndarray]:
        """Whitened rows (m,) of each block."""
        rows, _ = self.whole.whitened({**values, **self._at(values)}, False)
        return iter(rows.reshape(len(self.blocks), -1))

    def table(
        self, values: Values, names: Sequence[str]
    ) -> tuple[np.ndarray, np.ndarray, dict[str, slice]]:
        """Whitened rows (B, m) of the B blocks, their derivatives (B, m, N) by some of what the
        whole depends on, and which columns are whose; see `named`."""
        rows, d = self.whole.whitened({**values, **self._at(values)}, True)
        A, at = d.table(names)
        return rows.reshape(len(self.blocks), -1), A.reshape(len(self.blocks), -1, A.shape[2]), at

    def named(self, name: str) -> Sequence[str]:
        """What the unknown of the whole is called in each of the blocks; once, if all share it."""
        return self._own.get(name, (name,))

    def evaluate(self, values: Values) -> Iterator[tuple[np.ndarray, Derivatives]]:
        """Rows and derivatives of each block, as `SeenBody.evaluate` gives them."""
        rows, A, at = self.table(values, self.whole.variables)
        for k, block in enumerate(self.blocks):
            named = dict(zip(self.whole.stops.own, block.stops.own, strict=True))
            yield rows[k], {named.get(name, name): A[k][:, its] for name, its in at.items()}

    def in_world(self, values: Values) -> Iterator[np.ndarray]:
        """T_world_body (K, 4, 4) of each block, without what the instrument adds."""
        T = self.whole.stops.in_world(self.whole.body, {**values, **self._at(values)}, False).T
        return iter(T.reshape(len(self.blocks), -1, 4, 4))

    def _at(self, values: Values) -> dict[str, np.ndarray]:
        """Values of the blocks' own unknowns, as those of the whole."""
        counts = [len(block.measured) for block in self.blocks]
        return {
            name: np.repeat(np.stack([values[v] for v in names]), counts, axis=0)
            for name, names in self._own.items()
        }

    @cached_property
    def _own(self) -> dict[str, tuple[str, ...]]:
        """What each unknown of the whole that blocks have for themselves is called in them."""
        names = zip(*(block.stops.own for block in self.blocks), strict=True)
        return dict(zip(self.whole.stops.own, names, strict=True))


def evaluated(blocks: Sequence[SeenBody], values: Values) -> list[tuple[np.ndarray, Derivatives]]:
    """Whitened rows and derivatives of each of some blocks, in their order."""
    found = {
        id(block): each
        for together in BodiesTogether.of(blocks)
        for block, each in zip(together.blocks, together.evaluate(values), strict=True)
    }
    return [found[id(block)] for block in blocks]


def _whole(blocks: Sequence[SeenBody]) -> SeenBody:
    first = blocks[0]
    bases = stacked([b.bases for b in blocks], [len(b.measured) for b in blocks])
    weights = [np.ones(len(b.measured)) if b.weight is None else b.weight for b in blocks]
    return replace(
        first,
        stops=Stops.together([b.stops for b in blocks]),
        measured=np.concatenate([b.measured for b in blocks]),
        bases=bases,
        by_place=first.by_place and ByPlace.together([b.by_place for b in blocks]),
        weight=None if all(b.weight is None for b in blocks) else np.concatenate(weights),
    )
