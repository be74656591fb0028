"""What is estimated: which recordings, with which effects, holding what fixed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from calib import effects
from calib.effects import Effect, FrameOffset, Site
from calib.forward import Term, named
from calib.residuals.groups import JOINTS, Group, GroupKind
from calib.residuals.store import BeamStore
from calib.rig import Rig, load_rig
from calib.rig.columns import recorded_columns, stop_columns, tracked_poses, up_in_root
from calib.rig.recording import recorded
from chains import remote
from chains.errors import InputError
from sensors.documents import nearest
from sensors.recording import RecordedStops
from sensors.reference import Reference

ROWS_A_PARAMETER = 10  # of an arm, for its whole geometry to be estimated; see `default_effects`


@dataclass(frozen=True)
class Model:
    """A choice of effects; frames with a sigma are always in it unless fixed.

    Args:
        effects: those to estimate; the name of one in the catalogue stands for it.
        fixed: names kept at their nominal value: a frame or effect, or one parameter of it as
            ``name.parameter``, ``lidar.tz`` say.
        without: what of the recordings is left out, as `Group.token` names it.
        beams: how many beams of each scan are used at most; all where None.
        moved: unknowns that moved since CAD told of them, each by how many of its sigmas.
        starts: frames of the reference, each with its pose in the world (x y z qw qx qy qz) as an
            earlier run has it: where it starts if no recording tells where it is.
    """

    effects: tuple[Effect, ...] = effects.DEFAULT
    fixed: tuple[str, ...] = ()
    without: tuple[str, ...] = ()
    beams: int | None = None
    moved: Mapping[str, float] = field(default_factory=dict, hash=False)
    starts: Mapping[str, tuple[float, ...]] = field(default_factory=dict, hash=False)

    def __post_init__(self) -> None:
        chosen = (effects.find(e) if isinstance(e, str) else e for e in self.effects)
        object.__setattr__(self, "effects", tuple(chosen))
        if self.beams is not None and self.beams < 1:
            raise InputError(f"beams {self.beams}: use at least one beam of each scan")

    @classmethod
    def of(
        cls,
        chosen: str | None,
        fixed: Sequence[str],
        without: Sequence[str] = (),
        recordings: Sequence[Path | str] = (),
        beams: int | None = None,
        known: Sequence[Effect] = (),
    ) -> Model:
        """The model that a command line names: effects with commas, or `default_effects`.

        Args:
            chosen, fixed, without, beams: as the command line has them.
            recordings: to be fitted; effects that their ``rig.yaml`` names go by their names here.
            known: effects that are known of the rig, see `default_effects`.

        Raises:
            InputError: an effect that there is not, in the catalogue or in a file.
        """
        if chosen is None:
            named = default_effects(recordings, known)
        else:
            whole = all(map(effects.is_known, effects.split(chosen)))
            there = [r for r in recordings if not whole and (remote.here(r) / "rig.yaml").is_file()]
            own = effects.own_effects(map(load_rig, there))
            named = effects.load_effects(chosen, own=own)
        return cls(named, tuple(fixed), tuple(without), beams)

    @classmethod
    def read(
        cls,
        document: Mapping[str, Any],
        path: Path | str = "model.yaml",
        trust: effects.Trust = MappingProxyType({}),
    ) -> Model:
        """The model that a run's model.yaml describes.

        Args:
            document: what model.yaml holds.
            path: where it stands, for messages.
            trust: the Python files of effects that may run, as `calib.effects.trusted` gives them.

        Raises:
            NotTrustedError: an effect of a Python file that may not run.
            InputError: an effect that there is not, or no longer.
        """
        found = tuple(effects.read(effect, path, trust) for effect in document["effects"])
        left_out = tuple(document.get("without", ()))
        starts = {n: tuple(map(float, pose)) for n, pose in document.get("starts", {}).items()}
        fixed, beams = tuple(document["fixed"]), document.get("beams")
        return cls(found, fixed, left_out, beams, starts=starts)

    def document(self) -> dict[str, Any]:
        """As model.yaml holds it."""
        out = {
            "effects": [e.document() for e in self.effects],
            "fixed": list(self.fixed),
            "without": list(self.without),
        }
        out |= {} if self.beams is None else {"beams": self.beams}
        return out | ({"starts": {n: [*T] for n, T in self.starts.items()}} if self.starts else {})

    def plus(self, added: Sequence[Effect]) -> Model:
        """The model with more effects.

        Raises:
            InputError: one is in it already, with the same shape.
        """
        have = {(e.family, e.shape) for e in self.effects}
        for effect in added:
            if (effect.family, effect.shape) in have:
                raise InputError(f"effect '{effect.name}' is in the model already")
            have.add((effect.family, effect.shape))
        return replace(self, effects=(*self.effects, *added))

    def leaving_out(self, tokens: Sequence[str]) -> Model:
        """The model with more left out of its recordings."""
        return replace(self, without=(*self.without, *tokens))

    def minus(self, names: Sequence[str]) -> Model:
        """The model without some effects, and without what it held of them.

        Raises:
            InputError: one is not in it.
        """
        for name in names:
            if name not in self.names:
                raise InputError(f"effect '{name}' is not in the model{nearest(name, self.names)}")
        kept = tuple(e for e in self.effects if e.name not in names)
        fixed = (held for held in self.fixed if self._effect_of(held) not in names)
        return replace(self, effects=kept, fixed=tuple(fixed))

    def _effect_of(self, held: str) -> str:
        """The effect that a user holds, or of which one parameter; empty where it is a frame.

        A shape may have a point in it, as what is held has between an effect and a parameter: of
        effects whose names it begins with, the longest is meant.
        """
        mine = (n for n in self.names if held == n or held.startswith(f"{n}."))
        return max(mine, key=len, default="")

    @property
    def names(self) -> tuple[str, ...]:
        """Of its effects."""
        return tuple(effect.name for effect in self.effects)

    def terms(self, rig: Rig, several: bool) -> list[Term]:
        """The model's effects on one rig: those with anything to act on.

        Args:
            rig: the rig.
            several: True when other rigs share the graph; what belongs to this rig alone then
                carries its name.

        Raises:
            InputError: an effect or a fixed name that this rig does not know.
        """
        chosen: list[Effect] = [FrameOffset(name) for name in rig.frame_sigma]
        chosen += self.effects
        self._check_names(rig)
        self._check_fixed(chosen, rig)
        terms = []
        for effect in chosen:
            free = self._free(effect, rig)
            if len(free):
                owner = rig.name if several and owned(effect, rig) else ""
                terms.append(Term(effect, named(effect.name, owner), free, owner))
        return terms

    def _free(self, effect: Effect, rig: Rig) -> np.ndarray:
        if effect.name in self.fixed:
            return np.zeros(0, int)
        # What changes a joint that is unknown at every stop changes nothing that is measured.
        passive = rig.passive if effect.site is Site.JOINTS else ()
        free = [
            i
            for i, p in enumerate(effect.params(rig))
            if p.sigma and f"{effect.name}.{p.name}" not in self.fixed and p.joint not in passive
        ]
        return np.array(free, int)

    def _check_names(self, rig: Rig) -> None:
        taken = {*rig.frame_sigma, rig.reference_frame, "gravity", "planes"}
        for name in self.names:
            if name in taken:
                raise InputError(
                    f"effect '{name}': the graph has a '{name}' already; call the effect otherwise"
                )

    def _check_fixed(self, chosen: Sequence[Effect], rig: Rig) -> None:
        known = {e.name for e in chosen}
        known |= {f"{e.name}.{p.name}" for e in chosen for p in e.params(rig)}
        known |= {frame for frame in (rig.reference_frame,) if frame}
        for name in self.fixed:
            if name not in known:
                raise InputError(
                    f"--fix {name}: no such frame, effect or parameter in the model; it has "
                    f"{', '.join(sorted(e.name for e in chosen))} and name.parameter of each"
                )


def default_effects(
    recordings: Sequence[Path | str], known: Sequence[Effect] = ()
) -> tuple[str | Effect, ...]:
    """The effects that are estimated where none are chosen.

    What is known of the rig is among them: without an effect that it has, others would have to
    explain what that did. What goes with time is of the day, and not of the rig.

    Without the arm's whole geometry the sigmas of its lengths and zeros are too small, so it is
    there wherever the tracked poses can tell it: from ten rows on for each parameter of the arm
    (Harrell 2015, Regression Modeling Strategies, 4.4), six rows a pose and three a point.

    Raises:
        InputError: what is wrong with a recording's rig or stops.
    """
    rows, most, has = 0, 0, set[str]()
    for folder in recordings:
        if not (remote.here(folder) / "rig.yaml").is_file():
            continue  # what it is instead, the fit says
        rig = load_rig(folder)
        if rig.tracker and rig.joint_names:
            recording = recorded(rig)
            for body in filter(rig.joints_to, rig.tracker.bodies):
                pose = np.isfinite(recording.bodies[body])
                rows += 3 * int(pose[:, :3].all(axis=1).sum() + pose.all(axis=1).sum())
            arm = [effects.find(name) for name in effects.GEOMETRY]
            has |= {effect.name for effect in arm if effect.params(rig)}
            most = max(most, sum(p.sigma > 0 for effect in arm for p in effect.params(rig)))
    told = 0 < ROWS_A_PARAMETER * most <= rows
    whole = [name for name in effects.GEOMETRY if told and name in has]
    usual = (*effects.DEFAULT, *(name for name in whole if name not in effects.DEFAULT))
    lasting = (effect for effect in known if not effect.goes_with_time)
    return (*usual, *(effect for effect in lasting if effect.name not in usual))


def owned(effect: Effect, rig: Rig) -> bool:
    """Whether an effect belongs to this rig alone when several rigs stand in one graph.

    The arm, the base's frames and the scanner's alignment are the same hardware in every
    recording; what hangs from the arm's tip, and the LiDAR, are not, unless ``rig.yaml`` says so.
    """
    if effect.name in rig.shared:
        return False
    if effect.name in rig.own or effect.of_lidar:
        return True
    return effect.name in rig.beyond_arm


@dataclass(frozen=True)
class Source:
    """A recording opened for a fit.

    Args:
        rig: what is bolted to what.
        recording: its stops, without what is left out.
        reference: its mesh, if it has one.
        without: what is left out.
        given: the recording as it is on disk, where something is left out.
        beams: how many beams of each scan are used at most; all where None.
    """

    rig: Rig
    recording: RecordedStops
    reference: Reference | None
    without: tuple[Group, ...] = ()
    given: RecordedStops | None = None
    beams: int | None = None

    @classmethod
    def open(cls, folder: Path | str) -> Source:
        """Read a recording's rig, stops and mesh, checking all but the scans.

        Raises:
            InputError: what is wrong, and where.
        """
        rig = load_rig(folder)
        recording = recorded(rig)
        spec = rig.reference
        mesh = Reference.read(spec.mesh, spec.faces, spec.labels) if spec and spec.mesh else None
        return cls(rig, recording, mesh)

    def changed(self, recording: RecordedStops, without: Group) -> Source:
        """The same with a changed recording, something being left out; what scans were read stay
        read."""
        given = self.given or self.recording
        out = replace(self, recording=recording, without=(*self.without, without), given=given)
        if self.rig.lidar is not None:
            out.__dict__["store"] = self.store
        return out

    def of_beams(self, most: int | None) -> Source:
        """The same with so many beams of each scan at most, or with all of them."""
        return self if most == self.beams else replace(self, beams=most)

    @property
    def whole(self) -> Source:
        """The same with nothing left out."""
        return replace(self, recording=self.given or self.recording, without=(), given=None)

    def lacks(self, kind: GroupKind) -> set[tuple[str, str]]:
        """Where and what of one kind is left out."""
        return {(group.where, group.what) for group in self.without if group.kind == kind}

    @cached_property
    def measured_targets(self) -> Mapping[str, str]:
        """Targets of its targets.csv -> a digest of what was measured of each and of the names of
        the two frames that it ties to each other; those that are left out as well."""
        targets, rig = self.whole.recording.targets, self.rig
        if targets is None or rig.target is None or rig.tracker is None:
            return {}
        return targets.digests(f"{rig.world} {rig.reference_frame}")

    @property
    def counted_targets(self) -> frozenset[str]:
        """Digests of those of them whose sphere is not left out."""
        targets = self.recording.targets
        if targets is None:
            return frozenset()
        seen = zip(targets.names, np.isfinite(targets.faro_m).all(axis=1), strict=True)
        there = (self.measured_targets.get(name) for name, counts in seen if counts)
        return frozenset(digest for digest in there if digest is not None)

    @cached_property
    def unread(self) -> frozenset[tuple[str, str]]:
        """Stop and joint of every reading that there is not, as it was left out or never made."""
        stops, names = self.recording.stops, self.rig.joint_names
        gone = self.lacks("joints")
        gone |= {(stop, name) for stop, what in gone if what == JOINTS for name in names}
        gone |= {(stop, name) for stop in stops for name in self.rig.passive}
        return frozenset((stop, name) for stop, name in gone if name in names)

    @cached_property
    def store(self) -> BeamStore:
        """Its scans as beams; of a rig with a LiDAR."""
        return BeamStore(self.recording, self.rig.lidar.beam_origin_m, self.beams)

    @cached_property
    def columns(self) -> dict[str, np.ndarray]:
        """Per-stop columns (K, ...) that effects may look at; see `stop_columns`."""
        recording = self.recording
        of_stops = recording.joints, recording.time_s, recording.covariates
        try:
            columns = stop_columns(self.rig, *of_stops)
        except InputError as error:
            raise InputError(f"{recording.folder / 'stops.csv'}: {error}") from None
        columns |= {"stop": np.array(recording.stops), "location": recording.location}
        if self.rig.tracker:
            columns["tracked"] = tracked_poses(self.rig, recording)
        if self.reference:
            at_m = self.reference.vertices_m
            box_m = np.stack([at_m.min(axis=0), at_m.max(axis=0)])
            columns["mesh_box_m"] = np.broadcast_to(box_m, (len(recording.stops), 2, 3))
        if self.rig.levels:
            columns["up"] = up_in_root(self.rig, recording)
        return {**columns, **recorded_columns(recording.covariates)}


def recording_names(sources: Sequence[Source]) -> list[str]:
    """What each recording is called where stops of several stand together: its rig's name, with the
    recording's number after it where several are of one rig."""
    rigs = [s.rig.name for s in sources]
    return [
        f"{rig}.{rigs[:i].count(rig)}" if rigs.count(rig) > 1 else rig for i, rig in enumerate(rigs)
    ]


def labels(sources: Sequence[Source]) -> list[str]:
    """What each recording is called beside the others: its folder, with as much of the path to it
    as tells it from them; empty where it is the only one."""
    if len(sources) == 1:
        return [""]
    paths = [source.recording.folder.resolve().parts for source in sources]
    for count in range(1, 1 + max(map(len, paths))):
        found = ["/".join(path[-count:]) for path in paths]
        if len(set(found)) == len(found):
            break
    return found
