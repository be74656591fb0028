"""Turns of a LiDAR out of its packets, decoded when they are asked for.

The packets are read twice: first to see where each turn begins and ends, then to decode those that
are wanted, so that a capture of any size needs the memory of one turn.
"""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d

from chains.errors import InputError
from sensors.readers.base import Array, Columns, Contents, Options, Progress, Sweep, Sweeps
from sensors.readers.packets.pcap import Capture

Packets = Callable[[], Iterator[tuple[float, bytes]]]
"""Arrival time [s] and payload of every packet in order, anew each time it is called."""
Bytes = NDArray[np.uint8]

_CHUNK = 2048
"""Packets decoded at once: bounds the memory, of the largest to some 50 MB."""
_OVERTOOK_S = 1.0
"""Packets that overtook each other in a network are never so late: a choice."""
_ABOUT = 21
"""Turns of which one at least is taken to lack no packet: a choice, two seconds at 10 Hz."""
_PAUSE_S = 0.3
"""No packet for longer than this: what comes next belongs to another turn."""


class Decoder(Protocol):
    """What one packet format says; packets are (P, size) bytes with B blocks each."""

    size: int
    """Bytes of a packet; of others nothing is taken."""

    def marks(self, packets: Bytes) -> Array:
        """Return (P, B) what tells when each block's turn begins: its angle, or a counter."""

    def steps(self, difference: Array) -> NDArray[np.int64]:
        """Return by how many turns a block is ahead of the one before, from their marks' (N,)."""

    def points(self, packets: Bytes, wanted: NDArray[np.bool_]) -> Columns:
        """Return the points of the wanted (P, B) blocks as columns of a `Sweep`."""


def packet_sweeps(
    name: str, clock: str, packets: Packets, decoder: Decoder, progress: Progress
) -> Sweeps | None:
    """Return the turns in the packets, or None where no packet is the decoder's.

    A turn's time is the middle between its first and its last packet's arrival. Progress counts
    packets; whoever knows how many there are says so instead.
    """
    time_s, turns = _survey(packets, decoder, progress)
    if turns is None:
        return None
    first, last = turns.extent()

    def read(wanted: NDArray[np.bool_]) -> Iterator[Sweep]:
        for s, window in _windows(packets, decoder.size, np.flatnonzero(wanted), first, last):
            mine = turns.blocks(slice(first[s], last[s] + 1)) == s
            yield Sweep(float(middle_s[s]), decoder.points(window, mine))

    middle_s = (time_s[first] + time_s[last]) / 2
    return Sweeps(name, clock, middle_s, read, lost=_lost(time_s, turns, first, last))


def _lost(time_s: Array, turns: _Turns, first: NDArray[np.int64], last: NDArray[np.int64]) -> float:
    """Share of packets that are missing from turns, of which the first and last packet (S,) are
    given: those that are whole have as many as others about them. Not of turns that a pause, or an
    end, has cut."""
    pause = np.flatnonzero(np.diff(time_s) > _PAUSE_S)
    ends = np.concatenate([[0], pause, pause + 1, [len(time_s) - 1]])
    whole = np.ones(len(first), bool)
    whole[turns.here[ends]] = whole[turns.after[ends]] = False
    count = (last - first + 1)[whole]
    if not len(count):
        return 0.0
    return float(1.0 - count.sum() / maximum_filter1d(count, _ABOUT).sum())


def steps_of_phase(difference: Array) -> NDArray[np.int64]:
    """Steps of a phase that rises from 0 to 1 in a turn: a fall begins the next one.

    Packets that overtook each other in the network fall a little, or rise by nearly a turn; both
    belong to where they came from.
    """
    return (difference < -0.1).astype(np.int64) - (difference > 0.9)


@dataclass(frozen=True)
class _Turns:
    """To which turn the blocks of P packets belong: one that ends in it, and the one after."""

    here: NDArray[np.int32]
    """(P,) turn of the first block."""
    after: NDArray[np.int32]
    """(P,) turn of the last."""
    split: NDArray[np.uint8]
    """(P,) how many blocks belong to the first."""
    per_packet: int

    def blocks(self, part: slice) -> NDArray[np.int32]:
        """The turn (p, B) of every block of some packets."""
        ended = np.arange(self.per_packet) >= self.split[part, None]
        return np.where(ended, self.after[part, None], self.here[part, None])

    def extent(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """First and last packet (S,) of each turn; those of neighbours may overlap."""
        count = int(max(self.here.max(), self.after.max())) + 1
        first, last = np.full(count, len(self.here)), np.zeros(count, np.int64)
        for turn in (self.here, self.after):
            np.minimum.at(first, turn, np.arange(len(turn)))
            np.maximum.at(last, turn, np.arange(len(turn)))
        return first, last


def capture_packets(capture: Capture, size: int, options: Options) -> Packets:
    """The payloads of `size` bytes in a capture, from the one sensor that sends such.

    Iterating raises InputError where several do and `--topic` chooses none.
    """

    def packets() -> Iterator[tuple[float, bytes]]:
        ours: str | None = None
        for datagram in capture:
            if len(datagram.payload) != size:
                continue
            if options.topics and datagram.stream not in options.topics:
                continue
            ours = ours or datagram.stream
            if datagram.stream != ours:
                raise InputError(
                    f"{capture.name} has packets of several LiDARs, {ours} and {datagram.stream};"
                    f" choose one by --topic, such as --topic {ours}"
                )
            yield datagram.time_s, datagram.payload

    return packets


def captured(capture: Capture, contents: Contents) -> Contents:
    """What was found in a capture, and what is odd about its files."""
    odd = list(contents.odd)
    if capture.cut_short:
        names = " and ".join(path.name for path in capture.cut_short)
        odd.append(f"{names} ends within a packet: it was cut short; what is whole is read")
    if capture.reordered:
        names = ", ".join(path.name for path in capture.paths)
        odd.append(f"captures are read in the order of their first packets: {names}")
    if capture.overlap_s > _OVERTOOK_S:
        odd.append(
            f"captures overlap by {capture.overlap_s:.6g} s: give those of one LiDAR that follow"
            " each other"
        )
    if capture.back_s > _OVERTOOK_S:
        odd.append(
            f"{capture.name}: its clock was set back by {capture.back_s:.6g} s while it was"
            " captured; times before and after do not follow each other: import the parts one by"
            " one"
        )
    return replace(contents, odd=tuple(odd))


def stacked(payloads: list[bytes], size: int) -> Bytes:
    """Payloads of one size as (P, size) bytes."""
    return np.frombuffer(b"".join(payloads), np.uint8).reshape(-1, size)


class _Counter:
    """Numbers the turns of packets, chunk by chunk."""

    def __init__(self, decoder: Decoder) -> None:
        self.decoder = decoder
        self.turn = 0
        self.mark: float | None = None
        self.time_s: float | None = None

    def number(self, time_s: Array, marks: Array) -> NDArray[np.int64]:
        """The turn (P, B) of blocks with these marks, in packets that came at (P,) s."""
        flat = marks.ravel()
        mark = flat[0] if self.mark is None else self.mark
        before_s = time_s[0] if self.time_s is None else self.time_s
        steps = self.decoder.steps(np.diff(flat, prepend=mark)).reshape(marks.shape)
        steps[:, 0] += 2 * (np.diff(time_s, prepend=before_s) > _PAUSE_S)
        number = self.turn + np.cumsum(steps).reshape(marks.shape)
        self.turn, self.mark, self.time_s = int(number[-1, -1]), flat[-1], time_s[-1]
        return number


def _survey(packets: Packets, decoder: Decoder, progress: Progress) -> tuple[Array, _Turns | None]:
    """Arrival (P,) of all packets that are the decoder's, and their turns; None if none is."""
    counter, times, parts, blocks = _Counter(decoder), [np.zeros(0)], [], 0
    for chunk in _chunks(packets, decoder.size):
        times.append(np.array([time_s for time_s, _ in chunk]))
        marks = decoder.marks(stacked([payload for _, payload in chunk], decoder.size))
        number = counter.number(times[-1], marks)
        blocks = number.shape[1]
        split = (number == number[:, :1]).sum(axis=1)
        parts.append(np.stack([number[:, 0], number[:, -1], split]).astype(np.int32))
        progress("reading packets", (len(times) - 1) * _CHUNK, 0)
    if not parts:
        return times[0], None
    ends, split = np.split(np.concatenate(parts, axis=1), [2])
    here, after = np.unique(ends, return_inverse=True)[1].reshape(2, -1).astype(np.int32)
    return np.concatenate(times), _Turns(here, after, split[0].astype(np.uint8), blocks)


def _chunks(packets: Packets, size: int) -> Iterator[list[tuple[float, bytes]]]:
    ours = (packet for packet in packets() if len(packet[1]) == size)
    while chunk := list(itertools.islice(ours, _CHUNK)):
        yield chunk


def _windows(
    packets: Packets,
    size: int,
    wanted: NDArray[np.int64],
    first: NDArray[np.int64],
    last: NDArray[np.int64],
) -> Iterator[tuple[int, Bytes]]:
    """Each wanted turn with its packets (P, size), from the first to the last."""
    pending = deque(wanted.tolist())
    window: deque[tuple[int, bytes]] = deque()
    ours = (payload for _, payload in packets() if len(payload) == size)
    for i, payload in enumerate(ours):
        if not pending:
            return
        if i >= first[pending[0]]:
            window.append((i, payload))
        while pending and i >= last[pending[0]]:
            s = pending.popleft()
            yield s, stacked([p for k, p in window if first[s] <= k <= last[s]], size)
            while pending and window and window[0][0] < first[pending[0]]:
                window.popleft()
