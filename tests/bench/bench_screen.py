"""What it costs to test all candidates: against BLAS on the same columns, and against the fit.

    python tests/bench/bench_screen.py [--rows 200000]

The default model on eight stops of an OS0-128 in the simulated lab, and every candidate that a
diagnosis tests, structure included. Both sides run in one process on one thread; times are CPU
seconds.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from unittest import mock

import numpy as np
from scipy.linalg.blas import dsyrk
from workload import held, one_thread, recorded, timed

from calib import problem as problems
from calib.diagnosis.stand import Stand
from calib.linear.rows import StopRows, StopSums
from calib.problem.model import Model
from calib.solve.fit import solve


def fitted(folder: Path) -> Stand:
    """The default model, fitted to a recording."""
    source = held(folder)
    problem = problems.build([source], Model())
    return Stand([source], Model(), problem, solve(problem))


def captured(stand: Stand) -> list[StopRows]:
    """The rows of every stop with all candidates, as a diagnosis adds them up."""
    found, sums = [], StopRows.sums

    def keep(rows: StopRows) -> StopSums:
        found.append(rows)
        return sums(rows)

    with mock.patch.object(StopRows, "sums", keep):
        stand.look(silent)
    return found


def silent(what: str, done: int, total: int) -> None:
    """No progress."""


def stacked(rows: StopRows) -> np.ndarray:
    """The same columns (N, P) written out, whitened, as BLAS wants them."""
    count, wide = rows.dense.shape
    whole = np.zeros((count, wide + rows.sparse), order="F")
    whole[:, :wide] = rows.dense
    for index, value in zip(rows.index.T, rows.value.T, strict=True):
        known = np.flatnonzero(index >= 0)
        whole[known, wide + index[known]] = value[known]
    whole *= np.sqrt(rows.weight)[:, None]
    return whole


def against_blas(stand: Stand) -> None:
    """The screen's sums over all rows against BLAS's Gram matrix of the same columns."""
    ours = blas = 0.0
    count = 0
    for rows in captured(stand):
        count += len(rows.b)
        ours += timed(rows.sums)[1]
        whole = stacked(rows)
        blas += timed(lambda w=whole: dsyrk(1.0, w, trans=1))[1]
    print(f"{count} rows, {whole.shape[1]} columns at the last stop")
    report("sums of all candidates / BLAS syrk", ours, blas, "<= 1.4")


def against_fit(folder: Path) -> None:
    """A whole look, its draws included, against the fit that it looks from."""
    stand, fit_s = timed(lambda: fitted(folder))
    look_s = timed(lambda: stand.look(silent))[1]
    report("look, draws included / fit", look_s, fit_s, "<= 1")


def report(what: str, a_s: float, b_s: float, goal: str) -> None:
    """A line of the table."""
    print(f"{what:40s} {a_s:8.2f} s {b_s:8.2f} s   ratio {a_s / b_s:6.2f}   goal {goal}")


def main() -> None:
    """Run both."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rows", type=int, default=200_000)
    parser.add_argument("--stops", type=int, default=8)
    args = parser.parse_args()
    with one_thread(), tempfile.TemporaryDirectory() as folder:
        recording = recorded(Path(folder), args.rows, args.stops)
        against_blas(fitted(recording))
        against_fit(recording)


if __name__ == "__main__":
    main()
