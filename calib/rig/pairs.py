"""Bodies as others, or the tracker, see them, against where joints and CAD put them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from calib.rig import Rig
from calib.rig.suspect import Suspect
from chains import se3
from chains.align import hand_eye
from chains.errors import InputError
from chains.se3 import Array
from sensors.recording import RecordedStops

READINGS = "joints"  # whose columns may belong to other stops, as those of bodies may
# Turns, in rad, that are not the arm's; and how far off, rad and m alike, no CAD or arm is.
TURNED_RAD = 0.1
MOST_COMPARED = 100  # stops, each with each
# Of a place's stops, which agree where it is: a choice; half of a table may be out of step.
AGREE = 0.3
MOST_FITTED = 1000  # stops, to which what is unknown is fitted; all are held against it
# How far the root went between two stops, rad and m alike: fits end with 0.02 m, and name it; with
# 0.05 m they did not end. How many times further than from stop to stop elsewhere: a choice.
PUSHED, CLEARLY = 0.02, 5.0
STOPS_BESIDE = 10  # on either side, that tell how far the root goes from stop to stop
ARM_OFF_BY = 0.005  # rad and m that arms' joints and links are off by; those measured, by 0.003
JITTER = 1e-4  # rad by which joints scatter at least, as of industrial arms
# Sigmas; of 21 sound recordings 3.7 at most, 7.4 where a load changes how joints sag.
OUTLIER_SIGMAS = 8.0
# Left by all that CAD and the arm may be off by, m and rad: not this arm, or not so.
NOT_THIS_ARM = 0.05
MOST_TAKEN = 0.5  # of the rows by what is unknown: more, and what is left of the others says little
SWAPPED = 0.2  # of the misfit, left where two bodies are exchanged
HANGS_RAD = 0.5  # by which bodies hang otherwise than CAD says: a choice, far more than CAD errs by
AMISS = 0.1  # of the stops, that may be wrong in another way beside half turns: a choice
HALVES = (slice(0, 3), slice(3, 6))  # of a twist: turn and shift; 1.538 is the median of chi(3)
# What makes q times a half turn about an axis, of q = (w, x, y, z).
HALF_TURNS = {
    "x": np.eye(4)[[1, 0, 3, 2]] * [[-1], [1], [1], [-1]],
    "y": np.eye(4)[[2, 3, 0, 1]] * [[-1], [-1], [1], [1]],
    "z": np.eye(4)[[3, 2, 1, 0]] * [[-1], [1], [-1], [1]],
}


@dataclass(frozen=True)
class SeenPair:
    """A body as seen from another, or from the tracker, at K stops.

    Args:
        names: the bodies: that which is seen from, if any, and that which is seen.
        stops: (K,) indices.
        place: (K,) which unknown place the rig's root has; -1 where the other body carries it.
        nominal: (K, 4, 4) as joints and CAD say.
        poses: (K, 7) as measured, of each of the names.
        d_twist: (K, 6, P) of the nominal pose, by every edge of the rig.
    """

    names: tuple[str, ...]
    stops: np.ndarray
    place: np.ndarray
    nominal: Array
    poses: tuple[Array, ...]
    d_twist: Array

    def seen(self, other: Array | None = None, of: Sequence[str] = ()) -> Array:
        """(K, 4, 4) as measured; of some bodies quaternions are `other` (4, 4) times what is
        written."""
        T = [
            se3.from_xyz_quat(pose[:, :3], pose[:, 3:] @ other.T if name in of else pose[:, 3:])
            for name, pose in zip(self.names, self.poses, strict=True)
        ]
        return T[0] if len(T) == 1 else se3.inverse(T[0]) @ T[1]

    def some(self, index: Array) -> SeenPair:
        """At some of its stops, by index or as bool."""
        return replace(
            self,
            stops=self.stops[index],
            place=self.place[index],
            nominal=self.nominal[index],
            poses=tuple(pose[index] for pose in self.poses),
            d_twist=self.d_twist[index],
        )

    def reading(self, rig: Rig, joints: Array) -> SeenPair:
        """The same, had the joints read so (K, J)."""
        T = [rig.tree.place(name, joints).Ts_root_frame for name in self.names]
        return replace(self, nominal=T[0] if len(T) == 1 else se3.inverse(T[0]) @ T[1])

    def joints_between(self, rig: Rig) -> list[str]:
        """Joints that move its bodies against each other, or against the rig's root."""
        each = [set(rig.joints_to(name)) for name in self.names]
        return sorted(set.symmetric_difference(*each, *[set()] * (len(each) == 1)))

    def slipped(self, name: str, by: int) -> SeenPair:
        """The same, had the columns of one of the bodies, or of the "joints", come from so many
        stops later, at the stops that have one."""
        here = np.flatnonzero(np.isin(self.stops + by, self.stops))
        there = np.searchsorted(self.stops, self.stops[here] + by)
        of = dict(zip(self.names, self.poses, strict=True))
        return replace(
            self,
            stops=self.stops[here],
            place=self.place[here],
            nominal=self.nominal[there if name == READINGS else here],
            poses=tuple(pose[there if body == name else here] for body, pose in of.items()),
            d_twist=self.d_twist[there if name == READINGS else here],
        )


def pairs_of(
    rig: Rig, recording: RecordedStops, usable: Mapping[str, np.ndarray]
) -> Iterator[SeenPair]:
    """Each body as the tracker sees it, where the rig's root stands still; else as the body
    nearest to the root does. None beyond a joint that nothing reads, which would follow it."""
    read = (b for b in usable if set(rig.passive).isdisjoint(rig.joints_to(b)))
    bodies = sorted((b for b in read if usable[b].any()), key=lambda b: len(rig.joints_to(b)))
    still = np.zeros((1, len(rig.tree.edges), 6))
    placed = {b: rig.tree.place(b, recording.joints, still) for b in bodies}
    place = np.zeros(len(recording.stops), int)
    if rig.moves == "location":
        place = np.unique(recording.location, return_inverse=True)[1]
    for body in bodies if rig.moves != "stop" else bodies[1:]:
        names = (body,) if rig.moves != "stop" else (bodies[0], body)
        at = np.flatnonzero(np.all([usable[name] for name in names], axis=0))
        if not len(at):
            continue
        T, d = placed[body].Ts_root_frame[at], placed[body].d_twist[at].reshape(len(at), 6, -1)
        if len(names) == 2:
            first = placed[names[0]]
            T = se3.inverse(first.Ts_root_frame[at]) @ T
            d = d - se3.adjoint(se3.inverse(T)) @ first.d_twist[at].reshape(len(at), 6, -1)
        yield SeenPair(
            names=names,
            stops=at,
            place=place[at] if len(names) == 1 else np.full(len(at), -1),
            nominal=T,
            poses=tuple(recording.bodies[name][at] for name in names),
            d_twist=d,
        )


@dataclass(frozen=True)
class Push:
    """A move of the rig's root where it should stand still.

    Args:
        bodies: that tell of it.
        before, after: indices of the stops next to it, in time.
        twist: (6,) by which the root went, in its own axes.
    """

    bodies: tuple[str, ...]
    before: int
    after: int
    twist: Array

    def suspect(self, rig: Rig, recording: RecordedStops) -> Suspect:
        """What is said of it."""
        before, after = (recording.stops[k] for k in (self.before, self.after))
        turn_deg, shift_mm = np.degrees(size_of(self.twist[:3])), 1e3 * size_of(self.twist[3:])
        where, place = "", "say 'moves: location' under 'base', and give"
        if rig.moves == "location":
            where, place = f" at location {recording.location[self.after]}", "give"
        lies, lay = ("lies", "it lay") if len(self.bodies) == 1 else ("lie", "they lay")
        said = (
            f"from {after} on {' and '.join(self.bodies)} {lies} {shift_mm:.3g} mm and "
            f"{turn_deg:.2g} deg from where {lay} until {before}, by what the joints say: was the "
            "rig pushed, or the tracker set up anew? rig.yaml says that the base stands still"
            f"{where}; {place} the stops from {after} on a location of their own"
        )
        size_m = float(shift_mm / 1e3)
        return Suspect("frame", rig.tree.root, said, stops=(after,), size=size_m, unit="m")


def pushes(pairs: Sequence[SeenPair], time_s: Array) -> tuple[list[SeenPair], list[Push]]:
    """Moves of a root that stands still at each place, as every body that the tracker sees has it;
    and the pairs, with a place of its own for the root after each.

    Args:
        pairs: as of `pairs_of`, those first with fewest joints below their bodies.
        time_s: (K,) of the stops; in their own order where it is not known.
    """
    rank = np.argsort(np.argsort(time_s, kind="stable"))
    alone, found = [pair for pair in pairs if len(pair.names) == 1], []
    in_time = [pair.some(np.argsort(rank[pair.stops])) for pair in alone]
    places = [pair.place for pair in alone] or [np.zeros(0, int)]
    for place in np.unique(np.concatenate(places)).tolist():
        there = [pair.some(pair.place == place) for pair in in_time]
        found += _pushes([pair for pair in there if len(pair.stops)], rank)
    last = max((pair.place.max(initial=0) for pair in alone), default=0)
    for new, push in enumerate(found, int(last) + 1):
        of = {k: p for pair in alone for k, p in zip(pair.stops, pair.place, strict=True)}
        later = {k for k, p in of.items() if p == of[push.after] and rank[k] >= rank[push.after]}
        alone = [
            replace(pair, place=np.where(np.isin(pair.stops, [*later]), new, pair.place))
            for pair in alone
        ]
    return [*alone, *(pair for pair in pairs if len(pair.names) > 1)], found


def _pushes(pairs: Sequence[SeenPair], rank: Array) -> list[Push]:
    """Moves of the root at one place, as bodies have it that the tracker sees there, in the order
    of time: that which it sees most often tells when, and the others have to bear it out. The two
    stops before and the two after agree; one that is off by itself is a mishap to its row."""
    lead = max(pairs, key=lambda pair: len(pair.stops))
    T_lead = lead.seen() @ se3.inverse(lead.nominal)
    x, at = gap_of(T_lead[0], T_lead), np.arange(2, len(T_lead) - 1)
    if not len(at):
        return []
    others = [
        (pair, gap_of(T_lead[0], pair.seen() @ se3.inverse(pair.nominal)))
        for pair in pairs
        if pair is not lead
    ]
    moved = (x[at] + x[at + 1] - x[at - 1] - x[at - 2]) / 2
    step = size_of(np.diff(x, axis=0))  # from each row to the next
    usual = np.maximum(np.median(step), np.maximum(step[at - 2], step[at]))
    far = size_of(moved) >= np.maximum(PUSHED, CLEARLY * usual)
    found = []
    for k, by in zip(at[far].tolist(), moved[far], strict=True):
        beside = step[max(k - 1 - STOPS_BESIDE, 0) : k - 1], step[k : k + STOPS_BESIDE]
        if size_of(by) < CLEARLY * max(map(np.median, beside)):
            continue  # from then on it is elsewhere at every stop
        before, after = (int(lead.stops[i]) for i in (k - 1, k))
        said = {
            pair.names[0]: _borne_out(by, twist, int(np.sum(rank[pair.stops] < rank[after])))
            for pair, twist in others
        }
        if False not in said.values():
            bodies = tuple(p.names[0] for p in pairs if p is lead or said[p.names[0]])
            found.append(Push(bodies, before, after, gap_of(T_lead[k - 1], T_lead[k])))
    return found


def _borne_out(by: Array, twist: Array, at: int) -> bool | None:
    """Whether another body has it, too, that the root went by (6,) before one of its rows (N, 6);
    None where it does not tell."""
    if not 0 < at < len(twist):
        return None
    moved = twist[at : at + 2].mean(axis=0) - twist[max(at - 2, 0) : at].mean(axis=0)
    return bool(size_of(moved - by) < size_of(by) / 2)


def far_off(pair: SeenPair, roots: Mapping[int, Array]) -> set[int]:
    """Stops at which poses are further off than any CAD or arm, from some places of the root: see
    `TURNED_RAD`, rad and m alike."""
    far = size_of(gap_of(from_places(pair, roots), pair.seen())) > TURNED_RAD
    return {*pair.stops[far].tolist()}


def roots_of(pair: SeenPair) -> dict[int, Array]:
    """T_world_root of each place, on which enough of its stops agree."""
    every, found = pair.seen() @ se3.inverse(pair.nominal), {}
    for p in np.unique(pair.place[pair.place >= 0]).tolist():
        roots = every[pair.place == p]
        some = roots[:: -(-len(roots) // MOST_COMPARED)]
        apart = size_of(gap_of(some[:, None], some[None]))
        found[p] = some[np.quantile(apart, AGREE, axis=1).argmin()]
    return found


def from_places(pair: SeenPair, roots: Mapping[int, Array]) -> Array:
    """(K, 4, 4) nominal poses in the world, from these places of the root."""
    nominal = pair.nominal.copy()
    for p, T in roots.items():
        nominal[pair.place == p] = T @ nominal[pair.place == p]
    return nominal


def turns(pair: SeenPair, seen: Array) -> tuple[float, float]:
    """Rad by which a body turns otherwise than the joints say, median, whatever it hangs on and
    wherever the rig stands, and by which it hangs otherwise than CAD says; 0 where not to be told.
    """
    places, index = np.unique(pair.place, return_inverse=True)
    at = index == np.bincount(index, minlength=len(places)).argmax()
    try:
        X, Z = hand_eye(seen[at], pair.nominal[at])
    except InputError:
        return 0.0, 0.0
    left = gap_of(Z @ pair.nominal[at] @ X, seen[at])
    return float(np.median(np.linalg.norm(left[:, :3], axis=1))), float(size_of(se3.log(X)[:3]))


def gap_of(a: Array, b: Array) -> Array:
    """(..., 6) by which poses b differ from a, in their own axes."""
    return se3.log(se3.inverse(a) @ b)


def size_of(twist: Array) -> Array:
    """Rad and m alike: (...,) how large a twist is."""
    return np.linalg.norm(twist, axis=-1)


def robustly_left(A: Array, b: Array) -> tuple[Array, float]:
    """What is left of b (K, 6) after A (K, 6, P), of unknowns with a sigma of 1, and which share
    of the rows they took on: the mean diagonal of what makes fitted rows of seen ones."""
    some = slice(None, None, -(-len(b) // MOST_FITTED))
    rows, seen, P = A[some].reshape(-1, A.shape[2]), b[some], A.shape[2]
    weight = np.ones(len(seen))
    for _ in range(30):
        weighted = rows * np.repeat(weight, 6)[:, None]
        inner = rows.T @ weighted
        x = np.linalg.solve(inner + np.eye(P), weighted.T @ seen.ravel())
        size = np.linalg.norm(seen - (rows @ x).reshape(-1, 6), axis=1)
        before, weight = weight, 1.0 / (1.0 + np.square(size / max(3.0 * np.median(size), 3.0)))
        if np.abs(weight - before).max() < 1e-3:
            break
    taken = float(np.trace(np.linalg.solve(inner + np.eye(P), inner))) / len(rows)
    return b - A @ x, taken


def half_turned(pair: SeenPair) -> tuple[str, str, Array] | None:
    """A body that is half a turn about one of its axes from how it hangs at other stops: which,
    about which axis, and (K,) at which stops. None where there is none, or where more than a few
    stops fit neither way."""
    nominal = from_places(pair, roots_of(pair))

    def hung(seen: Array) -> Array:
        return (se3.inverse(nominal) @ seen)[:, :3, :3]

    as_seen = hung(pair.seen())
    some = as_seen[:: -(-len(as_seen) // MOST_COMPARED)]
    usual = some[np.quantile(_apart_rad(some[:, None], some), AGREE, axis=1).argmin()]
    alike, found = _apart_rad(usual, as_seen) < TURNED_RAD, []
    for body, (axis, turn) in product(pair.names, HALF_TURNS.items()):
        there = ~alike & (_apart_rad(usual, hung(pair.seen(turn, (body,)))) < TURNED_RAD)
        if there.any() and np.mean(alike | there) > 1.0 - AMISS:
            # Where as many are turned as not, those are that are not as CAD has them.
            turned = _apart_rad(usual, np.eye(3)) > np.pi / 2
            found.append((body, axis, alike if turned else there))
    return max(found, key=lambda one: one[2].sum(), default=None)


def hung_otherwise(pair: SeenPair) -> tuple[str, str] | None:
    """Of two bodies the one that is half a turn about one of its axes from how CAD has it, at all
    stops, and about which axis; None where neither is, or only one body is seen."""
    if len(pair.names) < 2:
        return None

    def fits(seen: Array, within_rad: float) -> bool:
        R = (se3.inverse(pair.nominal) @ seen)[:, :3, :3]
        return bool(np.mean(_apart_rad(R, np.eye(3)) < within_rad) > 1.0 - AMISS)

    every = product(pair.names, HALF_TURNS.items() if not fits(pair.seen(), np.pi / 2) else ())
    return next(((b, a) for b, (a, turn) in every if fits(pair.seen(turn, (b,)), HANGS_RAD)), None)


def _apart_rad(a: Array, b: Array) -> Array:
    """By how much rotations (..., 3, 3) differ."""
    return np.arccos(np.clip((np.einsum("...ij,...ij->...", a, b) - 1.0) / 2.0, -1.0, 1.0))


def outliers(rig: Rig, pair: SeenPair) -> Iterator[tuple[int, Array, bool]]:
    """Stops of a pair that stand out from the others: which, by how much (6,) [rad m], and whether
    they would not if the bodies were exchanged.

    The gaps between measured and nominal poses are laid on what all edges of the rig, and the
    root's places, may be off by: weighted least squares with CAD's sigmas as priors, and Cauchy's
    weights by stop, so that no wild one bends the rest.
    """
    if len(pair.stops) < 4:
        return
    nominal, seen = from_places(pair, roots_of(pair)), pair.seen()
    gap = gap_of(nominal, seen)
    noise = np.repeat([rig.tracker.sigma_rad, rig.tracker.sigma_m], 3) * np.sqrt(len(pair.names))
    noise = np.hypot(noise, max(rig.sigma_joint_rad, JITTER))
    d_place = se3.adjoint(se3.inverse(pair.nominal))
    columns = [pair.d_twist, *(d_place * (pair.place == p)[:, None, None]
               for p in np.unique(pair.place[pair.place >= 0]))]  # fmt: skip
    A = np.concatenate(columns, axis=2) / noise[:, None]
    prior = np.full(A.shape[2], NOT_THIS_ARM)
    prior[: pair.d_twist.shape[2]] = _edge_sigmas(rig)
    left, taken = robustly_left(A * prior, gap / noise)
    size = np.array([np.linalg.norm(left[:, s], axis=1) for s in HALVES]).T
    spread = np.median(size, axis=0) / 1.538 / np.sqrt(1.0 - min(taken, 0.99))
    if taken > MOST_TAKEN or (spread * noise[[0, 3]] > NOT_THIS_ARM).any():
        return
    for k in np.flatnonzero((size > OUTLIER_SIGMAS * np.maximum(spread, 1.0)).any(axis=1)):
        exchanged = len(pair.names) == 2 and (
            size_of(gap_of(nominal[k], se3.inverse(seen[k]))) < SWAPPED * size_of(gap[k])
        )
        yield int(k), left[k] * noise, bool(exchanged)


def _edge_sigmas(rig: Rig) -> Array:
    """(6 E,) how far each edge may be off: CAD's sigma of a frame, or what an arm's may be."""
    sigma = [
        np.maximum(rig.frame_sigma[name], 1e-6)
        if name in rig.frame_sigma
        else np.full(6, ARM_OFF_BY)
        for name in rig.tree.edge_names
    ]
    return 3.0 * np.concatenate(sigma)  # one in a hundred lies beyond
