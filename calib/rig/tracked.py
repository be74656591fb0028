"""What is wrong with tracked bodies, as far as it shows before any fit: placeholders, quaternions,
bodies exchanged, columns out of step, and poses that no other pose and no joint bears out."""

from __future__ import annotations

from collections.abc import Generator, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import combinations, permutations

import numpy as np

from calib.rig import Rig
from calib.rig.pairs import (
    HANGS_RAD,
    MOST_COMPARED,
    READINGS,
    SWAPPED,
    TURNED_RAD,
    SeenPair,
    far_off,
    gap_of,
    half_turned,
    hung_otherwise,
    outliers,
    pairs_of,
    pushes,
    roots_of,
    size_of,
    turns,
)
from calib.rig.suspect import Spell, Suspect, listed, rare, spells
from chains import se3
from chains.se3 import Array
from sensors.recording import RecordedStops

JOINT_MOVED = 1e-3  # rad or m by which a joint has moved, if it has
FITS_RAD = 0.03  # turns that are the arm's, others than those of `TURNED_RAD`
# Stops far off, from which columns may be out of step, and of these what is left if they are: a
# choice, as one in ten was left where columns were moved back, and all where they were not.
FEWEST_OFF, OUT_OF_STEP = 3, 0.25
TURNED_DEG = (-90, 90, 180)  # by which zeros of joints are drawn otherwise
SLIPPED = (-2, -1, 1, 2)  # stops by which columns are out of step: as far as tables slip, a choice
# What quaternions are in place of qw, qx, qy, qz, and what makes these of it.
OTHER_QUATERNIONS = {
    "qx, qy, qz, qw": np.eye(4)[[3, 0, 1, 2]],
    "qz, qw, qx, qy": np.eye(4)[[1, 2, 3, 0]],
    "qw, -qx, -qy, -qz (the inverse turn)": np.diag([1.0, -1.0, -1.0, -1.0]),
}


_Met = list[tuple[SeenPair, Array, bool]]  # pairs at a stop, how far off, whether if exchanged


def odd_bodies(rig: Rig, recording: RecordedStops) -> Iterator[str | Suspect]:
    """What looks wrong with tracked bodies."""
    if rig.tracker is None:
        return
    usable = {}
    for body in rig.tracker.bodies:
        bad = yield from _placeholders(rig, recording, body)
        usable[body] = np.isfinite(recording.bodies[body]).all(axis=1) & ~bad
    met: dict[int, _Met] = {}
    pairs, moves = pushes([*pairs_of(rig, recording, usable)], recording.time_s)
    yield from (push.suspect(rig, recording) for push in moves)
    for pair in pairs:
        pair = yield from _turned_round(recording, pair)
        wrong = _at_all_stops(pair) or _misread(rig, recording, pair)
        if wrong is not None:
            yield wrong
            return
        told = yield from _of_some_rows(rig, recording, pair)
        pair = pair.some(~np.isin(pair.stops, [*told]))
        for k, gap, exchanged in outliers(rig, pair):
            met.setdefault(int(pair.stops[k]), []).append((pair, gap, exchanged))
    at_stops: dict[tuple[str, bool], dict[str, tuple[Suspect, _Met]]] = {}
    for stop, found in sorted(met.items()):
        name = recording.stops[stop]
        one = _at_one_stop(rig, f"at {name}", found, (name,))
        at_stops.setdefault((one.name, found[0][2]), {})[name] = one, found
    for some in at_stops.values():
        yield from _those_that_last(rig, recording, some)


# --------------------------------------------------------------------------------- placeholders


def _placeholders(rig: Rig, recording: RecordedStops, body: str) -> Iterator[Suspect]:
    """Poses that trackers write where they have not seen; returns (K,) which these are."""
    pose, names = recording.bodies[body], np.array(recording.stops)
    zero = (pose[:, :3] == 0).all(axis=1)
    level = (pose[:, 3:] == [1, 0, 0, 0]).all(axis=1) & ~zero
    level &= np.isfinite(pose).all(axis=1).sum() > level.sum()
    old = _repeated(rig, recording, body) & ~zero
    for wrong, words in (
        (zero, "stands at exactly (0, 0, 0) at {}, as trackers write what they have not seen"),
        (level, "is turned by exactly (1, 0, 0, 0) at {}, as trackers write a turn not seen"),
        (old, "has at {} the pose of another stop to the last digit, though the arm had moved"),
    ):
        if wrong.any():
            at = tuple(names[wrong].tolist())
            said = f"{body} {words.format(listed(at))}; leave its cells empty there"
            yield Suspect("body", body, said, stops=at)
    return zero | level | old


def _repeated(rig: Rig, recording: RecordedStops, body: str) -> np.ndarray:
    """(K,) stops at which a body beyond the arm repeats an old pose, its joints having moved."""
    same = np.zeros(len(recording.stops), bool)
    joints = [rig.joint_names.index(name) for name in rig.joints_to(body)]
    seen = np.flatnonzero(np.isfinite(recording.bodies[body][:, 0]))
    if not joints or len(seen) < 2:
        return same
    pose, at = np.nan_to_num(recording.bodies[body][seen]), recording.joints[seen][:, joints]
    _, first, inverse = np.unique(pose, axis=0, return_index=True, return_inverse=True)
    same[seen] = np.abs(at - at[first[inverse.ravel()]]).max(axis=1) > JOINT_MOVED
    return same


# --------------------------------------------------------------------------------- turned round


def _turned_round(recording: RecordedStops, pair: SeenPair) -> Generator[Suspect, None, SeenPair]:
    """A body that is half a turn from how it hangs at other stops; returns the pair without those
    at which it is."""
    if (found := half_turned(pair)) is None:
        return pair
    body, axis, there = found
    at = tuple(recording.stops[k] for k in pair.stops[there])
    said = (
        f"at {len(at)} of {len(there)} stops ({listed(at)}) {body} is turned round by half a turn "
        f"about its {axis} axis, against the others: markers that look the same so are seen either "
        "way; leave its cells empty there, and move one of its markers"
    )
    yield Suspect("body", body, said, stops=at)
    return pair.some(~there)


# ------------------------------------------------------------------------------- at all stops


def _at_all_stops(pair: SeenPair) -> Suspect | None:
    """Bodies exchanged, or quaternions written otherwise."""
    if len(pair.stops) < 4:
        return None
    seen, names = pair.seen(), " and ".join(pair.names)
    if len(pair.names) == 2:
        apart, swapped = (
            np.median(size_of(gap_of(pair.nominal, T))) for T in (seen, se3.inverse(seen))
        )
        if apart > TURNED_RAD and swapped < SWAPPED * apart:
            said = f"{names} lie as CAD says if they are exchanged; is each named as it should be?"
            return Suspect("body", names, said)
    if found := hung_otherwise(pair):
        body, axis = found
        said = (
            f"{names} turn against each other as CAD says if {body} is turned round by half a turn "
            f"about its {axis} axis: is it drawn, or what lies between the two, the other way "
            "round in rig.yaml?"
        )
        return Suspect("body", body, said)
    if turns(pair, seen)[0] < TURNED_RAD:
        return None
    ways = {  # columns of all bodies, or of one of them
        (what, of): turns(pair, pair.seen(other, of))
        for what, other in OTHER_QUATERNIONS.items()
        for of in dict.fromkeys([pair.names, *((name,) for name in pair.names)])
    }
    fitting = [w for w, (left, hangs) in ways.items() if left < FITS_RAD and hangs < HANGS_RAD]
    if not fitting:
        return None
    what, of = min(fitting, key=lambda way: ways[way][1])
    names = " and ".join(of)
    said = (
        f"{names} {'turns' if len(of) == 1 else 'turn'} as the joints say if the columns qw, qx, "
        f"qy, qz hold {what}; write them as they are named"
    )
    return Suspect("body", names, said)


# ------------------------------------------------------------------------------- at some rows


def _of_some_rows(
    rig: Rig, recording: RecordedStops, pair: SeenPair
) -> Generator[Suspect, None, set[int]]:
    """Columns that belong to another stop, and readings that stood still; returns which stops these
    explain."""
    roots = roots_of(pair)
    off = far_off(pair, roots)
    if len(off) < FEWEST_OFF:
        return set()
    if said := _out_of_step(pair, roots, off, recording.stops):
        suspect, rows = said
        yield suspect
        return rows
    if mixed := _mixed_up(rig, recording, pair, off):
        yield mixed
        return off
    still = yield from _stood_still(rig, recording, pair, off)
    return still or (yield from _for_a_while(rig, recording, pair, off))


def _for_a_while(
    rig: Rig, recording: RecordedStops, pair: SeenPair, off: set[int]
) -> Generator[Suspect, None, set[int]]:
    """Columns exchanged or read otherwise at stops that follow each other; returns at which."""
    found: set[int] = set()
    for spell in _spells(recording, [pair], [recording.stops[k] for k in off]):
        if one := _as_one(rig, recording, pair, spell):
            yield one
            found.update(np.flatnonzero(np.isin(recording.stops, spell.stops)).tolist())
    return found


def _spells(
    recording: RecordedStops, pairs: Sequence[SeenPair], wrong: Sequence[str]
) -> list[Spell]:
    """Of the stops at which the bodies of some pairs are seen."""
    seen = np.unique(np.concatenate([pair.stops for pair in pairs]))
    return spells([recording.stops[k] for k in seen], recording.time_s[seen], wrong)


def _as_one(rig: Rig, recording: RecordedStops, pair: SeenPair, spell: Spell) -> Suspect | None:
    """What is wrong at stops that follow each other, as if these were all."""
    there = pair.some(np.isin(pair.stops, np.flatnonzero(np.isin(recording.stops, spell.stops))))
    one = _at_all_stops(there) or _misread(rig, recording, there)
    # Columns that are read otherwise are so at all of them, also where it hardly shows.
    return one and replace(one, sentence=f"{spell} {one.sentence}", stops=spell.stops)


def _out_of_step(
    pair: SeenPair, roots: Mapping[int, Array], off: set[int], stops: Sequence[str]
) -> tuple[Suspect, set[int]] | None:
    """What belongs to a stop before, or after, if what lies far `off` from places of the root then
    fits and nothing between is spoiled: every way in which it does; and the rows, from the first of
    these to the last."""
    mended: dict[tuple[str, int], set[int]] = {}
    for way in ((name, by) for name in (*pair.names, READINGS) for by in SLIPPED):
        moved = pair.slipped(*way)
        if len(moved.stops) < FEWEST_OFF:
            continue
        far = min((far_off(moved, of) for of in (roots, roots_of(moved))), key=len)
        fits = (off & {*moved.stops.tolist()}) - far
        spoiled = [k for k in far if fits and min(fits) <= k <= max(fits)]
        if len(fits) >= (1 - OUT_OF_STEP) * len(off) and len(spoiled) <= OUT_OF_STEP * len(fits):
            mended[way] = fits
    if not mended:
        return None
    most = max(mended.values(), key=len)
    told = [
        f"the columns of {name} from the {'row' if abs(by) == 1 else 'second row'} "
        f"{'below' if by > 0 else 'above'}"
        for (name, by), fits in mended.items()
        if len(fits) + abs(by) >= len(most)  # where rows of one table moved on, the last have gone
    ]
    first, last = min(most), max(most)
    whole = last - first + 1 > len(stops) - FEWEST_OFF
    rows = "each row" if whole else f"each row from {stops[first]} to {stops[last]}"
    names = " and ".join(pair.names)
    said = (
        f"{names} would lie where CAD and joints put {'it' if len(pair.names) == 1 else 'them'} if "
        f"{rows} of stops.csv took {', or '.join(told)}: is the table out of step"
        f"{'' if whole else ' there'}?"
    )
    rows_told = range(len(stops)) if whole else range(first, last + 1)
    return Suspect("body", names, said), {*rows_told}


def _mixed_up(rig: Rig, recording: RecordedStops, pair: SeenPair, off: set[int]) -> Suspect | None:
    """Most readings belong to other stops, in no order, as two bodies see them."""
    if len(pair.names) < 2 or 2 * len(off) < len(pair.stops):
        return None
    far = pair.some(np.flatnonzero(np.isin(pair.stops, [*off]))[:MOST_COMPARED])
    read = np.isfinite(recording.joints).all(axis=1)
    every = pair.reading(rig, recording.joints[read]).nominal
    fits = size_of(gap_of(every[None], far.seen()[:, None])) < TURNED_RAD
    if np.mean(fits.sum(axis=1) == 1) < 1.0 - OUT_OF_STEP:
        return None
    names = " and ".join(pair.names)
    said = (
        f"at {len(off)} of {len(pair.stops)} stops {names} would fit the joints of another stop: "
        "are rows of stops.csv mixed up?"
    )
    return Suspect("body", names, said)


def _stood_still(
    rig: Rig, recording: RecordedStops, pair: SeenPair, off: set[int]
) -> Generator[Suspect, None, set[int]]:
    """Joints whose readings stood still where a body lies far `off`; returns at which stops."""
    found: dict[str, set[int]] = {}
    joints = pair.joints_between(rig)
    for joint in joints:
        read = recording.joints[:, rig.joint_names.index(joint)]
        still = {*(1 + np.flatnonzero(np.diff(read) == 0)).tolist()}
        if len(off & still) >= (1 - OUT_OF_STEP) * max(len(off), len(still)):
            found[joint] = still
    if len(found) == len(joints) > 1:
        found = {READINGS: set.intersection(*found.values())}
    for joint, still in found.items():
        stops = tuple(recording.stops[k] for k in sorted(still))
        what, verb = ("all joints", "read") if joint == READINGS else (joint, "reads")
        said = (
            f"{what} {verb} the same to the last digit at {listed(stops)} as at the stop before, "
            f"and {' and '.join(pair.names)} is far from where that puts it: did the reading "
            "stand still?"
        )
        yield Suspect("joints", joint, said, stops=stops)
    return set().union(*found.values())


# ------------------------------------------------------------------------------------- joints


def _misread(rig: Rig, recording: RecordedStops, pair: SeenPair) -> Suspect | None:
    """Joints with another sign, exchanged, turned, or that go with others, if all then fits."""
    pair = pair.some(slice(None, None, max(1, -(-len(pair.stops) // MOST_COMPARED))))
    off = far_off(pair, roots_of(pair))
    if len(pair.stops) < 4 or len(off) < FEWEST_OFF:
        return None
    names, left, read = " and ".join(pair.names), {}, recording.joints[pair.stops]
    for what, otherwise in _otherwise_read(rig, pair.joints_between(rig), read):
        moved = pair.reading(rig, otherwise)
        left[what] = len(far_off(moved, roots_of(moved)))
    if (least := min(left.values(), default=len(off))) > OUT_OF_STEP * len(off):
        return None
    ways = ", or if ".join(what for what, count in left.items() if count == least)
    said = (
        f"{names} would lie where CAD and joints put {'it' if len(pair.names) == 1 else 'them'} if "
        f"{ways}: are the joints read as the URDF has them?"
    )
    return Suspect("body", names, said)


def _otherwise_read(rig: Rig, names: Sequence[str], read: Array) -> Iterator[tuple[str, Array]]:
    """In what other ways joints could be read, and (K, J) the joints then."""
    kind, q = (dict(zip(rig.joint_names, of, strict=True)) for of in (rig.joint_kinds, read.T))

    def but(others: Mapping[str, Array]) -> Array:
        return np.stack([others.get(name, q[name]) for name in q], axis=1)

    for name in names:
        yield f"{name} had the other sign", but({name: -q[name]})
        for deg in TURNED_DEG if kind[name] == "revolute" else ():
            way = "more" if deg > 0 else "less"
            yield f"{name} read {abs(deg)} deg {way}", but({name: q[name] + np.radians(deg)})
    along = [name for name in q if name in names]  # the chain
    back = [q[name] for name in along[::-1]]
    yield "all joints were in reverse order", but(dict(zip(along, back, strict=True)))
    for a, b in combinations(names, 2):
        yield f"the columns of {a} and {b} were exchanged", but({a: q[b], b: q[a]})
    for a, b in permutations(names, 2):  # rods hold links level, wrists are driven through others
        for way, sign in (("+", 1), ("-", -1)) if kind[a] == kind[b] else ():
            yield f"{a} moved by {a} {way} {b}", but({a: q[a] + sign * q[b]})


# -------------------------------------------------------------------------------- at one stop


def _those_that_last(
    rig: Rig, recording: RecordedStops, at_stops: Mapping[str, tuple[Suspect, _Met]]
) -> Iterator[str | Suspect]:
    """What is wrong with a body at stops, and once for those that follow each other."""
    alone = {stop: one for stop, (one, _) in at_stops.items()}
    pairs = {pair.names: pair for _, met in at_stops.values() for pair, *_ in met}
    for spell in _spells(recording, [*pairs.values()], [*at_stops]):
        found = [alone.pop(stop) for stop in spell.wrong]
        as_one = (_as_one(rig, recording, pair, spell) for pair in pairs.values())
        if one := next(filter(None, as_one), None):
            yield one
            continue
        (worst,) = max(found, key=lambda one: one.size or 0.0).stops
        where = f"{spell}, most of all at {worst},"
        yield _at_one_stop(rig, where, at_stops[worst][1], spell.wrong, f"this {spell.course}")
    of = max(len(pair.stops) for pair in pairs.values())
    swaps = any(met[0][2] for _, met in at_stops.values())
    yield from alone.values() if swaps else rare([*alone.values()], of)


def _at_one_stop(
    rig: Rig,
    where: str,
    found: _Met,
    stops: tuple[str, ...],
    look: str = "look at its row",
) -> Suspect:
    """One stop's bodies that stand out: the one that all pairs have in common, if there is one."""
    pair, gap, exchanged = found[0]
    common = [name for name in pair.names if all(name in other.names for other, *_ in found)]
    names = " or ".join(common or dict.fromkeys(n for p, *_ in found for n in p.names))
    turn_deg, shift_mm = np.degrees(np.linalg.norm(gap[:3])), 1e3 * np.linalg.norm(gap[3:])
    if exchanged:
        said = f"{where} {' and '.join(pair.names)} lie as at other stops if they are exchanged"
    else:
        joints = any(rig.joints_to(name) for p, *_ in found for name in p.names)
        said = (
            f"{where} {names} is {shift_mm:.3g} mm and {turn_deg:.2g} deg from where other stops"
            f"{' and the joints' if joints else ''} put it; {look}"
        )
    return Suspect("body", names, said, stops=stops, size=float(shift_mm / 1e3), unit="m")
