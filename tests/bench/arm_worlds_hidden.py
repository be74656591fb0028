"""What can be wrong with an arm under a tracker, each by its own physics, on any arm of a table.

Kinematics are those of `tests.calib.arm_worlds`, by scipy; weights pull by the change of the height
of what they move, by finite differences. No line is shared with the program's effects.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import RigidTransform

from ..calib.arm_worlds import TRACKER_M, TRACKER_RAD, ArmWorld, exp

G = 9.80665
LINK_KG = 3.0  # of each link, at its joint's axis, as `tests.chains.arms` writes them
WHITE = np.repeat([1 / TRACKER_RAD, 1 / TRACKER_M], 3)
SMALL = 1e-4  # of an amount: effects are linear over it
TURN = 1e-5  # rad or m, for derivatives


@dataclass(frozen=True)
class Session:
    """Poses one after another, and what else is recorded of each.

    Args:
        joints: (K, J) as reported.
        time_s: (K,); temperature_c: (K,); payload_kg: (K,); torque: (K, J), N m or N.
    """

    joints: np.ndarray
    time_s: np.ndarray
    temperature_c: np.ndarray
    payload_kg: np.ndarray
    torque: np.ndarray

    @classmethod
    def drawn(cls, world: ArmWorld, rng: np.random.Generator, poses: int) -> Session:
        """About 12 s a pose, the hall warming up by 8 degrees, one payload after another."""
        time = np.cumsum(rng.uniform(8.0, 16.0, poses))
        warm = 20.0 + 8.0 * (1 - np.exp(-time / 1500.0)) + 0.1 * rng.normal(size=poses)
        payload = rng.permutation(np.resize([0.0, 2.0, 5.0], poses))
        joints = world.draw(rng, poses)
        return cls(
            joints=joints,
            time_s=time,
            temperature_c=warm,
            payload_kg=payload,
            torque=40.0 * rng.normal(size=joints.shape),
        )

    @property
    def share(self) -> np.ndarray:
        """(K,) of the time that has gone by, from 0 to 1."""
        return self.time_s / self.time_s[-1]


Seen = Callable[[float], RigidTransform]  # T_world_tool (K,) with so much of an effect


def places(world: ArmWorld, q: np.ndarray, longer: np.ndarray | float = 1.0) -> list:
    """T_base_link (K,) of every link in order, with origins so many times (K,) as long."""
    T, column = RigidTransform.identity(len(q)), dict(zip(world.joints, q.T, strict=True))
    out = []
    for edge in world.edges:
        drawn = RigidTransform.from_matrix(edge.T_parent_child)
        origin = np.broadcast_to(np.reshape(longer, (-1, 1)), (len(q), 1)) * drawn.translation
        T = T * RigidTransform.from_components(origin, drawn.rotation)
        T = T * exp(world.twists.get(edge.name, np.zeros(6)))
        if edge.joint is not None:
            turned = column[edge.joint.name] + world.zeros[edge.joint.name]
            T = T * exp(turned[:, None] * edge.joint.screw)
        out.append(T)
    return out


def tool(world: ArmWorld, tip: RigidTransform) -> RigidTransform:
    """T_world_tool where the arm's end is at T_base_tip."""
    return (
        world.T_world_base
        * tip
        * RigidTransform.from_translation([0.03, 0.02, 0.06])
        * exp(world.tool)
    )


def height(
    world: ArmWorld,
    q: np.ndarray,
    payload: np.ndarray | float,
    links: float,
    beside_m: np.ndarray | None = None,
) -> np.ndarray:
    """Weight times height (K,), N m; of a payload at the arm's end, or beside it in its axes."""
    up = world.T_world_base.rotation.inv().apply([0.0, 0.0, 1.0])
    *moved, tip = places(world, q)
    weighed = sum(links * (T.translation @ up) for T in moved)
    centre = tip.translation if beside_m is None else tip.apply(beside_m)
    return G * (weighed + payload * (centre @ up))


def torques(
    world: ArmWorld,
    s: Session,
    payload: np.ndarray | float,
    links: float,
    beside_m: np.ndarray | None = None,
) -> np.ndarray:
    """What gravity does to every joint (K, J): minus the slope of weight times height."""
    out = np.empty_like(s.joints)
    for j in range(s.joints.shape[1]):
        step = TURN * np.eye(s.joints.shape[1])[j]
        turned = (s.joints + k * step for k in (1, -1))
        high, low = (height(world, q, payload, links, beside_m) for q in turned)
        out[:, j] = -(high - low) / (2 * TURN)
    return out


# --------------------------------------------------------------------------------- what is hidden


def _turning(world: ArmWorld, s: Session, more: np.ndarray) -> Seen:
    return lambda amount: world.seen(s.joints + amount * more)


def _each(rng: np.random.Generator, s: Session) -> np.ndarray:
    """An amount (J,) for every joint, of either sign, none near zero."""
    size = rng.uniform(0.5, 1.5, s.joints.shape[1])
    return size * rng.choice([-1, 1], s.joints.shape[1])


def gravity_sag(world: ArmWorld, s: Session, rng: np.random.Generator) -> Seen:
    weighed = torques(world, s, s.payload_kg, LINK_KG)
    return _turning(world, s, np.abs(_each(rng, s)) * weighed)


def payload_sag(world: ArmWorld, s: Session, rng: np.random.Generator) -> Seen:
    return _turning(world, s, np.abs(_each(rng, s)) * torques(world, s, s.payload_kg, 0.0))


def payload_offset(world: ArmWorld, s: Session, rng: np.random.Generator) -> Seen:
    """Of joints that are not as soft as each other, nor are sliding ones soft."""
    where = 0.2 * rng.normal(size=3)
    beside, at = (torques(world, s, s.payload_kg, 0.0, each) for each in (where, None))
    return _turning(world, s, np.abs(_each(rng, s)) * (beside - at) * _revolute(world))


def torque_sag(world: ArmWorld, s: Session, rng: np.random.Generator) -> Seen:
    return _turning(world, s, np.abs(_each(rng, s)) * s.torque)


def joint_scale(world: ArmWorld, s: Session, rng: np.random.Generator) -> Seen:
    return _turning(world, s, _each(rng, s) * s.joints)


def joint_coupling(world: ArmWorld, s: Session, rng: np.random.Generator) -> Seen:
    """A joint goes with the one before it."""
    error, joint = np.zeros(s.joints.shape), rng.integers(1, s.joints.shape[1])
    error[:, joint] = s.joints[:, joint - 1]
    return _turning(world, s, error)


def eccentricity(world: ArmWorld, s: Session, rng: np.random.Generator) -> Seen:
    turns = s.joints + rng.uniform(0, 2 * np.pi, s.joints.shape[1])
    return _turning(world, s, _each(rng, s) * np.sin(turns) * _revolute(world))


def gear(world: ArmWorld, s: Session, rng: np.random.Generator) -> Seen:
    turns = 100 * s.joints + rng.uniform(0, 2 * np.pi, s.joints.shape[1])
    return _turning(world, s, _each(rng, s) * np.sin(turns) * _revolute(world))


def _revolute(world: ArmWorld) -> np.ndarray:
    joints = {e.joint.name: e.joint for e in world.edges if e.joint is not None}
    return np.array([float(np.any(joints[name].screw[:3])) for name in world.joints])


def backlash(world: ArmWorld, s: Session, rng: np.random.Generator) -> Seen:
    way = np.sign(np.diff(s.joints, axis=0, prepend=s.joints[:1]))
    return _turning(world, s, -np.abs(_each(rng, s)) * way)


def lag(world: ArmWorld, s: Session, rng: np.random.Generator) -> Seen:
    went = np.diff(s.joints, axis=0, prepend=s.joints[:1])
    return _turning(world, s, np.abs(_each(rng, s)) * went)


def lag_decay(world: ArmWorld, s: Session, rng: np.random.Generator) -> Seen:
    """What is left of a way falls with the time since the stop before, to a third in 3 s."""
    went = np.diff(s.joints, axis=0, prepend=s.joints[:1])
    left = np.exp(-np.diff(s.time_s, prepend=0.0) / 3.0)[:, None]
    return _turning(world, s, np.abs(_each(rng, s)) * left * went)


def _one_joint(s: Session, rng: np.random.Generator) -> np.ndarray:
    return np.eye(s.joints.shape[1])[rng.integers(s.joints.shape[1])]


def joint_slip(world: ArmWorld, s: Session, rng: np.random.Generator) -> Seen:
    one = _one_joint(s, rng)
    return _turning(world, s, np.outer(s.share > rng.uniform(0.3, 0.7), one))


def joint_creep(world: ArmWorld, s: Session, rng: np.random.Generator) -> Seen:
    return _turning(world, s, np.outer(s.share, _one_joint(s, rng)))


def joint_settle(world: ArmWorld, s: Session, rng: np.random.Generator) -> Seen:
    course = 1.0 - np.exp(-s.time_s / 400.0)
    return _turning(world, s, np.outer(course, _one_joint(s, rng)))


def joint_thermal(world: ArmWorld, s: Session, rng: np.random.Generator) -> Seen:
    """All joints, each by a coefficient of its own."""
    return _turning(world, s, np.outer(s.temperature_c - 20.0, rng.normal(size=s.joints.shape[1])))


def joint_scatter(world: ArmWorld, s: Session, rng: np.random.Generator) -> Seen:
    return _turning(world, s, rng.normal(size=s.joints.shape))


def thermal_growth(world: ArmWorld, s: Session, rng: np.random.Generator) -> Seen:
    warmer = s.temperature_c - 20.0
    return lambda amount: tool(world, places(world, s.joints, 1.0 + amount * warmer)[-1])


def link_bending(world: ArmWorld, s: Session, rng: np.random.Generator) -> Seen:
    """Every origin turns with the moment of the weights beyond it, but for that about the joint."""
    up = world.T_world_base.rotation.inv().apply([0.0, 0.0, 1.0])
    *moved, tip = places(world, s.joints)
    weights = [(T.translation, LINK_KG) for T in moved] + [(tip.translation, s.payload_kg)]
    soft, turns = np.abs(rng.uniform(0.5, 1.5, len(moved))), []
    for i, T in enumerate(moved):
        moment = sum(
            np.cross(at - T.translation, -G * np.reshape(kg, (-1, 1)) * up)
            for at, kg in weights[i:]
        )
        screw = world.edges[i].joint.screw if world.edges[i].joint is not None else np.zeros(6)
        moment = T.rotation.inv().apply(moment)
        turns.append(soft[i] * (moment - np.outer(moment @ screw[:3], screw[:3])))

    def seen(amount: float) -> RigidTransform:
        T = RigidTransform.identity(len(s.joints))
        before = RigidTransform.identity(len(s.joints))
        for link, turn in zip([*moved, tip], [*turns, None], strict=True):
            T, before = T * (before.inv() * link), link
            if turn is not None:
                T = T * exp(np.hstack([amount * turn, np.zeros_like(turn)]))
        return tool(world, T)

    return seen


def base_flex(world: ArmWorld, s: Session, rng: np.random.Generator) -> Seen:
    """The foot tilts about two axes, each by its own stiffness."""
    up = world.T_world_base.rotation.inv().apply([0.0, 0.0, 1.0])
    *moved, tip = places(world, s.joints)
    pull = sum(np.cross(T.translation, -G * LINK_KG * up) for T in moved)
    pull = pull + np.cross(tip.translation, -G * s.payload_kg[:, None] * up)
    tilt = np.zeros((len(pull), 6))
    tilt[:, :2] = pull[:, :2] * rng.uniform(0.5, 1.5, 2)
    foot = world.T_world_base
    return lambda amount: foot * exp(amount * tilt) * foot.inv() * world.seen(s.joints)


def tracker_scale(world: ArmWorld, s: Session, rng: np.random.Generator) -> Seen:
    T = world.seen(s.joints)
    return lambda a: RigidTransform.from_components((1 + a) * T.translation, T.rotation)


def tracker_distortion(world: ArmWorld, s: Session, rng: np.random.Generator) -> Seen:
    T, bent = world.seen(s.joints), rng.normal(size=(3, 3, 3))
    p = T.translation
    shift = np.einsum("ijk,nj,nk->ni", bent + bent.transpose(0, 2, 1), p, p)
    return lambda a: RigidTransform.from_components(p + a * shift, T.rotation)


def _moved(world: ArmWorld, s: Session, course: np.ndarray, rng: np.random.Generator) -> Seen:
    twist = course[:, None] * rng.normal(size=6) / WHITE * WHITE[-1]
    return lambda amount: exp(amount * twist) * world.seen(s.joints)


def tracker_slip(world: ArmWorld, s: Session, rng: np.random.Generator) -> Seen:
    return _moved(world, s, 1.0 * (s.share > rng.uniform(0.3, 0.7)), rng)


def tracker_creep(world: ArmWorld, s: Session, rng: np.random.Generator) -> Seen:
    return _moved(world, s, s.share, rng)


def tracker_settle(world: ArmWorld, s: Session, rng: np.random.Generator) -> Seen:
    return _moved(world, s, 1.0 - np.exp(-s.time_s / 400.0), rng)


def body_slip(world: ArmWorld, s: Session, rng: np.random.Generator) -> Seen:
    late = 1.0 * (s.share > rng.uniform(0.3, 0.7))
    twist = late[:, None] * rng.normal(size=6) / WHITE * WHITE[-1]
    return lambda amount: world.seen(s.joints) * exp(amount * twist)


def tracker_scatter(world: ArmWorld, s: Session, rng: np.random.Generator) -> Seen:
    twist = rng.normal(size=(len(s.joints), 6)) / WHITE
    return lambda amount: world.seen(s.joints) * exp(amount * twist)


def nothing(world: ArmWorld, s: Session, rng: np.random.Generator) -> Seen:
    return lambda amount: world.seen(s.joints)


@dataclass(frozen=True)
class Kind:
    """Something that can be wrong.

    Args:
        hide: world, session, generator -> what the tracker sees with so much of it.
        right: names of the catalogue that say it.
        needs: columns beyond joints and time.
    """

    hide: Callable[[ArmWorld, Session, np.random.Generator], Seen]
    right: frozenset[str]
    needs: frozenset[str] = field(default_factory=frozenset)


def _kind(hide: Callable, *right: str, needs: tuple[str, ...] = ()) -> Kind:
    return Kind(hide, frozenset(right), frozenset(needs))


KINDS: Mapping[str, Kind] = {
    "nothing": _kind(nothing),
    "gravity sag": _kind(gravity_sag, "arm_gravity_sag", needs=("payload_kg",)),
    "payload sag": _kind(payload_sag, "arm_payload_sag", needs=("payload_kg",)),
    "torque sag": _kind(torque_sag, "arm_torque_sag", needs=("torque",)),
    "joint scale": _kind(joint_scale, "arm_joint_scale"),
    "eccentricity": _kind(eccentricity, "arm_joint_eccentricity"),
    "gear": _kind(gear, "arm_gear_error"),
    "backlash": _kind(backlash, "arm_backlash"),
    "lag": _kind(lag, "arm_joint_lag"),
    "joint slip": _kind(joint_slip, "arm_joint_slip"),
    "joint creep": _kind(joint_creep, "arm_joint_creep"),
    "joint settle": _kind(joint_settle, "arm_joint_settle"),
    "joint thermal": _kind(joint_thermal, "arm_joint_thermal", needs=("temperature_c",)),
    "joint scatter": _kind(joint_scatter, "joint_scatter"),
    "thermal growth": _kind(thermal_growth, "arm_thermal_growth", needs=("temperature_c",)),
    "link bending": _kind(link_bending, "arm_link_bending"),
    "base flex": _kind(base_flex, "base_flex"),
    "tracker scale": _kind(tracker_scale, "optitrack_scale"),
    "tracker distortion": _kind(tracker_distortion, "optitrack_distortion"),
    "tracker slip": _kind(tracker_slip, "tracker_slip", "base_slip"),
    "tracker creep": _kind(tracker_creep, "tracker_creep"),
    "tracker settle": _kind(tracker_settle, "tracker_settle"),
    "body slip": _kind(body_slip, "body_slip", "mount_slip"),
    "tracker scatter": _kind(tracker_scatter, "tracker_scatter"),
    "payload offset": _kind(
        payload_offset, "arm_payload_moment", "arm_payload_offset", needs=("payload_kg",)
    ),
    "coupling": _kind(joint_coupling, "arm_joint_coupling"),
    "lag decay": _kind(lag_decay, "arm_joint_lag_decay"),
}


def scaled(seen: Seen, size: float) -> RigidTransform:
    """T_world_tool (K,) with so much of an effect that what the tracker sees changes by `size`
    times its noise: root mean square over the poses and the six of each."""
    none = seen(0.0)
    change = (none.inv() * seen(SMALL)).as_exp_coords() * WHITE
    rms = np.sqrt(np.mean(np.square(change)))
    return seen(size * SMALL / rms) if rms else none
