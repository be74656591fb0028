"""The forward model: where every frame of the rig is, given the unknowns. The heart.

    reference <- world (tracker) <- root of the rig <- ... arm ... <- mount <- lidar

Each arrow that is known from CAD or URDF is a frame tree; the two that are not are poses. Effects
bend the tree at its edges and joints through their bases, so the derivative of any frame by any
unknown is the derivative by site times the basis.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from calib.effects import Effect, OneHot, Site, View
from calib.rig import Rig
from chains import se3
from chains.errors import NoColumnError

Values = Mapping[str, np.ndarray]
# Names of stops' own unknowns where several stops are taken together: a value for each stop.
ROOT, NOISE = "root of each", "noise of each"
Derivatives = Mapping[str, np.ndarray]


def named(name: str, rig: str) -> str:
    """Name of the unknown of a frame or an effect: that of the rig stands before it where it
    belongs to one of several rigs."""
    return f"{rig}/{name}" if rig else name


@dataclass(frozen=True)
class Term:
    """An effect as it stands in a model: its variable in the graph, and what of it is free."""

    effect: Effect
    variable: str
    free: np.ndarray  # (n,) indices into the effect's parameters
    rig: str = ""  # that it belongs to alone, as `named` has it

    def basis(self, view: View) -> np.ndarray | OneHot:
        """The effect's basis, of the free parameters only.

        Raises:
            NoColumnError: the effect looks at a column that there is not.
        """
        try:
            basis = self.effect.basis(view)
        except NoColumnError as error:
            if f"'{self.effect.name}'" in str(error):  # as formulas say
                raise
            said = f"effect '{self.effect.name}': {error}"
            raise NoColumnError(said, error.column) from None
        if not isinstance(basis, OneHot):
            return basis if len(self.free) == basis.shape[-1] else basis[..., self.free]
        column = np.full(basis.size + 1, -1)  # the last stands for index -1: none
        column[self.free] = np.arange(len(self.free))
        return OneHot(column[basis.index], basis.values, len(self.free))


class SitePart(NamedTuple):
    """What a variable moves at a site: which of the site's components (c,), and the basis
    (K or 1, c, n) by which it does."""

    site: Site
    components: np.ndarray
    basis: np.ndarray


@dataclass(frozen=True, eq=False)
class BySite(Mapping[str, np.ndarray]):
    """Derivatives (K, m, n) of what is at K stops by each variable: of the many that act at a few
    sites, the derivative by site times the basis, multiplied out when asked.

    Args:
        sites: site -> (K, m, C) derivative by its components.
        parts: variable -> what it moves there.
        direct: variable -> (K, m, n), of all others.
    """

    sites: Mapping[Site, np.ndarray]
    parts: Mapping[str, Sequence[SitePart]]
    direct: Mapping[str, np.ndarray]

    def __getitem__(self, name: str) -> np.ndarray:
        if name in self.direct:
            return self.direct[name]
        return sum(self.sites[p.site][:, :, p.components] @ p.basis for p in self.parts[name])

    def __contains__(self, name: object) -> bool:
        return name in self.parts or name in self.direct

    def __iter__(self) -> Iterator[str]:
        yield from self.parts
        yield from self.direct

    def __len__(self) -> int:
        return len(self.parts) + len(self.direct)

    def then(self, outer: np.ndarray) -> BySite:
        """Those of what depends on this by a derivative (K, m', m)."""
        sites, direct = (
            {name: outer @ d for name, d in some.items()} for some in (self.sites, self.direct)
        )
        return replace(self, sites=sites, direct=direct)

    def beside(self, direct: Derivatives) -> BySite:
        """Those by more variables (K, m, n) too."""
        return replace(self, direct={**self.direct, **direct})

    def at_site(self, site: Site, d: np.ndarray, bases: Mapping[str, np.ndarray]) -> BySite:
        """Those by variables that move all components of one more site, by bases (K or 1, C, n);
        its derivative is d (K, m, C)."""
        every = np.arange(d.shape[2])
        parts = {name: [SitePart(site, every, basis)] for name, basis in bases.items()}
        return replace(self, sites={**self.sites, site: d}, parts={**self.parts, **parts})

    def table(self, names: Iterable[str]) -> tuple[np.ndarray, dict[str, slice]]:
        """All derivatives (K, m, N) by some variables, and which columns are whose."""
        names = list(names)
        ends = np.cumsum([0, *(self._width(name) for name in names)]).tolist()
        at = {name: slice(*pair) for name, pair in zip(names, pairwise(ends), strict=True)}
        first = next(iter(self.sites.values()))
        out = np.empty((*first.shape[:2], ends[-1]))
        for name, columns in at.items():
            out[:, :, columns] = self[name]
        return out, at

    def _width(self, name: str) -> int:
        of = self.direct[name] if name in self.direct else self.parts[name][0].basis
        return of.shape[-1]


@dataclass(frozen=True)
class Placed:
    """A frame at K stops: T (K, 4, 4), and its right increment (K, 6, n) by each variable."""

    T: np.ndarray
    d: Derivatives

    def by(self, names: Iterable[str]) -> np.ndarray:
        """(K, 6, n) its right increment by all components of these variables, side by side."""
        some, count = (self.d[name] for name in names), len(self.T)
        return np.concatenate([np.broadcast_to(d, (count, *d.shape[1:])) for d in some], axis=2)


class RowsOf(Mapping[str, np.ndarray]):
    """Bases at some of the stops that they were computed for: rows are taken when asked.

    Args:
        whole: variable -> (K, ...) basis, or (1, ...) where it is the same at all stops.
        index: (k,) which of the stops.
    """

    def __init__(self, whole: Mapping[str, np.ndarray], index: np.ndarray) -> None:
        self.whole, self.index = whole, index

    def __getitem__(self, name: str) -> np.ndarray:
        basis = self.whole[name]
        return basis if len(basis) == 1 else basis[self.index]

    def __iter__(self) -> Iterator[str]:
        return iter(self.whole)

    def __len__(self) -> int:
        return len(self.whole)

    def __reduce__(self) -> tuple[type, tuple[dict[str, np.ndarray]]]:
        return dict, (dict(self),)  # what is sent elsewhere is these rows alone


def stacked(
    bases: Sequence[Mapping[str, np.ndarray]], counts: Sequence[int]
) -> dict[str, np.ndarray]:
    """The bases of sets of stops, so many in each, as those of all of them."""
    first = bases[0]
    if isinstance(first, RowsOf) and all(
        isinstance(each, RowsOf) and each.whole is first.whole for each in bases
    ):
        index = np.concatenate([each.index for each in bases])
        every = np.array_equal(index, np.arange(max(map(len, first.whole.values()), default=0)))
        return dict(first.whole if every else RowsOf(first.whole, index))
    each = {
        n: [np.broadcast_to(b[n], (k, *b[n].shape[1:])) for b, k in zip(bases, counts, strict=True)]
        for n in first
    }
    return {n: np.concatenate(parts) for n, parts in each.items()}


@dataclass(frozen=True)
class Stops:
    """The geometry of K stops that share every variable.

    Args:
        rig: the rig on paper.
        joints: (K, J) reported joints, rad or m.
        edge_bases: variable -> (K or 1, e, 6, P), the twists of the edges that it moves, per unit.
        edges: variable -> (e,) which of the E edges these are.
        joint_bases: variable -> (K or 1, j, P), the errors of the joints that it changes, per unit.
        axes: variable -> (j,) which of the J joints these are.
        root_bases: variable -> (K or 1, 6, P), the twists by which the root stands elsewhere.
        root: variable of T_world_root.
        reference: variable of T_world_reference, or None where both are one frame.
        noise: variable of the joint errors (J,) of these stops alone, or None.
    """

    rig: Rig
    joints: np.ndarray
    edge_bases: Mapping[str, np.ndarray]
    edges: Mapping[str, np.ndarray]
    joint_bases: Mapping[str, np.ndarray]
    axes: Mapping[str, np.ndarray]
    root_bases: Mapping[str, np.ndarray]
    root: str
    reference: str | None
    noise: str | None = None

    def with_joint_noise(self, variable: str) -> Stops:
        """The same stops, with what their encoders misreport as one more unknown."""
        return replace(self, noise=variable)

    @cached_property
    def variables(self) -> tuple[str, ...]:
        """What places the rig in the world."""
        return (self.root, *self.root_bases, *self.edge_bases, *self.joint_bases, *self.own[1:])

    @cached_property
    def own(self) -> tuple[str, ...]:
        """Of those, what each stop may have for itself: its root, and its joint errors."""
        return (self.root,) if self.noise is None else (self.root, self.noise)

    def some(self, index: np.ndarray, root: str) -> Stops:
        """Those of the stops, with their root."""
        return replace(
            self,
            joints=self.joints[index],
            edge_bases=RowsOf(self.edge_bases, index),
            joint_bases=RowsOf(self.joint_bases, index),
            root_bases=RowsOf(self.root_bases, index),
            root=root,
        )

    @classmethod
    def together(cls, stops: Sequence[Stops]) -> Stops:
        """Stops of one `place` that share all but their own unknowns, as one. Its own are called
        `ROOT` and `NOISE`, with values (K, 4, 4) and (K, J): one for each stop."""
        first, counts = stops[0], [len(s.joints) for s in stops]
        return cls(
            rig=first.rig,
            joints=np.concatenate([s.joints for s in stops]),
            edge_bases=stacked([s.edge_bases for s in stops], counts),
            edges=first.edges,
            joint_bases=stacked([s.joint_bases for s in stops], counts),
            axes=first.axes,
            root_bases=stacked([s.root_bases for s in stops], counts),
            root=ROOT,
            reference=first.reference,
            noise=None if first.noise is None else NOISE,
        )

    def at_edges(self, name: str, twists: np.ndarray) -> np.ndarray:
        """Twists (k, e, 6, ...) of the edges that an unknown moves, among those of all (k, E, ...),
        the others zero."""
        out = np.zeros((len(twists), len(self.rig.tree.edges), *twists.shape[2:]))
        out[:, self.edges[name]] = twists
        return out

    def in_root(self, frame: str, values: Values, derivatives: bool = True) -> Placed:
        """T_root_frame under all effects of edges and joints; here and below, without
        `derivatives` there are none."""
        joints, twists = self.joints, np.zeros((1, len(self.rig.tree.edges), 6))
        if self.noise is not None:
            joints = joints + values[self.noise]
        parts: dict[str, list[SitePart]] = {}
        for name, basis in self.edge_bases.items():
            twists = twists + self.at_edges(name, basis @ values[name])
            components = (6 * self.edges[name][:, None] + np.arange(6)).ravel()
            parts[name] = [SitePart(Site.EDGE, components, _flat(basis))]
        if self.joint_bases:
            joints = joints.copy()
        for name, basis in self.joint_bases.items():
            joints[:, self.axes[name]] += np.matvec(basis, values[name])
            parts.setdefault(name, []).append(SitePart(Site.JOINTS, self.axes[name], basis))
        if not derivatives:
            return Placed(self.rig.tree.transform(frame, joints, twists), {})
        placed = self.rig.tree.place(frame, joints, twists)
        by_edge = placed.d_twist.reshape(len(joints), 6, -1)
        sites = {Site.EDGE: by_edge, Site.JOINTS: placed.d_joint}
        own = {} if self.noise is None else {self.noise: placed.d_joint}
        return Placed(placed.Ts_root_frame, BySite(sites, parts, own))

    def from_stand(self, frame: str, values: Values, derivatives: bool = True) -> Placed:
        """T_stood_frame = exp(effects of the root) @ T_root_frame, from where the root stood."""
        inner = self.in_root(frame, values, derivatives)
        if not self.root_bases:
            return inner
        twists = sum(basis @ values[name] for name, basis in self.root_bases.items())
        T = se3.exp(twists) @ inner.T
        by = se3.adjoint(se3.inverse(inner.T)) @ se3.right_jacobian(twists)
        d = inner.d.at_site(Site.ROOT, by, self.root_bases) if derivatives else {}
        return Placed(T, d)

    def in_world(self, frame: str, values: Values, derivatives: bool = True) -> Placed:
        """T_world_frame = T_world_root @ T_stood_frame."""
        inner = self.from_stand(frame, values, derivatives)
        T = values[self.root] @ inner.T
        if not derivatives:
            return Placed(T, {})
        return Placed(T, inner.d.beside({self.root: se3.adjoint(se3.inverse(inner.T))}))

    def in_reference(self, frame: str, values: Values, derivatives: bool = True) -> Placed:
        """T_reference_frame = inverse(T_world_reference) @ T_world_frame."""
        outer = self.in_world(frame, values, derivatives)
        if self.reference is None:
            return outer
        T = se3.inverse(values[self.reference]) @ outer.T
        if not derivatives:
            return Placed(T, {})
        return Placed(T, outer.d.beside({self.reference: -se3.adjoint(se3.inverse(T))}))


def place_each(stops: Sequence[Stops], frame: str, values: Values) -> Iterator[Placed]:
    """T_reference_frame of single stops, computed together for all that share their structure."""
    groups: dict[object, list[int]] = {}
    for k, each in enumerate(stops):
        shared = tuple(n for n in each.variables if n not in each.own)
        like = (id(each.rig), shared, each.reference, each.noise is None)
        groups.setdefault(like, []).append(k)
    found: dict[int, Placed] = {}
    for numbers in groups.values():
        some = [stops[k] for k in numbers]
        whole = Stops.together(some)
        own = {
            name: np.stack([values[each.own[i]] for each in some])
            for i, name in enumerate(whole.own)
        }
        placed = whole.in_reference(frame, {**values, **own})
        by = {n: np.broadcast_to(x, (len(some), *x.shape[1:])) for n, x in placed.d.items()}
        for i, (k, each) in enumerate(zip(numbers, some, strict=True)):
            names = dict(zip(whole.own, each.own, strict=True))
            d = {names.get(n, n): x[i : i + 1] for n, x in by.items()}
            found[k] = Placed(placed.T[i : i + 1], d)
    return (found[k] for k in range(len(stops)))


def place(
    rig: Rig,
    terms: Sequence[Term],
    joints: np.ndarray,
    columns: Mapping[str, np.ndarray],
    root: str,
    reference: str | None,
) -> Stops:
    """Bind a model's geometric effects to K stops.

    Args:
        rig: the rig on paper.
        terms: the model's effects on this rig, of any site.
        joints: (K, J) reported joints.
        columns: (K,) per-stop covariates that effects may look at.
        root: variable of T_world_root at these stops.
        reference: variable of T_world_reference, or None.
    """
    view = View(rig, len(joints), columns, joints)
    edge_bases, edges = _acting(terms, Site.EDGE, view)
    joint_bases, axes = _acting(terms, Site.JOINTS, view)
    return Stops(
        rig=rig,
        joints=joints,
        edge_bases=edge_bases,
        edges=edges,
        joint_bases=joint_bases,
        axes=axes,
        root_bases={t.variable: t.basis(view) for t in terms if t.effect.site is Site.ROOT},
        root=root,
        reference=reference,
    )


def _acting(
    terms: Sequence[Term], site: Site, view: View
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Variable -> basis of the edges or joints that it moves alone, and which of all these are."""
    bases, moved = {}, {}
    for t in (t for t in terms if t.effect.site is site and not t.effect.widens):
        basis = t.basis(view)
        some = np.flatnonzero(basis.any(axis=(0, *range(2, basis.ndim))))
        moved[t.variable] = some
        bases[t.variable] = basis if len(some) == basis.shape[1] else basis[:, some]
    return bases, moved


def _flat(basis: np.ndarray) -> np.ndarray:
    rows, edges, dof, size = basis.shape
    return basis.reshape(rows, edges * dof, size)
