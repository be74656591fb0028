"""What to do after a diagnosis: commands that are ready to be typed, and what would tell more."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from calib.blunders import told
from calib.diagnosis.stand import Stand
from calib.diagnosis.verdict import ABSORBED_BY_MODEL, Diagnosis
from calib.diagnosis.verdict.sentences import BAD
from calib.diagnosis.weak import group, to_be_planned
from calib.problem.model import default_effects
from calib.runs.asked.in_place import InPlace
from calib.runs.run import Run


def next_command(run: Run, found: Diagnosis, others: Sequence[InPlace]) -> str:
    """What to do next: leave out what is wrong, add what is missing, or fit that of the `others`,
    in place of an effect of the model, which fits best and far better."""
    if tokens := told.tokens(found.blunders):
        return command_without(run, tokens)
    best = min(others, key=lambda each: each.odds, default=None)
    if best and best.is_better:
        return _command_instead(run, best)
    names = [*found.worth_adding, *found.formulas]
    if found.verdict == BAD or not names:
        return ""
    out = f"{run.folder}-{'formula' if found.formulas else 'added'}"
    return shlex.join(["rigcal", "add", str(run.folder), *names, "-o", out])


def command_to_plan(run: Run, effects: Sequence[str]) -> str:
    """The command that plans stops at which effects differ, and writes them beside the run, where
    the workbench shows them."""
    out = ["-o", f"{run.folder}-plan"]
    return shlex.join(["rigcal", "plan", str(run.folder), "--for", ",".join(effects), *out])


def remedies(run: Run, found: Diagnosis, stops: bool) -> Iterator[dict[str, Any]]:
    """What would tell of what a diagnosis could not; see `Diagnosis`.

    Args:
        run: the run.
        found: its diagnosis.
        stops: whether stops can be planned for it.
    """
    told = [("undistinguished", group(c), _separate(c), to_be_planned(c)) for c in _tied(found)]
    told += [
        ("weak_direction", w["parameters"], w["needs"], [] if w["alike"] else w["parameters"])
        for w in found.weak_directions
    ]
    told += [  # other rows want other columns
        ("untestable", [name], why, [name] if why == ABSORBED_BY_MODEL else [])
        for name, why in found.untestable.items()
    ]
    for of, names, needs, planned in told:
        command = command_to_plan(run, planned) if stops and planned else None
        yield {"of": of, "names": list(names), "needs": needs, "plan": command}


def _separate(candidate: Mapping[str, Any]) -> str:
    """What would separate a candidate from its rivals: of those that stops can tell it from, if
    there are any."""
    rivals = sorted(candidate["rivals"], key=lambda rival: rival["alike"])
    return rivals[0]["separate"]


def _tied(found: Diagnosis) -> list[Mapping[str, Any]]:
    """Candidates that were confirmed and have rivals; not what scatters by chance, whose rivals are
    told apart by other instruments and not by other stops."""
    return [c for c in found.candidates if c["step"] and c["rivals"]]


def can_be_planned_for(stand: Stand) -> bool:
    """Whether stops can be planned: the rig has an arm and, of scans, a mesh."""
    source = stand.sources[0]
    meets = source.reference is not None or not stand.problem.scans
    return bool(source.rig.joint_names) and meets


def command_without(run: Run, tokens: Sequence[str]) -> str:
    """The command that fits a run's model to the same without some groups of rows; from the run
    where its model has effects of files, or with a shape, or was named with rivals."""
    if _has_documents(run) or run.summary.get("rivals"):
        new = [part for token in tokens for part in ("--without", token)]
        out = ["-o", f"{run.folder}-without"]
        return shlex.join(["rigcal", "add", str(run.folder), *out, *new, *run.trusting])
    return _command_to_fit(run, run.model["effects"], tokens, "without")


def _command_instead(run: Run, other: InPlace) -> str:
    """The command that fits a run's model with another effect in place of one of its own; empty
    where it cannot be typed."""
    if _has_documents(run):
        return ""
    effects = [other.rival if name == other.effect else name for name in run.model["effects"]]
    return _command_to_fit(run, effects, (), "instead")


def _has_documents(run: Run) -> bool:
    """Whether effects of a run's model are of files, or have a shape."""
    return any(not isinstance(effect, str) for effect in run.model["effects"])


def _command_to_fit(run: Run, effects: Sequence[str], tokens: Sequence[str], to: str) -> str:
    """The command that fits a run's recordings as they were, with these effects, and without some
    more groups of rows."""
    left_out = [*run.model.get("without", ()), *tokens]
    without = [part for token in left_out for part in ("--without", token)]
    out = ["-o", f"{run.folder}-{to}"]
    usual = None if run.prior else default_effects(run.recordings)
    chosen = [] if tuple(effects) == usual else ["--effects", ",".join(effects)]
    chosen += [part for name in run.model["fixed"] for part in ("--fix", name)]
    for key, as_a_rule in (("hold_out", "location"), ("folds", 1)):
        if run.model[key] != as_a_rule:
            chosen += [f"--{key.replace('_', '-')}", str(run.model[key])]
    chosen += ["--prior", str(run.prior)] if run.prior else []
    chosen += ["--beams", str(run.beams)] if run.beams else []
    return shlex.join(["rigcal", "fit", *map(str, run.recordings), *out, *chosen, *without])
