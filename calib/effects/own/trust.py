"""Whose Python runs: a file that a run or a spec names is run only if the user says so.

A run may come from somebody else, and a Python file can do whatever its reader can. So a document
that names one tells the sha256 of what it was, and the file is run only where the user trusts these
bytes. Formulas need no trust: they are arithmetic.
"""

from __future__ import annotations

import hashlib
import re
import shlex
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

from chains.errors import InputError

Trust = Mapping[str, Path | None]
"""sha256 of a Python file that may run -> where it is; None: where the document says."""

LARGEST_PYTHON = 10_000_000  # bytes of a Python file: far more than anybody writes
_HASH = re.compile(r"[0-9a-fA-F]{64}")


class NotTrustedError(InputError):
    """A document names a Python file that the user did not say may run."""


@dataclass(frozen=True)
class Code:
    """A Python file as it was read: what is hashed is what runs.

    Args:
        path: where it is.
        source: its bytes.
    """

    path: Path
    source: bytes

    @classmethod
    def read(cls, path: Path | str) -> Code:
        """Read a Python file; InputError where there is none."""
        path = Path(path)
        try:
            if path.is_file():
                with path.open("rb") as file:
                    source = file.read(LARGEST_PYTHON + 1)
                if len(source) > LARGEST_PYTHON:
                    raise InputError(
                        f"{path} has more than {LARGEST_PYTHON / 1e6:.0f} MB: no Python file"
                    )
                return cls(path.resolve(), source)
        except (OSError, ValueError) as error:
            raise InputError(f"{path} cannot be read: {error}") from None
        raise InputError(f"{path} does not exist")

    @property
    def sha256(self) -> str:
        return hashlib.sha256(self.source).hexdigest()


def trusted(items: Iterable[str | Path]) -> dict[str, Path | None]:
    """What ``--trust`` names: Python files, or sha256 hashes of them.

    Raises:
        InputError: an item is neither.
    """
    found: dict[str, Path | None] = {}
    for item in map(str, items):
        if _HASH.fullmatch(item):
            found.setdefault(item.lower())
            continue
        try:
            code = Code.read(item)
        except InputError as error:
            raise InputError(
                f"--trust {item}: {error}; give a Python file, or its sha256 of 64 digits"
            ) from None
        found[code.sha256] = code.path
    return found


def code_named(source: str, recorded: str | None, where: str | Path, trust: Trust) -> Code:
    """The Python file that a document names, where it may run.

    Args:
        source: its path, as the document has it.
        recorded: its sha256 then; None where the document does not say.
        where: the document, for messages.
        trust: what the user trusts.

    Raises:
        NotTrustedError: the user did not say that it may run.
        InputError: it may, and is gone or has changed.
    """
    names = f"{where} names effects of a Python file, {source}"
    if recorded is not None and recorded in trust:
        code = Code.read(trust[recorded] or source)
        if code.sha256 != recorded:
            raise InputError(f"{names}, which has changed since; {_anew(source)}")
        return code
    try:
        code = Code.read(source)
    except InputError:
        known = f" of sha256 {recorded}" if recorded else ""
        raise NotTrustedError(
            f"{names}, which is not there and would not run unasked; if you trust it, give "
            f"--trust FILE with the file{known}"
        ) from None
    if recorded is None and code.sha256 in trust:
        return code
    if recorded not in (None, code.sha256):
        raise NotTrustedError(
            f"{names}, which has changed since, so it does not run; {_anew(source)}"
        )
    raise NotTrustedError(
        f"{names}, which does not run unasked; read it, and if you trust it, give "
        f"--trust {shlex.quote(source)}"
    )


def _anew(source: str) -> str:
    return f"put back what it was, or fit anew with --effects {shlex.quote(source)}"
