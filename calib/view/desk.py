"""What lies on the workbench: the runs, the one chosen, its ladder and what was found about it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from calib.diagnosis.verdict import worth_adding
from calib.effects import CATALOGUE, Trust, find
from calib.report.chart import Chart
from calib.report.charts.formulas import charts_of
from calib.runs.ladder import Rung, ladder
from calib.runs.run import Run
from chains.errors import InputError

LONGEST_CHANGE = 80  # letters of it that a folder's name takes up


@dataclass(frozen=True)
class Findings:
    """A run's diagnosis, as diagnosis.json has it.

    Args:
        heading: the verdict in words.
        sentences: the finding in words.
        candidates: effects that the model lacks, best first.
        unexplained: residual structure.
        blunders: what is wrong in the recording.
        curves: mean residual against one covariate each, by its name.
        formulas: a chart for each formula of residual structure.
        remedies: what would tell of what the diagnosis could not.
    """

    heading: str
    sentences: Sequence[str]
    candidates: Sequence[Mapping[str, Any]]
    unexplained: Sequence[Mapping[str, Any]]
    blunders: Sequence[Mapping[str, Any]]
    curves: Mapping[str, DiagnosisCurve]
    formulas: Sequence[Chart] = ()
    remedies: Sequence[Mapping[str, Any]] = ()

    @classmethod
    def read(cls, run: Run) -> Findings | None:
        """What was found about a run; None where it was not diagnosed.

        Raises:
            InputError: the file is of another version.
        """
        document = run.diagnosis()
        if document is None:
            return None
        single = (c for c in document["curves"] if len(c["covariates"]) == 1)
        curves: dict[str, DiagnosisCurve] = {}
        for each in single:  # of several rigs, whose stands out most
            covariate, curve = each["covariates"][0], DiagnosisCurve.read(each)
            if covariate not in curves or curve.stands_out > curves[covariate].stands_out:
                curves[covariate] = curve
        names = ("sentences", "candidates", "unexplained", "blunders")
        lists = {name: document[name] for name in names}
        charts = charts_of(document, narrow=True)
        lists["remedies"] = document.get("remedies", [])
        return cls(heading=document["heading"], curves=curves, formulas=charts, **lists)

    @property
    def worth_adding(self) -> list[str]:
        """Names of the effects that were confirmed, in the order in which to add them."""
        return worth_adding(self.candidates)

    def covariate_of(self, effect: str) -> str | None:
        """The covariate whose curve shows an effect best: its own, or what stands out most."""
        if not self.curves:
            return None
        known = any(e.family == effect.partition("@")[0] for e in CATALOGUE)
        own = [c for c in find(effect).covariates if c in self.curves] if known else []
        return max(own or self.curves, key=lambda c: self.curves[c].stands_out)


@dataclass(frozen=True)
class DiagnosisCurve:
    """Mean range residual (B,) in the bins of a covariate, with the band of chance; mm."""

    centres: np.ndarray
    mean_mm: np.ndarray
    band_mm: np.ndarray

    @classmethod
    def read(cls, document: Mapping[str, Any]) -> DiagnosisCurve:
        """As diagnosis.json has it; what is null there is NaN."""
        parts = document["centres"][0], document["mean_mm"], document["band_mm"]
        return cls(*(np.array(part, float) for part in parts))

    @property
    def stands_out(self) -> float:
        """The most that a bin's mean is beyond 0, in bands."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return float(np.nanmax(np.abs(self.mean_mm) / self.band_mm, initial=0.0))


@dataclass
class Desk:
    """The runs on the workbench.

    Args:
        runs: by the name that each is shown under, the lowest rung of a ladder first.
        chosen: which of them is looked at.
        refused: a sentence for each folder that could not be opened.
        trust: the Python files of effects that may run.
    """

    runs: dict[str, Run] = field(default_factory=dict)
    chosen: str = ""
    refused: list[str] = field(default_factory=list)
    trust: Trust = field(default_factory=dict)

    @classmethod
    def of(cls, folders: Sequence[Path | str], trust: Trust = MappingProxyType({})) -> Desk:
        """Runs, and those that they grew from; the last one is chosen.

        Raises:
            InputError: none of them can be opened; of several, those that can are.
        """
        desk = cls(trust=trust)
        for folder in folders:
            try:
                desk.add(Path(folder))
            except InputError as error:
                desk.refused.append(str(error))
        if not desk.runs:
            raise InputError("; ".join(desk.refused) or "no run was given; name a run folder")
        return desk

    @property
    def run(self) -> Run:
        """The one that is looked at."""
        return self.runs[self.chosen]

    def another(self) -> Desk:
        """One with the same runs, those to come included, and a choice of its own."""
        return replace(self)

    def add(self, folder: Path) -> None:
        """Lay a run on the bench, with those below it, and choose it.

        Raises:
            InputError: it cannot be opened.
        """
        run = Run.open(folder, self.trust)
        for rung in ladder([run]) or [Rung(run, None)]:
            self.chosen = self.name_of(rung.run.folder)
            self.runs[self.chosen] = rung.run

    def choose(self, name: str) -> None:
        """Look at another run."""
        self.chosen = name

    def rungs(self) -> list[Rung]:
        """From the run that all began with to the one looked at."""
        return ladder([self.run]) or [Rung(self.run, None)]

    def undo(self) -> str:
        """Go back to the run that this one grew from; what to tell of that.

        Raises:
            InputError: it grew from none, or that is gone.
        """
        left, below = self.run, self.rungs()[-1].below
        if below is None:
            raise InputError(f"{left.folder} grew from no other run that is still there")
        self.chosen = self.name_of(below.folder)
        self.runs[self.chosen] = below
        return f"Back at {self.chosen}; {left.folder} stays on disk."

    def addable(self, findings: Findings | None) -> dict[str, str | Mapping[str, Any]]:
        """Effects that the model lacks, those found first: name -> what `rigcal add` takes.

        Residual structure is a formula, as a document of an effect's file.
        """
        offered: dict[str, str | Mapping[str, Any]] = {}
        if findings is not None:
            documents = ((c["add"], c.get("document")) for c in findings.candidates)
            own = {name: what for name, what in documents if isinstance(what, Mapping)}
            offered |= {name: own.get(name, name) for name in findings.worth_adding}
            formulas = (each["formula"] for each in findings.unexplained if each.get("formula"))
            offered |= {formula["name"]: formula for formula in formulas}
            offered |= {c["add"]: own.get(c["add"], c["add"]) for c in findings.candidates}
        families = {name.partition("@")[0] for name in (*offered, *self.run.effects)}
        offered |= {e.name: e.name for e in CATALOGUE if e.family not in families}
        return {
            name: what
            for name, what in offered.items()
            if name not in self.run.effects and _addable(name, what)
        }

    @property
    def effects(self) -> dict[str, str | Mapping[str, Any]]:
        """Those of the run's model: name -> as model.yaml has it."""
        return dict(zip(self.run.effects, self.run.model["effects"], strict=True))

    def folder_for(self, *added: str, dropped: Sequence[str] = ()) -> Path:
        """Where a run with other effects goes: beside this one, under a name not yet taken."""
        change = "".join([*(f"+{name}" for name in added), *(f"-{name}" for name in dropped)])
        return self._beside(change if len(change) <= LONGEST_CHANGE else "-refit")

    def folder_without(self) -> Path:
        """Where a run goes that leaves something out; as `folder_for`."""
        return self._beside("-without")

    def _beside(self, change: str) -> Path:
        here = self.run.folder.resolve()
        wanted = here.with_name(f"{here.name}{change}")
        taken, number = wanted, 2
        while taken.exists():
            taken, number = wanted.with_name(f"{wanted.name}-{number}"), number + 1
        return taken

    def name_of(self, folder: Path) -> str:
        """What a run is shown under: its folder, as short as tells it from the others."""
        here = folder.resolve()
        known = next((n for n, r in self.runs.items() if r.folder.resolve() == here), None)
        if known is not None:
            return known
        return str(here) if here.name in self.runs else here.name


def _addable(name: Any, what: str | Mapping[str, Any]) -> bool:
    """Whether a diagnosis, which anybody may have written, names an effect of the catalogue or
    gives a formula: never a file."""
    if isinstance(what, Mapping):
        return str(name).isidentifier() and "python" not in what
    try:
        return find(str(name)) is not None
    except InputError:
        return False
