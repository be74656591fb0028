"""Arms under a tracker, written and placed by scipy, with all that geometry can be wrong.

The world shares no line with the fit's kinematics. In a world of *twists* every link is bent by a
twist of six numbers, which no name of the program has; in a world of *names* by what the names say.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
import pandas as pd
import yaml
from scipy.spatial.transform import RigidTransform, Rotation

from chains.frames import Edge

from ..chains.arms import edges_of

TRACKER_M, TRACKER_RAD = 5e-5, 2e-4
TOOL_M, TOOL_RAD = 0.005, 0.01


@dataclass(frozen=True)
class ArmWorld:
    """An arm as it is: its edges as drawn, and each one's true twist (6,) and zero.

    ``twists`` and ``tool`` are rotation vectors in rad, then m, after the drawn place.
    """

    edges: list[Edge]
    twists: dict[str, np.ndarray]
    zeros: dict[str, float]
    tool: np.ndarray
    T_world_base: RigidTransform

    @property
    def joints(self) -> list[str]:
        return [e.joint.name for e in self.edges if e.joint is not None and e.joint.leads]

    def tip(self, reported: np.ndarray) -> RigidTransform:
        """T_base_tip at reported joints (K, J), the tool's frame left out."""
        T, column = (
            RigidTransform.identity(len(reported)),
            dict(zip(self.joints, reported.T, strict=True)),
        )
        for edge in self.edges:
            twist = self.twists.get(edge.name, np.zeros(6))
            T = T * RigidTransform.from_matrix(edge.T_parent_child) * exp(twist)
            if edge.joint is not None:
                q = column[edge.joint.name] + self.zeros[edge.joint.name]
                T = T * exp(q[:, None] * edge.joint.screw)
        return T

    def seen(self, reported: np.ndarray) -> RigidTransform:
        """T_world_tool (K,) without noise."""
        drawn = RigidTransform.from_translation([0.03, 0.02, 0.06])
        return self.T_world_base * self.tip(reported) * drawn * exp(self.tool)

    def draw(self, rng: np.random.Generator, count: int) -> np.ndarray:
        """Joints (count, J) between their limits."""
        moving = [e.joint for e in self.edges if e.joint is not None and e.joint.leads]
        return rng.uniform(
            [j.lower for j in moving], [j.upper for j in moving], (count, len(moving))
        )


def exp(twist: np.ndarray) -> RigidTransform:
    """A rigid transform of a twist (..., 6), rad then m."""
    return RigidTransform.from_exp_coords(twist)


def bent(folder, name: str, rng: np.random.Generator, size: float = 1.0) -> ArmWorld:
    """A world of twists: every edge is off by 1 mm and 1 mrad in each of six ways, joints by 2; its
    URDF is written into a folder, which is made if it is not there."""
    folder.mkdir(exist_ok=True)
    edges = edges_of(folder, name)
    (folder / f"{name}.urdf").rename(folder / "arm.urdf")
    return ArmWorld(
        edges=edges,
        twists={e.name: size * 1e-3 * rng.normal(size=6) for e in edges},
        zeros={e.joint.name: size * 2e-3 * rng.normal() for e in edges if e.joint is not None},
        tool=size * rng.normal(size=6) * np.repeat([TOOL_RAD, TOOL_M], 3),
        T_world_base=somewhere(rng),
    )


def somewhere(rng: np.random.Generator) -> RigidTransform:
    """A place in the tracker's frame."""
    turn = Rotation.from_rotvec([0.02, -0.01, rng.uniform(-3, 3)])
    return RigidTransform.from_components(rng.uniform(-1, 1, 3), turn)


def write(folder, world: ArmWorld, rng: np.random.Generator, poses: int) -> None:
    """Write a recording of the world, its URDF being there as ``arm.urdf``."""
    joints = world.draw(rng, poses)
    save(folder, world, joints, world.seen(joints) * exp(noise(rng, poses)))


def noise(rng: np.random.Generator, poses: int) -> np.ndarray:
    """(K, 6) twists by which the tracker errs."""
    return rng.normal(size=(poses, 6)) * np.repeat([TRACKER_RAD, TRACKER_M], 3)


def save(
    folder,
    world: ArmWorld,
    joints: np.ndarray,
    T: RigidTransform,
    columns: Mapping[str, np.ndarray] = MappingProxyType({}),
    sigma_joint_rad: float = 0.0,
) -> None:
    """Write a recording of poses at which joints (K, J) were read and the tool was seen at T (K,),
    with more columns (K,) of the stops."""
    frames = {
        "arm_base": {"parent": "base", "xyz_m": [0, 0, 0], "sigma_m": 0, "sigma_rad": 0},
        "tool": {"parent": "arm_end", "xyz_m": [0.03, 0.02, 0.06]}
        | {"sigma_m": TOOL_M, "sigma_rad": TOOL_RAD},
    }
    arm = {"urdf": "arm.urdf", "base": "arm_base", "tip": "arm_end"}
    rig = {
        "name": "arm",
        "arm": arm | ({"sigma_joint_rad": sigma_joint_rad} if sigma_joint_rad else {}),
        "frames": frames,
        "base": {"moves": "never"},
        "tracker": {"bodies": ["tool"], "sigma_m": TRACKER_M, "sigma_rad": TRACKER_RAD},
    }
    (folder / "rig.yaml").write_text(yaml.safe_dump(rig))
    xyzw = T.rotation.as_quat()
    table = {"stop": [f"p{k:04d}" for k in range(len(joints))], "location": "a", **columns}
    table |= dict(zip(world.joints, joints.T, strict=True))
    table |= {f"tool.{c}": x for c, x in zip("xyz", T.translation.T, strict=True)}
    table |= {f"tool.q{c}": xyzw[:, i] for c, i in zip("wxyz", (3, 0, 1, 2), strict=True)}
    pd.DataFrame(table).to_csv(folder / "stops.csv", index=False)
