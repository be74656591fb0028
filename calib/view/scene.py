"""What a run shows at a stop, as arrays in the reference's frame: points, rig and room.

Points are drawn from the run's own residual tables: each on its beam, off the surface that it met
by its residual, which is what is left when all that the model knows has been taken off.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from calib.forward import Stops
from calib.problem import Problem
from calib.problem.model import Source
from calib.residuals.scan import ScanStop
from calib.runs.reopen import problem_of, reopened, state_of
from calib.runs.residual_table import UNSEEN_FOLDER, beam_ends, residual_table, table_path
from calib.runs.run import RESIDUALS, Run
from chains import se3
from chains.errors import InputError
from sensors.recording import read_table

MOST_POINTS = 150_000  # more than a screen can tell apart
MOST_TRIANGLES = 300_000  # of a room, and of a whole arm
CLICK_REACH = 0.01  # of its distance from the eye: what a click may miss a point by
_NEEDED = ("ring", "column", "range_m", "incidence_rad", "azimuth_rad", "elevation_rad")
_NEEDED += ("residual_m", "sigma_m", "weight")


@dataclass(frozen=True)
class Points:
    """The beams of a stop, or of several, that the fit used, N of them.

    Args:
        xyz_m: (N, 3) in the reference's frame.
        eye_m: (3,) where the LiDAR is, at the first stop, in the same.
        columns: (N,) each, as in the residual table.
        measured: how many beams the stops have, N of which are here.
    """

    xyz_m: np.ndarray
    eye_m: np.ndarray
    columns: Mapping[str, np.ndarray]
    measured: int

    @property
    def inlier(self) -> np.ndarray:
        """(N,) bool, those with any weight in the fit."""
        return self.columns["weight"] > 0

    def drawn(
        self, below_m: float = np.inf, most: int = MOST_POINTS, among: np.ndarray | bool = True
    ) -> np.ndarray:
        """Indices (n,) of those to draw: lower than `below_m`, every so many of them.

        Args:
            below_m: height.
            most: of them.
            among: (N,) bool, those that may be.
        """
        low = np.flatnonzero((self.xyz_m[:, 2] < below_m) & among)
        return low[:: max(1, -(-len(low) // most))]

    def picked(
        self, among: np.ndarray, origin_m: Sequence[float], direction: Sequence[float]
    ) -> int | None:
        """Index of the point that a ray through a pixel meant; None where it meant none.

        The nearest to the eye of those hardly beside the ray, as that one hides the others.

        Args:
            among: (n,) indices of those that are drawn.
            origin_m: (3,) the eye.
            direction: (3,) of any length.
        """
        reach = self.xyz_m[among] - np.asarray(origin_m, float)
        along = reach @ (np.asarray(direction, float) / np.linalg.norm(direction))
        beside = np.sqrt(np.maximum(np.einsum("ni,ni->n", reach, reach) - along**2, 0.0))
        with np.errstate(divide="ignore", invalid="ignore"):
            off = np.where(along > 0, beside / along, np.inf)
        meant = np.flatnonzero(
            off < max(CLICK_REACH / 4, min(CLICK_REACH, off.min(initial=np.inf) * 1.5))
        )
        return int(among[meant[np.argmin(along[meant])]]) if len(meant) else None


@dataclass(frozen=True)
class Scene:
    """A run's recordings, and where its fit puts everything.

    Args:
        run: the run.
        sources: its recordings.
        problem: its model on them; nothing in it is solved.
        state: where its fit stood.
    """

    run: Run
    sources: Sequence[Source]
    problem: Problem
    state: Mapping[str, np.ndarray]

    @classmethod
    def of(cls, run: Run) -> Scene:
        """Open what a run was fitted to.

        Raises:
            InputError: the recordings are gone or changed, or the run is of an earlier version.
        """
        sources = reopened(run)
        # Poses need no surface, and planes would have to be looked for in every scan.
        flat = [i for i, source in enumerate(sources) if source.reference is None]
        nothing = dict.fromkeys(flat, object())
        problem = problem_of(run, sources, nothing)
        scene = cls(run, sources, problem, state_of(run, problem))
        for stops, _ in scene._stops.values():
            unknown = [name for name in stops.variables if name not in scene.state]
            if unknown:
                raise InputError(f"{run.folder}: its state lacks '{unknown[0]}'; fit the run again")
        return scene

    @property
    def names(self) -> list[str]:
        """Of its recordings, by their folders."""
        folders = [s.recording.folder for s in self.sources]
        names = [folder.name for folder in folders]
        return names if len(set(names)) == len(names) else [str(folder) for folder in folders]

    def stops(self, recording: int) -> list[str]:
        """Stops of a recording at which something was measured."""
        names = self.sources[recording].recording.stops
        return [names[k] for number, k in self._stops if number == recording]

    def place(self, recording: int, stop: str, frame: str) -> np.ndarray:
        """T_reference_frame (4, 4) as fitted; in the tracker's frame where there is no reference.

        Raises:
            InputError: nothing was measured at the stop, so nothing says where the rig was.
        """
        stops, row = self._of_stop(recording, stop)
        return stops.in_reference(frame, self.state).T[row]

    def _of_stop(self, recording: int, stop: str) -> tuple[Stops, int]:
        """The geometry that places a stop, and its row there."""
        key = recording, self.sources[recording].recording.stops.index(stop)
        if key not in self._stops:
            raise InputError(f"stop '{stop}' has neither a scan nor a tracked body")
        return self._stops[key]

    def frames(self, recording: int, stop: str) -> dict[str, np.ndarray]:
        """Frame -> T_reference_frame (4, 4): the rig's root, its arm's ends, all that CAD names."""
        rig = self.sources[recording].rig
        edges = rig.tree.edges
        named = [e.child for e in edges if e.name not in rig.arm_edges]
        ends = [rig.arm_base, *rig.tips] if rig.chains else []
        names = dict.fromkeys((rig.tree.root, *ends, *named))
        return {name: self.place(recording, stop, name) for name in names}

    def links(
        self, recording: int, stop: str, shaped: Collection[str] = ()
    ) -> tuple[np.ndarray, np.ndarray]:
        """Segments (n, 2, 3) m from frame to frame, and which of them (n,) are the arm's; none
        between two frames that are `shaped`, as those links are drawn by their meshes."""
        rig = self.sources[recording].rig
        at = {f: self.place(recording, stop, f)[:3, 3] for f in rig.tree.frames}
        ends = [(at[e.parent], at[e.child]) for e in rig.tree.edges]
        arm = [e.name in rig.arm_edges for e in rig.tree.edges]
        drawn = np.array([not {e.parent, e.child} <= {*shaped} for e in rig.tree.edges], bool)
        drawn &= [np.linalg.norm(b - a) > 1e-6 for a, b in ends]
        return np.reshape(ends, (-1, 2, 3))[drawn], np.array(arm, bool)[drawn]

    def twists(self, recording: int, stop: str) -> tuple[np.ndarray, np.ndarray]:
        """By which twist (E, 6) each edge of the rig differs at a stop from what is drawn, by
        all effects on edges, and its covariance (E, 6, 6); NaN where an effect has none.

        Raises:
            InputError: nothing was measured at the stop.
        """
        stops, row = self._of_stop(recording, stop)
        known = {key: i for i, key in enumerate(self.run.solution.keys)}
        edges = len(stops.rig.tree.edges)
        twists, jacobians, numbers = np.zeros((edges, 6)), [np.zeros((edges, 6, 0))], []
        for name, bases in stops.edge_bases.items():
            (basis,) = stops.at_edges(name, bases[[row if len(bases) > 1 else 0]])
            twists += basis @ self.state[name]
            jacobians.append(basis)
            numbers += [known.get(key) for key in self.problem.variables[name].keys]
        lost = np.array([number is None for number in numbers], bool)
        at = np.array([number or 0 for number in numbers], int)
        covariance = self.run.solution.covariance[np.ix_(at, at)]
        J = np.concatenate(jacobians, axis=2)
        out = J @ np.where(lost | lost[:, None], 0.0, covariance) @ np.swapaxes(J, 1, 2)
        out[np.any(J[:, :, lost] != 0, axis=(1, 2))] = np.nan
        return twists, out

    def points(self, recording: int, stop: str) -> Points | None:
        """The stop's beams; None where it was not scanned.

        Raises:
            InputError: the run's table of the stop is gone, or of another version.
        """
        scan = self._scans.get((recording, stop))
        if scan is None:
            return None
        columns = self._table(self.run, scan)
        T = scan.pose(self.state)
        xyz_m = se3.apply(T, beam_ends(columns, scan.lidar.beam_origin_m))
        return Points(xyz_m, T[:3, 3], columns, len(xyz_m))

    def table(
        self, recording: int, stop: str, other: Run, unseen: bool = False
    ) -> Mapping[str, np.ndarray] | None:
        """What a run of the same recordings left of the stop's beams, as in its residual table;
        None where it has none of the stop.

        Args:
            recording: its number.
            stop: its name.
            other: the run, this one or another.
            unseen: as a fit without the stop predicts its beams, where the stop was held out.

        Raises:
            InputError: the table is of another version.
        """
        scan, folder = self._scans[recording, stop], UNSEEN_FOLDER if unseen else "."
        gone = not table_path(other.folder / RESIDUALS / folder, scan, self.sources).is_file()
        return None if gone else self._table(other, scan, folder)

    def nominal(self, recording: int, stop: str) -> Mapping[str, np.ndarray] | None:
        """The residual table of a stop with every frame and effect as in CAD, the rig where it then
        seems to be; None where there is no mesh, as planes would have to be looked for anew."""
        scan = self._scans[recording, stop]
        if self.sources[recording].reference is None:
            return None
        key = recording, stop
        if key not in self._nominal:
            self._nominal[key] = residual_table(scan.rows(self.problem.initial))
        return self._nominal[key]

    def _table(self, run: Run, scan: ScanStop, folder: str = ".") -> Mapping[str, np.ndarray]:
        path = table_path(run.folder / RESIDUALS / folder, scan, self.sources)
        try:
            columns = read_table(path)
        except InputError as error:
            raise InputError(f"{error}; the run is incomplete, fit it again") from None
        missing = [name for name in _NEEDED if name not in columns]
        if missing:
            raise InputError(f"{path} has no column {missing[0]}; fit the run again")
        return columns

    def room(self, recording: int) -> tuple[np.ndarray, np.ndarray] | None:
        """Vertices (V, 3) m and triangles (F, 3) of the mesh, its faces turned to the LiDAR.

        Of a mesh too large to be drawn, the largest triangles; None where there is none.
        """
        mesh = self.sources[recording].reference
        if mesh is None:
            return None
        kept = np.arange(len(mesh.triangles))
        if len(kept) > MOST_TRIANGLES:
            kept = np.sort(np.argsort(-mesh.area_m2)[:MOST_TRIANGLES])
        triangles = mesh.triangles[kept].copy()
        first = next((s for number, s in self._scans if number == recording), None)
        if first is not None:
            lidar = self.sources[recording].rig.lidar_frame
            eye = self.place(recording, first, lidar)[:3, 3]
            a, b, c = np.moveaxis(mesh.vertices_m[triangles], 1, 0)
            away = np.einsum("ni,ni->n", np.cross(b - a, c - a), eye - a) < 0
            triangles[away] = triangles[away][:, ::-1]
        return mesh.vertices_m, triangles

    @cached_property
    def _nominal(self) -> dict[tuple[int, str], Mapping[str, np.ndarray]]:
        """Tables that `nominal` has made."""
        return {}

    @cached_property
    def _scans(self) -> dict[tuple[int, str], ScanStop]:
        number = {id(s.recording): i for i, s in enumerate(self.sources)}
        return {(number[id(s.recording)], s.name): s for s in self.problem.scans}

    @cached_property
    def _stops(self) -> dict[tuple[int, int], tuple[Stops, int]]:
        """(recording, stop) -> the geometry that places it, and its row there; in their order."""
        number = {s.recording.folder: i for i, s in enumerate(self.sources)}
        placed: dict[tuple[int, int], tuple[Stops, int]] = {}
        for block in self.problem.seen:
            for row, (folder, k) in enumerate(block.stop_names):
                placed[number[folder], k] = block.stops, row
        for scan in self.problem.scans:
            placed[number[scan.recording.folder], scan.index] = scan.stops, 0
        return dict(sorted(placed.items(), key=lambda item: item[0]))


def sunk(vertices_m: np.ndarray, triangles: np.ndarray, depth_m: float) -> np.ndarray:
    """Vertices (V, 3) of a mesh moved so far behind its faces, where those meet on average."""
    a, b, c = np.moveaxis(vertices_m[triangles], 1, 0)
    across = np.cross(b - a, c - a)
    # Where surfaces only touch, each has vertices of its own: they must go the same way.
    _, place = np.unique(np.round(vertices_m, 6), axis=0, return_inverse=True)
    normal = np.zeros((place.max(initial=-1) + 1, 3))
    for corner in triangles.T:
        np.add.at(normal, place[corner], across)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    return vertices_m - depth_m * normal[place]


def box(points_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Corners (3,) of a box that holds nearly all points (N, 3)."""
    low, high = np.quantile(points_m, [0.01, 0.99], axis=0)
    return low, high


def camera(low_m: np.ndarray, high_m: np.ndarray, fov_rad: float) -> tuple[np.ndarray, np.ndarray]:
    """Where an eye stands (3,) to see a box from above one corner, and where it looks (3,)."""
    centre = (low_m + high_m) / 2
    size = max(float(np.linalg.norm(high_m - low_m)), 1.0)
    along = np.array([-0.5, -0.65, 0.7])
    return centre + along * (0.5 * size / np.tan(fov_rad / 2)), centre
