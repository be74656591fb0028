"""Effects that a user writes as formulas, without a line of code."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Self

import numpy as np
import pydantic

from calib.effects.base import Effect, Param, Site, View
from calib.effects.basis import finite
from calib.effects.own.expression import ALIASES, Expression
from calib.effects.rig import DOF
from calib.rig import Rig
from chains.errors import InputError, NoColumnError
from sensors.documents import Document, Marks, Number, nearest, plain, validate

BEAM_AXES = {"range": 0, "azimuth": 1, "elevation": 2}
OF_TARGET = {"target.x": 0, "target.y": 1, "target.z": 2}
SITE_WORDS = {
    "noise": Site.NOISE,
    "reference": Site.REFERENCE,
    **dict.fromkeys(OF_TARGET, Site.TARGET),
}
TRACKER = "tracker:"  # before a body's name, as frames go by the same
Text = Annotated[str, pydantic.Field(min_length=1)]
# What stands in place of units that numbers of formulas do not have.
SI = dict.fromkeys(("nm", "um", "\u03bcm", "mm", "cm", "km", "inch", "ft", "millimetre"), "m")
SI |= dict.fromkeys(("deg", "degree", "degrees", "°", "mrad", "urad", "\u03bcrad", "mas"), "rad")
SI |= dict.fromkeys(("arcsec", "arcmin"), "rad")
LARGEST_VALUE = 1e100  # of a formula: the squares of larger ones overflow
Sigma = Annotated[Number, pydantic.Field(gt=0)]


class FormulaFile(Document):
    """An effect as its YAML says it.

    Attributes:
        name: letters, digits and _.
        site: `range`, `azimuth`, `elevation` or `noise` of a beam; a joint's name, or
            ``joint:<name>``; ``<frame>.<dof>``, ``mount.tz`` say, in the frame's own axes;
            ``tracker:<body>.<dof>``, what the tracker adds to a body's pose, in its own axes;
            ``target.x`` to ``.z``, where spheres sit, in the tracker's; or `reference`, where the
            surface is, along its normal, which faces the LiDAR.
        unit: of the parameters: the site's per unit of the formulas.
        sigma: how large a parameter may plausibly be.
        basis: a formula per parameter: the error at the site per unit of it.
        parameters: their names; numbered where there are none.
        start: where a fit begins, a number per parameter; 0 where there are none. Beams that are
            off by more than noise explains are rejected until the effect is about right.
        seen: of an empirical effect: column -> its least and largest value
            there. Where it is used beyond that, a warning says so.
        what, typical, source: for its page.
    """

    name: Annotated[str, pydantic.Field(pattern=r"^[A-Za-z_][A-Za-z0-9_]*$")]
    site: Text
    unit: str
    sigma: Sigma
    basis: Annotated[tuple[Text, ...], pydantic.Field(min_length=1)]
    parameters: tuple[Text, ...] = ()
    start: tuple[Number, ...] = ()
    seen: dict[str, tuple[Number, Number]] = pydantic.Field(default_factory=dict)
    what: str = ""
    typical: str = ""
    source: str = ""

    @pydantic.field_validator("basis", mode="before")
    @classmethod
    def _several(cls, basis: Any) -> Any:
        return (basis,) if isinstance(basis, str) else basis

    @pydantic.field_validator("unit")
    @classmethod
    def _of_si(cls, unit: str) -> str:
        for part in re.findall(r"[^\W\d_]+|°(?!C)", unicodedata.normalize("NFKC", unit)):
            if part in SI:
                raise ValueError(
                    f"{unit}: formulas take and give m and rad, so parameters and sigma are in "
                    f"these too; write {SI[part]} in place of {part}"
                )
        return unit

    @pydantic.model_validator(mode="after")
    def _named(self) -> Self:
        if self.parameters and len(self.parameters) != len(self.basis):
            raise ValueError(
                f"{len(self.parameters)} parameters are named, and basis has {len(self.basis)} "
                f"formulas; name one for each"
            )
        if self.start and len(self.start) != len(self.basis):
            raise ValueError(
                f"start has {len(self.start)} numbers, and basis {len(self.basis)} formulas; "
                f"give one for each"
            )
        if len(set(self.parameters)) < len(self.parameters):
            raise ValueError("two parameters have one name; give each its own")
        for name, (low, high) in self.seen.items():
            if not low <= high:
                raise ValueError(f"seen of {name}: give its least value, then its largest")
        return self


class FormulaEffect(Effect):
    """An effect of the user's own, as formulas of what the recording knows."""

    def __init__(self, file: FormulaFile) -> None:
        self.file, self.name = file, file.name
        self.site = self._site()
        owner = f"effect '{file.name}'"
        self.expressions = tuple(Expression(text, owner) for text in file.basis)
        self.covariates = tuple(dict.fromkeys(n for e in self.expressions for n in e.names))
        self.seen = {ALIASES.get(name, name): ends for name, ends in file.seen.items()}
        for name in (n for n in self.seen if n not in self.covariates):
            what = f"{owner}: seen has {name}, which its formulas do not look at"
            raise InputError(what + nearest(name, self.covariates))
        self.unit, self.typical, self.source = file.unit, file.typical, file.source or "its user"
        named = zip(self.parameters, file.basis, strict=True)
        self.formula = f"{file.site} + " + " + ".join(f"{p} * ({text})" for p, text in named)
        if file.what:
            self.__doc__ = file.what

    @classmethod
    def read(cls, document: Mapping[str, Any], path: str | Path, marks: Marks) -> Self:
        """The effect that a mapping describes.

        Raises:
            InputError: a key is missing, unknown or wrong, or a formula is no arithmetic.
        """
        return cls(validate(FormulaFile, document, path, marks))

    def document(self) -> dict[str, Any]:
        """The mapping that describes it."""
        return plain(self.file.model_dump(exclude_defaults=True))

    @property
    def goes_with_time(self) -> bool:
        return bool({"elapsed_s", "time_s"}.intersection(self.covariates))

    @property
    def parameters(self) -> tuple[str, ...]:
        """Their names, in the formulas' order."""
        count = len(self.file.basis)
        numbered = ("amount",) if count == 1 else tuple(f"p{i + 1}" for i in range(count))
        return self.file.parameters or numbered

    def params(self, rig: Rig) -> tuple[Param, ...]:
        needed = {Site.TRACKER: rig.tracker, Site.TARGET: rig.target}
        if self.site is Site.JOINTS:
            self._joint(rig)
        elif self.site is Site.EDGE:
            self._edge(rig)
        elif not needed.get(self.site, rig.lidar):
            return ()
        elif self.site is Site.TRACKER:
            self._body(rig)
        start = self.file.start or (0.0,) * len(self.parameters)
        pairs = zip(self.parameters, start, strict=True)
        return tuple(Param(name, self.file.unit, self.file.sigma, at) for name, at in pairs)

    def basis(self, view: View) -> np.ndarray:
        values = [self._value(e, view) for e in self.expressions]
        columns = np.stack(np.broadcast_arrays(*values), axis=-1)
        rows, count = columns.shape
        if self.site is Site.NOISE:
            return columns[:, None]
        if self.site is Site.JOINTS:
            basis = np.zeros((rows, len(view.rig.joint_names), count))
            basis[:, self._joint(view.rig)] = columns
        elif self.site is Site.EDGE:
            basis = np.zeros((rows, len(view.rig.tree.edges), 6, count))
            basis[:, *self._edge(view.rig)] = columns
        elif self.site is Site.TRACKER:
            basis = np.zeros((rows, len(view.rig.tracker.bodies), 6, count))
            basis[:, *self._body(view.rig)] = columns
        elif self.site is Site.REFERENCE:
            basis = view["normal"][:, :, None] * columns[:, None]
        elif self.site is Site.TARGET:
            basis = np.zeros((rows, 3, count))
            basis[:, OF_TARGET[self.file.site]] = columns
        else:
            basis = np.zeros((rows, 3, count))
            basis[:, BEAM_AXES[self.file.site]] = columns
        return basis

    def _value(self, expression: Expression, view: View) -> np.ndarray:
        def column(name: str) -> np.ndarray:
            if name not in view.columns:
                # Columns of several numbers a row are for code, not for formulas.
                known = [n for n, c in view.columns.items() if callable(c) or np.ndim(c) == 1]
                said = expression.wrong(f"there is no column {name} here{nearest(name, known)}")
                raise NoColumnError(str(said), name)
            values = np.asarray(view[name])
            if values.dtype.kind not in "biuf":
                raise expression.wrong(f"column {name} holds names, not numbers")
            if values.ndim != 1:
                raise expression.wrong(f"column {name} has more than one number a row")
            return values.astype(float)

        values = finite(np.atleast_1d(expression.value(column)))
        if (largest := np.max(np.abs(values), initial=0.0)) > LARGEST_VALUE:
            raise expression.wrong(f"the formula reaches {largest:.0e} here; scale it down")
        return values

    def _site(self) -> Site:
        if self.file.site in BEAM_AXES:
            return Site.BEAM
        if self.file.site in SITE_WORDS:
            return SITE_WORDS[self.file.site]
        if self.file.site.startswith(TRACKER):
            return Site.TRACKER
        return Site.EDGE if self.file.site.rpartition(".")[2] in DOF else Site.JOINTS

    def _joint(self, rig: Rig) -> int:
        """Index of the joint that it acts on."""
        name = self.file.site.removeprefix("joint:")
        if name not in rig.joint_names:
            frames = [f"{edge}.tz" for edge in rig.tree.edge_names]
            bodies = [f"{TRACKER}{body}.tz" for body in (rig.tracker.bodies if rig.tracker else ())]
            raise self._no_site([*BEAM_AXES, *SITE_WORDS, *rig.joint_names, *frames, *bodies])
        return rig.joint_names.index(name)

    def _edge(self, rig: Rig) -> tuple[int, int]:
        """Index of the edge that it acts on, and of the degree of freedom."""
        return self._among(rig.tree.edge_names)

    def _body(self, rig: Rig) -> tuple[int, int]:
        """Index of the tracked body that it acts on, and of the degree of freedom."""
        return self._among(rig.tracker.bodies, TRACKER)

    def _among(self, names: Sequence[str], before: str = "") -> tuple[int, int]:
        name, _, dof = self.file.site.removeprefix(before).rpartition(".")
        if name not in names or dof not in DOF:
            dof = dof if dof in DOF else DOF[-1]
            raise self._no_site([f"{before}{each}.{dof}" for each in names])
        return list(names).index(name), DOF.index(dof)

    def _no_site(self, known: list[str]) -> InputError:
        what = f"effect '{self.name}': there is no site {self.file.site} on this rig"
        return InputError(what + nearest(self.file.site, known))
