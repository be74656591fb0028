"""Ways to break a recording: each gives a function that breaks one thing in a folder."""

import re
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np

from sensors.documents import read_yaml, write_yaml
from sensors.recording import read_table, write_table

Break = Callable[[Path], object]


def text(name: str, old: str | Callable[[str], str], new: str = "") -> Break:
    """Replace a text once in a file; or all of it by what a function makes of it."""

    def apply(rec: Path) -> None:
        before = (rec / name).read_text()
        if callable(old):
            (rec / name).write_text(old(before))
        else:
            assert old in before, old
            (rec / name).write_text(before.replace(old, new, 1))

    return apply


def overwrite(name: str) -> Break:
    """Put a text where a binary file was."""
    return lambda rec: (rec / name).write_text("x,y,z\n")


def remove(name: str) -> Break:
    """Take a file or folder away."""

    def apply(rec: Path) -> None:
        path = rec / name
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink()

    return apply


def cells(name: str, columns: str, value: object, row: int | None = None) -> Break:
    """Set cells of a CSV file: of the columns that a pattern matches, in one row or in all.

    The value may be a function of the number that stands there.
    """

    def change(before: str) -> str:
        head, *rows = [line.split(",") for line in before.splitlines()]
        at = [i for i, column in enumerate(head) if re.fullmatch(columns, column)]
        assert at, columns
        for each in rows if row is None else [rows[row]]:
            for i in at:
                each[i] = str(value(float(each[i])) if callable(value) else value)
        return "\n".join(",".join(each) for each in (head, *rows)) + "\n"

    return text(name, change)


def without(name: str, columns: str) -> Break:
    """Leave columns of a CSV file out."""

    def change(before: str) -> str:
        lines = [line.split(",") for line in before.splitlines()]
        keep = [i for i, column in enumerate(lines[0]) if not re.fullmatch(columns, column)]
        return "\n".join(",".join(line[i] for i in keep) for line in lines) + "\n"

    return text(name, change)


def table(name: str, **columns: Callable[[np.ndarray], np.ndarray] | None) -> Break:
    """Change columns of a Parquet file; None leaves one out."""

    def apply(rec: Path) -> None:
        old = read_table(rec / name)
        new = {c: change and change(old[c]) for c, change in columns.items()}
        write_table(rec / name, {c: v for c, v in (old | new).items() if v is not None})

    return apply


def rows(name: str, kept: slice) -> Break:
    """Keep some rows of a Parquet file."""

    def apply(rec: Path) -> None:
        write_table(rec / name, {c: v[kept] for c, v in read_table(rec / name).items()})

    return apply


def rig(*keys: str, value: object) -> Break:
    """Set a value of rig.yaml; None takes the key out."""

    def apply(rec: Path) -> None:
        data, _ = read_yaml(rec / "rig.yaml")
        part = data
        for key in keys[:-1]:
            part = part[key]
        part[keys[-1]] = value
        if value is None:
            del part[keys[-1]]
        write_yaml(rec / "rig.yaml", data)

    return apply


def mesh(change: Callable[[np.ndarray], np.ndarray]) -> Break:
    """Move the vertices (V, 3) of a binary mesh."""

    def apply(rec: Path) -> None:
        path = rec / "reference/mesh.ply"
        raw = path.read_bytes()
        start = raw.index(b"end_header\n") + len(b"end_header\n")
        count = int(re.search(rb"element vertex (\d+)", raw)[1])
        vertices = np.frombuffer(raw, "<f8", 3 * count, start).reshape(-1, 3)
        moved = np.ascontiguousarray(change(vertices), "<f8").tobytes()
        path.write_bytes(raw[:start] + moved + raw[start + len(moved) :])

    return apply


def all_of(*breaks: Break) -> Break:
    """Break several things."""

    def apply(rec: Path) -> None:
        for each in breaks:
            each(rec)

    return apply


def thousandfold(values: np.ndarray) -> np.ndarray:
    """Metres as millimetres."""
    return 1000 * values
