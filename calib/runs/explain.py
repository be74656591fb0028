"""Fit, diagnose, add, until nothing worth adding is left: ``rigcal explain``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from calib import outputs
from calib.blunders import told
from calib.diagnosis import Diagnosis
from calib.diagnosis.verdict.sentences import rival_sentence
from calib.effects import Effect, is_known, load_effects, own_effects, read, trust_in
from calib.problem.model import Model, Source
from calib.results.errors import judged_mm, tells_of_poses
from calib.results.holdout import Fall, gains_m2
from calib.rig import load_rig
from calib.runs.calibrate import calibrate, grow, recordings_document
from calib.runs.diagnose import diagnose
from calib.runs.reopen import model_of
from calib.runs.run import DIAGNOSIS, Run
from calib.solve.fit import Progress
from chains.errors import InputError
from sensors.documents import plain, write_json, write_yaml
from sensors.recording import digests

EXPLANATION, KEPT_EFFECTS = "explanation.json", "effects"
MOST_RUNGS = 8  # a choice: ends a ladder that does not end by itself
# Of what the held-out error has above the expected one, what an effect must take away: a choice, as
# little as `FALL_MATTERS` of the diagnosis; what takes less is a rung that nobody needs.
LEAST_FALL = 0.01


@dataclass(frozen=True)
class Explanation:
    """A ladder of runs, and why it ends where it does.

    Args:
        runs: from the first fit to the last, each grown from the one before.
        steps: per run what was added, dropped or left out, and its held-out error; and, of what was
            added, the `rivals` of `Diagnosis.candidates` that explain as much, by its name.
        refused: effects that were found, and rivals of such, that did not lower the held-out error.
        diagnosis: of the last run.
        kept: files of the formulas that the last run has, for other recordings to use.
        untold: what the last run has, though something else explains as much; a sentence each.
    """

    runs: Sequence[Run]
    steps: Sequence[dict[str, Any]]
    refused: Sequence[str]
    diagnosis: Diagnosis
    kept: Sequence[Path] = ()
    untold: Sequence[str] = ()

    def document(self) -> dict[str, Any]:
        """As written to explanation.json."""
        return {
            "verdict": self.diagnosis.verdict,
            "sentences": [*self.diagnosis.sentences, *self.untold],
            "ladder": list(self.steps),
            "refused": list(self.refused),
            "kept": [str(path) for path in self.kept],
        }


def explain(
    recordings: outputs.Paths,
    out: Path | str,
    model: Model | None = None,
    progress: Progress = lambda what, done, total: None,
    candidates: str | Sequence[str] = (),
) -> Explanation:
    """Grow a model until it is adequate, or residual structure is left; every rung is kept.

    What a mishap spoiled is left out first, as a rung of its own. What is found is added only if
    the held-out error falls, by a hundredth of what it has above the expected one or more, and
    dropped again if later steps leave it nothing to lower. In place of what is refused, its rivals
    are tried; where the last name is refused, the diagnosis looks at held-out stops, too. Residual
    structure is added as a formula, which ``effects/NAME.yaml`` keeps for other recordings. Rungs
    that an interrupted call has finished are taken up again.

    Args:
        recordings: folder, or folders.
        out: folder of the runs ``00``, ``01``, …, made if it is not there.
        model: what is estimated at first; the default effects where None.
        progress: as of `fit.solve`.
        candidates: files of effects of the user's own, as of `diagnose`.

    Raises:
        InputError: what is wrong with the input, or `out` is something else.
    """
    out, recordings = Path(out), outputs.each(recordings)
    with outputs.entries(out, outputs.LADDER, recordings) as entries:
        for number in range(MOST_RUNGS):  # one that is not climbed any more, too
            outputs.settle(out / f"{number:02d}")
        own_effects((), candidates)  # what is wrong with a file is said before the first fit
        climb = _Climb(recordings, out, entries, progress, candidates)
        climb.first(model or Model.of(None, (), (), recordings))
        diagnosis = climb.to_the_top()
        climb.clear_above()
        kept = _keep_formulas(climb.run, entries)
        files = [out / KEPT_EFFECTS / path.name for path in kept]
        result = Explanation(
            climb.runs, climb.steps, climb.refused, diagnosis, kept=files, untold=climb.untold()
        )
        write_json(entries / EXPLANATION, result.document())
        if not kept and (out / KEPT_EFFECTS).is_dir():
            outputs.remove(out / KEPT_EFFECTS)
    return result


def _keep_formulas(run: Run, entries: Path) -> list[Path]:
    """Write the effects of a run that only describe into files that ``--effects`` takes, each to
    begin with what the run found."""
    written = []
    for effect in (e for e in model_of(run).effects if e.seen):
        (entries / KEPT_EFFECTS).mkdir(exist_ok=True)
        parts = (run.solution.shared, *run.solution.recordings.values())
        found = next(part.effects[effect.name] for part in parts if effect.name in part.effects)
        document = effect.document() | {
            "start": [float(f"{x:.4g}") for x in found.estimate],
            "source": f"found by 'rigcal explain' in {', '.join(r.name for r in run.recordings)}",
        }
        written.append(entries / KEPT_EFFECTS / f"{effect.name}.yaml")
        write_yaml(written[-1], document)
    return written


class _Climb:
    """The ladder while it is climbed."""

    def __init__(
        self,
        recordings: list[Path],
        out: Path,
        entries: Path,
        progress: Progress,
        candidates: str | Sequence[str] = (),
    ) -> None:
        self.recordings, self.out, self.progress = recordings, out, progress
        self.candidates, self._entries = candidates, entries
        self.runs: list[Run] = []
        self.steps: list[dict[str, Any]] = []
        self.refused: list[str] = []
        self._formulas: Mapping[str, Mapping[str, Any]] = {}
        self._general: set[str] = set()  # effects that have a more general rival
        self._rivals: Mapping[str, Sequence[Mapping[str, Any]]] = {}

    @property
    def run(self) -> Run:
        return self.runs[-1]

    def tell(self, what: str, done: int, total: int) -> None:
        """Progress, with the rung's name."""
        self.progress(f"{self._next().name}: {what}", done, total)

    def first(self, model: Model) -> None:
        """The fit to start from."""
        folder = self._next()
        run = self._finished(folder, model, None)
        if run is None:
            run = calibrate(self.recordings, folder, model, progress=self.tell)
        self._keep(run, [], [])

    def to_the_top(self) -> Diagnosis:
        """Rung after rung; the last diagnosis. Each rung shows by itself whether the held-out error
        falls with what was found. Where it does not fall, the diagnosis is made once more with the
        fits that show it, and says what there is instead."""
        refits, diagnosis = False, self._diagnosis(False)
        while len(self.runs) < MOST_RUNGS:
            found = {*diagnosis.worth_adding, *diagnosis.formulas}
            if self.improve(diagnosis):
                refits = False
            elif refits or found.isdisjoint(self.refused):
                break
            else:
                refits = True
            diagnosis = self._diagnosis(refits)
        return diagnosis

    def _diagnosis(self, refits: bool) -> Diagnosis:
        """Of the last rung; what it finds on the way is kept until the ladder stands."""
        return diagnose(self.run, self.tell, refits, self.candidates, kept=self._kept)

    @cached_property
    def _kept(self) -> outputs.Kept:
        return outputs.kept(self._entries, {"recordings": list(map(str, self.recordings))})

    def improve(self, diagnosis: Diagnosis) -> bool:
        """Leave out blunders; or else add what lowers the held-out error, and drop what that made
        idle. Whether anything was changed."""
        if tokens := told.tokens(diagnosis.blunders):
            self._leave_out(tokens)
            return True
        if not self.run.converged:  # of such a run nothing else is learnt
            return False
        self._formulas = diagnosis.formulas
        self._general = {
            each["add"]
            for each in diagnosis.candidates
            if any(rival["dof"] > each["dof"] for rival in each["rivals"])
        }
        self._rivals = {each["add"]: each["rivals"] for each in diagnosis.candidates}
        names = [*diagnosis.worth_adding, *self._formulas]
        earlier = [name for step in self.steps for name in step["added"]]
        before = len(self.runs)
        for name in names:
            if self._add(name):
                continue
            for rival in self._rivals.get(name, []):  # in its place, if stops bear that out
                if self._add(rival["add"], instead=True):
                    break
        if len(self.runs) == before:
            return False
        for name in earlier:
            here = {effect.name: effect for effect in self._model.effects}
            if name in here and not here[name].by_chance:
                self._try(self._model.minus([name]), [], [name])
        return True

    def clear_above(self) -> None:
        """Remove rungs that an earlier call left above the last one."""
        for folder in self.out.iterdir():
            if folder.name.isdigit() and int(folder.name) >= len(self.runs):
                outputs.remove(folder)

    def _add(self, name: str, instead: bool = False) -> bool:
        """Add an effect, if the error falls with it; by more than chance, if `instead` of another.
        Whether it is in the model."""
        described = self._formulas.get(name)
        if described is not None:
            effects = (read(described, self.run.folder / DIAGNOSIS, {}),)
        else:
            effects = load_effects((name,), own=() if is_known(name) else self._own)
        if name not in self.refused and not self._has(effects[0]):
            self._try(self._model.plus(effects), [name], [], instead)
        return self._has(effects[0])

    def _has(self, effect: Effect) -> bool:
        """Whether the model has an effect; of one that repeats, in this very shape."""
        key = "name" if effect.repeats else "family"
        return any(getattr(mine, key) == getattr(effect, key) for mine in self._model.effects)

    def _leave_out(self, tokens: list[str]) -> None:
        """A rung with the same model, and less data: its errors say nothing against it."""
        folder, model = self._next(), self._model.leaving_out(tokens)
        run = self._finished(folder, model, self.run) or grow(self.run, model, folder, self.tell)
        self._keep(run, [], [], tokens)

    def untold(self) -> list[str]:
        """What was added, and is there at last, though something that is not there explains as
        much; a sentence each."""
        names, families = ({getattr(e, k) for e in self._model.effects} for k in ("name", "family"))
        return [
            f"{name} was added. {rival_sentence(rival)}"
            for step in self.steps
            for name, rivals in step["rivals"].items()
            for rival in rivals
            if name in names and rival["effect"] not in families
        ]

    @property
    def _model(self) -> Model:
        return model_of(self.run)

    def _try(
        self, model: Model, added: list[str], dropped: list[str], instead: bool = False
    ) -> None:
        folder = self._next()
        run = self._finished(folder, model, self.run)
        if run is None:
            run = grow(self.run, model, folder, self.tell)
        # What is drawn anew by chance tells nothing of a stop that was left out.
        chance = any(effect.by_chance for effect in model.effects if effect.name in added)
        falls = _falls(self.run, run, LEAST_FALL if added else 0.0)
        later = any(step["added"] for step in self.steps)
        if instead or (later and self._general.intersection(added)):
            falls = falls and not _by_chance(self.run, run)
        if run.converged and (chance or falls):
            self._keep(run, added, dropped)
        else:
            outputs.remove(folder)
            self.refused += added

    def _keep(
        self, run: Run, added: list[str], dropped: list[str], left_out: Sequence[str] = ()
    ) -> None:
        self.runs.append(run)
        rms = run.summary["rms_mm"]
        self.steps.append(
            {
                "run": str(run.folder),
                "added": added,
                "empirical": [name for name in added if name in self._formulas],
                "dropped": dropped,
                "left_out": list(left_out),
                "rivals": {name: list(self._rivals.get(name, ())) for name in added},
                "held_out_rms_mm": rms["held_out"],
                "fit_rms_mm": rms["fit"],
                "noise_floor_mm": rms["noise_floor"],
            }
        )

    def _next(self) -> Path:
        return self.out / f"{len(self.runs):02d}"

    def _finished(self, folder: Path, model: Model, below: Run | None) -> Run | None:
        """The rung that an earlier call made here, if it is the same one."""
        try:
            run = Run.open(folder, trust_in(model.effects))
            run.state()
        except InputError:
            return None
        if not tells_of_poses(run.summary):
            return None
        wanted = {
            "beams": None,
            **model.document(),
            "recordings": self._told,
            "hold_out": "location",
            "prior": None,
        }
        if run.grown_from != (below.folder.resolve() if below else None):
            return None
        return run if all(run.model.get(key) == plain(wanted[key]) for key in wanted) else None

    @cached_property
    def _own(self) -> tuple[Effect, ...]:
        """Effects that stand beside the catalogue."""
        return own_effects(map(load_rig, self.recordings), self.candidates)

    @cached_property
    def _told(self) -> list[dict[str, str]]:
        """The recordings as a run's model.yaml has them."""
        opened = [Source.open(folder) for folder in self.recordings]
        return recordings_document(opened, [digests(s.recording.folder) for s in opened])


def _falls(before: Run, after: Run, share: float) -> bool:
    """Whether the squared held-out error falls, and by this share of what is above the floor."""
    was, now = _held_out(before) ** 2, _held_out(after) ** 2
    excess = was - judged_mm(before.summary)["noise_floor"] ** 2
    return now < was and was - now >= share * excess


def _by_chance(before: Run, after: Run) -> bool:
    """Whether the fall of the held-out error may be chance."""
    floor = judged_mm(after.summary)["noise_floor"]
    gain = gains_m2(before.unseen_m2, after.unseen_m2)
    return Fall(_held_out(before), _held_out(after), floor, gain).by_chance


def _held_out(run: Run) -> float:
    rms = judged_mm(run.summary)
    return rms["fit"] if rms["held_out"] is None else rms["held_out"]
