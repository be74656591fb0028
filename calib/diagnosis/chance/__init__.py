"""Whether values scatter from stop to stop, or from place to place, by chance: tested at zero.

As `calib.solve.components` has it, a group's values have a score ``g ~ N(0, M + d M M)``, d their
variance. With the eigenvalues l of M, the squares ``w = z^2 / l`` of its independent parts are
chi-square times ``1 + d l``. The restricted likelihood ratio of d against 0 lies on the edge of
what d may be, so it is no chi-square; its distribution follows from the l alone (Crainiceanu and
Ruppert 2004). It is drawn, and its tail is that of a chi-square, scaled, with a share of zeros
(Greven, Crainiceanu, Kuechenhoff and Peters 2008).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from typing import Any

import numpy as np
from scipy import special

from calib.blunders.chance import LEVELS, POWER, after_looks, at_least
from calib.blunders.judged import Blunder
from calib.blunders.others import Others
from calib.blunders.shifts import beside_bodies, of_poses, told_by_stop
from calib.diagnosis.chance.agreeing import Agreement
from calib.diagnosis.chance.at_zero import AtZero
from calib.diagnosis.chance.serial import random_or_not
from calib.diagnosis.score import Scores
from calib.effects import CATALOGUE, Scatter, Site
from calib.problem import Problem
from calib.problem.spread import SpreadName, Whose, by_chance, rows_at, sigmas, spread_keys
from calib.problem.surfaces import TILT
from calib.residuals.groups import Group
from calib.results.holdout import fall_document
from calib.results.solution import one_unit
from calib.solve.components import NO_CHECKS, Sums, sigma_beyond, spreads, squares
from calib.solve.components.checks import Checks
from calib.solve.components.told import LEAST_SD, Told, slices, told
from calib.solve.estimate import Estimate

ALPHA_SCATTER = LEVELS["scatter by chance"]
# Members, or checks of a body's rows, below which nothing is said of their spread.
FEWEST_MEMBERS = 4
SCATTER_LOOKS = sum(effect.by_chance for effect in CATALOGUE)  # effects that are looked at
# Rows of which scatter of one kind seems to be scatter of the other.
TAKING_IN = (Site.TRACKER, Site.JOINTS)
# Of wider rows: who scatters.
NOUNS = {
    Site.TRACKER: "The tracker scatters",
    Site.JOINTS: "Joint readings scatter",
    Site.TARGET: "Targets scatter",
    Site.REFERENCE: "The mesh scatters",
}
WHO = {TILT: "the ends of leaning surfaces"}  # what scatters, where its key alone says too little


@dataclass(frozen=True)
class Spread:
    """How widely values scatter, or the rows of one body, joint or part beyond their sigma.

    Args:
        of: whose it is, as files have it; empty where the effect has one spread.
        unit: "m" or "rad".
        sd, sigma: the spread, and its sigma.
        who: the same, as people read it.
    """

    of: str
    unit: str
    sd: float
    sigma: float
    who: str = ""

    @property
    def told(self) -> str:
        """As people read it."""
        unit = {"m": "mm", "rad": "mrad"}[self.unit]
        return f"{1e3 * self.sd:.2f} ± {1e3 * self.sigma:.2f} {unit}"

    def document(self, effect: str) -> dict[str, Any]:
        """As the contract has what an effect scatters by."""
        of = {"of": self.of} if self.of else {}
        return {"effect": effect, **of, "sd": self.sd, "sigma": self.sigma, "unit": self.unit}


@dataclass(frozen=True)
class Chance:
    """An effect by chance that a model lacks.

    Args:
        effect: which.
        spreads: how widely it scatters; of several bodies, in each of their units.
        statistic: the likelihood ratio against none.
        p_value: how often as much is seen where there is none.
        detectable: spread that is found with 80 % power, in the effect's leading unit.
        rivals: names of others that explain as much.
        p_serial: how often chance makes stops that follow each other err so much alike.
        p_of_pose: the same of stops in which the arm has the same pose.
        agreements: by recording or body, of most stops, where only some are off.
    """

    effect: Scatter
    spreads: Sequence[Spread]
    statistic: float
    p_value: float
    detectable: float
    rivals: Sequence[str] = ()
    p_serial: float = 1.0
    p_of_pose: float = 1.0
    agreements: Sequence[Agreement | None] = ()

    @property
    def agreed(self) -> bool:
        """Whether nothing of it scatters, as everywhere only some stops are off."""
        return bool(self.agreements) and all(self.agreements)

    @property
    def p_adjusted(self) -> float:
        """Its p-value, all effects by chance being looked at."""
        return float(after_looks(self.p_value, SCATTER_LOOKS))

    @property
    def found(self) -> bool:
        """Whether it is to be named."""
        return self.p_adjusted < ALPHA_SCATTER

    def beside(self, estimate: Estimate) -> Chance:
        """The same as a fit has it that it is part of, tested beside all else in that."""
        if self.effect.widens:
            again = _of_rows(self.effect, squares(estimate), estimate.problem)
            return replace(again, rivals=self.rivals) if again else self
        known, found = spreads(estimate), []
        for unknown in by_chance(estimate.problem):
            if unknown.owner.effect == self.effect.name:  # of whichever rig
                rows = told([unknown], estimate.values, estimate.covariance_of([unknown.name]))
                pairs = zip(units_of(self.effect), spread_keys(unknown), strict=True)
                each = [
                    Spread(of="", unit=unit, sd=known[key][0], sigma=known[key][1])
                    for unit, key in pairs
                ]
                again = _of_values(self.effect, rows) or self
                found.append(replace(again, spreads=each, rivals=self.rivals))
        return max(found, key=lambda chance: chance.statistic)

    def document(self, step: int | None) -> dict[str, Any]:
        """As one of the candidates of diagnosis.json.

        Args:
            step: in which it was added, counting from 1; None where it was not.
        """
        sizes_m = [spread.sd for spread in self.spreads if spread.unit == "m"]
        size_mm = 1e3 * max(sizes_m) if sizes_m else None
        return {
            "effect": self.effect.family,
            "add": self.effect.name,
            "site": "range" if self.effect.site is Site.BEAM else self.effect.site.value,
            "p_value": at_least(self.p_value),
            "p_adjusted": self.p_adjusted,
            "p_serial": at_least(self.p_serial),
            "p_of_pose": at_least(self.p_of_pose),
            "statistic": self.statistic,
            "dof": len(self.spreads),
            "step": step,
            "dressed_up": False,
            **fall_document(None),
            "rejected_share": {"before": None, "after": None},
            "error_explained": None,
            "rms_mm": size_mm,
            "unabsorbed_rms_mm": size_mm,
            "parameters": {
                "unit": one_unit([spread.unit for spread in self.spreads]),
                "names": [self._name(spread) for spread in self.spreads],
                "estimate": [spread.sd for spread in self.spreads],
                "sigma": [spread.sigma for spread in self.spreads],
            },
            "smallest_detectable": self.detectable,
            "indistinguishable_from": list(self.rivals),
            "rivals": [],
            "matters": None,
        }

    def _name(self, spread: Spread) -> str:
        """As solution.yaml has it."""
        return SpreadName.made(spread.of, spread.unit, len(self.spreads) > 1).name

    @property
    def unsettled(self) -> str:
        """What is said of it where no fit that has it comes to an optimum."""
        who = NOUNS.get(self.effect.site, f"{self.effect.per.capitalize()}s scatter")
        return (
            f"{who} more than chance allows (p = {self.p_adjusted:.1g}), but no fit with that "
            f"scatter ({self.effect.name}) comes to an optimum: part of it is systematic."
        )

    @property
    def sentence(self) -> str:
        """What it says, and what to do about it."""
        each, name = self.effect.per, self.effect.name
        if self.effect.widens:
            sizes: dict[str, list[str]] = {}
            for spread in (s for s in self.spreads if s.sd > s.sigma):
                sizes.setdefault(spread.who, []).append(spread.told)
            each_of = (f"{WHO.get(of, of)} by {' and '.join(some)}" for of, some in sizes.items())
            told = ", ".join(each_of)
            what = f"{NOUNS[self.effect.site]} more than rig.yaml says: beyond its sigma, {told}"
        else:
            told = [s.told for s in self.spreads if s.sd > s.sigma] or [self.spreads[0].told]
            told = " and ".join(told)
            what = f"{each.capitalize()}s scatter by {told} {self.effect.what}"
        rivals = f"On these data it is not distinguishable from {', '.join(self.rivals)}. "
        how = random_or_not(self.p_adjusted, self.p_serial, self.p_of_pose)
        return (
            f"{what}; {how}. {rivals if self.rivals else ''}"
            f"{name} widens every sigma by that; it predicts nothing at another {each}, so the "
            "held-out error does not fall."
        )


def chances(
    scores: Scores,
    some: Sequence[Scatter],
    columns: Mapping[str, Sequence[np.ndarray]],
    noisier: float = 1.0,
) -> list[Chance]:
    """The tests of effects whose values are drawn by chance.

    Args:
        scores: of candidates, these among them.
        some: those to test.
        columns: effect's name -> its columns among the scores, of each of its unknowns.
        noisier: how many times wider than their sigmas the rows scatter by themselves.
    """
    found = []
    for effect in some:
        mine = columns[effect.name]
        at = np.concatenate(mine)
        score, information = scores.score[at], scores.information[np.ix_(at, at)]
        rows = Told(score, information, np.zeros(len(at), int))
        rows = rows.about_means(slices(map(len, mine))).of_noisier(noisier)
        found.append(_of_values(effect, rows))
    return [chance for chance in found if chance is not None]


def of_lidar(some: Sequence[Scatter], blunders: Sequence[Blunder], others: Others) -> list[Chance]:
    """The same of effects on where the LiDAR is at each stop, scans that are blunders left out;
    arguments as of `rows_by_chance`."""
    wild = [blunder.group for blunder in blunders if blunder.found]
    rows = of_poses(others, wild) if some else None
    found = [_of_values(effect, rows) for effect in some if rows is not None]
    return [chance for chance in found if chance is not None]


def units_of(effect: Scatter) -> list[str]:
    """Of its spreads, in the order of their groups."""
    return sorted(effect.unit.split(", "))


def _of_values(effect: Scatter, rows: Told) -> Chance | None:
    """The test of values, each spread against none; None where too few are told of."""
    units = units_of(effect)
    tests = [AtZero(rows.of(group)) for group in range(len(units))]
    if any(test.members < FEWEST_MEMBERS for test in tests):
        return None
    statistic, p_value = max((test.p_value() for test in tests), key=lambda each: -each[1])
    p_value = float(after_looks(p_value, len(tests)))
    sd = np.array([test.spread() for test in tests])
    # The others are worth no effort.
    if len(tests) == 1 or after_looks(p_value, SCATTER_LOOKS) < ALPHA_SCATTER:
        sd = rows.spread(np.full(len(tests), effect.sigma))
        statistic = max(rows.statistic(sd), statistic)
    pairs = zip(
        units, sd.tolist(), rows.sigma(np.maximum(sd, LEAST_SD * effect.sigma)), strict=True
    )
    return Chance(
        effect,
        spreads=[Spread("", unit, each, float(sigma)) for unit, each, sigma in pairs],
        statistic=statistic,
        p_value=p_value,
        detectable=tests[units.index(effect.leading)].detectable(
            ALPHA_SCATTER / SCATTER_LOOKS / len(tests)
        ),
    )


def ranked(some: Sequence[Chance]) -> list[Chance]:
    """Those that chance explains least first; of those that are found, the likeliest: no p-value
    is told that far out."""
    found = sorted((c for c in some if c.found), key=lambda chance: -chance.statistic)
    return found + sorted((c for c in some if not c.found), key=lambda chance: chance.p_value)


def rows_by_chance(
    effects: Sequence[Scatter], blunders: Sequence[Blunder], others: Others
) -> list[Chance]:
    """The tests that rows scatter beyond their sigmas, those of blunders left out; of those that
    next to nothing checks there is none.

    Args:
        effects: that say so.
        blunders: all groups of rows.
        others: all rows of the fit.
    """
    problem = others.problem
    seen: dict[Whose, list[tuple[float, float]]] = {}
    for shift in (b.shift for b in blunders if not b.found and b.group.kind == "body"):
        for unit, squares_there in shift.squares.items():
            seen.setdefault(Whose("body", shift.group.what, unit), []).append(squares_there)
    sums = {body: Checks.alone(*np.sum(mine, axis=0)) for body, mine in seen.items()}
    sites = {effect.site for effect in effects} - {Site.TRACKER}
    wild = [b.group for b in blunders if b.found]
    if whose := {each for site in sites for each in rows_at(problem, site)}:
        sums |= beside_bodies(others, whose, wild)
    tests = (_of_rows(effect, sums, problem) for effect in effects)
    found = [chance for chance in tests if chance is not None]
    return _by_likelihood(found, others, wild)


def _by_likelihood(found: list[Chance], others: Others, wild: Sequence[Group]) -> list[Chance]:
    """The same, where scatter of a tracker and of joints, if both are found, are in the order of
    their likelihoods over all rows of each stop: rows of one kind show what those of the other err
    by, and a fit that lacks either has given them less weight."""
    both = [chance for chance in found if chance.found and chance.effect.site in TAKING_IN]
    if len(both) < 2:
        return found
    mine = [rows_at(others.problem, chance.effect.site) for chance in both]
    number = {whose: i for i, whose in enumerate(chain(*mine))}
    told = told_by_stop(others, number, wild)
    ratio = []
    for some in mine if told.parts else ():
        of_it = told.of(*(number[whose] for whose in some))
        ratio.append(of_it.statistic(of_it.spread(np.ones(len(some)))))
    by_rows = [chance.statistic for chance in both]
    ordered = dict(zip(np.argsort(ratio), sorted(by_rows), strict=False))
    again = {id(c): replace(c, statistic=ordered.get(i, c.statistic)) for i, c in enumerate(both)}
    return [again.get(id(chance), chance) for chance in found]


def _of_rows(effect: Scatter, sums: Sums, problem: Problem) -> Chance | None:
    """The test that rows have the variance that is stated, as `Checks` have it."""
    if effect.site is Site.JOINTS:
        return _of_readings(effect, sums, problem)
    known, spreads, p, statistic, detectable = sigmas(problem), [], [], 0.0, np.inf
    mine = [whose for whose in rows_at(problem, effect.site) if whose in sums]
    checked = {whose: sums[whose] for whose in mine if sums[whose].left >= FEWEST_MEMBERS}
    for whose, checks in checked.items():
        sigma, beyond = known[whose]
        variance = sigma**2 - beyond**2
        at_first = checks.had_variance(variance / sigma**2)
        grown = max(at_first.growth(), 0.0)
        sd = float(np.sqrt(grown * variance))
        of_sd = sigma_beyond(sd, variance * at_first.sigma(grown))
        spreads.append(Spread(whose.text, whose.unit, sd, of_sd, who=whose.what))
        p.append(float(special.chdtrc(at_first.dof, at_first.scaled)))
        statistic += at_first.statistic(grown)
        if whose.unit == effect.leading:
            detectable = min(detectable, _detectable(at_first, variance, len(checked)))
    if not any(spread.unit == effect.leading for spread in spreads):
        return None
    p_value = float(after_looks(min(p), len(p)))
    return Chance(effect, spreads, statistic, p_value=p_value, detectable=detectable)


def _of_readings(effect: Scatter, sums: Sums, problem: Problem) -> Chance | None:
    """The same of joint readings: of all of them together, and of each joint's."""
    among = next((sums[w].among for w in rows_at(problem, effect.site) if w in sums), None)
    leading = [w.unit == effect.leading for w in among.whose] if among else []
    every, each = among.checks(among.first) if among else (NO_CHECKS, [])
    if every.left < FEWEST_MEMBERS or not any(leading):
        return None
    known = [checks.left >= FEWEST_MEMBERS for checks in each]
    looked = [every, *(checks for checks, enough in zip(each, known, strict=True) if enough)]
    p = [special.chdtrc(checks.dof, checks.scaled) for checks in looked]
    sigma = np.array([sigmas(problem)[whose][0] for whose in among.whose])
    first, best = among.first * sigma, among.likeliest
    ratio = among.told.statistic(best) - among.told.statistic(among.first)
    sd = np.sqrt(np.maximum((best * sigma) ** 2 - first**2, 0.0))
    of_variance = 2.0 * best * among.told.sigma(best) * sigma**2
    of_sd = map(sigma_beyond, sd.tolist(), of_variance.tolist())
    mine = np.flatnonzero(np.array(leading) & known)
    of_it = [(every, np.median(first[leading])), *((each[j], first[j]) for j in mine)]
    return Chance(
        effect,
        spreads=[
            Spread(of=whose.text, unit=whose.unit, sd=float(one), sigma=of, who=whose.what)
            for whose, one, of in zip(among.whose, sd, of_sd, strict=True)
        ],
        statistic=float(ratio),
        p_value=float(after_looks(min(p), len(p))),
        detectable=min(_detectable(checks, s**2, len(looked)) for checks, s in of_it),
    )


def _detectable(checks: Checks, variance: float, looks: int) -> float:
    """The sd beyond rows' variance that is found with 80 % power, of so many that are looked at."""
    limit = special.chdtri(checks.dof, ALPHA_SCATTER / SCATTER_LOOKS / looks)
    enough = limit / special.chdtri(checks.dof, POWER) - 1.0
    return float(np.sqrt(variance * enough * checks.left / checks.told))
