"""The exceptions that speak to users, and how it names what they probably meant."""

import difflib
from collections.abc import Collection


class InputError(ValueError):
    """Something a user gave is wrong.

    The message is one sentence that names the file, row or key, what was found, and what would be
    right. The command line prints it alone and exits with 2; every other exception is a fault of
    the program.
    """


class CutShortError(InputError):
    """What was asked was right, and something else ended it: the same command may go on later."""


class NothingMetError(InputError):
    """No beam of a scan meets a surface."""


class UntiedError(InputError):
    """Nothing in a recording says where the scanner's frame is in the tracker's."""


class NoColumnError(InputError):
    """A recording has not the column that an effect looks at."""

    def __init__(self, message: str, column: str) -> None:
        super().__init__(message, column)  # both, so that it can be sent from a worker
        self.column = column

    def __str__(self) -> str:
        return str(self.args[0])


LONGEST_NAME = 80  # bytes: tables are called RIG.STOP.parquet, and file systems take 255


def is_file_name(name: str) -> bool:
    """Whether a name of a file's own may stand in the name of one that is written.

    It leads nowhere else, is not hidden, is not among those that runs give their own tables (they
    begin with an underscore), holds nothing that cannot be seen, and is short.
    """
    plain = name.isprintable() and not name.startswith((".", "_")) and not set(name) & set("/\\")
    return bool(name.strip()) and plain and len(name.encode("utf-8", "replace")) <= LONGEST_NAME


def shortened(name: str) -> str:
    """A name as it stands in a sentence: in quotes, what cannot be seen spelled out, and short."""
    return repr(name if len(name) <= LONGEST_NAME else name[:LONGEST_NAME] + " ...")


def nearest(name: str, known: Collection[str]) -> str:
    """Return the rest of a sentence about an unknown name: the one probably meant, or all."""
    close = difflib.get_close_matches(name[:LONGEST_NAME], list(known), n=1)
    return f"; did you mean {close[0]}?" if close else f"; known are {', '.join(known)}"
