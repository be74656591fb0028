"""A fitted model, and the tests of all that it lacks, from one linearisation there."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain, pairwise
from typing import Any

import numpy as np

from calib import problem as problems
from calib.blunders.judged import Blunder, judge
from calib.blunders.others import Others
from calib.blunders.unjudged import unjudged
from calib.diagnosis.candidates import finer, known_effects
from calib.diagnosis.carried import Carried
from calib.diagnosis.chance import Chance, chances, of_lidar, ranked, rows_by_chance
from calib.diagnosis.chance.agreeing import agreements
from calib.diagnosis.chance.beams import BeamScatter
from calib.diagnosis.chance.serial import p_of_pose, p_serial
from calib.diagnosis.judges import Shares
from calib.diagnosis.linear import Linear, beams_looked_at, linearise_with, rows_along
from calib.diagnosis.score import ScoreTest, away_from_model, project
from calib.diagnosis.screen import Candidate, Screen, screen
from calib.diagnosis.structure import of_look, singly, structure
from calib.effects import CATALOGUE, Effect, Scatter, Site
from calib.linear.layout import Layout
from calib.problem import Problem
from calib.problem.build import shapes_of
from calib.problem.model import Model, Source
from calib.problem.without import leave_out
from calib.residuals.groups import Group
from calib.residuals.levels import Level
from calib.residuals.tracker import TrackedBody
from calib.results.intervals import Intervals, intervals
from calib.results.sigmas import TOLERATED
from calib.solve.estimate import Estimate, Start
from calib.solve.fit import Progress, fitted_as, shapes_freed, solve
from chains.errors import InputError

REFINING_BEAMS = 4_096  # of a scan, to find between which shapes the best is: a choice


@dataclass(frozen=True)
class Stand:
    """A model fitted to its recordings.

    Args:
        sources, model, problem, estimate: these.
        own: effects of the user's own, candidates as those of the catalogue are.
    """

    sources: Sequence[Source]
    model: Model
    problem: Problem
    estimate: Estimate
    own: Sequence[Effect] = ()

    @property
    def catalogue(self) -> tuple[Effect, ...]:
        """Every effect that could be missing."""
        return (*CATALOGUE, *self.own)

    @cached_property
    def beams(self) -> BeamScatter:
        """How widely beams scatter, of a rig with scans."""
        return BeamScatter.of(self.estimate)

    @cached_property
    def levels_err_most(self) -> bool:
        """Whether levels fit worse than their sigmas allow, and worse than what the tracker sees:
        they, or what they are mounted on, err then, and no body."""
        if all(block.kind != Level.kind for block in self.problem.seen):
            return False
        squares: dict[str, list[np.ndarray]] = {Level.kind: [], TrackedBody.kind: []}
        for block in self.problem.seen:
            rows, _ = block.whitened(self.estimate.values, False)
            squares[block.kind].append(np.square(rows).ravel())
        off = {kind: np.sqrt(np.concatenate(some).mean()) for kind, some in squares.items() if some}
        return bool(off[Level.kind] > max(TOLERATED, off.get(TrackedBody.kind, 0.0)))

    @cached_property
    def spent(self) -> int:
        """How many unknowns of the model differ by stop alone: those of effects that depend on
        columns of the stops and on nothing else. Geometry of the arm, which depends on joints, and
        errors of a tracker are not counted: each stop has the rows of its tracked bodies to tell of
        them."""
        return sum(map(self.spent_by, self.model.effects))

    def spent_by(self, effect: Effect) -> int:
        """How many of them one effect of the model has."""
        columns = {c for s in self.sources for c in s.columns}
        by_stop = effect.covariates and columns.issuperset(effect.covariates)
        if not by_stop or effect.by_chance or effect.site is Site.TRACKER:
            return 0
        terms = (t for some in self.problem.terms for t in some if t.effect.name == effect.name)
        return sum({term.variable: len(term.free) for term in terms}.values())

    def with_effects(self, added: Sequence[Effect], progress: Progress) -> Stand:
        """The model with more effects, fitted from here."""
        return self.refitted(self.model.plus(tuple(added)), self.estimate.start, progress)

    def lacking(self, names: Collection[str], progress: Progress) -> Stand:
        """The model without some of its effects, fitted from here."""
        return self.refitted(self.model.minus(names), self.estimate.start, progress)

    def without(
        self,
        groups: Sequence[Group],
        progress: Progress,
        of: Stand | None = None,
        aside: Collection[str] | None = None,
    ) -> Stand:
        """The model fitted from here, with some groups of rows left out: of what this fit was made
        of, or `of` what another one was. What it had set `aside` may be given in tokens."""
        of = of or self
        tokens = [group.token for group in groups]
        sources = leave_out(of.sources, tokens)
        model = replace(self.model, without=(*of.model.without, *tokens))
        meetings = dict(self.problem.meetings)
        if of is not self or any(group.kind == "surface" for group in groups):  # other surfaces
            meetings = {i: m for i, m in meetings.items() if sources[i].reference is None}
        problem = problems.build(sources, model, meetings=meetings)
        start = self.estimate.start
        start = start if aside is None else replace(start, aside=frozenset(aside))
        estimate = solve(problem, progress=progress, start=start)
        return Stand(sources, model, problem, estimate, own=self.own)

    def refitted(self, model: Model, start: Start, progress: Progress) -> Stand:
        """Another model on these recordings, fitted from a start."""
        problem = self.problem_of(model)
        estimate = solve(problem, progress=progress, start=start)
        return Stand(self.sources, model, problem, estimate, own=self.own)

    def compared(self, model: Model, start: Start, progress: Progress) -> Stand:
        """Another model, fitted with rows weighed and scattering as in this fit: what its cost is
        compared by."""
        problem = self.problem_of(model)
        estimate = fitted_as(problem, self.estimate.problem, start, progress)
        return Stand(self.sources, model, problem, estimate, own=self.own)

    def problem_of(self, model: Model) -> Problem:
        """The problem of another model on these recordings; beams meet what they met here."""
        return problems.build(self.sources, model, meetings=self.problem.meetings)

    def look(self, progress: Progress) -> Look:
        """Test everything that the model lacks."""
        carried = self.carried
        known = known_effects(self.model, self.sources, carried.everywhere, self.catalogue)
        by_rows = [e for e in known if e.by_chance and e.site is not Site.BEAM]
        known = [e for e in known if e not in by_rows]
        there = set(self.model.names)
        unnamed = [e for e in structure(self.sources, carried.sample) if e.name not in there]
        linear, at, of_rigs = self.linearise((*known, *unnamed), progress)
        scores = project(linear, linear.candidates, self.spent)
        chance = [e for e in known if e.by_chance]
        named = [e for e in known if e.site is not Site.NOISE and not e.by_chance]
        named = screen(scores, named, at)
        felt = np.sqrt(np.maximum(scores.felt, 0.0))
        alone, each = singly(unnamed, of_rigs, felt)
        rest = screen(scores, alone, each, named.common if named.candidates else None)
        noise = screen(scores, [e for e in known if e.site is Site.NOISE], at, 1.0)
        values = chances(scores, chance, of_rigs)
        # Where beams are noisier than stated, the mean of those of a stop scatters more as well.
        if any(c.found for c in values) and self.beams.alone > TOLERATED:
            values = chances(scores, chance, of_rigs, self.beams.alone)
        return Look(
            stand=self,
            linear=linear,
            named=named,
            unnamed=rest,
            noise=noise,
            values=values,
            by_rows=by_rows,
        )

    def linearise(
        self, candidates: Sequence[Effect], progress: Progress, most: int | None = None
    ) -> tuple[Linear, dict[str, np.ndarray], dict[str, list[np.ndarray]]]:
        """All rows with these candidates beside the model, of beams about `most` of each scan or
        `beams_looked_at`; each one's columns among theirs; and the same apart for each of its
        unknowns, of which every rig may have one."""
        wide = self.problem_of(self.model.plus(tuple(candidates)))
        variables = variables_of(wide, {e.name for e in candidates})
        every = [*chain(*variables.values())]
        most = most or beams_looked_at(self.estimate.associations)
        linear = linearise_with(wide, self.estimate, every, progress, most)
        at, start = {}, 0
        for name, theirs in variables.items():
            ends = start + np.cumsum([0, *(wide.variables[v].dim for v in theirs)])
            at[name] = [np.arange(*each) for each in pairwise(ends.tolist())]
            start = int(ends[-1])
        return linear, {name: np.concatenate(each) for name, each in at.items()}, at

    def theta(self, effect: Effect) -> np.ndarray:
        """The free parameters (q,) of an effect of the model."""
        return self.estimate.values[self._variable(effect)]

    def sigma(self, effect: Effect) -> np.ndarray:
        """Sigma (q,) of each free parameter of an effect of the model: see `intervals`. Of several
        rigs, the first that has the effect."""
        known, estimate = self.known
        return np.sqrt(np.diag(known.over(estimate, [self._variable(effect)])))

    def _variable(self, effect: Effect) -> str:
        """The unknown of an effect of the model; of several rigs, the first that has it."""
        terms = (t for some in self.problem.terms for t in some)
        found = next((t.variable for t in terms if t.effect.name == effect.name), None)
        if found is None:
            raise ValueError(f"'{effect.name}' is not in the model")
        return found

    @cached_property
    def known(self) -> tuple[Intervals, Estimate]:
        """Intervals of all unknowns, as a fit of the model reports them, and of what they are."""
        estimate = shapes_freed(self.estimate, self.model)
        return intervals(estimate), estimate

    @cached_property
    def carried(self) -> Carried:
        """Which columns points and stops carry."""
        return Carried.of(self.sources, self.estimate)


@dataclass(frozen=True)
class Look:
    """What the rows say from where a fit stands.

    Args:
        stand: that fit.
        linear: the rows, linearised.
        named: the catalogue's effects, tested.
        unnamed: structure, tested.
        noise: effects on the scatter, tested; they move no mean.
        values: effects whose values are drawn anew by chance, tested.
        by_rows: those that need no columns of their own: what groups of rows are off tells of them.
    """

    stand: Stand
    linear: Linear
    named: Screen
    unnamed: Screen
    noise: Screen
    values: Sequence[Chance]
    by_rows: Sequence[Scatter]

    def thinned(self) -> Look:
        """What is asked of a look that a search has left behind: what its tests said, and what its
        candidates would change. None of them can be judged with it."""
        scores = self.named.scores.thinned()
        screens = (replace(s, scores=scores) for s in (self.named, self.unnamed, self.noise))
        named, unnamed, noise = screens
        thin = self.linear.thinned()
        return replace(self, linear=thin, named=named, unnamed=unnamed, noise=noise)

    @cached_property
    def others(self) -> Others:
        """The rows, linearised, over the unknowns of the fit alone."""
        problem = self.stand.estimate.problem
        return Others.of(self.linear.whole.onto(Layout.of(problem)), problem)

    @cached_property
    def blunders(self) -> list[Blunder]:
        """All groups of rows, those that chance explains least first; of parts of the mesh that
        would be named, none that is `unjudged`."""
        judged = judge(self.others)
        parts = [b.group for b in judged if b.found and b.group.kind == "surface"]
        gone = unjudged(self.stand.estimate, parts)
        return [b for b in judged if b.group not in gone]

    @cached_property
    def chance(self) -> list[Chance]:
        """What may scatter by chance, that which chance explains least first; rows of no body where
        levels err most."""
        if self.stand.levels_err_most:
            return ranked(self.values)
        wider = [e for e in self.by_rows if e.widens]
        posed = [e for e in self.by_rows if not e.widens]
        of_rows = rows_by_chance(wider, self.blunders, self.others)
        of_poses = of_lidar(posed, self.blunders, self.others)
        return ranked([*self.values, *of_poses, *of_rows])

    def still(self, some: Sequence[Chance]) -> list[Chance]:
        """Those of some effects by chance, all of them in this look's model, that are found beside
        all else in it."""
        beside = (chance.beside(self.stand.estimate) for chance in some)
        return [
            replace(
                c,
                p_serial=p_serial(c.effect, self.others, self.blunders),
                p_of_pose=p_of_pose(c.effect, self.others, self.blunders),
                agreements=agreements(c.effect, self.stand.estimate, self.others, self.blunders),
            )
            for c in beside
            if c.found
        ]

    @property
    def checked(self) -> set[Group]:
        """Groups of rows that others contradict, or could."""
        return {blunder.group for blunder in self.blunders}

    def closely(self, candidate: Candidate, progress: Progress) -> tuple[Look, Candidate]:
        """A look at one candidate alone, in finer shapes between those of the grid beside its own;
        and the best of them, whose p-value is to be adjusted for these shapes as well. All but the
        last grid are looked at with some of the beams."""
        stand, near, finest = self.stand, self, candidate
        grid, times = shapes_of(candidate.effect, stand.sources), candidate.effect.refinements
        for left in reversed(range(times if candidate.effect.shape_name else 0)):
            shaped = finer(finest.effect, grid)
            grid = [each.shape for each in shaped]
            shaped = [each for each in shaped if each.name not in stand.model.names]
            linear, at, _ = stand.linearise(shaped, progress, REFINING_BEAMS if left else None)
            scores = project(linear, linear.candidates, stand.spent)
            named = screen(scores, shaped, at, self.named.common)
            if not named.candidates:
                return self, candidate
            near = replace(self, linear=linear, named=named)
            (found,) = named.candidates
            finest = replace(found, looks=found.looks * finest.looks)
        return near, finest

    def with_shape(
        self, candidate: Candidate, near: Look, finest: Candidate
    ) -> tuple[Look, Candidate]:
        """This look with one of its candidates in the finer shape that it has in another look."""
        columns = candidate.test.columns
        if near is self:
            return self, finest
        if len(columns) != len(finest.test.columns):  # the data show more or less of it
            return self, replace(candidate, effect=finest.effect)
        here, there = (np.ix_(each, each) for each in (columns, finest.test.columns))
        scores, shaped = self.named.scores, near.named.scores
        information = scores.information.copy()
        information[here] = shaped.information[there]
        told = scores.told_as(columns, shaped, finest.test.columns)
        changed = replace(told, information=information)
        named = replace(self.named, scores=changed)
        moved = replace(finest, test=replace(finest.test, columns=columns))
        return replace(self, named=named), moved

    def judged(self, candidate: Candidate, progress: Progress) -> ScoreTest:
        """A candidate's test with its clusters jackknifed: see `jackknife`."""
        stand, found = self.stand, candidate.test
        every = {n: np.isin(np.r_[at], found.columns) for n, at in self.named.scores.at.items()}
        its = {name: there for name, there in every.items() if there.any()}
        away = away_from_model(self.linear, list(its))[:, np.concatenate([*its.values()])]
        away = away @ found.whiten
        wide = stand.problem
        if wide.scans:
            wide = stand.problem_of(stand.model.plus((of_look(candidate.effect),)))
        return found.judged(self.shares(wide, away, progress), self.named.scores)

    def shares(self, problem: Problem, away: np.ndarray, progress: Progress) -> Shares:
        """Rows of the clusters along directions (U, r), of a problem that has their unknowns."""

        def tell(done: int, total: int) -> None:
            progress("fitting the candidates", done, total)

        shares = Shares()
        for rows in rows_along(self.linear, problem, self.stand.estimate, away, tell):
            shares.add(rows.A, rows.stop, rows.place)
        return shares


def tried(fit: Callable[..., Stand], *of: Any) -> Stand | None:
    """What a fit gives; None where the LiDAR leaves the room, so that no beam meets it."""
    try:
        return fit(*of)
    except InputError:
        return None


def variables_of(problem: Problem, effects: set[str]) -> dict[str, list[str]]:
    """Effect -> its variables: one, or one per rig."""
    found: dict[str, dict[str, None]] = {}
    for terms in problem.terms:
        for term in terms:
            if term.effect.name in effects:
                found.setdefault(term.effect.name, {})[term.variable] = None
    return {name: list(variables) for name, variables in found.items()}
