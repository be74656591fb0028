"""No part of the mesh is said to be off by what few of its beams say, nor if it is most of it."""

import shutil
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from calib.blunders.unjudged import unjudged
from calib.problem.build import build
from calib.problem.model import Model, Source
from calib.residuals.groups import MESH, Group
from calib.simulation import Spec
from calib.solve.fit import solve
from sensors.recording import read_table, write_table

from .simulated import made

SPEC = Spec(lidar="hesai_pandarxt32", locations=3, stops_per_location=2, column_step=40)


@pytest.fixture(scope="module")
def fitted(tmp_path_factory):
    """A recording, and of its patches (stop, ring, column) of the beams that meet them."""
    folder = tmp_path_factory.mktemp("unjudged") / "rec"
    estimate = solve(build([made(folder, SPEC)[0]], Model()))
    beams: dict[int, list[tuple[str, int, int]]] = {}
    for scan, association in zip(estimate.scans, estimate.associations, strict=True):
        read, _ = scan.store.read(scan.index)
        for k, part in enumerate(scan.parts(association, "patch").tolist()):
            beams.setdefault(part, []).append((scan.name, int(read.ring[k]), int(read.column[k])))
    return folder, {part: some for part, some in beams.items() if part >= 0}, estimate


def a_scan(beams) -> float:
    return float(np.mean([*Counter(stop for stop, *_ in beams).values()]))


@pytest.mark.parametrize(
    ("narrow", "share", "is_sliver"),
    [(True, 0.0, False), (True, 0.3, False), (True, 0.8, True), (False, 0.8, False)],
)
def test_narrow_parts_of_which_most_beams_are_rejected(fitted, tmp_path, narrow, share, is_sliver):
    """They meet what stands 60 mm before it."""
    folder, patches, _ = fitted
    shutil.copytree(folder, tmp_path / "rec")
    size = (5, 14) if narrow else (25, 60)
    part, beams = next(
        (part, some)
        for part, some in patches.items()
        if size[0] < len(some) < size[1] and (a_scan(some) < 2.5) == narrow
    )
    passing = set(beams[: int(share * len(beams))])
    for path in sorted((tmp_path / "rec" / "scans").glob("*.parquet")):
        table = read_table(path)
        every = zip(table["ring"].tolist(), table["column"].tolist(), strict=True)
        near = np.array([(path.stem, *beam) in passing for beam in every])
        points = np.stack([table[axis] for axis in "xyz"], axis=1).astype(float)
        points[near] *= 1.0 - 0.06 / np.linalg.norm(points[near], axis=1, keepdims=True)
        write_table(path, table | dict(zip("xyz", points.astype(np.float32).T, strict=True)))
    estimate = solve(build([Source.open(tmp_path / "rec")], Model()))
    group = Group("surface", MESH, f"patch_{part}")
    assert unjudged(estimate, [group]) == ({group} if is_sliver else set())
    assert unjudged(estimate, []) == set()


@pytest.mark.parametrize(("share", "is_most"), [(0.45, False), (0.55, True)])
def test_what_most_beams_meet_is_what_all_else_is_held_against(fitted, share, is_most):
    *_, estimate = fitted
    pairs = list(zip(estimate.scans, estimate.associations, strict=True))
    surfaces = [scan.parts(association, "surface") for scan, association in pairs]
    usable = [scan.rows(estimate.values, association).usable for scan, association in pairs]
    most = int(np.bincount(np.concatenate(surfaces) + 1)[1:].argmax())
    on_it = sum(int(np.sum(u & (s == most))) for u, s in zip(usable, surfaces, strict=True))
    others = int(on_it * (1.0 - share) / share)
    fewer = []
    for association, surface, use in zip(estimate.associations, surfaces, usable, strict=True):
        other = np.flatnonzero(use & (surface != most))
        kept, others = other[:others], others - len(other[:others])
        part = np.where(surface == most, association.part, -1)
        part[kept] = association.part[kept]
        fewer.append(replace(association, part=part))
    group = Group("surface", MESH, f"surface_{most}")
    found = unjudged(replace(estimate, associations=fewer), [group])
    assert found == ({group} if is_most else set())


@pytest.mark.parametrize(("beams", "is_judged"), [(4, False), (12, True)])
def test_a_part_that_hardly_any_beam_meets_is_not_judged(fitted, beams, is_judged):
    """Two or three of its beams may end at somebody who stands just before it."""
    _, patches, estimate = fitted
    part = next(part for part, some in patches.items() if len(some) == beams)
    group = Group("surface", MESH, f"patch_{part}")
    assert unjudged(estimate, [group]) == (set() if is_judged else {group})
