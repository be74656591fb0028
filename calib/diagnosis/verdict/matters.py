"""What a finding would change: the error on stops that were held out, and the calibration.

With many rows a test sees what no user feels. A finding matters where the held-out error would fall
by a hundredth of what noise alone makes of it, or a value of the calibration would move by half its
sigma; one that does neither is a trace.

Once an effect was named, what it leaves is significant wherever it is nearly right and not wholly,
and some effect always takes that in. So a later name does not stand where stops that were held out
do not bear it out, and another effect, of more parameters, explains as much at its price: then the
data ask for a more general form, and not for this name.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from calib.diagnosis.score import away_from_model, projection
from calib.diagnosis.screen import Candidate, Screen
from calib.diagnosis.search import NamedEffect, Search
from calib.diagnosis.stand import Look
from calib.diagnosis.suggest import in_words
from calib.effects import Effect, Site
from calib.results.errors import Errors
from calib.results.holdout import TAKEN_BACK, Fall
from calib.results.outstanding import shown
from calib.results.solution import Solution

# Where neither is reached a user would decide nothing otherwise: a hundredth of an error is less
# than two folds of one recording differ by, and half a sigma widens an interval by a tenth.
FALL_MATTERS, SHIFT_MATTERS = 0.01, 0.5
# The held-out error of models that lack nothing, over its floor: of 30 by another simulator, with 6
# to 30 stops, the largest was 1.23, and of 160 more 1.25.
HELD_OUT_BY_CHANCE = 1.25
# The same of models with something that scatters beyond its sigma: of 24 by that simulator the
# largest was 1.31, with a mesh three times as bad as stated, whose errors steps only approach.
HELD_OUT_BESIDE_SCATTER = 1.4
# From which it says that something is wrong, though no test does: a choice beyond both of these.
HELD_OUT_UNSAID = 1.5
NOTABLE = 1.96  # sigmas: half a 95 % interval
OF_INSTRUMENTS = {Site.TRACKER, Site.REFERENCE, Site.TARGET, Site.BEAM}
# Of how far an effect moves the unknowns of one effect, in the sigmas that these had before any
# data: where it moves all others by less, it is part of that one, as a range offset is of offsets
# by ring. In the presets' worlds others are moved by less than 1e-5 then, else by more than 0.05.
PART_OF = 1e-3
# Share of structure, or held-out error, that names must explain to be the answer: a choice. Of the
# rms more than half is left by an answer that explains less than that of the squares.
ABSORBED = 0.7


@dataclass(frozen=True)
class Matters:
    """What adding an effect or a structure would change.

    Args:
        held_out_mm: of the held-out error; negative where it falls.
        largest_shift_sigmas: of any value of the calibration, in its own sigma.
        floor_mm: the error that noise alone makes.
        takes_back: whether far fewer beams are rejected with it.
    """

    held_out_mm: float
    largest_shift_sigmas: float
    floor_mm: float
    takes_back: bool = False

    @property
    def worse(self) -> bool:
        """Whether stops that were held out are predicted worse with it."""
        return self.held_out_mm > FALL_MATTERS * self.floor_mm and not self.takes_back

    @property
    def enough(self) -> bool:
        """Whether it is more than a trace."""
        return (
            self.takes_back
            or -self.held_out_mm > FALL_MATTERS * self.floor_mm
            or self.largest_shift_sigmas > SHIFT_MATTERS
        )

    def document(self) -> dict[str, Any]:
        """As the contract has it."""
        return {
            "held_out_mm": self.held_out_mm,
            "largest_shift_sigmas": self.largest_shift_sigmas,
        }


class Consequences:
    """What the candidates of a look would change.

    Args:
        look: at which they were tested.
        rms_mm: as of `errors.judged_mm`; ``fit`` counts where nothing was held out.
    """

    def __init__(self, look: Look, rms_mm: Mapping[str, float | None]) -> None:
        self.look = look
        self.floor_mm = rms_mm["noise_floor"] or 0.0
        self.error_mm = rms_mm["held_out"] or rms_mm["fit"] or 0.0

    def of(self, candidate: Candidate, screen: Screen, fall: Fall | None = None) -> Matters:
        """What a candidate would change.

        Args:
            candidate: of the look.
            screen: of the look, that it is in.
            fall: of the held-out error, once it was truly fitted; where None, what it explains of
                the residuals is taken off.
        """
        if fall is None:
            explained = 1e3 * screen.rms_m(candidate)
            after = np.sqrt(max(self.error_mm**2 - explained**2, 0.0))
            fall = Fall(self.error_mm, float(after), self.floor_mm)
        taken, sigma = self._projected
        moved = taken[:, candidate.test.columns] @ candidate.test.estimate()
        shift = float(np.max(np.abs(moved) / sigma, initial=0.0))
        return Matters(fall.after_mm - fall.before_mm, shift, fall.floor_mm, fall.takes_back)

    @cached_property
    def _projected(self) -> tuple[np.ndarray, np.ndarray]:
        """How much (C, Q) of each candidate every value of the calibration absorbs, and sigmas."""
        linear = self.look.linear
        _, model, taken = projection(linear, linear.candidates)
        ours = np.searchsorted(model, linear.among(_calibration(self.look)))
        block = linear.information[np.ix_(model, model)]
        scale = np.sqrt(np.maximum(np.diag(block), 1e-300))
        inverse = np.linalg.inv(block / np.outer(scale, scale) + 1e-13 * np.eye(len(model)))
        return taken[ours], np.sqrt(np.diag(inverse)[ours]) / scale[ours]


def _calibration(look: Look) -> list[str]:
    """Unknowns of the calibration that the rows of a look depend on."""
    return [name for name in look.stand.problem.calibration if name in look.linear.at]


def unchecked(look: Look, solution: Solution) -> Iterator[str]:
    """Of errors of an instrument that the model takes in wholly: what those of usual size would
    change unseen; a sentence each, of those that would change a value by more than its interval.
    How an arm is divided into its joints, no data tell, and no pose depends on.

    Args:
        look: at the fit as it was.
        solution: of its run.
    """
    at = look.named.at
    gauges = [e for e in look.named.gauges if e.site in OF_INSTRUMENTS and e.name in at]
    gauges = [e for e in _by_family(gauges, look) if not _part_of_one(e, look)]
    if not gauges:
        return
    linear, names = look.linear, _calibration(look)
    _, model, taken = projection(linear, linear.candidates)
    keys = [key for name in names for key in look.stand.problem.variables[name].keys]
    reported = dict(zip(solution.keys, np.sqrt(np.diag(solution.covariance)), strict=True))
    here = [i for i, key in enumerate(keys) if reported.get(key, 0.0) > 0.0]
    keys, taken = [keys[i] for i in here], taken[np.searchsorted(model, linear.among(names))][here]
    sigma = np.array([reported[key] for key in keys])
    for effect in gauges if keys else ():
        usual = np.concatenate([linear.whole.layout.unknowns[n].sigma for n in _its(effect, look)])
        moved = np.linalg.norm(taken[:, at[effect.name]] * usual, axis=1) / sigma
        most = int(np.argmax(moved))
        if moved[most] > NOTABLE:
            yield (
                f"Nothing here checks {effect.name}, as other parts of the model take it in: one "
                f"of its usual size{_size(effect, look)} would change {keys[most].name} by "
                f"{moved[most]:.0f} of its sigmas.{_would_tell(effect, look)}"
            )


def _by_family(gauges: Sequence[Effect], look: Look) -> list[Effect]:
    """The first shape of each effect of which no shape can be tested."""
    tested = {candidate.effect.family for candidate in look.named.candidates}
    first = {effect.family: effect for effect in reversed(gauges)}
    return [first[family] for family in first if family not in tested][::-1]


def _part_of_one(gauge: Effect, look: Look) -> bool:
    """Whether an effect of the model has another as a part of it, so that it moves nothing else."""
    names, layout = _its(gauge, look), look.linear.whole.layout
    away = np.abs(away_from_model(look.linear, names)) / layout.sigma[:, None]
    moved = {n: away[at].max() for n, at in layout.at.items() if n not in names and away[at].size}
    first, *others = sorted(moved, key=lambda name: -moved[name])
    rest = max((moved[name] for name in others), default=0.0)
    return bool(layout.unknowns[first].owner.effect) and rest < PART_OF * moved[first]


def _its(candidate: Effect, look: Look) -> list[str]:
    """The unknowns of a candidate, of every rig that has it."""
    linear = look.linear
    return [name for name in linear.candidates if linear.owner[name].effect == candidate.name]


def _size(effect: Effect, look: Look) -> str:
    """The usual size of an effect of one number, after a comma; else nothing."""
    params = next(p for s in look.stand.sources if (p := effect.params(s.rig)))
    if len(params) > 1:
        return ""
    scale, unit = shown(params[0].unit)
    return f", {scale * params[0].sigma:g}{'' if params[0].unit == '1' else f' {unit}'},"


def _would_tell(effect: Effect, look: Look) -> str:
    """A sentence with what would check an effect, after a blank, where that is known."""
    if effect.site is Site.BEAM and not all(source.reference for source in look.stand.sources):
        return " A mesh of the room, which another instrument measured, would tell."
    scale = effect.site in (Site.TRACKER, Site.REFERENCE)
    return " A length that another instrument measured would tell." if scale else ""


@dataclass(frozen=True)
class Weighed:
    """What of a search matters.

    Args:
        found: the search without the rest.
        matter: effect -> what it would change.
        traces, refused: a sentence for each trace, and for each name that is not to be believed.
    """

    found: Search
    matter: Mapping[str, Matters]
    traces: Sequence[str]
    refused: Sequence[str]


def weighed(
    found: Search,
    held_out: Mapping[str, Fall],
    rms_mm: Mapping[str, float | None],
) -> Weighed:
    """A search without its traces, and without names that stops which were held out speak against
    or, of a later name that has a more general rival, do not bear out.

    Args:
        found: the search.
        held_out: effect -> how the held-out error falls once it is truly fitted.
        rms_mm: as of `Consequences`.
    """
    matter, named, traces, refused = {}, [], [], []
    for step in found.found:
        screen, name = step.before.named, step.effect.name
        fall = held_out.get(name)
        told = Consequences(step.before, rms_mm).of(step.candidate, screen, fall)
        matter[name] = told
        if told.worse:
            refused.append(
                f"{name} was tried and rejected: it absorbs part of the residuals, but stops that "
                f"were held out are predicted worse with it ({told.held_out_mm:+.3f} mm)."
            )
        elif named and not borne_out(fall) and (other := _more_general(step)):
            refused.append(
                f"{name} was tried and rejected: what {named[-1].effect.name} leaves of the "
                f"residuals is significant (adjusted p = {step.p_adjusted:.1g}) and it absorbs "
                f"part of that, but so does {other}, which is more general, and stops held out "
                f"do not confirm it: their error changes by {told.held_out_mm:+.3f} mm, ± "
                f"{fall.spread_mm:.3f} by how much stops differ."
            )
        elif told.enough:
            named.append(step)
        else:
            traces.append(_sentence(name, step.candidate, screen, told))
    kept: dict[str, list[Candidate]] = {"unnamed": [], "at_first": []}
    for key, look in (("unnamed", found.looks[-1]), ("at_first", found.looks[0])):
        every, weigh = getattr(found, key), Consequences(look, rms_mm)
        for candidate in every:
            told = weigh.of(candidate, look.unnamed)
            if told.enough:
                kept[key].append(candidate)
            elif key == "unnamed":
                what = in_words(candidate.effect)
                traces.append(_sentence(f"structure over {what}", candidate, look.unnamed, told))
    if not refused and not named:
        kept["at_first"] = []  # nothing stands in the way of what is left
    more = found.more and len(named) == len(found.found)
    found = replace(found, found=named, more=more, **kept)
    return Weighed(found, matter, traces, refused=refused)


def as_good(errors: Errors, than_mm: float, thrown: float) -> bool:
    """Whether errors at unseen stops are no larger than another fit's, as far as that matters, and
    no more beams are rejected than this share."""
    size = errors.size
    worse = size.judged_mm > than_mm + FALL_MATTERS * size.floor_mm
    return not worse and (errors.rejected_share or 0.0) <= thrown + TAKEN_BACK


def borne_out(fall: Fall | None) -> bool:
    """Whether stops held out confirm a name, as far as is known: they agree on it, or it takes away
    most of an error that is larger than chance makes it."""
    if fall is None or not fall.by_chance:
        return True
    return fall.before_mm > HELD_OUT_BY_CHANCE * fall.floor_mm and fall.explained > ABSORBED


def _more_general(step: NamedEffect) -> str:
    """A rival with more parameters, which explains as much at its price; empty without any."""
    own = step.candidate.test.dof
    return next((r.effect.name for r in step.rivals if r.candidate.test.dof > own), "")


def _sentence(what: str, candidate: Candidate, screen: Screen, told: Matters) -> str:
    return (
        f"{what} is significant, {1e3 * screen.rms_m(candidate):.2f} mm rms, and too small to "
        f"matter: it would change the held-out error by {told.held_out_mm:+.3f} mm, and no value "
        f"of the calibration by more than {told.largest_shift_sigmas:.1f} of its sigmas."
    )
