"""What a surface is made of, told by numbers or colours of its triangles."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from chains.errors import InputError
from sensors.documents import read_yaml
from sensors.numbers import read_csv

# Colours this near each other are one: what a JPEG makes of one colour scatters by a few steps.
_SAME_COLOUR = 24.0
# Of a mesh with labels most colours lie so near one of few; photographs have all between. Half of
# the above; the share, and how many labels people name, are a choice.
_NEAR_COLOUR = 12.0
_MOST_COLOURS = 64
_SHARE_NEAR = 0.9
# A colour further than this from every one of a palette is none of them.
_FARTHEST_COLOUR = 60.0
_MOST_LABELS = 1 << 16  # as a recording's faces have labels in two bytes


@dataclass(frozen=True)
class Palette:
    """Names of labels, by number and by colour (r, g, b), each from 0 to 255."""

    numbers: Mapping[int, str] = field(default_factory=dict)
    colours: Mapping[str, tuple[int, int, int]] = field(default_factory=dict)


@dataclass(frozen=True)
class Labels:
    """Label (F,) uint16 of each triangle and the labels' names; `odd` says what is not told."""

    label: np.ndarray
    names: dict[int, str]
    odd: tuple[str, ...] = ()


def read_palette(path: Path) -> Palette:
    """Read names of labels from YAML or CSV.

    YAML: `3: wall`, or `wall: "#c0c0c0"`, or `wall: [192, 192, 192]`. CSV: columns `name` and
    `label`, or `name` and `colour`, or `name`, `red`, `green`, `blue`. Raises InputError for
    anything else.
    """
    if path.suffix.lower() == ".csv":
        table = read_csv(path, text=("name", "colour"))
        if "name" not in table or not ({"label", "colour"} & table.keys() or "red" in table):
            raise InputError(
                f"{path}: columns name and label, colour, or red green blue are needed"
            )
        if "label" in table:
            rows = zip(table["label"].tolist(), table["name"].tolist(), strict=True)
        elif "colour" in table:
            rows = zip(table["name"].tolist(), table["colour"].tolist(), strict=True)
        else:
            rgb = np.stack([table[c] for c in ("red", "green", "blue")], axis=1).tolist()
            rows = zip(table["name"].tolist(), rgb, strict=True)
    else:
        data, _ = read_yaml(path)
        if not isinstance(data, dict):
            raise InputError(f"{path}: each line should read `3: wall` or `wall: '#c0c0c0'`")
        rows = data.items()
    numbers, colours = {}, {}
    for key, value in rows:
        if isinstance(key, int | float):
            if not np.isfinite(key):
                raise InputError(f"{path}: {key} is no number of a label")
            numbers[int(key)] = str(value)
        else:
            colours[key] = _colour(path, key, value)
    return Palette(numbers, colours)


def _colour(path: Path, name: str, value: object) -> tuple[int, int, int]:
    try:
        if isinstance(value, str) and len(value) == 7 and value[0] == "#":
            return tuple(bytes.fromhex(value[1:]))
        if isinstance(value, list) and len(value) == 3 and all(0 <= v <= 255 for v in value):
            return tuple(int(v) for v in value)
    except (TypeError, ValueError):
        pass
    raise InputError(f"{path}: {name}: {value!r} is no colour; give '#c0c0c0' or [192, 192, 192]")


def labels_of_numbers(numbers: np.ndarray, palette: Palette) -> Labels:
    """Labels of numbers (F, S), S of each triangle: what most of them are.

    What is negative or not finite was given no label, and becomes one of its own. Raises
    InputError for numbers that are not whole, or beyond 65535.
    """
    numbers = np.asarray(numbers, np.float64)
    known = np.isfinite(numbers) & (numbers >= 0)
    if (numbers[known] != np.rint(numbers[known])).any() or (numbers[known] >= _MOST_LABELS).any():
        raise InputError("its labels are no whole numbers from 0 to 65535")
    label = most_frequent(np.where(known, numbers, -1).astype(np.int64))
    names = {int(n): palette.numbers.get(int(n), f"label_{n}") for n in np.unique(label) if n >= 0}
    return _with_rest(label, names)


def labels_of_colours(colours: np.ndarray, palette: Palette) -> Labels | None:
    """Labels of colours (F, S, 3) uint8, S of each triangle; None where they are a photograph's.

    A given palette decides; without one, colours that keep to at most 64 distinct ones are
    labels, named colour_#rrggbb, the most frequent first.
    """
    distinct, place, count = np.unique(
        colours.reshape(-1, 3), axis=0, return_inverse=True, return_counts=True
    )
    distinct = distinct.astype(np.float64)
    if palette.colours:
        entries = np.array(list(palette.colours.values()), np.float64)
        names = list(palette.colours)
    else:
        entries = _distinct_colours(distinct, count)
        if entries is None:
            return None
        names = ["colour_#" + bytes(rgb).hex() for rgb in entries.astype(np.uint8)]
    away = np.stack([np.linalg.norm(distinct - entry, axis=1) for entry in entries], axis=1)
    nearest = np.where(away.min(axis=1) <= _FARTHEST_COLOUR, away.argmin(axis=1), -1)
    label = most_frequent(nearest[place.reshape(colours.shape[:2])])
    return _with_rest(label, {n: name for n, name in enumerate(names) if (label == n).any()})


def _distinct_colours(colours: np.ndarray, count: np.ndarray) -> np.ndarray | None:
    """The colours (P, 3) round which all others gather, most frequent first; None if they do not.

    The most frequent colour takes those near it, then the most frequent of the rest, and so on.
    """
    left, entries, near = count.astype(np.float64), [], 0
    while left.any():
        if len(entries) == _MOST_COLOURS:
            return None
        entry = colours[left.argmax()]
        away = np.linalg.norm(colours - entry, axis=1)
        near += left[away <= _NEAR_COLOUR].sum()
        left[away <= _SAME_COLOUR] = 0
        entries.append(entry)
    return np.array(entries) if near >= _SHARE_NEAR * count.sum() else None


def most_frequent(values: np.ndarray) -> np.ndarray:
    """The most frequent (F,) of each row of values (F, S); of equals, the first in the row."""
    votes = sum((values == values[:, [i]]).astype(np.uint8) for i in range(values.shape[1]))
    return np.take_along_axis(values, votes.argmax(axis=1)[:, None], axis=1)[:, 0]


def _with_rest(label: np.ndarray, names: dict[int, str]) -> Labels:
    """Triangles without a label (-1) get the number behind the last, and the name unlabelled."""
    rest, odd = label < 0, ()
    if rest.any():
        number = max(names, default=-1) + 1
        if number >= _MOST_LABELS:
            raise InputError("its labels go to 65535, which leaves none for what has no label")
        names = {**names, number: "unlabelled"}
        odd = (f"{rest.sum()} of {len(label)} triangles have no label; they are `unlabelled`",)
        label = np.where(rest, number, label)
    return Labels(label.astype(np.uint16), names, odd)
