"""What a file claims to hold, against how large it is.

A header of a few bytes can claim more rows than any machine has memory for, and a compressed block
can unpack to thousands of times its size. Readers ask here before they take memory.
"""

from pathlib import Path

from chains.errors import InputError

FREELY = 1 << 28
"""Bytes that any file may unpack to: 256 MB, more than a scan or a run's state has."""
TIMES_STORED = 100
"""How much larger than itself a larger file may be unpacked; of the files in shared/data the most
are 16 times (the labels of a mesh, which are alike in long rows)."""


def most(stored: int) -> int:
    """The most bytes that `stored` bytes of a file may unpack to."""
    return max(FREELY, TIMES_STORED * stored)


def check_claim(path: Path, claimed: int, what: str) -> None:
    """Refuse a file that claims to hold more than it can.

    Args:
        path: the file.
        claimed: bytes that reading it will take, as it says itself.
        what: what these are, for the message: "10000000000 rows".

    Raises:
        InputError: they are more than `most` of the file's size.
    """
    stored = path.stat().st_size
    if claimed > most(stored):
        raise InputError(
            f"{path} claims to hold {what}, which is {claimed / 1e6:.0f} MB out of a file of "
            f"{stored / 1e6:.3g} MB; it is damaged, or made to fill the memory"
        )


def check_stored(path: Path, claimed: int, what: str) -> None:
    """Refuse a file that is not compressed and claims to hold more bytes than it has.

    Raises:
        InputError: it has fewer; arguments as of `check_claim`.
    """
    stored = path.stat().st_size
    if claimed > stored:
        raise InputError(
            f"{path} should hold {what}, but they cannot be read: they take {claimed} bytes, and "
            f"it has {stored}; get the whole file"
        )
