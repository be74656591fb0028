"""A file, damaged: by chance from a seed, the same for the same seed."""

import re
import struct

import numpy as np

# Numbers at which programs err: none, all, the largest of each type, and those beside them.
ODD = (0, 1, 2, 127, 128, 255, 256, 32767, 65535, 2**31 - 1, 2**31, 2**32 - 1, 2**62, 2**63 - 1)
WORDS = (b"-1", b"0", b"1e308", b"nan", b"inf", b"-inf", b"99999999999", b"", b"x", b"\xff\xfe")
WORDS += (
    b"1" * 400,
    b"[" * 200,
    b"{",
    b'"',
    b"'",
    b"\0",
    b",,,",
    b"../../x",
    b"&a",
    b"*a",
    b"<!--",
)


def mutated(data: bytes, seed: int) -> bytes:
    """One to four damages of one file."""
    rng = np.random.default_rng(seed)
    for _ in range(rng.integers(1, 5)):
        damage = DAMAGES[rng.integers(len(DAMAGES))]
        data = damage(data, rng) if data else data
    return data


def _place(data: bytes, rng: np.random.Generator) -> int:
    """Where to damage: as often in the first part, where headers stand, as anywhere."""
    most = min(len(data), (64, 512, 4096)[rng.integers(3)]) if rng.random() < 0.6 else len(data)
    at = int(rng.integers(most))
    return len(data) - 1 - at if rng.random() < 0.15 else at


def _flip(data: bytes, rng: np.random.Generator) -> bytes:
    out = bytearray(data)
    for _ in range(rng.integers(1, 9)):
        out[_place(data, rng)] ^= 1 << rng.integers(8)
    return bytes(out)


def _overwrite(data: bytes, rng: np.random.Generator) -> bytes:
    out = bytearray(data)
    at = _place(data, rng)
    size = int(rng.integers(1, 33))
    out[at : at + size] = rng.bytes(size)
    return bytes(out)


def _truncate(data: bytes, rng: np.random.Generator) -> bytes:
    return data[: _place(data, rng)]


def _number(data: bytes, rng: np.random.Generator) -> bytes:
    """A number of the header becomes an odd one: a length, a count, a size."""
    kind = "<>"[rng.integers(2)] + "BHIQ"[rng.integers(4)]
    size = struct.calcsize(kind)
    value = ODD[rng.integers(len(ODD))] % (1 << 8 * size)
    at = _place(data, rng) // size * size
    return data[:at] + struct.pack(kind, value) + data[at + size :]


def _splice(data: bytes, rng: np.random.Generator) -> bytes:
    """A piece of the file stands elsewhere as well."""
    start, to = int(rng.integers(len(data))), _place(data, rng)
    piece = data[start : start + int(rng.integers(1, 2000))]
    return data[:to] + piece * int(rng.integers(1, 4)) + data[to:]


def _remove(data: bytes, rng: np.random.Generator) -> bytes:
    at = _place(data, rng)
    return data[:at] + data[at + int(rng.integers(1, 500)) :]


def _word(data: bytes, rng: np.random.Generator) -> bytes:
    """A number that is written out becomes a word that is odd."""
    numbers = list(re.finditer(rb"-?\d+(\.\d+)?", data[: 1 << 16]))
    if not numbers:
        return _overwrite(data, rng)
    chosen = numbers[rng.integers(min(len(numbers), 60))]
    word = WORDS[rng.integers(len(WORDS))]
    return data[: chosen.start()] + word + data[chosen.end() :]


DAMAGES = (_flip, _overwrite, _truncate, _number, _number, _splice, _remove, _word, _word)
