"""Numbers of a text, as many as it holds, and of the parts of a graph, at the speed of C."""

import warnings
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray


def parse_numbers(text: bytes) -> NDArray[np.float64]:
    """The numbers (N,) of a text, with white space between them, up to the first word that is none.

    Who knows how many there should be tells from the count whether all were.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("error", DeprecationWarning)  # numpy before 2.4 only warns
        try:
            return np.fromstring(text.decode("latin-1"), np.float64, sep=" ")
        except (ValueError, DeprecationWarning):
            return np.array(list(_until_none(text)), np.float64)


def _until_none(text: bytes) -> Iterator[float]:
    for word in text.split():
        try:
            yield float(word)
        except ValueError:
            return


def connected(count: int, a: NDArray[np.int64], b: NDArray[np.int64]) -> NDArray[np.int64]:
    """Which part of a graph each of its nodes (count,) is in, counted by their first nodes.

    Each node takes the lowest number among its neighbours' and its own, and then that which the
    node of this number has (Shiloach and Vishkin 1982), until none is lowered.

    Args:
        count: how many nodes there are.
        a, b: (n,) nodes that an edge joins.
    """
    lowest = np.arange(count)
    while True:
        new = lowest.copy()
        joined = np.minimum(lowest[a], lowest[b])
        for ends in (a, b):
            np.minimum.at(new, lowest[ends], joined)
        new = new[new]
        if np.array_equal(new, lowest):
            return np.unique(lowest, return_inverse=True)[1].astype(np.int64)
        lowest = new
