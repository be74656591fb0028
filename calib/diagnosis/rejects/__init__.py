"""What a fit threw away, looked at: how much, where, and whether it agrees with itself.

A beam that meets a surface and whose robust weight is 0 is rejected. Mixed pixels and clutter are:
they stand in a few places of the room, and scatter over all values. An error of the LiDAR that is
larger than Tukey's 4.685 sigma is rejected as well, and no other test sees it, as the redescending
weight is 0 there, where Huber's clipped residual would be a full one. So rejected beams are counted
in bins of every covariate, those that read long and short together and each alone: the difference
of these is the sum of their clipped residuals.

A bin's share is held against the share elsewhere. Stops, and the regions of a mesh, or planes, that
the beams meet, are the clusters, not beams: the variance of the difference is the cluster
jackknife's (Bell and McCaffrey 2002), that by stops and that by regions added, and Student's t with
the effective number of the fewer clusters (Carter, Schnepel and Steigerwald 2017) judges it. Sidak
pays for all looks. Surfaces and stops are looked at as covariates too, with the other as clusters,
and regions of surfaces with stops as clusters. Where a covariate stands out, its interval is the
one of the largest binomial likelihood (the scan statistic of Kulldorff 1997); its beams are set
aside, and the rest is looked at again.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import special

from calib.blunders.chance import LEAST_P, LEVELS, after_looks
from calib.diagnosis.rejects.counts import CellAxis, Counts, count, meshed
from calib.diagnosis.rejects.found import CLUTTER, Place, Rejects
from calib.diagnosis.rejects.moved import WHOLE_SHARE, moved
from calib.diagnosis.rejects.rejected import Rejected
from calib.diagnosis.stand import Stand
from calib.residuals.groups import ALONG_BEAMS, MESH_PARTS, REGION_PART, SURFACE
from calib.solve.fit import Progress

ALPHA_REJECTED = LEVELS["structure of what was rejected"]
MOST_PLACES = 4  # places that are told apart
# Share of a place's rejected beams that parts of the mesh which moved hold, beyond which these are
# told in its stead: a choice, most of them.
MOSTLY_ELSEWHERE = 0.5
FEWEST_STOPS = 4  # stops, below which nothing is claimed
# Signs of the residuals that are counted.
SIGNS_COUNTED = {
    "all": (-1, 1),
    "long": (1,),
    "short": (-1,),
}


def rejects(stand: Stand, progress: Progress = lambda what, done, total: None) -> Rejects | None:
    """Look at what a fit threw away.

    Args:
        stand: a fitted model.
        progress: called with what is being done, how many stops are done, and of how many.

    Returns:
        What was found; None where there are no scans.
    """
    if not stand.estimate.scans:
        return None
    counts = count(stand, progress)
    enough = len(counts.stop_names) >= FEWEST_STOPS
    every, least = _places(counts) if enough else ([], 1.0)
    known = [inside for inside, place in every if place.structured and not place.of_mesh]
    parts = moved(counts, ~_any(counts, known)) if enough else []
    elsewhere = _any(counts, [some for _, some in parts])
    every = [(mine, place) for mine, place in every if elsewhere[mine].mean() <= MOSTLY_ELSEWHERE]
    said = [mine for mine, place in every if place.structured or place.harmless]
    places = [place for _, place in every]
    total = int(counts.met.sum())
    rest = counts.rejected[~_any(counts, [mine for mine, _ in every]) & ~elsewhere]
    crowded = _crowded(counts, rest)
    hit = float(crowded[rest.stop, rest.surface].sum()) / total
    apart = [place for place in places if place.structured]
    outside = 1.0 - sum(place.beams for place in apart)
    usual = float((~elsewhere).sum()) / total - sum(place.rejected for place in apart)
    others = counts.rejected[~_any(counts, said) & ~elsewhere]
    less = others[~crowded[others.stop, others.surface]]
    beyond = len(others) / total - hit > CLUTTER
    hit_at = crowded.any(axis=1)
    share = len(counts.rejected) / total
    # Of scans with few beams there may be too few on each surface to say so of it. Near planes
    # found in the scans other surfaces may be, before them and behind.
    other = less.in_the_way if counts.place_names else less.beside_each_other
    if beyond and other(share):
        hit, beyond = hit + len(less) / total, False
        hit_at[less.stop] = True
    return Rejects(
        share=share,
        expected=min(usual / max(outside, 1.0 / total), CLUTTER + hit),
        p_adjusted=least,
        places=places,
        meshed=meshed(stand),
        clutter=hit,
        clutter_stops=tuple(counts.stop_names[i] for i in np.flatnonzero(hit_at)),
        beyond=beyond,
        beyond_m=float(np.median(others.residual_m)) if beyond and others.coherent else None,
        moved=[part for part, _ in parts],
    )


def _places(counts: Counts) -> tuple[list[tuple[np.ndarray, Place]], float]:
    """Places, most of the rejected first, each with which of these (R,) it holds; and the smallest
    p-value."""
    found: list[tuple[np.ndarray, Place]] = []
    left, least = np.ones(len(counts.rejected), bool), 1.0
    while len(found) < MOST_PLACES:
        next_one, p = _most(counts, left)
        least = min(least, p)
        if next_one is None:
            break
        found.append(next_one)
        left &= ~next_one[0]
    return found, least


def _any(counts: Counts, some: Sequence[np.ndarray]) -> np.ndarray:
    """Which of the rejected (R,) any of some sets (R,) holds."""
    return np.any([np.zeros(len(counts.rejected), bool), *some], axis=0)


@dataclass(frozen=True)
class _View:
    """One covariate's beams, by bins of it.

    Args:
        axis: its cells and bins.
        rows: (C,) beams by cells.
        bin: (R,) of the rejected; B where it is not known. cell: (R,) likewise.
        ways: the clusters: per way their number (R,) of the rejected, and beams (G, B) by bins and
            (G,) in all of each.
    """

    axis: CellAxis
    rows: np.ndarray
    bin: np.ndarray
    cell: np.ndarray
    ways: tuple[tuple[np.ndarray, np.ndarray, np.ndarray], ...]


def _views(counts: Counts) -> Iterator[_View]:
    rejected, met = counts.rejected, counts.met
    of_stop, of_place = met.sum(axis=1), counts.met_places.sum(axis=0)
    for a, axis in enumerate(counts.axes):
        cell = rejected.cells[:, a]
        yield _View(
            axis=axis,
            rows=counts.cells[a],
            bin=axis.bin_of[cell],
            cell=cell,
            ways=(
                (rejected.stop, counts.stops[a], of_stop),
                (rejected.place, counts.places[a], of_place),
            ),
        )
    stops = CellAxis.of_things("stop", counts.stop_names)
    surfaces = CellAxis.of_things(SURFACE, counts.surface_names)
    things = [
        (stops, rejected.stop, rejected.surface, met.T),
        (surfaces, rejected.surface, rejected.stop, met),
    ]
    if counts.place_names:
        regions = CellAxis.of_things(REGION_PART, counts.place_names)
        things.append((regions, rejected.place, rejected.stop, counts.met_places))
    for axis, mine, other, beams in things:
        rows, ways = beams.sum(axis=0), ((other, beams, beams.sum(axis=1)),)
        yield _View(axis=axis, rows=rows, bin=mine, cell=mine, ways=ways)


def _most(counts: Counts, left: np.ndarray) -> tuple[tuple[np.ndarray, Place] | None, float]:
    """The place that explains most of the rejected that are left, with which of these it holds;
    and the smallest p-value, after all looks."""
    views = list(_views(counts))
    looks = len(SIGNS_COUNTED) * sum(view.axis.count for view in views)
    sign = np.sign(counts.rejected.residual_m)
    best, most, least = None, 0.0, 1.0
    for view in views:
        for signs in SIGNS_COUNTED.values():
            mine = left & np.isin(sign, signs) & (view.bin < view.axis.count)
            p = after_looks(_p_values(view, mine), looks)
            least = min(least, float(p.min()))
            if p.min() >= ALPHA_REJECTED:
                continue
            cells, gain = _extent(view, mine, p < ALPHA_REJECTED)
            if gain > most:
                most, best = gain, (view, cells, float(p.min()))
    if best is None:
        return None, least
    view, cells, p = best
    inside = left & np.append(cells, False)[view.cell]
    return (inside, _place(view, counts, cells, inside, p)), least


def _p_values(view: _View, mine: np.ndarray) -> np.ndarray:
    """p-value (B,) of each bin: that its share of beams that are `mine` (R,) is the others'."""
    bins, of = view.axis.count, view.bin[mine]
    _, beams, whole = view.ways[0]
    rows, total = beams.sum(axis=0), whole.sum()
    inside = np.bincount(of, minlength=bins)
    share = inside / np.maximum(rows, 1)
    others = (len(of) - inside) / np.maximum(total - rows, 1)
    # Were beams independent; of one more, as a bin with none has a variance too.
    mean = (len(of) + 1.0) / (total + 2.0)
    variance, dof = np.zeros(bins), np.full(bins, np.inf)
    for cluster, n, every in view.ways:
        k = np.bincount(cluster[mine] * bins + of, minlength=n.size).reshape(n.shape)
        rest = every[:, None] - n, k.sum(axis=1)[:, None] - k
        (here, some), (there, many) = _apart(n, k), _apart(*rest)
        with np.errstate(invalid="ignore"):  # of one cluster, and of all beams, nothing is known
            variance += np.square(here - there).sum(axis=0)
        dof = np.minimum(dof, np.minimum(some, many) - 1.0)
    least = mean * (1.0 - mean) / np.maximum(rows, 1)
    t = (share - others) / np.sqrt(np.maximum(variance, least))
    known = (rows > 0) & (dof > 0) & np.isfinite(variance)
    return np.where(known, special.stdtr(np.where(known, dof, 1.0), -t), 1.0)


def _apart(n: np.ndarray, k: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What each cluster (G, B) adds to a share's error were the others to predict it, and how many
    clusters there are in effect (B,)."""
    rows = np.maximum(n.sum(axis=0), 1)
    part = n / rows
    with np.errstate(divide="ignore", invalid="ignore"):
        beyond = (k / rows - k.sum(axis=0) / rows * part) / (1.0 - part)
    return np.where(part < 1.0, beyond, np.inf), 1.0 / np.maximum(np.square(part).sum(axis=0), 1e-9)


def _extent(view: _View, mine: np.ndarray, out: np.ndarray) -> tuple[np.ndarray, float]:
    """Cells (C,) of a place, and how much likelier (log) what is `mine` (R,) is with a share of its
    own there: the interval where that is most; or of things, those bins (B,) that stand `out`."""
    axis, n = view.axis, view.rows
    k = np.bincount(view.cell[mine], minlength=len(n))[: len(n)]
    if not axis.ordered:
        return out, float(_gain(n[out].sum(), k[out].sum(), n.sum(), k.sum()))
    size = len(n)
    turns = 2 if axis.wraps else 1
    n_to, k_to = (np.append(0, np.cumsum(np.tile(x, turns))) for x in (n, k))
    start, stop = np.arange(size)[:, None], np.arange(len(n_to))[None]
    allowed = (stop > start) & (stop - start < size)
    gain = _gain(n_to[stop] - n_to[start], k_to[stop] - k_to[start], n.sum(), k.sum())
    first, last = np.unravel_index(np.argmax(np.where(allowed, gain, -1.0)), gain.shape)
    cells = np.zeros(size, bool)
    inside = np.arange(first, last) % size
    seen = np.flatnonzero(n[inside])
    cells[inside[seen[0] : seen[-1] + 1]] = True
    return cells, float(gain[first, last])


def _gain(n: np.ndarray, k: np.ndarray, rows: int, total: int) -> np.ndarray:
    """By how much the log likelihood of `total` in `rows` beams rises when those n with k have a
    larger share of their own; 0 where theirs is smaller."""
    other_n, other_k = rows - n, total - k
    inside, outside = k / np.maximum(n, 1), other_k / np.maximum(other_n, 1)
    out = _log_likelihood(n, k, inside) + _log_likelihood(other_n, other_k, outside)
    out = out - _log_likelihood(rows, total, total / max(rows, 1))
    return np.where(inside > outside, out, 0.0)


def _log_likelihood(n: np.ndarray, k: np.ndarray, share: np.ndarray) -> np.ndarray:
    return special.xlogy(k, share) + special.xlog1py(n - k, -share)


def _place(view: _View, counts: Counts, cells: np.ndarray, inside: np.ndarray, p: float) -> Place:
    """What the rejected beams (R,) inside some cells (C,) of a covariate do."""
    rejected, total, beams = counts.rejected[inside], view.rows.sum(), view.rows[cells].sum()
    lower, upper = view.axis.interval(cells)
    parts = view.axis.name in MESH_PARTS and counts.place_names
    along = rejected.steadier if view.axis.name in MESH_PARTS else ALONG_BEAMS
    steady, share = rejected.along(along), len(rejected) / max(beams, 1)
    return Place(
        covariate=view.axis.name,
        lower=lower,
        upper=upper,
        names=view.axis.names_of(cells),
        p_adjusted=p,
        share=share,
        rejected=len(rejected) / total,
        beams=beams / total,
        residual_m=float(np.median(steady.residual_m)),
        sigma_m=steady.sigma_m,
        coherent=rejected.coherent or bool(parts and share > WHOLE_SHARE and steady.coherent),
        short=rejected.short,
        along=along,
        meshed=bool(counts.place_names),
    )


def _crowded(counts: Counts, rejected: Rejected) -> np.ndarray:
    """Where something stands before a surface at a stop (K, S): far more beams than mixed pixels
    explain end before it, at all distances."""
    short = rejected[rejected.residual_m < 0]
    k = np.zeros(counts.met.shape, int)
    np.add.at(k, (short.stop, short.surface), 1)
    chance = special.bdtrc(k - 1.0, counts.met, CLUTTER) * k.size
    out = (k > CLUTTER * counts.met) & (chance < LEAST_P)
    for stop, surface in np.argwhere(out):
        out[stop, surface] = not short[(short.stop == stop) & (short.surface == surface)].coherent
    return out
