"""The one exception that speaks to users."""


class InputError(ValueError):
    """Something a user gave is wrong.

    The message is one sentence that names the file, row or key, what was found, and what would be
    right. The command line prints it alone and exits with 2; every other exception is a fault of
    the program.
    """
