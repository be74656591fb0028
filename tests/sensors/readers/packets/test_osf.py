"""The images of an OSF, coded here as their formats say."""

import io
import struct

import numpy as np
import pyarrow
import pytest
from PIL import Image

from sensors.readers.packets.osf import _png, _staggered, _zpng

RNG = np.random.default_rng(5)


def zpng(pixels: np.ndarray) -> bytes:
    """Code bytes (rows, columns, n) as github.com/catid/Zpng does."""
    rows, columns, size = pixels.shape
    steps = np.diff(pixels, axis=1, prepend=np.zeros((rows, 1, size), np.uint8))
    if size == 4:
        r, g, b, a = np.moveaxis(steps, 2, 0)
        steps = np.stack([b, g - b, g - r, a])
    head = struct.pack("<HHHBB", 0xFBF8, columns, rows, size, 1)
    return head + pyarrow.compress(steps.tobytes(), codec="zstd", asbytes=True)


@pytest.mark.parametrize("size", [1, 2, 4, 8])
def test_zpng_comes_back(size):
    pixels = RNG.integers(0, 256, (16, 64, size), np.uint8)
    np.testing.assert_array_equal(_zpng(zpng(pixels)), pixels)


@pytest.mark.parametrize(("mode", "size"), [("L", 1), ("I;16", 2), ("RGB", 3), ("RGBA", 4)])
def test_png_comes_back_lowest_byte_first(mode, size):
    pixels = RNG.integers(0, 256, (16, 64, size), np.uint8)
    numbers = (pixels.astype(int) << (8 * np.arange(size))).sum(axis=2)
    image = (
        Image.fromarray(numbers.astype(np.uint16 if size == 2 else np.uint8))
        if size < 3
        else Image.fromarray(pixels)
    )
    assert image.mode == mode
    file = io.BytesIO()
    image.save(file, "PNG")
    found = _png(file.getvalue()).astype(int)
    np.testing.assert_array_equal((found << (8 * np.arange(found.shape[2]))).sum(axis=2), numbers)


def test_staggering_undoes_what_makes_images_upright():
    by_id = RNG.integers(0, 9999, (4, 32))
    shift = [6, 3, 0, 29]
    upright = np.stack([np.roll(row, by) for row, by in zip(by_id, shift, strict=True)])
    facts = {"lidar_data_format": {"pixel_shift_by_row": shift}}
    np.testing.assert_array_equal(_staggered(upright, facts), by_id)
