"""What of a run does not fit, by its summary: groups of residuals, moves from CAD, rows that err
together."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from statistics import median_low
from typing import Any

# Times its sigmas, from which a group of residuals is told. In 7 recordings of an independent
# simulator in which nothing happened to any stop the largest of 860 groups was 2.1; where a body or
# a joint was spoilt at one stop, it was 3.0 to 6.4 there, and 2.3 or less elsewhere. Where chance
# puts one of so many groups further out, as of bodies with few rows, `misfit_by.limit` says from
# where on it does not.
STANDS_OUT = 3.0
# Of CAD's sigmas, from which a move is told: one in 16,000 where these are honest. In 20 of these
# recordings, with CAD as its sigmas say, the furthest of some 15 moves was 2.4.
FAR_FROM_CAD = 4.0
# Times what single rows would give, from which it is told how much wider intervals are (median): in
# 24 worlds of another simulator with nothing to find and 8 or 30 stops it was 1.00; in 12 where
# stops scatter by 1 mm, 1.35 at least.
TOGETHER = 1.2
TOLD = 6  # of what stands out, the worst; of the others, how many there are
DISPLAY_UNITS = {"m": (1e3, "mm"), "rad": (1e3, "mrad"), "1": (1.0, "(no unit)")}


def shown(unit: str) -> tuple[float, str]:
    """Factor and unit in which a unit is shown, m/K as m is."""
    length, per, rest = unit.partition("/")
    if per and length in DISPLAY_UNITS and length != "1":
        scale, name = DISPLAY_UNITS[length]
        return scale, f"{name}/{rest}"
    return DISPLAY_UNITS.get(unit, (1.0, unit))


def together_told(summary: Mapping[str, Any]) -> list[str]:
    """That rows err together more than the model has it, where intervals are much wider for it."""
    wider = summary.get("intervals_wider_by") or {"median": 1.0}
    if wider["median"] <= max(TOGETHER, summary.get("sigmas_widened_by", 1.0)):
        return []
    return [
        f"rows of one stop, or of one part of the room, have errors in common that the model does "
        f"not account for: sigmas are {times(wider['median'])} times what single rows would give "
        f"(median; {times(wider['most'])} for {wider['parameter']})"
    ]


def times(ratio: float) -> str:
    """A ratio, as precise as anyone needs it."""
    return f"{ratio:.1f}" if ratio < 100 else f"{ratio:.0f}"


def of_stop(found: Mapping[str, Any]) -> dict[str, float]:
    """Misfit of what a stop has, by name: its bodies, joints and beams; without what is unknown."""
    parts = {**found.get("bodies", {}), **{k: found.get(k) for k in ("joints", "beams")}}
    return {name: ratio for name, ratio in parts.items() if ratio is not None}


def groups(summary: Mapping[str, Any]) -> dict[str, float]:
    """Misfit of every group of residuals, the worst first: ``STOP, BODY``, or a target."""
    found = summary.get("misfit_by", {"stop": {}, "target": {}})
    out = {
        f"{stop}, {name}": ratio
        for stop, parts in found["stop"].items()
        for name, ratio in of_stop(parts).items()
    }
    out |= {f"target {n}": ratio for n, ratio in found["target"].items() if ratio is not None}
    return dict(sorted(out.items(), key=lambda pair: -pair[1]))


def things(summary: Mapping[str, Any]) -> dict[str, float]:
    """Misfit of every tracked body and target over all stops, the worst first."""
    found = summary.get("misfit_by", {"body": {}, "target": {}})
    out = {**found["body"], **{f"target {name}": x for name, x in found["target"].items()}}
    known = {name: ratio for name, ratio in out.items() if ratio is not None}
    return dict(sorted(known.items(), key=lambda pair: -pair[1]))


def outstanding(summary: Mapping[str, Any]) -> dict[str, float]:
    """Those groups that stand out from their like, the worst first.

    Where most of a body's residuals are too large, its sigma is too small or an effect is missing,
    and nothing happened to one stop: a group is held against the median of its like, and 1.
    """
    found = groups(summary)
    like = {key: key.rpartition(", ")[2] if ", " in key else "target" for key in found}
    kinds = set(like.values())
    ratios = {name: [x for key, x in found.items() if like[key] == name] for name in kinds}
    usual = {name: max(1.0, median_low([1.0, *each])) for name, each in ratios.items()}
    limit = summary.get("misfit_by", {}).get("limit", {})
    least = {name: max(STANDS_OUT, limit.get(name, 0.0)) for name in ratios}
    return {k: x for k, x in found.items() if x > least[like[k]] * usual[like[k]]}


def moves(summary: Mapping[str, Any]) -> dict[str, Mapping[str, Any]]:
    """Moves of the parts of the geometry from what was known of them, the furthest first."""
    found = summary.get("misfit_by", {"prior": {}})["prior"]
    return dict(sorted(found.items(), key=lambda pair: -pair[1]["move_sigmas"]))


def move_told(name: str, move: Mapping[str, Any]) -> str:
    """A move in words."""
    scale, unit = shown(move["unit"])
    name = name if name.endswith(f".{move['worst']}") else f"{name}.{move['worst']}"
    return (
        f"{name}: {scale * move['change']:+.4g} {unit} from CAD, {times(move['move_sigmas'])} of "
        f"its sigmas"
    )


def standing_out(summary: Mapping[str, Any]) -> list[str]:
    """What stands out, a line each, the worst first."""
    return [*_told(_groups_told(summary)), *_told(_moves_told(summary))]


def _groups_told(summary: Mapping[str, Any]) -> Iterator[str]:
    for name, ratio in outstanding(summary).items():
        yield f"{name}: residuals {times(ratio)} times larger than their sigmas allow"


def _moves_told(summary: Mapping[str, Any]) -> Iterator[str]:
    known: set[str] = set()
    if "moved_since_cad" not in summary:  # of an earlier version, whose moves are in CAD's sigmas
        freed = freedoms(summary)
        for link in (link for link in summary.get("links", ()) if link["name"] in freed):
            known |= {link["name"], *(f"{link['name']}.{p}" for p in link["parameters"])}
    for name, move in moves(summary).items():
        if move["move_sigmas"] > FAR_FROM_CAD and name not in known:
            yield move_told(name, move)


def freedoms(summary: Mapping[str, Any]) -> dict[str, float]:
    """The links that a fit from an earlier run let go, each with by how many of CAD's sigmas: they
    moved since, or may have in place of one that did. Earlier versions let go by one sigma what had
    moved."""
    links = summary.get("links", ())
    found = {link["name"]: link.get("freed", float(link["moved"])) for link in links}
    return {name: times for name, times in found.items() if times}


def _told(lines: Iterator[str]) -> list[str]:
    every = list(lines)
    more = len(every) - TOLD
    return every[:TOLD] + ([f"and {more} more; summary.json has all"] if more > 0 else [])
