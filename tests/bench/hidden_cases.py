"""The cases of the scored benchmark: what is hidden, how large, and in which recording.

A case follows from its family and number alone. An effect's size is the root mean square of what it
does to the range residual of all beams, at the poses where the stops truly were and before any fit
takes a part of it on. What the tracker or a target says wrongly moves the rig, or the mesh, as a
reader who believes it would; so every effect has a size in mm.
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from calib.effects import CATALOGUE, DEFAULT, Effect, Site, find, load_effects
from calib.problem import Problem, build
from calib.problem.build import stops_view
from calib.problem.model import Model, Source
from calib.residuals.targets import HangingTarget
from calib.residuals.tracker import TrackedBody
from calib.simulation import Spec, simulate
from calib.simulation.truth import draw
from chains import se3
from sensors.documents import write_yaml

# LiDAR, every how many-th column, room: about 1000 to 2000 beams a stop.
SETUPS = (
    ("hesai_pandarxt32", 60, "lab"),
    ("ouster_os0_128_rev7", 64, "lab"),
    ("hesai_pandarqt64", 24, "box"),
)
SEED = 20_000
UNFELT_MM = 1e-3  # at an effect's usual size: no beam feels it (a body slips), so it has that size
PROBE = 0.1  # of an effect's usual size: small enough to be linear, large enough to be exact

# What no catalogue has: name -> covariates that tell it, and its formula effect. Sizes are set.
UNKNOWN: dict[str, tuple[frozenset[str], dict[str, Any]]] = {
    name: (frozenset(covariates), {"site": site, "unit": unit, "sigma": sigma, "basis": basis})
    for name, covariates, site, unit, sigma, basis in (
        ("lobe", {"azimuth_rad"}, "range", "m", 0.003, "cos(6 * azimuth)"),
        ("bump", {"range_m"}, "range", "m", 0.003, "exp(-((range - 2.6) / 0.25) ** 2)"),
        (
            "product",
            {"azimuth_rad", "elevation_rad"},
            "range",
            "m",
            0.003,
            "cos(2 * azimuth) * sin(5 * elevation)",
        ),
        ("humid", {"humidity", "range_m"}, "range", "m", 0.02, "(humidity - 0.5) * range"),
        (
            "slanted_lobe",
            {"azimuth_rad", "incidence_rad"},
            "range",
            "m",
            0.003,
            "incidence * cos(3 * azimuth)",
        ),
        (
            "coupled_joints",
            {"joint_2", "joint_3"},
            "joint:joint_2",
            "rad",
            0.001,
            "sin(2 * joint_3)",
        ),
    )
}

# The range zero is the rings' mean, which is in every model here; and rounding acts on no sensor.
# What needs columns that these recordings lack is hidden in arms (`arm_effects.py`).
_OF_LOADS = {"arm_payload_sag", "arm_payload_offset", "arm_payload_moment", "arm_torque_sag"}
_NOT_ALONE = {"range_offset", "range_quantisation", *DEFAULT, *_OF_LOADS}
# What is drawn anew by chance at every stop has a bench of its own (`chance.py`).
SINGLES = tuple(
    e.name
    for e in CATALOGUE
    if e.site is not Site.NOISE and not e.by_chance and e.name not in _NOT_ALONE
    # No rig of these has or does so.
    if e.joint_kind not in ("prismatic", "mimic") and not e.needs_standing
)
# Their parameters have one unit, so that a size at which they are found means something.
OF_ONE_UNIT = tuple(n for n in SINGLES if not find(n).shape_name and "creep" not in n)
RIVALS = ("ring_elevation_offset", "ring_range_offset")
WITHOUT_RINGS = ("arm_link_length", "arm_joint_offset")
FAMILIES = {
    "null": 0.0,
    "single-1mm": 1.0,
    "single-half": 0.5,
    "single-shot": None,
    "unknown": 1.0,
    "pair": 1.0,
    "rival": 1.0,
    "detectable": None,
    "pair-shot": None,
    "triple-shot": None,
}
TOGETHER = {"pair": 2, "pair-shot": 2, "triple-shot": 3}  # how many are hidden at once


@dataclass(frozen=True)
class Case:
    """One recording and what is hidden in it.

    Args:
        family: one of `FAMILIES`.
        number: within its family.
        spec: of the recording.
        seed: of the recording.
        hidden: families of the hidden effects, or names of `UNKNOWN`.
        size_mm: of each, rms over the range residual; None where it is found out.
        model: what is fitted.
    """

    family: str
    number: int
    spec: Spec
    seed: int
    hidden: tuple[str, ...]
    size_mm: float | None
    model: Model

    @property
    def name(self) -> str:
        """Unique."""
        return f"{self.family}/{self.number:03d}"

    @property
    def rng(self) -> np.random.Generator:
        """For what the case draws itself."""
        return np.random.default_rng([zlib.crc32(self.family.encode()), self.number])


def cases(count: int, families: Sequence[str], first: int = 0) -> Iterator[Case]:
    """So many cases of each family, those of one number together."""
    for number in range(first, first + count):
        for family in families:
            yield case(family, number)


def case(family: str, number: int) -> Case:
    """The case of this number."""
    seed = SEED + 1000 * list(FAMILIES).index(family) + number
    rng = np.random.default_rng(seed)
    # So that what is hidden in turn comes to every set-up, also where their counts have a divisor.
    lidar, step, room = SETUPS[(number + number // len(SETUPS)) % len(SETUPS)]
    spec = Spec(
        lidar=lidar,
        column_step=step,
        room=room,
        locations=6,
        stops_per_location=5,
        mesh_error_m=float(np.round(rng.uniform(0.0006, 0.0015), 5)),
        mixed_pixel_share=float(np.round(rng.uniform(0.01, 0.03), 3)),
        occluded_share=0.15,
        level=family == "rival",
    )
    model = Model(WITHOUT_RINGS) if family == "rival" else Model()
    return Case(
        family=family,
        number=number,
        spec=spec,
        seed=seed,
        hidden=_hidden(family, number, rng),
        size_mm=FAMILIES[family],
        model=model,
    )


def _hidden(family: str, number: int, rng: np.random.Generator) -> tuple[str, ...]:
    if family == "null":
        return ()
    if family == "unknown":
        return (list(UNKNOWN)[number % len(UNKNOWN)],)
    if family == "rival":
        return (RIVALS[number % len(RIVALS)],)
    if family == "detectable":
        return (_nth(OF_ONE_UNIT, number),)
    chosen = [_nth(SINGLES, number)]
    while len(chosen) < TOGETHER.get(family, 1):
        apart = [n for n in SINGLES if not any(n == c or _confounded(n, c) for c in chosen)]
        chosen.append(str(rng.choice(apart)))
    return tuple(chosen)


def _confounded(one: str, other: str) -> bool:
    return other in find(one).confounded_with or one in find(other).confounded_with


def _nth(names: Sequence[str], number: int) -> str:
    """All of them in turn, in an order that mixes sites."""
    order = np.random.default_rng(len(names)).permutation(len(names))
    return names[order[number % len(names)]]


@dataclass(frozen=True)
class Hidden:
    """What is hidden in a recording.

    Args:
        texts: what `simulate` takes -> size in sigmas.
        effects: the effects.
        mm: rms over the range residual of each at size 1; empty where it was not asked for.
    """

    texts: Mapping[str, float]
    effects: Sequence[Effect]
    mm: Sequence[float]


def record(case: Case, folder: Path) -> tuple[Source, dict[str, Any], Hidden]:
    """The case's recording, opened; its truth; and what is hidden in it.

    Args:
        case: with a size.
        folder: to work in.
    """
    texts = _texts(case, folder) if case.hidden else ()
    mm = [_rms_mm(case, text, folder) for text in texts]
    size_mm = case.size_mm
    if size_mm is None:
        lidar = Source.open(folder / "twin").rig.lidar
        size_mm = 1e3 * float(lidar.sigma_range(2.5, 0.5))
    felt = [each > UNFELT_MM for each in mm]
    sizes = [size_mm / each if there else 1.0 for each, there in zip(mm, felt, strict=True)]
    hide = dict(zip(texts, sizes, strict=True))
    return written(case, folder, hide, mm)


def written(
    case: Case, folder: Path, hide: Mapping[str, float], mm: Sequence[float] = ()
) -> tuple[Source, dict[str, Any], Hidden]:
    """A recording with this hidden."""
    rings_off = {"ring_range_offset": 0.0} if case.family == "rival" else {}
    simulate(case.spec, folder / "recording", case.seed, {**rings_off, **hide})
    truth = json.loads((folder / "recording.truth.json").read_text(encoding="utf-8"))
    effects = [effect for text in hide for effect in load_effects([text])]
    return Source.open(folder / "recording"), truth, Hidden(hide, effects, mm)


def _texts(case: Case, folder: Path) -> list[str]:
    """The hidden effects as `simulate` takes them, shapes drawn between those that are looked at.

    Leaves a thin recording of the same stops at ``twin``.
    """
    thin = case.spec.model_copy(update={"column_step": 4 * case.spec.column_step})
    simulate(thin, folder / "twin", case.seed)
    return [_text(name, case, folder) for name in case.hidden]


def _text(name: str, case: Case, folder: Path) -> str:
    if name in UNKNOWN:
        path = folder / f"{name}.yaml"
        write_yaml(path, {"name": name, **UNKNOWN[name][1]})
        return str(path)
    effect = find(name)
    if not effect.shape_name:
        return name
    grid = sorted(effect.shapes(stops_view(Source.open(folder / "twin"))))
    if len(grid) == 1:  # looked for in the middle of the stops first
        grid = [0.7 * grid[0], 1.3 * grid[0]]
    i = int(case.rng.integers(len(grid) - 1))
    whole = all(shape == int(shape) for shape in grid) and len(grid) > 10
    shape = grid[i] if whole else case.rng.uniform(grid[i], grid[i + 1])
    return effect.at(float(f"{shape:.6g}")).name


def _rms_mm(case: Case, text: str, folder: Path) -> float:
    """What an effect of size 1, drawn as `simulate` will, does to the range residual."""
    source = Source.open(folder / "twin")
    truth = json.loads((folder / "twin.truth.json").read_text(encoding="utf-8"))
    (effect,) = load_effects([text])
    drawn = draw(source.rig, case.spec, {text: 1.0}, case.seed).effects
    theta = next(values for e, values in drawn if e.name == effect.name)
    problem, values = _at_truth(source, truth, effect)
    term = next(t for t in problem.terms[0] if t.effect.name == effect.name)
    there = _believed(problem, source, effect, {**values, term.variable: PROBE * theta[term.free]})
    square, count = 0.0, 0
    for scan in problem.scans:
        met = scan.associate(values, near_edges=True)
        before, after = scan.rows(values, met), scan.rows(there, met)
        moved = (after.residual_m - before.residual_m)[before.usable & after.usable]
        square, count = square + float(moved @ moved), count + len(moved)
    return 1e3 * float(np.sqrt(square / count)) / PROBE


def _at_truth(
    source: Source, truth: Mapping[str, Any], effect: Effect
) -> tuple[Problem, dict[str, np.ndarray]]:
    """The problem of one effect, and values at which every stop stands where it truly was."""
    problem = build([source], Model((effect,)))
    values = dict(problem.initial)
    T_opti_faro = se3.inverse(np.array(truth["T_faro_opti"]))
    values[source.rig.reference_frame] = T_opti_faro
    for stop, at in truth["stops"].items():
        values[f"root@{stop}"] = T_opti_faro @ np.array(at["T_faro_root"])
    return problem, values


def _believed(
    problem: Problem, source: Source, effect: Effect, values: dict[str, np.ndarray]
) -> dict[str, np.ndarray]:
    """Values with the base where its markers, the mesh where its targets seem to be."""
    out, theta = dict(values), values[effect.name]
    for block in problem.blocks:
        if isinstance(block, TrackedBody) and effect.site is Site.TRACKER:
            if block.body == source.rig.tracker.bodies[0]:
                T = block.stops.in_root(block.body, values).T[0]
                out[block.stops.root] = block.seen(values).T[0] @ se3.inverse(T)
        elif isinstance(block, HangingTarget) and effect.site is Site.TARGET:
            mesh = out[block.reference] = values[block.reference].copy()
            mesh[:3, 3] -= block.shift[effect.name] @ theta
    return out
