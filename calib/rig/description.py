"""rig.yaml: what is bolted to what, what measures it, and how sure its builder is."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from calib.outputs import settle
from calib.rig.document import (
    RECORDING_FORMAT,
    ArmDocument,
    ReferenceDocument,
    RigDocument,
)
from chains import remote, se3
from chains.arm import Mass, read_arm, read_masses
from chains.errors import InputError, shortened
from chains.frames import Edge, FrameTree, Joint, unknown_name
from sensors.documents import Document, Marks, read_yaml, validate
from sensors.lidar import LidarModel, load_lidar


@dataclass(frozen=True)
class Tracker:
    """What sees the bodies: its world frame, and its noise per axis [m, rad]."""

    frame: str
    bodies: tuple[str, ...]
    sigma_m: float
    sigma_rad: float


@dataclass(frozen=True)
class Levels:
    """Accelerometers: the frames that have one, its noise, and what is known of up in the world."""

    frames: tuple[str, ...]
    sigma_rad: float | None
    """Of a direction, about either axis across it; None without frames."""
    sigma_zero_rad: float | None = None
    """Of what an axis reads where it feels nothing, over 1 g; None where that counts as none."""
    up: tuple[float, float, float] | None = None
    sigma_up_rad: float | None = None


@dataclass(frozen=True)
class TargetSpec:
    """A rod with two markers and a sphere below them, hanging along gravity; in m."""

    sphere_below_lower_marker_m: float
    sigma_sphere_m: float
    sigma_marker_m: float


@dataclass(frozen=True)
class ReferenceSpec:
    """The scanned mesh: its world frame, its files, the error of its surface [m], and where the
    scanner stood, each station (3,) [m] in that frame."""

    frame: str
    mesh: Path
    faces: Path | None
    labels: Path | None
    sigma_m: float
    scanner_m: tuple[tuple[float, float, float], ...]


@dataclass(frozen=True)
class Rig:
    """The rig as built on paper, validated."""

    name: str
    folder: Path
    tree: FrameTree
    """Every edge from CAD, named after its child frame, and of the arm, named after its joint."""
    frame_sigma: dict[str, NDArray[np.float64]]
    """Per frame (6,) [rad rad rad m m m] how sure CAD is, about the child's axes; 0 = exact."""
    lidar: LidarModel | None
    lidar_frame: str | None
    chains: tuple[tuple[str, ...], ...]
    """Per tip of the arm, the URDF joints between its base and there, in order, fixed ones too."""
    joint_names: tuple[str, ...]
    """Those that move, as the stops name them."""
    sigma_joint_rad: float
    moves: Literal["stop", "location", "never"]
    """When T_opti_base may change."""
    tracker: Tracker | None
    target: TargetSpec | None
    reference: ReferenceSpec | None
    shared: tuple[str, ...]
    """Frames and effects that are the same hardware in every recording."""
    own: tuple[str, ...]
    """Frames and effects that belong to this recording alone."""
    masses: tuple[Mass, ...] = ()
    """What weighs on the arm's joints, as the URDF says."""
    arm_urdf: Path | None = None
    """The URDF that the arm was read from."""
    effects: tuple[Path, ...] = ()
    """Files of formulas: effects of the user's own, candidates of every diagnosis."""
    levels: Levels | None = None
    passive: tuple[str, ...] = ()
    """Joints that nothing reads: unknown at every stop."""
    labels: dict[int, str] = field(default_factory=dict)
    """Names of the labels of the reference's triangles; empty where nothing names them."""

    @property
    def world(self) -> str:
        """The frame that poses are given in: the tracker's, or else the reference's."""
        return self.tracker.frame if self.tracker else self.reference_frame

    @property
    def reference_frame(self) -> str:
        """The frame of the mesh and of the spheres' centres."""
        return self.reference.frame if self.reference else "faro"

    @property
    def arm_edges(self) -> tuple[str, ...]:
        """URDF joints of all chains, each once."""
        return tuple(dict.fromkeys(name for chain in self.chains for name in chain))

    @property
    def arm_base(self) -> str | None:
        """The link that all chains begin at."""
        return self.edge(self.chains[0][0]).parent if self.chains else None

    @property
    def tips(self) -> tuple[str, ...]:
        """The links that the chains end at."""
        return tuple(self.edge(chain[-1]).child for chain in self.chains)

    def edge(self, name: str) -> Edge:
        """The edge of the tree that is called so."""
        return self.tree.edges[self.tree.edge_names.index(name)]

    def beyond(self, tips: Sequence[str]) -> frozenset[str]:
        """Frames of CAD that hang from any of some links."""
        ways = {name: self.tree.path(name) for name in self.frame_sigma}
        carried = {n: {self.tree.edges[i].parent for i in way} for n, way in ways.items()}
        return frozenset(n for n, links in carried.items() if not links.isdisjoint(tips))

    @property
    def beyond_arm(self) -> frozenset[str]:
        """Frames that hang from the arm's tips; all of them where there is no arm."""
        return self.beyond(self.tips) if self.chains else frozenset(self.frame_sigma)

    @cached_property
    def joints(self) -> tuple[Joint, ...]:
        """Those that move by a value of their own, as `joint_names` has them."""
        known = {j.name: j for e in self.tree.edges if (j := e.joint) is not None and j.leads}
        return tuple(known[name] for name in self.joint_names)

    @cached_property
    def joint_kinds(self) -> tuple[str, ...]:
        """ "revolute" or "prismatic", by joint."""
        return tuple(joint.kind for joint in self.joints)

    @property
    def joint_units(self) -> dict[str, str]:
        """The unit of every joint, by its name."""
        return {joint.name: joint.unit for joint in self.joints}

    @property
    def followers(self) -> list[Edge]:
        """Edges of joints that follow another, whether that is in the chains or not."""
        return [e for e in self.tree.edges if e.joint is not None and e.joint.name != e.name]

    @property
    def turning(self) -> frozenset[str]:
        """Names of the joints that turn."""
        return frozenset(joint.name for joint in self.joints if joint.kind == "revolute")

    @property
    def carried(self) -> tuple[str, ...]:
        """The tracked bodies that joints move."""
        bodies = self.tracker.bodies if self.tracker else ()
        return tuple(body for body in bodies if self.joints_to(body))

    def joints_to(self, frame: str) -> tuple[str, ...]:
        """The moving joints between the root and a frame."""
        edges = (self.tree.edges[i] for i in self.tree.path(frame))
        return tuple(dict.fromkeys(edge.joint.name for edge in edges if edge.joint is not None))


def load_rig(folder: str | Path) -> Rig:
    """Read and check rig.yaml in a recording's folder, with the URDF and LiDAR model it names.

    Raises InputError, one sentence with file, line and key, for unknown keys and frames, missing
    files, frames that form no tree, and numbers that look like millimetres or degrees.
    """
    folder = remote.here(folder)
    settle(folder)
    path = folder / "rig.yaml"
    if not path.is_file():
        raise InputError(f"{path} does not exist; a recording is a folder that holds one")
    data, marks = read_yaml(path)
    RECORDING_FORMAT.check(data, path)
    file = validate(RigDocument, data, path, marks)
    where = _Where(path, marks)
    arm, masses = _read_arm(file.arm, folder, where)
    reference = _read_reference(file.reference, folder, where) if file.reference else None
    tree = _read_tree(file, arm, where)
    _check_frames(file, tree, where)
    return Rig(
        name=file.name,
        folder=folder,
        tree=tree,
        frame_sigma={
            name: np.array(frame.sigma_rad + frame.sigma_m) for name, frame in file.frames.items()
        },
        lidar=_read_lidar(file.lidar, folder, where) if file.lidar else None,
        lidar_frame=file.lidar.frame if file.lidar else None,
        chains=_chains(file.arm, tree),
        joint_names=tree.joint_names,
        passive=file.arm.passive if file.arm else (),
        sigma_joint_rad=file.arm.sigma_joint_rad if file.arm else 0.0,
        moves=file.base.moves,
        tracker=Tracker(**file.tracker.model_dump()) if file.tracker else None,
        levels=Levels(**file.levels.model_dump()) if file.levels else None,
        target=TargetSpec(**file.target.model_dump()) if file.target else None,
        reference=reference,
        shared=file.shared,
        own=file.own,
        masses=masses,
        arm_urdf=folder / file.arm.urdf if file.arm else None,
        effects=_read_effects(file.effects, folder, where),
        labels=_read_labels(reference.labels) if reference else {},
    )


@dataclass(frozen=True)
class _Where:
    """Says where in rig.yaml something is wrong."""

    path: Path
    marks: Marks

    def wrong(self, what: object, *key: str | int) -> InputError:
        line = next(
            (self.marks[key[:n]] for n in range(len(key), 0, -1) if key[:n] in self.marks), 1
        )
        return InputError(f"{self.path}:{line}: {'.'.join(map(str, key))}: {what}")

    def file(self, folder: Path, name: str | None, *key: str | int) -> Path | None:
        if name is None:
            return None
        if not (folder / name).is_file():
            raise self.wrong(f"{folder / name} does not exist; add the file or drop the key", *key)
        return folder / name


def _read_arm(
    arm: ArmDocument | None, folder: Path, where: _Where
) -> tuple[list[Edge], tuple[Mass, ...]]:
    if arm is None:
        return [], ()
    urdf = where.file(folder, arm.urdf, "arm", "urdf")
    edges = read_arm(urdf, arm.base, *arm.tip)
    return edges, tuple(read_masses(urdf, arm.base, *arm.tip))


def _chains(arm: ArmDocument | None, tree: FrameTree) -> tuple[tuple[str, ...], ...]:
    """The edges from the arm's base to each of its tips; none where these are one."""
    if arm is None:
        return ()
    below = len(tree.path(arm.base))
    chains = (tree.path(tip)[below:] for tip in arm.tip)
    return tuple(tuple(tree.edge_names[i] for i in chain) for chain in chains if chain)


def _read_tree(file: RigDocument, arm: list[Edge], where: _Where) -> FrameTree:
    edges = [
        Edge(name, frame.parent, name, se3.from_xyz_rpy(frame.xyz_m, frame.rpy_rad))
        for name, frame in file.frames.items()
    ]
    root = file.lidar.frame if file.lidar else "base"
    try:
        return FrameTree([*edges, *arm], root=None if edges or arm else root)
    except InputError as error:
        raise where.wrong(error, "frames") from None


def _check_frames(file: RigDocument, tree: FrameTree, where: _Where) -> None:
    """Sensors and bodies stand in the tree, worlds outside of it."""
    named = [(("lidar", "frame"), file.lidar.frame)] if file.lidar else []
    bodies = file.tracker.bodies if file.tracker else ()
    named += [(("tracker", "bodies", i), body) for i, body in enumerate(bodies)]
    levels = file.levels.frames if file.levels else ()
    named += [(("levels", "frames", i), frame) for i, frame in enumerate(levels)]
    for key, name in named:
        if name not in tree.frames:
            raise where.wrong(unknown_name("frame", name, tree.frames), *key)
    for i, joint in enumerate(file.arm.passive if file.arm else ()):
        if joint not in tree.joint_names:
            raise where.wrong(unknown_name("joint", joint, tree.joint_names), "arm", "passive", i)
    if file.levels and not file.levels.frames and not file.tracker:
        what = "without frames it is the tracker that tells how the rig lies; give one, or frames"
        raise where.wrong(what, "levels", "up")
    if file.levels and file.levels.up and not (file.tracker or file.reference):
        what = "nothing here has a world to be upright in; give a tracker or a reference, or no up"
        raise where.wrong(what, "levels", "up")
    for section in ("tracker", "reference"):
        world = getattr(file, section)
        if world and world.frame in tree.frames:
            what = f"'{world.frame}' is a frame of the rig; name the world that it moves in"
            raise where.wrong(what, section, "frame")
    if file.tracker and file.reference and file.tracker.frame == file.reference.frame:
        what = f"'{file.reference.frame}' is the tracker's frame; name another, and how the two lie"
        raise where.wrong(f"{what} to each other is found by the fit", "reference", "frame")


def _read_lidar(lidar: Document, folder: Path, where: _Where) -> LidarModel:
    name = lidar.model
    if name.endswith((".yaml", ".yml")):
        name = where.file(folder, name, "lidar", "model")
    changed = lidar.model_fields_set - {"model", "frame"}
    try:
        return load_lidar(name, {field: getattr(lidar, field) for field in changed})
    except InputError as error:
        raise where.wrong(error, "lidar") from None


def _read_reference(reference: ReferenceDocument, folder: Path, where: _Where) -> ReferenceSpec:
    paths = {
        key: where.file(folder, getattr(reference, key), "reference", key)
        for key in ("mesh", "faces", "labels")
    }
    return ReferenceSpec(
        frame=reference.frame, sigma_m=reference.sigma_m, scanner_m=reference.scanner_m, **paths
    )


def _read_effects(names: tuple[str, ...], folder: Path, where: _Where) -> tuple[Path, ...]:
    for i, name in enumerate(names):
        if not name.endswith((".yaml", ".yml")):
            what = f"{shortened(name)} is no YAML file of formulas; give Python to --candidates"
            raise where.wrong(what, "effects", i)
        where.file(folder, name, "effects", i)
    return tuple(folder / name for name in names)


def _read_labels(path: Path | None) -> dict[int, str]:
    """Number -> name, in the numbers' order."""
    data = read_yaml(path)[0] if path else {}
    if not isinstance(data, dict) or not all(type(number) is int for number in data):
        raise InputError(f"{path}: each line should read `number: name`, as in `0: floor`.")
    return {number: str(data[number]) for number in sorted(data)}
