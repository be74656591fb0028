"""Tables of made-up beams, and the answers of dense least squares that they are held against."""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_array, vstack

from calib.diagnosis.formulas.table import BeamTable

SURFACES, RINGS = 12, 32
SIGMA = 0.002  # of a beam, m
TRACKED = (0.0005, 0.0005)  # sigma of a stop's pose, m and rad


def covariates(rng: np.random.Generator, stops: int, each: int) -> dict[str, np.ndarray]:
    """Columns (N,) of beams of a spinning LiDAR, and of its stops."""
    rows, stop = stops * each, np.repeat(np.arange(stops), each)
    ring = rng.integers(0, RINGS, rows).astype(float)
    return {
        "range_m": rng.uniform(1.0, 12.0, rows),
        "incidence_rad": rng.uniform(0.0, 1.3, rows),
        "azimuth_rad": rng.uniform(-np.pi, np.pi, rows),
        "elevation_rad": np.radians(ring - (RINGS - 1) / 2),
        "ring": ring,
        "intensity": rng.uniform(0.05, 1.0, rows),
        "temperature_c": rng.uniform(15.0, 35.0, stops)[stop],
        "humidity": rng.uniform(0.3, 0.6, stops)[stop],
    }


def derivative(
    columns: dict[str, np.ndarray], stop: np.ndarray, place: np.ndarray, rng: np.random.Generator
) -> csr_array:
    """(N, 6 K + U) of the residual by the twists of K stops, and by the unknowns: the poses of
    these, a range zero, rings and surfaces; see `BeamTable`."""
    rows, begin = len(stop), 6 * (int(stop.max()) + 1)
    azimuth, elevation = columns["azimuth_rad"], columns["elevation_rad"]
    flat = np.cos(elevation)
    along = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], axis=1)
    turned = np.cross(along, rng.standard_normal((rows, 3)))  # surfaces lie any way
    first, own = 2 * begin, 6 * stop[:, None] + np.arange(6)
    zeros = [np.full(rows, first), first + 1 + columns["ring"], first + 1 + RINGS + place]
    at = np.column_stack([own, *zeros]).astype(int)
    values = np.hstack([along, turned, -np.ones((rows, 3))])
    shape = (rows, first + 1 + RINGS + SURFACES)
    return csr_array((values.ravel(), (np.repeat(np.arange(rows), 9), at.ravel())), shape)


def table(
    seed: int = 0,
    stops: int = 30,
    each: int = 200,
    hidden: object = None,
    scatter_m: float = 0.0,
    outliers: float = 0.0,
    more: object = None,
    share: float = 1.0,
) -> BeamTable:
    """Beams of a model of stops' poses (tracked), a range zero, and offsets of rings and surfaces.

    Args:
        hidden: a function of the covariates: what ranges are off by (N,), m.
        scatter_m: sd of a range zero that each stop has of its own.
        outliers: share of the beams that are off by 50 mm.
        more: a function of the generator and the covariates: columns beside these.
        share: as of `BeamTable`.
    """
    rng = np.random.default_rng(seed)
    columns = covariates(rng, stops, each)
    columns |= more(rng, columns) if more else {}
    rows, stop = stops * each, np.repeat(np.arange(stops), each)
    place = rng.integers(0, SURFACES, rows)
    unknowns = 6 * stops + 1 + RINGS + SURFACES
    begin = 6 * stops
    twists = derivative(columns, stop, place, rng)
    poses = np.eye(begin, unknowns)  # the twist of each stop is that of its own pose
    priors = np.ones(unknowns)  # of rings and surfaces as good as nothing is known beforehand
    priors[:begin] = np.tile(np.repeat(1 / np.array(TRACKED), 3), stops)
    noise = rng.standard_normal(rows) * SIGMA
    noise += scatter_m * rng.standard_normal(stops)[stop]
    noise += 0.05 * (rng.random(rows) < outliers)
    true = 0.1 * rng.standard_normal(unknowns) / priors  # a fit has been here
    true[begin:] *= 0.01
    residual = noise - twists @ np.concatenate([poses @ true, true])
    return BeamTable(
        covariates=columns,
        by_stop=frozenset({"temperature_c", "humidity", "time_s"} & set(columns)),
        residual_m=residual + (hidden(columns) if hidden else 0.0),
        sigma_m=np.full(rows, SIGMA),
        stop=stop,
        place=place,
        share=share,
        twists=twists,
        chain=csr_array(vstack([csr_array(poses), csr_array(np.eye(unknowns))])),
        others=csr_array(np.diag(priors)),
        others_b=rng.standard_normal(unknowns) * np.where(priors > 1.0, 1.0, 0.01),
        others_stop=np.concatenate([np.repeat(np.arange(stops), 6), np.full(unknowns - begin, -1)]),
        others_place=np.full(unknowns, -1),
    )


def dense(
    table: BeamTable, weight: np.ndarray, columns: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """All rows of a table with columns (N, k) beside its model, whitened: (N + R, U + k) their
    derivative by the unknowns, and (N + R,) what each is off by where these are zero."""
    root = np.sqrt(weight)[:, None]
    model = (table.twists @ table.chain).toarray()
    others = table.others.toarray()
    rows = np.vstack(
        [
            np.hstack([root * model, -root * columns]),
            np.hstack([others, np.zeros((len(others), columns.shape[1]))]),
        ]
    )
    return rows, np.concatenate([root[:, 0] * table.residual_m, -table.others_b])


def solved(rows: np.ndarray, off: np.ndarray) -> tuple[np.ndarray, float]:
    """The unknowns that make the squares least, and what these then are."""
    size = np.linalg.norm(rows, axis=0)
    step = np.linalg.lstsq(rows / size, -off, rcond=1e-12)[0] / size
    return step, float(np.sum(np.square(off + rows @ step)))
