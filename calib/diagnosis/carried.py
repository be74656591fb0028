"""What points and stops carry: the columns that effects may look at, in every recording."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from calib.diagnosis.structure import covariates
from calib.problem.model import Source, labels
from calib.residuals.scan import ScanStop
from calib.rig.suspect import listed
from calib.solve.estimate import Estimate
from sensors.holds import spread_known

SCANS_SAMPLED = 8  # scans from which the bins of covariates are taken
# Beams of each of them at most: a quantile of so many beams in all is off by 0.15 % of them.
BEAMS_DRAWN = 16_384
SPREAD_OF_HOLDS, LABELS = "range_std_m", "label"
# What a recording may lack: it has then no rows that look at it, or effects do without it.
NOT_DEMANDED = frozenset({"tracked", "mesh_box_m", "up", SPREAD_OF_HOLDS})


@dataclass(frozen=True)
class Carried:
    """The columns of a fit's recordings.

    Args:
        of_each: recording, by its label -> the columns of its stops and points; of one that was not
            scanned, those of other recordings' points as well.
        recorded: those that stand in a file.
        sample: covariate that all have -> its values at some of the points.
    """

    of_each: Mapping[str, frozenset[str]]
    recorded: frozenset[str]
    sample: Mapping[str, np.ndarray]

    @classmethod
    def of(cls, sources: Sequence[Source], estimate: Estimate) -> Carried:
        """Of the recordings that were fitted, as some of their scans show it."""
        scans, names = estimate.scans, labels(sources)
        number = {id(s.recording): i for i, s in enumerate(sources)}
        whose = np.array([number[id(scan.recording)] for scan in scans], int)
        chosen = np.linspace(0, len(scans) - 1, SCANS_SAMPLED).round().astype(int)
        first = np.unique(whose, return_index=True)[1]  # none is without a sample
        points: dict[int, set[str]] = {i: set() for i in np.unique(whose).tolist()}
        found: dict[str, list[np.ndarray]] = {}
        recorded = {"time_s"}.union(*(s.recording.covariates for s in sources))
        rng = np.random.default_rng(0)
        for i in np.union1d(chosen, first).tolist() if len(scans) else ():
            rows = scans[i].rows(estimate.values, estimate.associations[i])
            points[whose[i]] |= set(rows.view.columns)
            scan, _ = scans[i].store.read(scans[i].index)
            if spread_known(scan.range_std_m, scan.count).any():
                points[whose[i]].add(SPREAD_OF_HOLDS)
            recorded |= {*scan.extra}
            looked_at = {*covariates(), *_own_columns(scans[i])}
            some = np.flatnonzero(rows.usable)
            if len(some) > BEAMS_DRAWN:
                some = np.sort(rng.choice(some, BEAMS_DRAWN, replace=False))
            for name in (n for n in rows.view.columns if n in looked_at):
                whole = np.broadcast_to(rows.view[name], rows.view.rows)
                found.setdefault(name, []).append(whole[some])
        stops = [{*s.columns} for s in sources]
        of_points = set().union(*points.values()) - set().union(*stops)
        each = [mine | points.get(i, of_points) for i, mine in enumerate(stops)]
        of_each = dict(zip(names, map(frozenset, each), strict=True))
        carried = cls(of_each, frozenset(recorded), {})
        whole = {n: np.concatenate(v) for n, v in found.items() if n in carried.everywhere}
        return replace(carried, sample=whole)

    @cached_property
    def anywhere(self) -> frozenset[str]:
        """The columns that there are."""
        return frozenset().union(*self.of_each.values())

    @cached_property
    def partly(self) -> dict[str, list[str]]:
        """Column that some recordings carry and others do not -> these."""
        some = sorted(self.anywhere - NOT_DEMANDED - frozenset.intersection(*self.of_each.values()))
        return {c: [n for n, mine in self.of_each.items() if c not in mine] for c in some}

    def where_not(self, column: str) -> str:
        """Which recordings lack a column, of which others have it, for a sentence."""
        return f" in {listed(self.partly[column])}" if column in self.partly else ""

    def sentences(self) -> list[str]:
        """Which recordings lack what others have in files, or a mesh, and what comes of it."""
        by: dict[str, list[str]] = {}
        for column, names in self.partly.items():
            if column in self.recorded:
                by.setdefault(listed(names), []).append(column)
        out = [
            f"No effect that depends on {listed(columns)} was tested: {names} "
            f"{'have' if ', ' in names else 'has'} none."
            for names, columns in by.items()
        ]
        if names := self.partly.get(LABELS):
            have = "have" if len(names) > 1 else "has"
            out.append(f"No effect of labels was tested: {listed(names)} {have} no mesh.")
        return out

    @cached_property
    def everywhere(self) -> frozenset[str]:
        """The columns that an effect on all recordings may look at."""
        return self.anywhere - self.partly.keys()


def _own_columns(scan: ScanStop) -> tuple[str, ...]:
    """Columns that the maker of a scan's recording added, as the first of its scans has them."""
    first = int(np.flatnonzero(scan.recording.has_scan)[0])
    return (*scan.recording.covariates, *scan.store.read(first)[0].extra)
