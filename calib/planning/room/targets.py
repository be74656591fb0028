"""Where targets should hang: spheres on rods, in the tracker's volume and clear of the room.

A target ties the reference's frame to the tracker's. What one of them tells is nine rows; its own
marker's place is eliminated from them, and what is left adds up over targets as it does over stops.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from calib.diagnosis.linear import beside
from calib.linear.layout import Layout
from calib.planning.information import Information
from calib.planning.room.sight import seen_by_two
from calib.planning.scene import PlanningScene
from calib.planning.stops import MARK
from calib.problem import Problem, build
from calib.problem.bodies import GRAVITY
from calib.problem.unknowns import Role
from calib.residuals.targets import HangingTarget
from calib.solve.clustered import of_graph
from calib.solve.graph import Graph
from chains import se3
from chains.errors import InputError
from sensors.stops import Targets

# The upper marker above the lower one, where no target of the recording says; assumed.
ROD_M = 0.3
TARGET_CLEAR_M = 0.3  # of a sphere and its rod to the mesh: room to hang it; a choice
PLACES_DRAWN = 20  # times as many places as are wanted are drawn


def hanging_places(
    scene: PlanningScene,
    region: Sequence[float] | None,
    count: int,
    rng: np.random.Generator,
    cameras_m: np.ndarray | None = None,
) -> np.ndarray:
    """Random places (n, 3) of spheres, reference frame, m: in the box that the tracker was seen to
    reach or, with a region, between the mesh's floor and ceiling there; clear of the mesh.

    Args:
        scene: the fit.
        region: x and y of two corners, m, in the reference's frame.
        count: how many at most.
        rng: chance.
        cameras_m: (C, 3) of the tracker, world frame, two of which are to see both markers of each;
            None where nothing says where they are.

    Raises:
        InputError: the rig has no targets, no box, or no place in it is clear.
    """
    source, mesh = scene.source, scene.source.reference
    if source.rig.target is None or source.rig.tracker is None:
        raise InputError(f"{source.rig.folder}: rig.yaml describes no target and tracker of it")
    if region is None:
        low, high = _tracked(scene)
    elif mesh is None:
        raise InputError("--region: there is no mesh to say where the floor is; add reference.mesh")
    else:
        ends = mesh.vertices_m[:, 2].min(), mesh.vertices_m[:, 2].max()
        low, high = np.column_stack([np.sort(np.reshape(region, (2, 2)), axis=0), ends])
    at = rng.uniform(low, high, (PLACES_DRAWN * count, 3))
    if mesh is not None:
        top = se3.inverse(scene.T_world_reference)[:3, :3] @ _upper(scene)
        clear = [mesh.distance_m(at + share * top) > TARGET_CLEAR_M for share in (0.0, 0.5, 1.0)]
        inside = [_inside(mesh.vertices_m, at + share * top) for share in (0.0, 1.0)]
        at = at[np.all([*clear, *inside], axis=0)]
    if cameras_m is not None:
        T = scene.T_world_reference
        markers = [se3.apply(T, at) + share * _upper(scene) for share in (_lower_share(scene), 1.0)]
        at = at[np.all([seen_by_two(source, cameras_m, each, T) for each in markers], axis=0)]
    if not len(at):
        raise InputError(
            f"no place for a target is {TARGET_CLEAR_M:g} m clear of the mesh"
            + (" and in two cameras' sight" if cameras_m is not None else "")
            + "; give another --region"
        )
    return at[:count]


def _tracked(scene: PlanningScene) -> tuple[np.ndarray, np.ndarray]:
    """Two corners (3,) of the box, reference frame, in which the tracker saw anything.

    Raises:
        InputError: it saw nothing.
    """
    recording = scene.source.recording
    seen = [body[:, :3] for body in recording.bodies.values()]
    if recording.targets is not None:
        seen += [recording.targets.upper_m, recording.targets.lower_m]
    points = np.concatenate([np.zeros((0, 3)), *seen])
    points = points[np.isfinite(points).all(axis=1)]
    if not len(points):
        raise InputError(
            f"{recording.folder}: the tracker has seen nothing yet, so say with --region x0 y0 x1 "
            "y1 where it sees, m, in the reference's frame"
        )
    points = se3.apply(se3.inverse(scene.T_world_reference), points)
    return points.min(axis=0), points.max(axis=0)


def _inside(vertices_m: np.ndarray, at_m: np.ndarray) -> np.ndarray:
    """(n,) whether places are within the mesh's box."""
    return ((at_m > vertices_m.min(axis=0)) & (at_m < vertices_m.max(axis=0))).all(axis=1)


def _down(scene: PlanningScene) -> np.ndarray:
    """Along which rods hang (3,), world frame: as estimated, or down in the reference's frame."""
    down = scene.values.get(GRAVITY)
    return -scene.T_world_reference[:3, 2] if down is None else down / np.linalg.norm(down)


def _rod_m(scene: PlanningScene) -> float:
    """The upper marker above the lower one, of the recording's targets in the median."""
    targets = scene.source.recording.targets
    if targets is None:
        return ROD_M
    return float(np.nanmedian(np.linalg.norm(targets.upper_m - targets.lower_m, axis=1)))


def _upper(scene: PlanningScene) -> np.ndarray:
    """From a sphere to the upper marker above it (3,), world frame, m."""
    below_m = scene.source.rig.target.sphere_below_lower_marker_m
    return -(below_m + _rod_m(scene)) * _down(scene)


def _lower_share(scene: PlanningScene) -> float:
    """Where the lower marker is on the way from the sphere to the upper one."""
    below_m = scene.source.rig.target.sphere_below_lower_marker_m
    return below_m / (below_m + _rod_m(scene))


def _with_targets(
    scene: PlanningScene, at_m: np.ndarray
) -> tuple[Problem, dict[str, np.ndarray], list[HangingTarget]]:
    """The problem with targets (n, 3) in the reference's frame beside all that was measured, where
    all of it lies, and those targets."""
    source, recording = scene.source, scene.source.recording
    sphere = se3.apply(scene.T_world_reference, at_m)
    upper = sphere + _upper(scene)
    lower = upper + _rod_m(scene) * _down(scene)
    names = [f"{MARK}{k}" for k in range(len(at_m))]
    old = recording.targets or Targets([], *np.zeros((3, 0, 3)))
    parts = zip((old.faro_m, old.upper_m, old.lower_m), (at_m, upper, lower), strict=True)
    targets = Targets([*old.names, *names], *(np.vstack(pair) for pair in parts))
    longer = replace(source, recording=replace(recording, targets=targets))
    if source.rig.lidar is not None:
        longer.__dict__["store"] = source.store  # what was read stays read
    stand = scene.stand
    sources = [longer, *stand.sources[1:]]
    model = stand.model.plus(tuple(scene.added))
    problem = build(sources, model, meetings=stand.problem.meetings)
    for name in (n for n in scene.calibration if n not in problem.variables):
        problem.calibration.append(problem.add(stand.estimate.problem.variables[name]))
    problem, values = beside(problem, stand.estimate)
    hung = [b for b in problem.blocks if isinstance(b, HangingTarget)][-len(at_m) :]
    return problem, values, hung


def known_with(scene: PlanningScene, at_m: np.ndarray) -> Information:
    """What is known with targets (n, 3) in the reference's frame beside all that was measured."""
    if not len(at_m):
        return scene.now
    problem, values, _ = _with_targets(scene, at_m)
    return scene.told_by(problem, values, scene.stand.estimate.associations)


def each_target(scene: PlanningScene, at_m: np.ndarray) -> tuple[Information, np.ndarray]:
    """What is known without any planned target, and what each of some (n, 3) tells (n, S, S)."""
    problem, values, hung = _with_targets(scene, at_m)
    weightless = {id(b): replace(b, weight=np.zeros(3)) for b in hung}
    bare = replace(problem, blocks=[weightless.get(id(b), b) for b in problem.blocks])
    met = scene.stand.estimate.associations
    known = scene.told_by(bare, values, met)
    markers = {n for n, u in problem.variables.items() if u.role is Role.TARGET}
    known = known.onto(np.array([i for i, (n, _) in enumerate(known.keys) if n not in markers]))
    layout = Layout.of(problem, unbounded=scene.unbounded)
    graph = Graph(list(layout.outer().values()), layout.others, layout.unbounded)
    number = {id(b): k for k, b in enumerate(hung)}
    place = {key: i for i, key in enumerate(known.keys)}
    every = (key for unknown in layout.outer().values() for key in unknown.keys)
    keys = dict(zip(layout.kept.tolist(), every, strict=True))
    out = np.zeros((len(hung), len(known.keys), len(known.keys)))
    for block, _, rows in of_graph(graph, layout, values):
        if (k := number.get(id(block))) is not None:
            A = rows.A * layout.sigma[rows.columns]
            at = np.array([place.get(keys[c], -1) for c in rows.columns.tolist()])
            own, shared = A[:, at < 0], A[:, at >= 0]
            gone = np.linalg.solve(own.T @ own + np.eye(own.shape[1]), own.T @ shared)
            out[k][np.ix_(at[at >= 0], at[at >= 0])] += shared.T @ (shared - own @ gone)
    return known, out
