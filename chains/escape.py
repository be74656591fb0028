"""Text that others wrote, made safe for where it lands: one function for each destination.

Names come out of recordings and runs that somebody sent. Where a file format, a browser or a
terminal would take a part of a name for a command of its own, that part is written so that it
stands there as the name's letters and nothing else.
"""

from __future__ import annotations

import html as _html
import re
from xml.sax.saxutils import quoteattr

# What moves a cursor, starts a terminal's command, ends a line or turns the direction of writing,
# and halves of characters that no file can hold.
_CONTROL = re.compile(
    "[\x00-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ufeff\ud800-\udfff]"
)
_LATEX = {
    **{sign: f"\\{sign}" for sign in "&%$#_{}"},
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "±": r"$\pm$",
    "→": r"$\to$",
    "<": r"$<$",
    ">": r"$>$",
    **{sign: f"{{{sign}}}" for sign in "[]*"},  # after the end of a row they would be an argument
}
_MARKDOWN = {sign: f"\\{sign}" for sign in "\\`*[]|"} | {"&": "&amp;", "<": "&lt;", ">": "&gt;"}
_FORMULA = re.compile(r"[=+\-@]")  # what a spreadsheet takes for the start of a formula


def line(text: str) -> str:
    r"""One line without control characters, which are spelled out: ``\x1b``.

    For comments in any language, where an end of line would end the comment; and for XML, which
    cannot hold such characters at all.
    """
    return _CONTROL.sub(_spelled, text)


def terminal(text: str) -> str:
    """For a terminal: as `line`, but ends of lines and tabs stay."""
    return _CONTROL.sub(lambda found: found[0] if found[0] in "\n\t" else _spelled(found), text)


def html(text: str) -> str:
    """For HTML, as text or as the value of an attribute in quotes."""
    return _html.escape(terminal(text))


def json(text: str) -> str:
    """For the whole text of a JSON document: control characters that it lets stand, as numbers."""
    return _CONTROL.sub(lambda found: found[0] if found[0] < " " else _numbered(found[0]), text)


def xml_attribute(text: str) -> str:
    """For XML: the value of an attribute, with its quotes."""
    return quoteattr(line(text))


def xml_comment(text: str) -> str:
    """For a line within a comment of XML, which two hyphens would end."""
    return re.sub("-(?=-)", "- ", line(text)).encode("ascii", "backslashreplace").decode()


def identifier(text: str) -> str:
    """For an id in HTML or SVG: letters, digits and hyphens as they are, all else as numbers."""
    return re.sub(r"[^A-Za-z0-9-]", lambda found: f"_{ord(found[0]):x}_", text)


def latex(text: str) -> str:
    """For the text of a LaTeX document."""
    return "".join(_LATEX.get(sign, sign) for sign in line(text))


def markdown(text: str) -> str:
    """For a cell of a table in Markdown."""
    return "".join(_MARKDOWN.get(sign, sign) for sign in line(text))


def csv_cell(text: str) -> str:
    """For a cell of a CSV file that a spreadsheet may open: a number stays one, and what looks like
    a formula gets an apostrophe before it, which spreadsheets take for "this is text"."""
    text = line(text)
    return f"'{text}" if _FORMULA.match(text.lstrip()) and not is_number(text) else text


def from_csv_cell(cell: str) -> str:
    """What `csv_cell` was given, but for control characters and a number."""
    return cell[1:] if cell[:1] == "'" and _FORMULA.match(cell[1:].lstrip()) else cell


def is_number(text: str) -> bool:
    """Whether a spreadsheet may take it for a number, NaN and infinity among them."""
    try:
        float(text)
    except ValueError:
        return False
    return True


def _spelled(found: re.Match[str]) -> str:
    return found[0].encode("unicode_escape").decode()


def _numbered(sign: str) -> str:
    return f"\\u{ord(sign):04x}"
