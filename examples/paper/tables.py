"""The study's tables, from states of its recordings; lengths in mm."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from calib import problem as problems
from calib.effects import FrameOffset, Site
from calib.evaluation.tally import Evaluated, Tally
from calib.forward import Values
from calib.problem.model import Model, Source
from calib.residuals.tracker import TrackedBody
from chains import se3
from sensors.meshes import ransac_plane

from .case import Case, Columns, State, gather, well_seen
from .sequence import LENGTHS, RINGS

BENDS = (Site.EDGE, Site.JOINTS)
PLANES = {"wood": "wood_panel", "metal": "metal_cabinet"}
WITHIN_M = 0.05  # of a RANSAC plane: four times the thickest plane of the study's Table 4
FAR_OFF_M = 0.05  # a direction that errs by more was spoilt: two surfaces, or none

Row = dict[str, Any]


# ------------------------------------------------------------------------------- Table 3: two ways


def gaps_mm(source: Source, model: Model, values: Values) -> np.ndarray:
    """Distance (K,) of the mount's markers as tracked from where base markers and arm put them.

    Args:
        source: a recording, with or without scans.
        model, values: of a calibration; poses and joint errors of single stops are not used.
    """
    problem = problems.build([source], model)
    known = {**problem.initial, **{n: values[n] for n in problem.calibration if n in values}}
    seen = {}
    for block in problem.blocks:
        if isinstance(block, TrackedBody):
            T_root_body = block.stops.in_root(block.body, known).T[0]
            seen.setdefault(block.stop_names[0], {})[block.body] = block.measured[0], T_root_body
    first, last = source.rig.tracker.bodies
    gaps = []
    for bodies in seen.values():
        if len(bodies) == 2:
            T_opti_first, T_root_first = bodies[first]
            T_opti_last, T_root_last = bodies[last]
            told = T_opti_first @ se3.inverse(T_root_first) @ T_root_last
            gaps.append(np.linalg.norm(told[:3, 3] - T_opti_last[:3, 3]))
    return 1e3 * np.array(gaps)


def two_ways(case: Case, states: Mapping[str, State]) -> Row:
    """Table 3: mean gap while still, and over as many stops again while moving, by method."""
    out = {}
    for name, state in states.items():
        effects = (t.effect for t in state.problem.terms[0] if t.effect.site in BENDS)
        model = Model(tuple(e for e in effects if not isinstance(e, FrameOffset)))
        still = gaps_mm(case.source, model, state.values)
        moving = gaps_mm(case.moving, model, state.values)
        out[name] = {
            "static": float(still.mean()),
            "all": float((still.mean() + moving.mean()) / 2),
        }
    return out


# -------------------------------------------------------------------------- Table 4: planes' spread


def thickness_mm(points: Columns, rows: np.ndarray) -> float | None:
    """Standard deviation of returns across the RANSAC plane of these directions; None of too few.

    Returns within a direction scatter by its precision; across the plane that is times cos.
    """
    if len(rows) < 50:
        return None
    xyz = np.stack([points[f"{axis}_m"][rows] for axis in "xyz"], axis=1).astype(float)
    inliers = ransac_plane(xyz, WITHIN_M)
    xyz, rows = xyz[inliers], rows[inliers]
    n = points["count"][rows].astype(int)
    within = np.nan_to_num(points["precision_m"][rows]) * np.cos(points["incidence_rad"][rows])
    across_m2 = np.linalg.eigvalsh(np.cov(xyz.T, fweights=n))[0]
    return 1e3 * float(np.sqrt(across_m2 + np.average(within**2, weights=n)))


def planes(case: Case, by_tracker: Columns, by_arm: Columns, by_graph: Columns) -> dict[str, Row]:
    """Table 4 of one LiDAR: a wooden and a metal plane, of ever more stops.

    The surface is the flat one of the material that most directions met; the location and the stop
    are those that saw most of it. Stops at which the mount was not seen are left out throughout.
    """
    recording = case.source.recording
    last = case.source.rig.tracker.bodies[-1]
    tracked = np.array(recording.stops)[np.isfinite(recording.bodies[last][:, 0])]
    names = {name: number for number, name in case.source.rig.labels.items()}
    out = {}
    for material, label in PLANES.items():
        flat = by_tracker["label"] == names[label]
        flat &= (by_tracker["surface"] >= 0) & np.isin(by_tracker["stop"], tracked)
        surface = _most(by_tracker["surface"][flat])
        place = _most(by_tracker["location"][flat & (by_tracker["surface"] == surface)])

        def rows(points: Columns, surface=surface, **where: str) -> np.ndarray:
            chosen = (points["surface"] == surface) & np.isin(points["stop"], tracked)
            for name, value in where.items():
                chosen &= points[name] == value
            return np.flatnonzero(chosen)

        stop = _most(by_tracker["stop"][rows(by_tracker, location=place)])
        out[material] = {
            "Static": thickness_mm(by_tracker, rows(by_tracker, stop=stop)),
            "Opti": thickness_mm(by_tracker, rows(by_tracker, location=place)),
            "Arm": thickness_mm(by_arm, rows(by_arm, location=place)),
            "All Opti": thickness_mm(by_tracker, rows(by_tracker)),
            "All graph": thickness_mm(by_graph, rows(by_graph)),
        }
    return out


def _most(values: np.ndarray) -> Any:
    """The value that is there most often."""
    distinct, count = np.unique(values, return_counts=True)
    return distinct[count.argmax()]


# ------------------------------------------------------------------ Tables 5 and 6: mean and spread


def spread(points: Columns, error_m: np.ndarray, rows: np.ndarray) -> Row:
    """Mean and spread of the returns of some directions, and of what makes the spread.

    `half_68`: half the width of the central 68 % of directions. `near`: the spread of returns
    without directions that err by more than 5 cm, whose share is `far_share`. `noise`: the spread
    of returns about their direction's mean, which no calibration can cure.
    """
    e, n = error_m[rows].astype(float), points["count"][rows].astype(float)
    s2 = np.square(np.nan_to_num(points["precision_m"][rows].astype(float)))
    near = np.abs(e - np.median(e)) < FAR_OFF_M
    low, high = np.quantile(e, (0.15865, 0.84135))
    return {
        "mean": 1e3 * float(np.average(e, weights=n)),
        "std": 1e3 * _std(e, n, s2),
        "half_68": 1e3 * float(high - low) / 2,
        "near": 1e3 * _std(e[near], n[near], s2[near]),
        "far_share": float(1 - near.mean()),
        "noise": 1e3 * float(np.sqrt(np.average(s2[near], weights=n[near]))),
    }


def _std(e: np.ndarray, n: np.ndarray, s2: np.ndarray) -> float:
    mean = np.average(e, weights=n)
    return float(np.sqrt(np.average((e - mean) ** 2 + s2, weights=n)))


def offsets(sequence: Columns, graphs: Mapping[str, Columns], offset_m: np.ndarray) -> list[Row]:
    """Table 6 and what goes beyond it, of stops that no method learnt from.

    Args:
        sequence: points at the study's poses, all stops, uncorrected.
        graphs: corrected points by method, of the left-out stops.
        offset_m: (rings,) by averaging over the other stops.
    """
    raw, unseen = sequence["raw_signed_error_m"], sequence["left_out"]
    learnt = well_seen(sequence) & ~unseen
    one_m = np.average(raw[learnt], weights=sequence["count"][learnt])
    every, chosen = np.flatnonzero(unseen), np.flatnonzero(unseen & well_seen(sequence))
    rows = [
        {"step": "origin", **spread(sequence, raw, every)},
        {"step": "origin, filtered", **spread(sequence, raw, chosen)},
        {"step": "one offset", **spread(sequence, raw - one_m, chosen)},
        {"step": "ring offsets", **spread(sequence, raw - offset_m[sequence["ring"]], chosen)},
    ]
    for name, points in graphs.items():
        some = np.flatnonzero(well_seen(points))
        rows.append({"step": name, **spread(points, points["signed_error_m"], some)})
    return rows


def cloud_to_mesh(stops: Iterable[Evaluated]) -> tuple[Row, Columns]:
    """Table 5 of one LiDAR, of all returns uncorrected; and their points."""
    tally, kept = Tally(raw=True), []
    for done in stops:
        tally.add(done)
        kept.append(done)
    evaluation = tally.document({})
    keys = ("signed_error_mm", "cloud_to_mesh_mm", "accuracy_mm", "precision_mm")
    return {key: evaluation[key] for key in keys}, gather(kept)


# ----------------------------------------------------------- what each method buys, on unseen stops


def judged(case: Case, state: State, tell: Any) -> tuple[Row, Columns]:
    """One line of the comparison: errors on stops left out, and against the truth; the points."""
    names, tally = case.stops(True), Tally()
    kept = []
    for done in state.evaluated(names, tell):
        tally.add(done)
        kept.append(done)
    evaluation = tally.document({})
    row = {
        "held_out_rms": state.held_out(names).rms_mm,
        "mean": evaluation["signed_error_mm"]["mean"],
        "std": evaluation["signed_error_mm"]["std"],
        "half_68": evaluation["signed_error_mm"]["half_68"],
        "cloud_to_mesh": evaluation["cloud_to_mesh_mm"],
        "plane": _wall(evaluation["planes"]),
    }
    return row | against_truth(case, state), gather(kept)


def _wall(planes: list[Row]) -> float:
    """Mean thickness of the planes of most returns, weighted by these."""
    return float(np.average([p["thickness_mm"] for p in planes], weights=[p["n"] for p in planes]))


def against_truth(case: Case, state: State) -> Row:
    """How far poses of the stops left out, lengths, rings and scanner are from the truth."""
    true = case.truth
    scans = {scan.name: scan for scan in state.problem.scans}
    off = [
        se3.log(
            se3.inverse(np.array(true["stops"][name]["T_faro_lidar"]))
            @ scans[name].pose(state.values)
        )
        for name in case.stops(True)
    ]
    turn, shift = np.square(off)[:, :3].sum(axis=1), np.square(off)[:, 3:].sum(axis=1)
    lengths = np.array(true["effects"][LENGTHS])
    (term,) = (t for t in state.problem.terms[0] if t.variable == LENGTHS)
    rings = np.array(true["effects"][RINGS]) - state.values[RINGS]
    T_faro_opti = np.array(true["T_faro_opti"])
    scanner = se3.log(T_faro_opti @ state.values[case.source.rig.reference_frame])
    return {
        "pose_mm": 1e3 * float(np.sqrt(shift.mean())),
        "pose_mrad": 1e3 * float(np.sqrt(turn.mean())),
        "lengths_mm": 1e3 * _rms(state.values[LENGTHS] - lengths[term.free]),
        "rings_mm": 1e3 * _rms(rings),
        "ring_pattern_mm": 1e3 * float(np.std(rings)),
        "faro_mm": 1e3 * float(np.linalg.norm(scanner[3:])),
        "faro_mrad": 1e3 * float(np.linalg.norm(scanner[:3])),
    }


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
