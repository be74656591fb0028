"""Readers of foreign files: one format, one file. A new one is a function and a line here."""

from sensors.readers.base import Reader

READERS: dict[str, Reader] = {}
