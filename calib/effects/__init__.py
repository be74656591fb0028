"""The catalogue of effects. A new one is a short class and a line in `CATALOGUE`."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

from calib.effects.arm import (
    ArmAxisTilt,
    ArmGeometry,
    ArmJointCreep,
    ArmJointOffset,
    ArmJointSettle,
    ArmJointSlip,
    ArmJointThermal,
    ArmLinkLength,
    ArmRailBending,
    ArmThermalGrowth,
)
from calib.effects.base import (
    Basis,
    Effect,
    LazyColumn,
    OneHot,
    Param,
    ShapeStep,
    Site,
    View,
)
from calib.effects.beams import (
    BeamOriginOffset,
    ElevationScale,
    EncoderEccentricity,
    EncoderSecondHarmonic,
    NearRangeAzimuth,
    RingAzimuthOffset,
    RingAzimuthSlip,
    RingElevationOffset,
    RingElevationSlip,
    SpinAxisWobble,
)
from calib.effects.drives import (
    ArmBacklash,
    ArmGearError,
    ArmJointCoupling,
    ArmJointEccentricity,
    ArmJointLag,
    ArmJointLagDecay,
    ArmJointScale,
    ArmMimicRatio,
    ArmScrewError,
)
from calib.effects.elastic import (
    ArmGravitySag,
    ArmLinkBending,
    ArmPayloadMoment,
    ArmPayloadOffset,
    ArmPayloadSag,
    ArmTorqueSag,
    BaseFlex,
    BodyBending,
    MountBending,
)
from calib.effects.noise import NoiseIncidence, NoiseIntensity, NoiseRange
from calib.effects.own.files import files_in, from_document, from_file, is_file
from calib.effects.own.trust import NotTrustedError, Trust, trusted
from calib.effects.range import (
    AzimuthRangeHarmonic,
    IncidenceAngleBias,
    IntensityRangeWalk,
    LabelIncidenceBias,
    LabelRangeOffset,
    NearRangeBias,
    RangeCyclic,
    RangeOffset,
    RangeQuantisation,
    RangeScale,
    RangeStep,
    RingRangeOffset,
    TemperatureDrift,
    WarmupDrift,
)
from calib.effects.reference import (
    FaroRangeOffset,
    FaroScale,
    MeshScale,
    MeshSeamX,
    MeshSeamY,
    MeshShift,
    MeshStrain,
    MovedSurface,
)
from calib.effects.rig import (
    FrameOffset,
    LidarSlip,
    MountCreep,
    MountSettle,
    MountSlip,
    StandCreep,
    StandSettle,
    StandSlip,
)
from calib.effects.scatter import (
    JointScatter,
    LocationRangeScatter,
    ReferenceScatter,
    Scatter,
    StopPoseScatter,
    StopRangeScatter,
    TargetScatter,
    TrackerScatter,
)
from calib.effects.tracker import (
    BaseSlip,
    BodySlip,
    OptitrackDistortion,
    OptitrackScale,
    TargetRodTilt,
    TargetSphereOffset,
    TrackerCreep,
    TrackerSettle,
    TrackerSlip,
)
from calib.rig import Rig
from chains.errors import InputError

CATALOGUE: tuple[Effect, ...] = (
    RangeOffset(),
    RangeScale(),
    RingRangeOffset(),
    RangeCyclic(),
    NearRangeBias(),
    RangeStep(),
    IncidenceAngleBias(),
    IntensityRangeWalk(),
    LabelRangeOffset(),
    LabelIncidenceBias(),
    WarmupDrift(),
    TemperatureDrift(),
    AzimuthRangeHarmonic(),
    RangeQuantisation(),
    RingElevationOffset(),
    RingAzimuthOffset(),
    RingElevationSlip(),
    RingAzimuthSlip(),
    ElevationScale(),
    BeamOriginOffset(),
    EncoderEccentricity(),
    EncoderSecondHarmonic(),
    SpinAxisWobble(),
    NearRangeAzimuth(),
    ArmLinkLength(),
    ArmJointOffset(),
    ArmJointSlip(),
    ArmJointCreep(),
    ArmJointSettle(),
    ArmJointThermal(),
    ArmAxisTilt(),
    ArmGeometry(),
    ArmJointScale(),
    ArmJointCoupling(),
    ArmMimicRatio(),
    ArmRailBending(),
    ArmJointEccentricity(),
    ArmGravitySag(),
    ArmPayloadSag(),
    ArmPayloadOffset(),
    ArmPayloadMoment(),
    ArmTorqueSag(),
    ArmLinkBending(),
    ArmBacklash(),
    ArmJointLag(),
    ArmJointLagDecay(),
    ArmGearError(),
    ArmScrewError(),
    ArmThermalGrowth(),
    BaseFlex(),
    MountSlip(),
    LidarSlip(),
    MountCreep(),
    MountSettle(),
    MountBending(),
    BodyBending(),
    StandSlip(),
    StandCreep(),
    StandSettle(),
    OptitrackScale(),
    OptitrackDistortion(),
    BodySlip(),
    BaseSlip(),
    TrackerSlip(),
    TrackerCreep(),
    TrackerSettle(),
    TargetRodTilt(),
    TargetSphereOffset(),
    FaroScale(),
    FaroRangeOffset(),
    MeshShift(),
    MeshScale(),
    MeshStrain(),
    MeshSeamX(),
    MeshSeamY(),
    MovedSurface(),
    NoiseRange(),
    NoiseIncidence(),
    NoiseIntensity(),
    StopRangeScatter(),
    LocationRangeScatter(),
    StopPoseScatter(),
    TrackerScatter(),
    JointScatter(),
    TargetScatter(),
    ReferenceScatter(),
)
DEFAULT = ("arm_link_length", "arm_joint_offset", "ring_range_offset")
# All that an arm's can be; the last of an arm in which joints follow others.
GEOMETRY = ("arm_link_length", "arm_joint_offset", "arm_geometry", "arm_mimic_ratio")

__all__ = [
    "CATALOGUE",
    "DEFAULT",
    "GEOMETRY",
    "Basis",
    "Effect",
    "FrameOffset",
    "LazyColumn",
    "NotTrustedError",
    "OneHot",
    "Param",
    "Scatter",
    "ShapeStep",
    "Site",
    "Trust",
    "View",
    "find",
    "is_known",
    "load_effects",
    "own_effects",
    "read",
    "split",
    "trust_in",
    "trusted",
]


def find(name: str, own: Iterable[Effect] = ()) -> Effect:
    """The effect of this name, ``family`` or ``family@shape``.

    Args:
        name: as commands have it.
        own: effects that are known beside the catalogue.

    Raises:
        InputError: there is none, naming the nearest.
    """
    known = {effect.name: effect for effect in (*CATALOGUE, *own)}
    if name in known:
        return known[name]
    family, _, shape = name.partition("@")
    if family not in known:
        near = difflib.get_close_matches(family, known, 1)
        hint = f"; did you mean '{near[0]}'?" if near else f": it has {', '.join(known)}."
        raise InputError(f"effect '{name}' is not in the catalogue{hint}")
    effect = known[family]
    try:
        chosen = float(shape)
    except ValueError:
        chosen = float("nan")
    if not effect.shape_name or not chosen < float("inf"):
        wanted = f"write {family}@NUMBER" if effect.shape_name else "it has no shape to choose"
        raise InputError(f"effect '{name}': {wanted}")
    return effect.at(chosen)


def load_effects(
    texts: str | Iterable[str], trust: Trust | None = None, own: Sequence[Effect] = ()
) -> tuple[Effect, ...]:
    """The effects that a command line names, each once.

    Args:
        texts: names of the catalogue, ``family@shape``, and files of effects of the user's own:
            ``file.yaml`` of formulas, a folder of such files, ``file.py`` or ``file.py:Class``. One
            text may hold several of these, with commas between.
        trust: the Python files that may run, where a file names these effects; None where the user
            did so himself.
        own: effects that go by their names beside the catalogue.

    Raises:
        InputError: there is no such effect or file, or two effects have one name.
    """
    found: dict[str, Effect] = {}
    for text in split(texts):
        for effect in _named(text, trust, own):
            same = found.setdefault(effect.name, effect)
            if same.document() != effect.document():
                raise InputError(f"{text}: another effect is called '{effect.name}' too")
    return tuple(found.values())


def own_effects(rigs: Iterable[Rig], named: str | Iterable[str] = ()) -> tuple[Effect, ...]:
    """Effects of the user's own that stand beside the catalogue: of rigs' files, and `named` ones.

    Args:
        rigs: whose ``effects`` name files.
        named: as of `load_effects`; what is of the catalogue is there already.

    Raises:
        InputError: as of `load_effects`.
    """
    files = [str(path) for rig in rigs for path in rig.effects]
    every = load_effects(files + split(named))
    return tuple(e for e in every if all(e.family != known.family for known in CATALOGUE))


def split(texts: str | Iterable[str]) -> list[str]:
    """Items of a command line: one text or several, each with commas or without."""
    texts = [texts] if isinstance(texts, str) else texts
    return [text.strip() for each in texts for text in each.split(",") if text.strip()]


def is_known(text: str) -> bool:
    """Whether an item of a command line is a name of the catalogue, a file, or a folder."""
    named = any(text.partition("@")[0] == effect.family for effect in CATALOGUE)
    return named or is_file(text) or Path(text).is_dir()


def _named(text: str, trust: Trust | None, own: Sequence[Effect]) -> list[Effect]:
    """What one item of a command line names."""
    if any(text == effect.name for effect in (*CATALOGUE, *own)):
        return [find(text, own)]
    files = files_in(text) if Path(text).is_dir() else [text] if is_file(text) else []
    if files:
        return [_own(effect) for file in files for effect in from_file(file, trust)]
    return [find(text, own)]


def read(
    document: str | Mapping[str, Any],
    path: str | Path = "model.yaml",
    trust: Trust = MappingProxyType({}),
) -> Effect:
    """The effect that `Effect.document` spelled.

    Args:
        document: a name in the catalogue, the mapping of a formula, or a class in a Python file.
        path: where it stands, for messages.
        trust: the Python files that may run.

    Raises:
        NotTrustedError: it is of a Python file that may not run.
        InputError: there is no such effect.
    """
    if isinstance(document, str):
        return find(document)
    return _own(from_document(document, path, trust))


def trust_in(effects: Iterable[Effect]) -> Trust:
    """The Python files that effects came from, which ran: the user trusts them already."""
    origins = (effect.origin for effect in effects if effect.origin)
    return {origin["sha256"]: Path(origin["python"]) for origin in origins}


def _own(effect: Effect) -> Effect:
    """A user's effect, unless the catalogue has one of its name."""
    if any(known.family == effect.family for known in CATALOGUE):
        raise InputError(f"effect '{effect.name}' is in the catalogue; give yours another name")
    return effect
