"""What moved between recordings that one fit takes for the same rig."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from calib.blunders import told
from calib.diagnosis.stand import Stand
from calib.problem import build
from calib.problem.model import Model, Source, labels
from calib.results.intervals import intervals
from calib.results.recalibrate import Link, earlier, solve_from
from calib.results.solution import solution_of
from calib.solve.fit import Progress, solve
from chains.errors import InputError


def moved_between(stand: Stand, last: Stand, progress: Progress) -> Iterator[dict[str, Any]]:
    """The links that moved between the first recording of a rig and a later one, as blunders of
    `diagnosis.json`: as a fit of the later one, with that of the first as its prior, finds them.

    Args:
        stand: a model, fitted to all recordings.
        last: with what it was found to lack. What scatters by chance is none of that here: a link
            that moved once seems to.
        progress: as of `calib.solve.fit.solve`.
    """
    chance = {e.name for e in last.model.effects if e.by_chance} - set(stand.model.names)
    model = last.model.minus(list(chance))
    named = dict(zip(labels(last.sources), last.sources, strict=True))
    for rig in dict.fromkeys(source.rig.name for source in named.values()):
        first, *later = (label for label, source in named.items() if source.rig.name == rig)
        found = _moved(model, named[first], [named[label] for label in later], progress)
        try:
            for label, links in zip(later, found, strict=True):
                yield from (_told(first, label, link) for link in links if link.moved)
        except InputError:  # one alone has nothing to start from, or lacks what an effect needs
            continue


def _told(first: str, later: str, link: Link) -> dict[str, Any]:
    """As a blunder, by the parameter that shows it best."""
    best = int(np.argmax(np.abs(link.change) / link.sigma))
    way = link.parameters[best], link.change[best], link.sigma[best], link.units[best]
    return told.of_link(first, later, link.name, way, p=link.p_value, instead=link.instead)


def _moved(
    model: Model, first: Source, later: Sequence[Source], progress: Progress
) -> Iterator[list[Link]]:
    """What became of each link from a recording to each later one; of nothing, where a fit of one
    alone comes to no optimum."""
    if not later:
        return
    problem = build([first], model)
    estimate = solve(problem, progress=progress)
    known = solution_of(problem, estimate, intervals(estimate, progress))
    for source in later:
        other = build([source], model)
        alone, *_, links = solve_from(other, model, earlier(other, known), progress)
        yield links if estimate.converged and alone.converged else []
