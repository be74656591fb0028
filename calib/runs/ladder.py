"""The ladder of a study: runs that grew from each other, down to the expected error."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from calib.rig.suspect import listed
from calib.runs.run import Run
from chains.errors import InputError

DESCRIBED = "~"  # before an effect that was added and is empirical
FORMULA = "an empirical formula, without a known cause"


@dataclass(frozen=True)
class Rung:
    """A run, and the one that it grew from; None where that is gone, or it is the first.

    Args:
        run: the run.
        below: what it grew from.
    """

    run: Run
    below: Run | None

    @property
    def grown_from(self) -> Path | None:
        """Where the run below was when this one grew from it."""
        return self.run.grown_from

    @property
    def added(self) -> list[str] | None:
        """Effects that the run below has not; None where that is gone."""
        if self.below is None:
            return None if self.grown_from else []
        return [name for name in self.run.effects if name not in self.below.effects]

    @property
    def empirical(self) -> list[str]:
        """Those of the effects added that only describe what was measured."""
        return [name for name in self.added or () if name in self.run.empirical]

    @property
    def dropped(self) -> list[str] | None:
        """Effects that only the run below has; None where that is gone."""
        if self.below is None:
            return None if self.grown_from else []
        return [name for name in self.below.effects if name not in self.run.effects]

    @property
    def left_out(self) -> list[str] | None:
        """What the run leaves out of the recordings and the run below does not; None where that is
        gone."""
        if self.below is None:
            return None if self.grown_from else self.run.left_out
        return [token for token in self.run.left_out if token not in self.below.left_out]

    @property
    def step(self) -> str:
        """What the run changed of the one below, in words."""
        if self.grown_from and self.below is None:
            return f"grew from {self.grown_from.name}, which is gone"
        signs = dict.fromkeys(self.empirical, DESCRIBED)
        changes = [f"{signs.get(name, '+')} {name}" for name in self.added]
        changes += [f"- {name}" for name in self.dropped]
        changes += [f"without {listed(self.left_out)}"] if self.left_out else []
        changes += ["all beams"] if self.below and self.below.beams and not self.run.beams else []
        return ", ".join(changes if self.below else ["start", *changes]) or "the same model"

    def document(self) -> dict[str, Any]:
        """As ``rigcal compare --json`` gives it."""
        rms = self.run.summary["rms_mm"]
        return {
            "run": str(self.run.folder),
            "grown_from": str(self.grown_from) if self.grown_from else None,
            "added": self.added,
            "empirical": self.empirical,
            "dropped": self.dropped,
            "left_out": self.left_out,
            "held_out_rms_mm": rms["held_out"],
            "fit_rms_mm": rms["fit"],
            "noise_floor_mm": rms["noise_floor"],
        }


def ladder(runs: Sequence[Run]) -> list[Rung]:
    """The rungs of runs that grew, or were grown from, the lowest first; empty where none did.

    Args:
        runs: those to show; of a single one, all that it grew from, as far as they are there.
    """
    if len(runs) == 1:
        runs = list(_down(runs[0]))[::-1]
    known = {run.folder.resolve(): run for run in runs}
    below = {folder: _below(run, known) for folder, run in known.items()}
    related = {folder for folder, run in known.items() if run.grown_from}
    related |= {run.folder.resolve() for run in below.values() if run is not None}
    shown = [folder for folder in known if folder in related]
    depth = {folder: len(list(_down(known[folder], known))) for folder in shown}
    return [Rung(known[f], below[f]) for f in sorted(shown, key=depth.__getitem__)]


def _down(run: Run, known: dict[Path, Run] | None = None) -> Iterator[Run]:
    """The run, what it grew from, what that grew from, and so on; each once."""
    seen: set[Path] = set()
    lower: Run | None = run
    while lower is not None and lower.folder.resolve() not in seen:
        seen.add(lower.folder.resolve())
        yield lower
        lower = _below(lower, known or {})


def _below(run: Run, known: dict[Path, Run]) -> Run | None:
    """What a run grew from, where that is still there."""
    folder = run.grown_from
    if folder is None:
        return None
    if folder.resolve() in known:
        return known[folder.resolve()]
    try:
        found = Run.open(folder, run.trust)
    except InputError:
        return None
    steps = run.model.get("steps")  # another run may stand there by now
    same = not steps or all(found.model.get(key) == value for key, value in steps[-1].items())
    return found if same else None
