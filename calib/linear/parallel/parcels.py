"""Objects on their way between processes: what is large travels once, and then by a key.

A fit asks a dozen times for sums over the same stops: their scans, surfaces and what beams met do
not change, only the state does. Objects of the classes in `ONCE` are pickled each by itself and
stand in all else by their key; a process is sent those that it does not hold. It keeps what it was
sent up to `KEPT_PARCELS_BYTES`, what was used last, and says what it lacks.

Scans never travel: a store of scans is sent as where the recording is, and reads for itself.
Relative paths are sent as absolute ones, those that stand for a URL as that, and effects from a
user's Python file with that file.
"""

from __future__ import annotations

import io
import itertools
import pickle
import uuid
import weakref
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from threading import Lock
from typing import Any, NamedTuple

from calib.effects.own.files import code_of, of_code
from calib.linear.layout import Layout
from calib.linear.rows import State, Weighing
from calib.residuals.beams import Association, CellNumbers
from calib.residuals.scan import ScanStop
from calib.residuals.store import BeamStore
from calib.residuals.surfaces import MeshSurface, PlaneSurface
from calib.rig import Rig
from chains import remote
from sensors.recording import RecordedStops
from sensors.reference import Reference

KEPT_PARCELS_BYTES = 2e9  # in each process: what 150 million beams met (12 bytes each), and a mesh
Key = tuple[str, int]


@dataclass(frozen=True, eq=False)
class Task:
    """What is to be done with each stop of a pass."""

    work: Callable[..., Any]


ONCE = (Task, Layout, ScanStop, BeamStore, RecordedStops, Rig, Reference, MeshSurface)
ONCE += (PlaneSurface, CellNumbers, Association, State, Weighing)


class Parcel(NamedTuple):
    """An object on its way.

    Args:
        body: it, pickled.
        needed: keys of all objects that stand in it, or in those that go along, by their key.
        along: those of them that go along, pickled.
    """

    body: bytes
    needed: Sequence[Key]
    along: dict[Key, bytes]


class LackingError(LookupError):
    """A parcel speaks of objects that are not here; their keys are the arguments."""


@dataclass(frozen=True, eq=False)
class _Known:
    """An object that has a key, and the names of the processes that hold it."""

    key: Key
    object: weakref.ref[Any]
    holders: set[str] = field(default_factory=set)


class Parcels:
    """Packs objects for other processes, and opens what they send.

    Args:
        kept_bytes: how much of what came is kept, for others to speak of it.
    """

    def __init__(self, kept_bytes: float = 0.0) -> None:
        self.name = uuid.uuid4().hex
        self.kept_bytes = kept_bytes
        self._count = itertools.count()
        self._lock = Lock()
        self._by_id: dict[int, _Known] = {}
        self._by_key: dict[Key, _Known] = {}
        self._kept: OrderedDict[Key, tuple[Any, int]] = OrderedDict()
        self._bytes = 0

    def packed(self, what: object, holder: str | None) -> Parcel:
        """An object, and with it what of it that process does not hold; None holds nothing."""
        body, inner = self._pickled(what)
        queue, along = list(inner), {}
        needed = {self._known(each).key: None for each in inner}
        while queue:
            each = queue.pop()
            known = self._known(each)
            if known.key in along or holder in known.holders:
                continue
            along[known.key], inner = self._pickled(each)
            queue += inner
            needed |= {self._known(each).key: None for each in inner}
        return Parcel(body, list(needed), along)

    def opened(self, parcel: Parcel, sender: str) -> Any:
        """What a parcel holds.

        Raises:
            LackingError: it speaks of what is not here.
        """
        here = {key: found for key in parcel.needed if (found := self._object(key)) is not None}
        lacking = [key for key in parcel.needed if key not in here and key not in parcel.along]
        if lacking:
            raise LackingError(*lacking)

        opening = _Opening(here, parcel.along, self._take)
        for key, data in parcel.along.items():
            self._keep(key, opening.load(key), len(data))
            self.held(sender, [key])
        return _Unpickler(parcel.body, opening).load()

    def held(self, holder: str, keys: Sequence[Key], holds: bool = True) -> None:
        """Take down what another process holds, or does not."""
        for known in filter(None, map(self._by_key.get, keys)):
            (known.holders.add if holds else known.holders.discard)(holder)

    def keep(self, parcel: Parcel) -> None:
        """Keep what goes along with a parcel: whoever gets it may speak of it."""
        for key, data in parcel.along.items():
            self._keep(key, self._object(key), len(data))

    def _pickled(self, what: object) -> tuple[bytes, list[object]]:
        """An object, and those of `ONCE` that stand in it by their key."""
        file, inner = io.BytesIO(), []

        def key(each: object) -> Key:
            inner.append(each)
            return self._known(each).key

        _Pickler(file, what, key).dump(what)
        return file.getvalue(), inner

    def _known(self, what: object) -> _Known:
        known = self._by_id.get(id(what))
        return known or self._take(what, (self.name, next(self._count)))

    def _take(self, what: object, key: Key) -> _Known:
        """Give an object a key until it is gone, unless another thread just did."""
        at = id(what)

        def forget(_: object) -> None:
            self._by_id.pop(at, None)
            self._by_key.pop(key, None)

        with self._lock:
            known = self._by_id.get(at)
            if known is None:
                known = self._by_id[at] = self._by_key[key] = _Known(key, weakref.ref(what, forget))
            return known

    def _object(self, key: Key) -> Any:
        known = self._by_key.get(key)
        found = None if known is None else known.object()
        with self._lock:
            if key in self._kept:
                self._kept.move_to_end(key)
        return found

    def _keep(self, key: Key, what: object, size: int) -> None:
        """Keep an object of which so much travelled, and let go those that were not used for
        longest."""
        size += getattr(what, "nbytes", 0)
        gone = []
        with self._lock:
            if size > self.kept_bytes or key in self._kept:
                return
            self._kept[key] = what, size
            self._bytes += size
            while self._bytes > self.kept_bytes:
                _, last = self._kept.popitem(last=False)
                self._bytes -= last[1]
                gone.append(last)  # until the lock is free: they are forgotten as they go


class _Pickler(pickle.Pickler):
    """Pickles one object; those of `ONCE` in it are named by `key`."""

    def __init__(self, file: io.BytesIO, top: object, key: Callable[[object], Key]) -> None:
        super().__init__(file, protocol=pickle.HIGHEST_PROTOCOL)
        self.top, self.key = top, key

    def persistent_id(self, obj: Any) -> Key | None:
        """Its key, of one of those."""
        return self.key(obj) if type(obj) in ONCE and obj is not self.top else None

    def reducer_override(self, obj: Any) -> Any:
        """Otherwise than usual: relative paths, those that stand for a URL, and what a user's
        Python file defines."""
        if isinstance(obj, Path) and (url := remote.url_of(obj)) is not None:
            return remote.place, (url,)
        if isinstance(obj, Path) and not obj.is_absolute():
            return Path, (str(obj.absolute()),)
        if (code := code_of(obj)) is not None:
            return of_code, (code, obj.__qualname__)
        return NotImplemented


@dataclass(frozen=True)
class _Opening:
    """A parcel that is being opened.

    Args:
        here: objects by their key.
        along: others, pickled.
        take: notes the key of one that was unpickled.
    """

    here: dict[Key, Any]
    along: dict[Key, bytes]
    take: Callable[[Any, Key], object]

    def load(self, key: Key) -> Any:
        """The object of a key."""
        if key not in self.here:
            self.here[key] = found = _Unpickler(self.along[key], self).load()
            self.take(found, key)
        return self.here[key]


class _Unpickler(pickle.Unpickler):
    def __init__(self, data: bytes, opening: _Opening) -> None:
        super().__init__(io.BytesIO(data))
        self.opening = opening

    def persistent_load(self, key: Key) -> Any:
        return self.opening.load(key)
