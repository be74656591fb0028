"""What a recording holds, in a line each, and what of it looks odd without being an error."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from calib.rig import Rig
from calib.rig.columns import PAYLOAD, direction_in_root_at, up_in_root
from calib.rig.suspect import listed
from sensors.recording import RecordedStops
from sensors.reference import Reference
from sensors.stops import Targets, level_columns, undeclared_levels

FEW_LOCATIONS = 3  # below that no whole location can be held out
JOINT_STILL = 0.05  # rad or m that a joint travels: too little to tell its own errors
LIMIT_SLACK = 1e-3  # rad or m beyond a joint's limit
# Between spin axes, below which they are all one. A choice: the sine of 3 deg is 0.05, so of a
# shift of the LiDAR by 10 mm along its axis 0.5 mm differ from a shift of the room.
LEVEL_RAD = np.radians(3.0)
# Of incidence, nine tenths of it, below which what depends on it is hardly told: a choice; from 0
# to 30 deg its cosine falls by an eighth.
NARROW_RAD = np.radians(30.0)
# Mass over the cube of an arm's length, kg/m3: of arms for sale 13 (UR10, 29 kg, 1.3 m) to 143 (a
# KR 1000, 4,700 kg, 3.2 m). Ten times less or more is no arm's, but in grams or tonnes it would be.
LIGHTEST, HEAVIEST = 1.3, 1430.0
# What the strongest arms for sale carry. No arm carries more than it weighs, either: of those for
# sale a fifth (KR 1000) to a half (iiwa 14) of that.
HEAVIEST_LOAD_KG = 2300.0
# What stands for no number is at a tenth of the stops at most, and one of these, or a hundred times
# as far from the middle of all others as these are apart. Choices: a column of times that goes on
# the next morning is not told, as that is some ten times as far as the first day was long.
STAND_INS = (-9999.0, -999.0, -99.0, 99.0, 999.0, 9999.0, 32767.0, -32768.0, 65535.0)
STOPS_A_STAND_IN, BEYOND_REAL = 10, 100.0
ANOTHER_UNIT = 2.0  # times as far as measured: of feet for metres 3.3, were the scan well placed
FEWEST_IN_ORDER = 6  # rows: in any order, two of so many are out of it in 1 of 48 draws
HEAD_DOWN = -0.5  # of the root's z along what points up: of a rig on a wall it is about 0
LEANS_RAD = 0.1  # its sine: of what weights do, as much is taken to act across or not at all
OFTEN_UP = (0.0, 0.0, 1.0), (0.0, 1.0, 0.0)  # in the frames of trackers
AGREEING = 0.995  # length of a mean direction: those of stops scatter by 0.1 rad
ALL_ALIKE = 3  # links of one and the same mass: no maker's, but what is written until one is known
SLOWEST_S = 6 * 3600.0  # from stop to stop: a choice, as no arm takes a quarter of a day
FIRST_DATE_S, LAST_DATE_S = 9.46e8, 1e10  # since 1970: of 2000, and of the year 2286
# How many there are in a second, and below which number they are the unit of a date.
FINER_UNITS = {
    "milliseconds": (1e3, 1e13),
    "microseconds": (1e6, 1e16),
    "nanoseconds": (1e9, np.inf),
}
COARSE_M = 0.05  # no instrument here is as bad as that
FAR_OFF_M = 0.3  # median residual at the start: more than CAD is wrong by

Line = tuple[str, str]


@dataclass(frozen=True)
class PlacedScan:
    """A scan where the recording says that it was made.

    Args:
        name: of the stop.
        T: (4, 4) T_reference_lidar.
        share: of the beams that meet a surface.
        range_m, incidence_rad: (n,) of those.
        residual_m: median of their size.
        further: median of how many times as far as measured the surfaces lie.
    """

    name: str
    T: np.ndarray
    share: float
    range_m: np.ndarray
    incidence_rad: np.ndarray
    residual_m: float
    further: float


# ---------------------------------------------------------------------------------- what is there


def of_rig(rig: Rig) -> Iterator[Line]:
    """The rig's instruments."""
    parts = [f"{rig.lidar.name} with {rig.lidar.rings} rings"] if rig.lidar else []
    kg = sum(float(mass.kg) for mass in rig.masses)
    weight = f"{kg:.3g} kg" if kg else "without masses"
    parts += [f"arm of {counted(len(rig.joint_names), 'joint')} ({weight})"] * bool(rig.joint_names)
    parts += [f"{counted(len(rig.frame_sigma), 'frame')} from CAD"] if rig.frame_sigma else []
    yield "rig", f"{rig.name}: {', '.join(parts) or 'nothing on it'}"


def of_stops(rig: Rig, recording: RecordedStops) -> Iterator[Line]:
    """Stops, locations, and how often each body is seen."""
    count, locations = len(recording.stops), len(set(recording.location))
    when = f"over {np.ptp(recording.time_s) / 60:.0f} min" if recording.timed else "no times"
    yield "stops", f"{count} at {counted(locations, 'location')}, {when}"
    for body, seen in _seen(recording).items():
        yield body, f"seen at {seen.sum()} of {count} stops"
    for frame, felt in recording.levels.items():
        yield f"level in {frame}", f"read at {np.isfinite(felt[:, 0]).sum()} of {count} stops"
    for joint in rig.passive:
        yield joint, f"read by nothing: estimated at each of {count} stops"
    if recording.base_guess is not None:
        given = np.isfinite(recording.base_guess).all(axis=1).sum()
        yield "base_guess", f"given at {given} of {count} stops"
    if recording.covariates:
        read = {n: int(np.isfinite(x).sum()) for n, x in recording.covariates.items()}
        told = (n if k == count else f"{n} (at {k} of {count} stops)" for n, k in read.items())
        yield "per-stop covariates", ", ".join(told)


def of_targets(targets: Targets) -> Iterator[Line]:
    """How many targets hang, and how far apart."""
    yield "targets", f"{len(targets.names)} within {_size(targets.faro_m)}"


def of_mesh(reference: Reference) -> Iterator[Line]:
    """The mesh's size, and its labels."""
    triangles, surfaces = len(reference.triangles), int(reference.surface.max()) + 1
    size = _size(reference.vertices_m)
    yield "mesh", f"{triangles:,} triangles in {counted(surfaces, 'surface')}, {size}"
    yield "labels", ", ".join(reference.label_names.values())


def of_beams(placed: Sequence[PlacedScan]) -> Iterator[Line]:
    """What the beams meet, where the recording says that they were sent out."""
    share = np.mean([p.share for p in placed])
    near, far = _nine_tenths([p.range_m for p in placed])
    low, high = np.degrees(_nine_tenths([p.incidence_rad for p in placed]))
    yield (
        "beams",
        f"{share:.0%} meet a surface, nine tenths of them at {near:.1f} to {far:.1f} m and "
        f"{low:.0f} to {high:.0f} deg from its normal",
    )


# ---------------------------------------------------------------------------------- what looks odd


def odd_numbers(rig: Rig, recording: RecordedStops) -> Iterator[str]:
    """Numbers of stops that are hardly what they are taken for, and that no residual need show."""
    yield from odd_times(recording)
    yield from odd_columns(recording)
    yield from odd_payloads(rig, recording)
    yield from _head_down(rig, recording)
    yield from _leans(rig, recording)


def odd_rig(rig: Rig) -> Iterator[str]:
    """Sigmas that look like millimetres."""
    for section in ("tracker", "target", "reference"):
        for key in ("sigma_m", "sigma_marker_m", "sigma_sphere_m"):
            sigma_m = getattr(getattr(rig, section), key, 0.0)
            if sigma_m > COARSE_M:
                yield f"{section}.{key} is {sigma_m:g} m in rig.yaml; was it meant in millimetres?"
    yield from _odd_masses(rig)


def _odd_masses(rig: Rig) -> Iterator[str]:
    """Links that weigh all the same, or more or less than any arm's."""
    kg = [float(mass.kg) for mass in rig.masses]
    if not kg:
        return
    if len(kg) >= ALL_ALIKE and len(set(kg)) == 1:
        yield f"all {len(kg)} links with a mass weigh {kg[0]:g} kg in the URDF; are these measured?"
    longest = max(
        sum(float(np.linalg.norm(rig.edge(name).T_parent_child[:3, 3])) for name in chain)
        for chain in rig.chains
    )
    if not LIGHTEST * longest**3 < sum(kg) < HEAVIEST * longest**3:
        yield (
            f"the arm's links weigh {sum(kg):g} kg in the URDF, at a length of {longest:.2f} m; "
            "inertial/mass is in kg"
        )


def odd_stops(rig: Rig, recording: RecordedStops) -> Iterator[str]:
    """Too few locations, and bodies that are hardly seen."""
    names = np.array(recording.stops)
    if (locations := len(set(recording.location))) < FEW_LOCATIONS:
        yield (
            f"all stops stand at {counted(locations, 'location')}; with {FEW_LOCATIONS} or more, "
            "whole locations can be held out of a fit"
        )
    seen = _seen(recording)
    for body, at in seen.items():
        if at.sum() < len(at) / 2:
            yield f"{body} is seen at {at.sum()} of {len(at)} stops only; look for what hides it"
    if seen and (unseen := names[~np.any(list(seen.values()), axis=0)]).size:
        yield f"no tracked body is seen at {listed(unseen)}; what they tell rests on their scans"


def odd_times(recording: RecordedStops) -> Iterator[str]:
    """Times in another unit, two that seem exchanged, a clock that seems to have started again."""
    time_s = recording.time_s if recording.timed else np.zeros(1)
    order = np.argsort(time_s, kind="stable")
    moved = np.flatnonzero(order != np.arange(len(order)))
    back = np.flatnonzero(np.diff(time_s) < 0)
    if len(moved) == 2 and len(order) >= FEWEST_IN_ORDER:
        a, b = (recording.stops[k] for k in moved)
        yield (
            f"the rows of stops.csv are in the order of time_s but for {a} and {b}, and all would "
            "be with the times of these two exchanged; are they?"
        )
    elif len(back) == 1 and time_s[-1] > time_s[0]:
        yield (
            f"time_s in stops.csv goes back once, from {recording.stops[back[0]]} to "
            f"{recording.stops[back[0] + 1]}, and rises otherwise: did a clock start again there?"
        )
    gaps_s, last_s = np.diff(np.sort(time_s)), float(np.max(time_s))
    usual_s = float(np.median(gaps_s[gaps_s > 0])) if np.any(gaps_s > 0) else 0.0
    if last_s > LAST_DATE_S:
        unit = next(name for name, (_, until_s) in FINER_UNITS.items() if last_s < until_s)
        yield f"time_s in stops.csv goes up to {last_s:.3g} s: is it in {unit} since 1970?"
    elif usual_s > SLOWEST_S and last_s < FIRST_DATE_S:
        units = (name for name, (times, _) in FINER_UNITS.items() if usual_s / times < SLOWEST_S)
        yield (
            f"by time_s in stops.csv it takes {usual_s / 3600:.3g} h from one stop to the next "
            f"(median); time_s is in seconds: is it in {next(units, 'a finer unit')}?"
        )


def poses_of(recording: RecordedStops) -> np.ndarray:
    """Poses (K, 7 B) of all bodies, side by side."""
    return np.hstack(list(recording.bodies.values()) or [np.zeros((len(recording.stops), 0))])


def copied(recording: RecordedStops, unseen: bool = False) -> dict[str, str]:
    """Stop -> an earlier one with the same joints and the same poses, to every digit; of stops
    where a body was seen or, if that is asked, of all."""
    poses = poses_of(recording)
    first: dict[bytes, str] = {}
    found = {}
    for stop, joints, pose in zip(recording.stops, recording.joints, poses, strict=True):
        if unseen or np.isfinite(pose).any():
            of = first.setdefault(joints.tobytes() + pose.tobytes(), stop)
            found |= {stop: of} if of != stop else {}
    return found


def odd_copies(recording: RecordedStops) -> Iterator[str]:
    """Stops of which others are copies."""
    if copies := copied(recording):
        pairs = [f"{stop} of {of}" for stop, of in copies.items()]
        yield (
            f"stops.csv holds joints and poses of one stop again at another, to every digit "
            f"({listed(pairs)}); a copy would count as a second measurement, so remove its row"
        )


def odd_columns(recording: RecordedStops) -> Iterator[str]:
    """Numbers that stand for none, such as -999: few, and far from all others of their column."""
    for name, column in recording.covariates.items():
        known = np.flatnonzero(np.isfinite(column))
        away = np.abs(column[known] - np.median(column[known])) if len(known) else column[known]
        order = known[np.argsort(away, kind="stable")]
        for count in range(len(known) // STOPS_A_STAND_IN, 0, -1):
            near, far = column[order[:-count]], column[order[-count:]]
            apart = np.abs(far - np.median(near)).min()
            usual = np.isin(far, STAND_INS).all() and apart > np.ptp(near)
            if usual or apart > BEYOND_REAL * np.ptp(near) > 0.0:
                where = listed([recording.stops[i] for i in sorted(order[-count:].tolist())])
                least, most = near.min(), near.max()
                numbers = listed([f"{each:g}" for each in np.unique(far)])
                yield (
                    f"{name} is {numbers} at {where} in stops.csv, and {least:g} to {most:g} at "
                    "all others; leave a cell empty where nothing was measured"
                )
                break


def odd_payloads(rig: Rig, recording: RecordedStops) -> Iterator[str]:
    """Payloads that no arm carries."""
    for name in (PAYLOAD, *(f"{tip}.{PAYLOAD}" for tip in rig.tips)):
        if name not in recording.covariates:
            continue
        kg = np.nan_to_num(recording.covariates[name])
        weighs_kg = sum(float(mass.kg) for mass in rig.masses)
        credible = weighs_kg > 0 and not list(_odd_masses(rig))
        most = min(HEAVIEST_LOAD_KG, weighs_kg) if credible else HEAVIEST_LOAD_KG
        if kg.min(initial=0.0) < 0.0:
            yield f"{name} goes down to {kg.min():g} in stops.csv; a load is not below 0"
        elif kg.max(initial=0.0) > most:
            yield (
                f"{name} goes up to {kg.max():g} in stops.csv, more than such an arm carries "
                f"({most:.3g} kg); is it in grams?"
            )


def _head_down(rig: Rig, recording: RecordedStops) -> Iterator[str]:
    """Levels that say the rig hangs head down."""
    if rig.levels and rig.levels.frames and up_in_root(rig, recording).mean(axis=0)[2] < HEAD_DOWN:
        yield (
            f"levels say that z of '{rig.tree.root}' points down; at rest they are to read 1 g "
            "along what points up. Does the rig hang from a ceiling? Else turn the signs of .ax, "
            ".ay and .az"
        )


def _leans(rig: Rig, recording: RecordedStops) -> Iterator[str]:
    """An arm that stands askew in the tracker's frame, of which nothing says where up is; or that
    leans from where that is said to be."""
    if not rig.masses or rig.tracker is None or (rig.levels and rig.levels.frames):
        return
    ups = [rig.levels.up] if rig.levels else OFTEN_UP
    there = np.stack([direction_in_root_at(rig, recording, up) for up in ups], axis=1)
    there = there[np.isfinite(there[:, 0, 0])]
    mean = there.sum(axis=0) / max(len(there), 1)
    size = np.linalg.norm(mean, axis=1)
    if len(there) < 2 or size.min() < AGREEING:  # the joints do not say how it stands
        return
    lean_rad, root = np.arccos(np.clip(mean[:, 2] / size, -1.0, 1.0)), rig.tree.root
    if lean_rad.min() <= LEANS_RAD:
        return
    if rig.levels:
        yield (
            f"z of '{root}' leans by {np.degrees(lean_rad[0]):.0f} deg from up as rig.yaml has it "
            "(levels.up): does the arm stand so?"
        )
        return
    z_deg, y_deg = np.degrees(lean_rad)
    yield (
        f"z of '{root}' leans by {z_deg:.0f} deg from z of the tracker's frame, and by "
        f"{y_deg:.0f} deg from its y. The weight of the arm's links is taken to pull along z of "
        f"'{root}'; if it does not, say where up is in the tracker's frame, as by levels: "
        "{up: [0, 0, 1], sigma_up_rad: 0.005} in rig.yaml, or put a level on the rig"
    )


def odd_levels(recording: RecordedStops) -> Iterator[str]:
    """Columns as an accelerometer writes them, of which rig.yaml says nothing."""
    for frame in undeclared_levels(recording.covariates):
        yield (
            f"stops.csv has {', '.join(level_columns(frame))}, as of an accelerometer in {frame}, "
            f"and they are covariates only; with levels: {{frames: [{frame}], sigma_rad: 0.001}} "
            "in rig.yaml they would tell its tilt"
        )


def odd_joints(rig: Rig, recording: RecordedStops) -> Iterator[str]:
    """Joints at rest, or beyond their limits."""
    names = np.array(recording.stops)
    values = dict(zip(rig.joint_names, recording.joints.T, strict=True))
    values = {name: at for name, at in values.items() if name not in rig.passive}
    if still := [name for name, at in values.items() if np.ptp(at) < JOINT_STILL]:
        yield f"{listed(still)} hardly moved, too little to tell their own errors; move them"
    for joint in rig.joints:
        if joint.name not in values:
            continue
        at, unit = values[joint.name], joint.unit
        beyond = (at < joint.lower - LIMIT_SLACK) | (at > joint.upper + LIMIT_SLACK)
        if beyond.any():
            yield (
                f"{joint.name} is beyond its limits of {joint.lower:g} to {joint.upper:g} {unit} "
                f"at {listed(names[beyond])}; check its sign, zero and unit"
            )


def odd_beams(placed: Sequence[PlacedScan]) -> Iterator[str]:
    """Views that are all alike, and scans that lie beside what they should meet."""
    spin = np.array([p.T[:3, 2] for p in placed])
    if len(spin) > 1 and np.arccos(np.clip(spin @ spin[0], -1, 1)).max() < LEVEL_RAD:
        yield (
            "the LiDAR's spin axis points the same way at all stops, so what shifts the LiDAR "
            "along it looks like a shift of the room; tilt it at some stops"
        )
    low, high = _nine_tenths([p.incidence_rad for p in placed])
    if high - low < NARROW_RAD:
        low, high = np.degrees([low, high])
        yield (
            f"beams meet surfaces at {low:.0f} to {high:.0f} deg from their normal only; what "
            "depends on incidence cannot be told from an offset"
        )
    if off := [p for p in placed if p.residual_m > FAR_OFF_M]:
        times = float(np.median([p.further for p in off]))
        unit = max(times, 1.0 / times) > ANOTHER_UNIT
        yield (
            f"at {listed([p.name for p in off])} half of the beams end more than {FAR_OFF_M:g} m "
            "from the surface that they should meet; check base_guess, tracker and targets"
            + (f", and the unit of the mesh, which lies {times:.2g} times as far" if unit else "")
        )


def counted(n: int, what: str) -> str:
    """A number of things, in words."""
    return f"{n:,} {what}" if n == 1 else f"{n:,} {what}s"


def _seen(recording: RecordedStops) -> dict[str, np.ndarray]:
    return {body: np.isfinite(pose[:, 0]) for body, pose in recording.bodies.items()}


def _size(points_m: np.ndarray) -> str:
    return " x ".join(f"{m:.1f}" for m in np.ptp(points_m, axis=0)) + " m"


def _nine_tenths(parts: Sequence[np.ndarray]) -> np.ndarray:
    """The range (2,) in which nine tenths of the values lie."""
    return np.quantile(np.concatenate(parts), [0.05, 0.95])
