"""Pages held against what is printed: words as they are, figures up to their last digit."""

from __future__ import annotations

import re
from collections.abc import Iterator

FIGURE = r"[-+]?\d[\d.e-]*"
NOT_TOOK = r"(?! (?:s|min)\b)"  # not a time that something took: it differs from run to run


def unwrapped(text: str) -> str:
    """A text in one line."""
    return " ".join(text.split())


def shape(text: str) -> str:
    """A text without its figures and the width of its blanks."""
    return unwrapped(re.sub(FIGURE, "#", text))


def blocks(language: str, text: str) -> list[str]:
    """The code blocks of a language in a page."""
    return re.findall(rf"^```{language}\n(.*?)^```", text, flags=re.M | re.S)


def unlike(shown: str, said: str) -> list[str]:
    """In what a text that a page shows differs from what is printed: in figures, where it is most
    alike, or in all of it, where its words are nowhere.

    Whole numbers must be the same; of others the last digit may be one off, as libraries differ.
    """
    shown = unwrapped(shown)
    words = FIGURE.join(map(re.escape, re.split(FIGURE, shown)))
    there = [
        [f"{a} -> {b}" for a, b in _pairs(shown, each[0]) if _off(a, b)]
        for each in re.finditer(words, unwrapped(said))
    ]
    return min(there, key=len, default=[f"not printed: {shown}"])


def _pairs(*texts: str) -> Iterator[tuple[str, str]]:
    """The figures of two texts of the same words, times left out."""
    found = (re.finditer(rf"{FIGURE}(?![\d.e-]){NOT_TOOK}", text) for text in texts)
    return ((a[0], b[0]) for a, b in zip(*found, strict=True))


def _off(one: str, other: str) -> bool:
    """Whether two figures differ by more than a last digit; dates and the like never do."""
    try:
        apart = abs(float(one) - float(other))
    except ValueError:
        return False
    return apart > 1.001 * max(_last_digit(one), _last_digit(other))


def _last_digit(figure: str) -> float:
    """What one more in a figure's last digit is; 0 of whole numbers."""
    mantissa, _, exponent = figure.partition("e")
    decimals = len(mantissa.partition(".")[2])
    return 10.0 ** (int(exponent or 0) - decimals) if decimals or exponent else 0.0
