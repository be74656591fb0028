"""What a page shows, as text after the key of its address: a link shows the same again."""

from __future__ import annotations

import re
from collections.abc import Mapping
from urllib.parse import parse_qsl, quote, urlencode

LONGEST = 2000  # letters: what browsers and mail programs take as a link
KEYS = ("run", "recording", "stop", "stops", "other", "beside", "colour", "size", "scales", "only")
KEYS += ("up", "over", "lit", "area", "moves", "below", "camera", "dark")


def read(text: str) -> dict[str, str]:
    """What an address asks for, by `KEYS`; of what cannot be read, nothing."""
    pairs = parse_qsl(text[:LONGEST], errors="replace")
    return {key: value for key, value in pairs if key in KEYS}


def write(look: Mapping[str, str]) -> str:
    """The text that `read` reads, percent-encoded; what is empty is left out."""
    return urlencode({k: look[k] for k in KEYS if look.get(k)}, quote_via=quote, safe=",:")


def numbers(text: str, count: int) -> tuple[float, ...] | None:
    """So many numbers with commas between; None where the text is anything else."""
    try:
        values = tuple(float(part) for part in text.split(","))
    except ValueError:
        return None
    return values if len(values) == count and all(abs(v) < 1e9 for v in values) else None


def read_scales(text: str) -> dict[str, tuple[float, float]]:
    """Ends of scales by column, of those that can be read."""
    found = {}
    for part in text.split(","):
        name, _, ends = part.partition(":")
        pair = numbers(ends.replace(":", ","), 2)
        if re.fullmatch(r"[\w.]+", name) and pair and pair[0] < pair[1]:
            found[name] = pair
    return found


def write_scales(scales: Mapping[str, tuple[float, float]]) -> str:
    """The text that `read_scales` reads."""
    return ",".join(f"{name}:{low:.6g}:{high:.6g}" for name, (low, high) in scales.items())
