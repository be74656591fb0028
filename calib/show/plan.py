"""What people read of a plan: the stops, and what is known now and will be after them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from rich.console import Console
from rich.table import Table

from calib.planning.purpose import ALL, RELIABILITY, SCATTER, WORKSPACE
from calib.problem.unknowns import Key
from calib.rig.suspect import listed
from calib.show.tables import columns_table, print_pairs, shown, terminal

if TYPE_CHECKING:
    from calib.planning import Plan
    from calib.planning.room.hanging import TargetPlan

MANY_PARAMETERS = 12  # parameters of an effect, from which on their sigmas are told together
DIRECTIONS_SHOWN = 4  # directions that are shown
EFFECTS_SHOWN = 10  # effects that are shown, those that gain most: all are in --json
AIMS = {
    ALL: "for the whole calibration",
    RELIABILITY: "against blunders: no single stop is to carry an estimate",
    SCATTER: "for the whole calibration, where stops err as a whole by chance",
    WORKSPACE: "to predict the place of what the arm carries, wherever it can go",
}
WEAK = {
    "now": "hardly determined now",
    "after": "and after these stops",
    "with_any_number": "and after any number of stops of this arm: measure it directly",
}
# Of a sigma, what any number of stops leaves of it at least, where none help: a choice.
SETTLED = 0.9
ASKED_SHOWN = 4  # parameters that stops are for, that are told in a sentence
FALLS = 0.99  # of a sigma: one that falls by less is told together with all such


def print_plan(plan: Plan) -> None:
    """Print a plan: what it is for and what it achieves, the stops, and all that they are worth."""
    console, document = terminal(), plan.document()
    stops = f"{len(plan.stops)} stop{'s' * (len(plan.stops) != 1)}"
    console.print(f"{stops} {aim(document)}", style="bold", soft_wrap=True)
    for sentence in (*achieved(plan), *_unlike(plan), *_reached(plan)):
        console.print(sentence)
    console.print()
    console.print("Joints in degrees or mm, in the order of a short path.")
    for sentence in _way(document):
        console.print(sentence)
    tables = [_stops_table(plan)]
    if document["smallest_detectable"]:
        tables.append(_detectable_table(document["smallest_detectable"]))
    tables.append(_sigma_table(plan))
    tables += [_effects_table(document), _mishaps_table(document)]
    for table in tables:
        console.print(table)
        console.print()
    for sentence in _unseen(document["unseen_blunder"]):
        console.print(sentence)
        console.print()
    _print_others(console, plan)
    weak = document["weak_directions"]
    for when, title in WEAK.items():
        pairs = [("", " and ".join(each["parameters"])) for each in weak[when][:DIRECTIONS_SHOWN]]
        more = len(weak[when]) - DIRECTIONS_SHOWN
        pairs += [("", f"and {more} more")] if more > 0 else []
        print_pairs(console, title, pairs or [("", "nothing")])
    now, after = document["observability"]["now"], document["observability"]["after"]
    table = columns_table("observability", *now)
    for name, row in (("now", now), ("after", after)):
        table.add_row(name, *(f"{value:.3g}" for value in row.values()))
    console.print(table)


def _way(document: Mapping[str, Any]) -> Iterator[str]:
    """What is known of the way from stop to stop, and for what the arm is taken, in sentences."""
    way, what = document["way"], "links and room, all joints moving at once"
    checked = [row for row in document["way"] if row["clear"] is not None and row["stop"]]
    by = [k["stop"] for row, k in pairwise(way) if row["stop"] is None]
    shut = [row["stop"] for row in checked if not row["clear"]]
    if checked and not by and not shut:
        yield f"The straight way from each to the next is clear of the arm's own {what}."
    if by:
        yield (
            f"Before stop{'s' * (len(by) > 1)} {', '.join(map(str, by))} the arm goes by another "
            f"pose ('way' of --json; way.csv of -o FOLDER), to stay clear of its own {what}."
        )
    if shut:
        yield (
            f"No clear way was found to stop{'s' * (len(shut) > 1)} "
            f"{', '.join(map(str, shut))} from the stop before: drive there by hand."
        )
    if document["tubes"]:
        rest = len(document["tubes"]) - 1
        more = f", and of {rest} more link{'s' * (rest > 1)}" if rest else ""
        yield f"Taken for tubes, as their shapes are missing: {document['tubes'][0]}{more}."


def print_targets(plan: TargetPlan) -> None:
    """Print where targets should hang, and what is known without and with them."""
    console = terminal()
    heading, fall = achieved_by_targets(plan)
    console.print(heading.removesuffix("."), style="bold", soft_wrap=True)
    console.print(fall)
    console.print()
    console.print("Centres of the spheres, m, in the reference's frame.")
    table = columns_table("target", "x", "y", "z")
    for row in plan.targets:
        table.add_row(row["target"], *(f"{row[axis]:.2f}" for axis in "xyz"))
    for each in (table, _sigma_table(plan)):
        console.print(each)
        console.print()
    _print_others(console, plan)


def _print_others(console: Console, plan: Plan | TargetPlan) -> None:
    """Print which parameters are as well known as before."""
    same = [row for row in known_rows(plan) if row.after >= FALLS * row.now]
    if same:
        print_pairs(console, "as well known as before", [("", _together(same))])


def _fall(plan: Plan | TargetPlan) -> str:
    """How many sigmas fall, and which most."""
    rows = list(known_rows(plan))
    fall = [row for row in rows if row.after < FALLS * row.now]
    if not fall:
        return f"None of {len(rows)} expected sigmas falls by more than {100 * (1 - FALLS):.0f} %."
    most = min(fall, key=lambda row: row.after / row.now)
    factor, unit = shown(most.unit)
    return (
        f"With them {len(fall)} of {len(rows)} sigmas fall; most of all that of {most.name}, from "
        f"{factor * most.now:.3g} to {factor * most.after:.3g} {unit}."
    )


def achieved(plan: Plan) -> list[str]:
    """What the stops are worth, in a sentence or two."""
    return list(_achieved(plan, plan.document()))


def achieved_by_targets(plan: TargetPlan) -> list[str]:
    """How many targets are for what, and what they are worth, in two sentences."""
    count, told = len(plan.targets), AIMS.get(plan.purpose.text, f"for {plan.purpose.text}")
    return [f"{count} target{'s' * (count != 1)} {told}.", _fall(plan)]


def _achieved(plan: Plan, document: Mapping[str, Any]) -> Iterator[str]:
    """What the stops are worth, in a sentence or two."""
    never = {(each["effect"], each["from"]) for each in document["never_told_apart"]}
    for name, each in document["smallest_detectable"].items():
        now, after = (each["beside_rivals"][when] for when in ("now", "after"))
        factor, unit = shown(each["unit"])
        rivals = [rival for rival in each["beside"] if (name, rival) not in never]
        told = f", told from {_and(rivals)}" if rivals else ""
        if after is not None and (told or not each["beside"]):
            before = "never" if now is None else f"from {factor * now:.3g} {unit}"
            yield f"With them {name} is found from {factor * after:.3g} {unit}{told}; now {before}."
        elif each["beside_rivals"]["with_any_number"] is None and not each["beside"]:
            yield f"NEVER FOUND: no number of stops of this arm tells {name} from the model."
    yield from _never(document)
    if plan.purpose.components and not plan.purpose.tolerance:
        yield from _asked(plan)
    if document["predicted_mm"]["after"] is not None:
        now, after = (document["predicted_mm"][when] for when in ("now", "after"))
        yield (
            "The place of what the arm carries is then known, wherever it can go, to "
            f"{after:.3g} mm rms; now to {now:.3g}."
        )
    yield _fall(plan)


def _asked(plan: Plan) -> Iterator[str]:
    """What becomes of the parameters that the stops are for."""
    at = [plan.keys.index(key) for key in plan.purpose.components]
    helped, never = [], []
    for i in at:
        now, after, endless = (k.sigma[i] for k in (plan.now, plan.after, plan.endless))
        factor, unit = shown(plan.units[i])
        if endless > SETTLED * now:
            never.append(f"{plan.names[i]} stays at {factor * now:.3g} {unit}")
        else:
            helped.append(f"{plan.names[i]} from {factor * now:.3g} to {factor * after:.3g} {unit}")
    if helped:
        yield f"With them sigmas fall: {listed(helped, ASKED_SHOWN, '; ')}."
    if never:
        yield (
            f"NO STOPS of this arm help: the sigma of {listed(never, ASKED_SHOWN, '; ')}, "
            "however many they are. Measure it itself."
        )


def _never(document: Mapping[str, Any]) -> Iterator[str]:
    """Which rivals no stops tell apart."""
    for each in document["never_told_apart"]:
        name, rival, size = (each[key] for key in ("effect", "from", "smallest"))
        factor, unit = shown(document["smallest_detectable"][name]["unit"])
        least = "at no size" if size is None else f"only from {factor * size:.3g} {unit} on"
        yield (
            f"NOT TOLD APART by any stops: at all {document['candidates']} poses {rival} moves all "
            f"that is seen almost as {name} does, which could be told apart {least}."
        )


def _and(names: Iterable[str]) -> str:
    *first, last = names
    return f"{', '.join(first)} and {last}" if first else last


def _unlike(plan: Plan) -> Iterator[str]:
    """What changed alike so far, and is at the stops as it never was before."""
    now, after = (
        [w["parameters"] for w in known.weak if not w["alike"]] for known in (plan.now, plan.after)
    )
    for names in (each for each in now if each not in after and plan.measured.joints.size):
        alike = "change alike" if len(names) > 1 else "changes little"
        yield f"So far {_and(names)} {alike} in all that is seen; at these stops not."
    if plan.unlike:
        yield f"New at these stops: {'; '.join(map(str, plan.unlike))}."


def _reached(plan: Plan) -> Iterator[str]:
    """Whether tolerances are kept, and with how many stops what is far off."""
    if not plan.curve:
        return
    *steps, endless = plan.curve
    if plan.reached is False:
        still = endless.worst > 1.0
        why = f"no stop of this arm tells {endless.parameter} so well, so measure it directly"
        yield f"NOT REACHED: {why if still else 'with more stops it would be'}."
    for step in steps:
        yield (
            f"with {step.stops:3d} stops {step.parameter} is the worst, at {step.worst:.2f} times "
            "what is wanted"
        )


def aim(document: Mapping[str, Any]) -> str:
    """What a plan's stops are for, in words, from its document."""
    what = document["for"]
    if document["learning_curve"]:
        told = f"until {document['for']}"
    elif document["rivals"]:
        first, *others = document["rivals"]
        told = f"to tell {first} from {', '.join(others) or 'the model'}"
    else:
        told = AIMS.get(what, f"for {document['why'] or what}")
    return f"{told}: {document['why']}" if document["rivals"] and document["why"] else told


def _stops_table(plan: Plan) -> Table:
    table = columns_table("stop", "location", *(name for name, _ in plan.joints))
    scales = [_scale(kind) for _, kind in plan.joints]
    for k, row in enumerate(plan.stops, start=1):
        values = [row[name] for name, _ in plan.joints]
        cells = (f"{s * value:.1f}" for s, value in zip(scales, values, strict=True))
        table.add_row(str(k), row["location"], *cells)
    return table


def _scale(kind: str) -> float:
    """From rad to degrees, or from m to mm."""
    return float(np.degrees(1.0)) if kind == "revolute" else 1e3


def _sigma_table(plan: Plan | TargetPlan) -> Table:
    table = columns_table("expected sigma", "", "now", "after")
    for row in known_rows(plan):
        if row.after < FALLS * row.now:
            factor, unit = shown(row.unit)
            table.add_row(row.name, unit, f"{factor * row.now:.3g}", f"{factor * row.after:.3g}")
    return table


class _Row(NamedTuple):
    """What is known of some parameters of an unknown: of one, or the root mean square of many."""

    keys: Sequence[Key]
    unit: str
    now: float
    after: float

    @property
    def name(self) -> str:
        first, count = self.keys[0], len(self.keys)
        return first.name if count == 1 else f"{first.unknown}, rms of {count}"


def known_rows(plan: Plan | TargetPlan) -> Iterator[_Row]:
    """A row a parameter; of an effect with many in one unit, one for all."""
    by_unknown: dict[str, list[int]] = {}
    for i, key in enumerate(plan.keys):
        by_unknown.setdefault(key.unknown, []).append(i)
    for at in by_unknown.values():
        alike = len(at) >= MANY_PARAMETERS and len({plan.units[i] for i in at}) == 1
        for some in [at] if alike else [[i] for i in at]:
            sizes = (float(np.sqrt(np.mean(k.sigma[some] ** 2))) for k in (plan.now, plan.after))
            yield _Row([plan.keys[i] for i in some], plan.units[some[0]], *sizes)


def _together(rows: Sequence[_Row]) -> str:
    """What rows are of, parameters of one unknown together."""
    by_unknown: dict[str, list[str]] = {}
    for row in rows:
        alone = len(row.keys) == 1
        some = by_unknown.setdefault(row.keys[0].unknown if alone else row.name, [])
        some += [row.keys[0].dof] if alone else []
    return "; ".join(" ".join(filter(None, (n, ", ".join(d)))) for n, d in by_unknown.items())


def _detectable_table(smallest: Mapping[str, Mapping[str, Any]]) -> Table:
    table = columns_table("smallest that is found", "", "now", "after")
    for name, each in smallest.items():
        factor, unit = shown(each["unit"])
        rows = {name: each["beside_model"]}
        rows |= {f"{name}, told from {rival}": sizes for rival, sizes in each["beside"].items()}
        for what, sizes in rows.items():
            cells = (_found(sizes[when], factor) for when in ("now", "after"))
            table.add_row(what, unit, *cells)
    return table


def _effects_table(document: Mapping[str, Any]) -> Table:
    """The effects that the model lacks, those first that stops bring nearest to being found."""
    every, table = document["smallest_effect"], columns_table("smallest effect", "", "now", "after")
    gain = sorted(every, key=lambda name: _ratio(every[name]["now"], every[name]["after"]))
    for name in gain[:EFFECTS_SHOWN]:
        factor, unit = shown(every[name]["unit"])
        cells = (_found(every[name][when], factor) for when in ("now", "after"))
        table.add_row(name, unit, *cells)
    if more := len(gain[EFFECTS_SHOWN:]):
        table.add_row(f"and {more} more, in --json")
    return table


def _ratio(now: float | None, after: float | None) -> float:
    """How much smaller what is found gets: the smaller, the better; 0 of what was never found."""
    if after is None:
        return np.inf
    return 0.0 if now is None else after / now


def _found(size: float | None, factor: float) -> str:
    return "never" if size is None else f"{factor * size:.3g}"


def _mishaps_table(document: Mapping[str, Any]) -> Table:
    """From which size a mishap is found, wherever it happens."""
    table = columns_table("smallest blunder, at worst", "", "now", "after")
    for kind, units in document["smallest_blunder"].items():
        for name, each in units.items():
            factor, unit = shown(name)
            sizes = (each[when] and each[when]["worst"] for when in ("now", "after"))
            table.add_row(kind, unit, *(_found(size, factor) for size in sizes))
    return table


def _unseen(document: Mapping[str, Any]) -> Iterator[str]:
    """What a mishap that is not found could do."""
    told = {"now": "A mishap too small to be found", "after": "With these stops one"}
    for when, what in told.items():
        if each := document[when]:
            yield (
                f"{what} ({each['by']}) could move {each['estimate']} by up to "
                f"{each['sigmas']:.1f} of its sigmas."
            )
