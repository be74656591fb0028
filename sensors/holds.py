"""A raw hold, the same sweep again and again while nothing moves, averaged per direction."""

from collections.abc import Callable, Iterator, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

Columns = dict[str, NDArray]
Read = Callable[[Sequence[str]], Iterator[Columns]]

OUTLYING_MADS = 4 * 1.4826
"""Four standard deviations, from the median absolute deviation of a normal distribution."""
SET_ASIDE = "set_aside"
"""The column that says how many returns of a direction are left out of its average."""
FLOOR_M = 0.012
"""Three range steps of the coarsest sensor: below this nothing is an outlier."""


def spread_known(
    range_std_m: NDArray, count: NDArray, among: NDArray[np.bool_] | bool = True
) -> NDArray[np.bool_]:
    """Which spreads (N,), `among` some or all, say how far the sweeps (N,) that were averaged into
    a point scatter. Where more than half of these are 0 none does: nothing was recorded, or ranges
    are rounded to more than they scatter."""
    known = np.isfinite(range_std_m) & (count > 1) & among
    return known & bool(known.any() and np.median(range_std_m[known]) > 0.0)


def average_hold(read: Read, names: Sequence[str]) -> Columns:
    """Average the returns of a raw hold per direction, which is one pair of ring and column.

    A return is set aside where its range is farther than max(4 * 1.4826 * MAD, 12 mm) from the
    direction's median over the sweeps. The mean point of those kept lies on the beam, at their mean
    range, wherever the beam starts. ``count`` says how many were kept, ``range_std_m`` their
    standard deviation (n - 1; NaN for one), ``set_aside`` how many were not; every other column is
    the mean of those kept. Directions without any return are left out, the others ordered by ring
    and column.

    ``read(names)`` streams the named columns in batches, in the same order each time; it is called
    three times, so that a hold of any length needs memory only for one float32 range per direction
    and sweep. ``names`` are the columns to average.
    """
    keys, sweeps = _directions(read)
    median_m, limit_m = _bounds(read, keys, sweeps)
    means = [name for name in names if name not in ("ring", "column", "scan")]
    sums: Columns = {name: np.zeros(len(keys)) for name in (*means, "n", "d", "dd", SET_ASIDE)}
    for batch in read([*means, "ring", "column"]):
        range_m, seen = _ranges(batch)
        i = np.searchsorted(keys, _key(batch))
        d = range_m - median_m[i]
        kept = seen & (np.abs(d) <= limit_m[i])
        _add(sums[SET_ASIDE], i[seen & ~kept], 1.0)
        i, d = i[kept], d[kept]
        for name, values in (("n", 1.0), ("d", d), ("dd", d * d)):
            _add(sums[name], i, values)
        for name in means:
            _add(sums[name], i, batch[name][kept])
    return _means(sums, keys, means)


def _key(batch: Columns) -> NDArray[np.int64]:
    return (batch["ring"].astype(np.int64) << 32) + batch["column"].astype(np.int64)


def _ranges(batch: Mapping[str, NDArray]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Give the range of each point [m], and whether it is a return at all."""
    xyz = np.stack([batch[axis] for axis in "xyz"], axis=-1).astype(np.float64)
    range_m = np.linalg.norm(xyz, axis=-1)
    return range_m, np.isfinite(range_m) & (range_m > 0)


def _directions(read: Read) -> tuple[NDArray[np.int64], NDArray]:
    keys: list[NDArray] = []
    sweeps: list[NDArray] = []
    for batch in read(["ring", "column", "scan"]):
        keys.append(_distinct(_key(batch)))
        sweeps.append(_distinct(batch["scan"]))
    if not keys:
        return np.empty(0, np.int64), np.empty(0)
    return _distinct(np.concatenate(keys)), _distinct(np.concatenate(sweeps))


def _distinct(values: NDArray) -> NDArray:
    """Sorted values without repeats, faster than np.unique, which hashes."""
    ordered = np.sort(values)
    return ordered[np.append(True, ordered[1:] != ordered[:-1])[: len(ordered)]]


def _bounds(read: Read, keys: NDArray, sweeps: NDArray) -> tuple[NDArray, NDArray]:
    """Give the median range of each direction, and how far from it a return may lie [m].

    Of two returns in one sweep and direction the median sees the later; both are averaged.
    """
    ranges = np.full((len(keys), len(sweeps)), np.nan, np.float32)
    for batch in read(["x", "y", "z", "ring", "column", "scan"]):
        range_m, seen = _ranges(batch)
        i, j = np.searchsorted(keys, _key(batch)), np.searchsorted(sweeps, batch["scan"])
        ranges[i[seen], j[seen]] = range_m[seen]
    median_m = _median(ranges)
    np.abs(ranges - median_m[:, None], out=ranges)
    return median_m.astype(np.float64), np.maximum(OUTLYING_MADS * _median(ranges), FLOOR_M)


def _median(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """Median of each row without its NaNs, sorting the rows in place."""
    values.sort(axis=1)
    n = np.count_nonzero(~np.isnan(values), axis=1)
    row = np.arange(len(values))
    return (values[row, (n - 1) // 2] + values[row, n // 2]) / 2


def _add(total: NDArray[np.float64], i: NDArray[np.int64], values: NDArray | float) -> None:
    weights = np.broadcast_to(np.asarray(values, np.float64), i.shape)
    total += np.bincount(i, weights, minlength=len(total))


def _means(sums: Columns, keys: NDArray, means: Sequence[str]) -> Columns:
    has = sums["n"] > 0
    n = sums["n"][has]
    spread = np.maximum(sums["dd"][has] - sums["d"][has] ** 2 / n, 0)
    columns = {name: sums[name][has] / n for name in means}
    columns["ring"], columns["column"] = keys[has] >> 32, keys[has] & 0xFFFFFFFF
    columns["count"] = n
    columns["range_std_m"] = np.sqrt(
        np.divide(spread, n - 1, where=n > 1, out=np.full_like(n, np.nan))
    )
    columns[SET_ASIDE] = sums[SET_ASIDE][has]
    return columns
