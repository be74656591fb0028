"""Recordings of made-up worlds, by code that shares nothing with the program that is tested.

Rig, room, ray casts, noise and mesh errors are this package's own, in numpy; it imports none of
`chains`, `sensors` and `calib`. What it writes is a recording in the format of the contract, with
its truth beside it in the format of the recordings of the independent simulator.
"""

from .knobs import World
from .write import write

__all__ = ["World", "write"]
