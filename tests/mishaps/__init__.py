"""Mishaps: what can be wrong with one recording, done to its files.

`MISHAPS` lists them by name; each has a size in multiples of what can just be detected, says which
names for it are right, and what it does to the truth. The benchmark of blunders and the tests of
damage draw on the same list.
"""

from . import at_stops, of_sensors, of_setup  # noqa: F401 - each enters its mishaps
from .kinds import MISHAPS, TIMES, Done, Mishap
from .scene import Scene

__all__ = ["MISHAPS", "TIMES", "Done", "Mishap", "Scene"]
