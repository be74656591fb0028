"""Numbers of a text, as many as it holds, at the speed of a C loop."""

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
