"""The recordings that mishaps are done to: rigs of every kind, each from a world with no mishap.

Those by the independent simulator are judged by. A few were recorded with one mishap, which is
undone here: what is left is a good recording. Rigs with less than all are the same recordings with
instruments taken away. Beside them are the program's own presets.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from calib.simulation import PRESETS, simulate

from ..mishaps import Scene
from ..mishaps.scene import QUAT, XYZ

SHARED = Path(__file__).resolve().parents[3] / "shared" / "data" / "recordings"
BEAMS = 800  # of a stop, about: columns are left out until so few are left
BEAMS_OF_PLANES = 4000  # enough neighbours for a flat patch to be seen; 2000 of an OS0-128 are not
GUESSED_M, GUESSED_RAD = 0.01, 0.01  # how well somebody guesses where the base stands

Fill = Callable[[Path, int], None]


# ----------------------------------------------------------------- by the independent simulator


def _exchange(scene: Scene) -> None:
    """The scans of two stops change places again."""
    one, other = map(scene.scan_path, ("L00P04", "L04P02"))
    first, second = one.read_bytes(), other.read_bytes()
    one.write_bytes(second)
    other.write_bytes(first)


def _turn_sign(scene: Scene) -> None:
    """The LiDAR's z has its sign again."""
    with scene.description() as rig:
        rig["frames"]["lidar"]["xyz_m"][2] *= -1


def _as_it_is(scene: Scene) -> None:
    """Nothing is wrong with it."""


LABS = (
    ("known_exchanged_scans", _exchange),
    ("known_wrong_cad_sign", _turn_sign),
    ("known_nothing_hidden", _as_it_is),
)


def _copy(name: str, folder: Path) -> None:
    shutil.copytree(SHARED / name, folder)
    for path in (folder, *folder.rglob("*")):
        path.chmod(0o755 if path.is_dir() else 0o644)
    shutil.copy(SHARED / f"{name}.truth.json", f"{folder}.truth.json")


def _lab(folder: Path, number: int, beams: int = BEAMS) -> Scene:
    name, mend = LABS[number % len(LABS)]
    _copy(name, folder)
    scene = Scene(folder, np.random.default_rng(number))
    mend(scene)
    phase = number // len(LABS)

    def thin(columns: dict[str, np.ndarray]) -> None:
        at = np.unique(columns["column"], return_inverse=True)[1]
        step = max(1, round(len(at) / beams))
        keep = at % step == phase % step
        columns.update({name: column[keep] for name, column in columns.items()})

    scene.each_scan(thin)
    return scene


def all_instruments(folder: Path, number: int) -> None:
    """Arm, tracker of base and mount, LiDAR, mesh and targets."""
    _lab(folder, number)


def no_arm(folder: Path, number: int) -> None:
    """A tracked mount with a LiDAR on it, before a mesh with targets."""
    scene = _lab(folder, number)
    seen = np.flatnonzero(scene.seen("mount_markers"))
    with scene.sheet("stops.csv") as stops:
        for stop in set(scene.names) - {scene.names[k] for k in seen}:
            scene.scan_path(stop).unlink()
        stops.keep(seen.tolist())
        for name in [n for n in stops.columns if n.startswith(("joint_", "base_markers"))]:
            del stops.columns[name]
    with scene.description() as rig:
        del rig["arm"]
        rig["frames"] = {n: rig["frames"][n] for n in ("mount_markers", "lidar")}
        rig["tracker"]["bodies"] = ["mount_markers"]
    (folder / "arm.urdf").unlink()


def no_mesh(folder: Path, number: int) -> None:
    """Planes that the stops have in common, and no laser scanner."""
    scene = _lab(folder, number, BEAMS_OF_PLANES)
    shutil.rmtree(folder / "reference")
    (folder / "targets.csv").unlink()
    with scene.description() as rig:
        del rig["reference"], rig["target"]


def no_tracker(folder: Path, number: int) -> None:
    """Arm and LiDAR before a mesh; the base stands still at a location, and its pose is guessed."""
    scene = _lab(folder, number)
    said = json.loads(Path(f"{folder}.truth.json").read_text(encoding="utf-8"))
    T_faro_opti, T_base_body = (
        np.array(said["T_faro_opti"]),
        np.array(said["frames"]["base_markers"]),
    )
    at = [f"base_markers.{p}" for p in (*XYZ, *QUAT)]
    poses = scene.stops.numbers(*at)
    where = scene.stops.columns["location"]
    for location in dict.fromkeys(where):
        rows = [k for k, name in enumerate(where) if name == location]
        T = T_faro_opti @ _matrix(poses[rows[0]]) @ np.linalg.inv(T_base_body)
        T[:3, 3] += GUESSED_M * scene.rng.standard_normal(3)
        R = Rotation.from_matrix(T[:3, :3])
        R = R * Rotation.from_rotvec(GUESSED_RAD * scene.rng.standard_normal(3))
        poses[rows] = [*T[:3, 3], *R.as_quat(scalar_first=True)]
    with scene.sheet("stops.csv") as stops:
        for name in [n for n in stops.columns if "_markers." in n]:
            del stops.columns[name]
        names = [f"base_guess.{p}" for p in (*XYZ, *QUAT)]
        stops.columns |= {name: [] for name in names}
        stops.put(poses, *names)
    with scene.description() as rig:
        del rig["tracker"], rig["target"]
        del rig["frames"]["base_markers"], rig["frames"]["mount_markers"]
        rig["base"]["moves"] = "location"
    (folder / "targets.csv").unlink()


def _matrix(pose: np.ndarray) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_quat(pose[3:], scalar_first=True).as_matrix(), pose[:3]
    return T


def arm_alone(folder: Path, number: int) -> None:
    """Poses of one body on an arm whose base stands: 100 of them, 3 draws from each recording."""
    name = ("arm_zero_rows", "arm_one_wild_row")[number % 2]
    _copy(name, folder)
    scene = Scene(folder, np.random.default_rng(number))
    xyz = scene.stops.numbers(*(f"tool.{axis}" for axis in XYZ))
    good = np.any(xyz != 0, axis=1)
    if name == "arm_one_wild_row":
        good[np.argmax(_unlike_others(scene, xyz))] = False
    rows = np.flatnonzero(good)[number // 2 % 3 :: 3]
    with scene.sheet("stops.csv") as stops:
        stops.keep(rows.tolist()[:100])


def _unlike_others(scene: Scene, xyz: np.ndarray) -> np.ndarray:
    """How far each position (K,) is from what the other poses and its joints make of it.

    An arm's positions are linear in the products of sines and cosines of its joints, 243 of the
    first five; so a ridge over these predicts each pose from the others to about a centimetre.
    """
    terms = np.ones((len(xyz), 1))
    for angle in scene.stops.numbers(*scene.joints[:5]).T:
        each = np.column_stack([np.ones(len(xyz)), np.cos(angle), np.sin(angle)])
        terms = (terms[:, :, None] * each[:, None]).reshape(len(xyz), -1)
    inverse = np.linalg.inv(terms @ terms.T + 1e-6 * np.eye(len(xyz)))
    return np.linalg.norm(inverse @ xyz / np.diag(inverse)[:, None], axis=1)


# ------------------------------------------------------------------------ by the program's own


def preset(name: str, **fields: object) -> Fill:
    """A preset of the simulator, with other fields."""

    def fill(folder: Path, number: int) -> None:
        spec = PRESETS[name].model_copy(update=fields)
        simulate(spec, folder, seed=100 + number)

    return fill


RIGS: dict[str, Fill] = {
    "all": all_instruments,
    "no arm": no_arm,
    "no mesh": no_mesh,
    "no tracker": no_tracker,
    "arm alone": arm_alone,
    "own all": preset("tiny", locations=6, stops_per_location=4),
    "own no arm": preset("lidar-tracker", lidar="hesai_pandarxt32", column_step=100),
    "own points": preset("laser-tracker", stops_per_location=10),
}


def made(rig: str, number: int, recording: Path) -> Path:
    """A good recording of a rig, and its truth beside it; where they are already, as they are."""
    if not recording.exists():
        RIGS[rig](recording, number)
    return recording
