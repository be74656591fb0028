"""The one exception that speaks to users, and how it names what they probably meant."""

import difflib
from collections.abc import Collection


class InputError(ValueError):
    """Something a user gave is wrong.

    The message is one sentence that names the file, row or key, what was found, and what would be
    right. The command line prints it alone and exits with 2; every other exception is a fault of
    the program.
    """


def nearest(name: str, known: Collection[str]) -> str:
    """Return the rest of a sentence about an unknown name: the one probably meant, or all."""
    close = difflib.get_close_matches(name, list(known), n=1)
    return f"; did you mean {close[0]}?" if close else f"; known are {', '.join(known)}"
