"""Memory shared by two processes; unnamed, so that nothing is left when one is killed."""

from __future__ import annotations

import fcntl
import json
import math
import mmap
import os
import struct
import time
import zlib
from collections.abc import Iterator
from dataclasses import asdict, replace
from itertools import chain, islice
from multiprocessing.reduction import DupFd
from operator import attrgetter
from typing import Any, Protocol

from executor.state_machine import CycleRecord, LoopEvent, State
from executor.supervision import OperatorRequests, StopReason
from model.pose import Pose


class _Sent(Protocol):
    """A descriptor in transit to a new process."""

    def detach(self) -> int:
        """Returns the file descriptor in this process."""


class SharedMemory:
    """A block of memory that can be passed to a new process.

    Attributes:
        view: Its content.
        size: [bytes].
        descriptor: Of the memory file in this process.
    """

    def __init__(self, descriptor: int, size: int, *, writable: bool) -> None:
        """Takes ownership of an open memory file; `create` and `sealed` make one."""
        self.descriptor, self._writable = descriptor, writable
        self.size = size
        protection = mmap.PROT_READ | (mmap.PROT_WRITE if writable else 0)
        self.view = mmap.mmap(descriptor, size, prot=protection)

    @classmethod
    def create(cls, size: int) -> SharedMemory:
        """Zeroed memory that both sides may write."""
        descriptor = os.memfd_create("cdpr", os.MFD_CLOEXEC)
        os.ftruncate(descriptor, size)
        return cls(descriptor, size, writable=True)

    @classmethod
    def sealed(cls, content: bytes) -> SharedMemory:
        """Memory that no process can write any more."""
        descriptor = os.memfd_create("cdpr", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
        left = memoryview(content)
        while left:
            left = left[os.write(descriptor, left) :]
        seals = fcntl.F_SEAL_WRITE | fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW | fcntl.F_SEAL_SEAL
        fcntl.fcntl(descriptor, fcntl.F_ADD_SEALS, seals)
        return cls(descriptor, len(content), writable=False)

    def close(self) -> None:
        """Closes the descriptor; memory in use by NumPy stays mapped."""
        os.close(self.descriptor)

    def __reduce__(self) -> tuple[object, ...]:
        """Pickles the descriptor; only while a process is being started."""
        return _received, (DupFd(self.descriptor), self.size, self._writable)


def _received(descriptor: _Sent, size: int, writable: bool) -> SharedMemory:
    return SharedMemory(descriptor.detach(), size, writable=writable)


# Lock-free ring buffer in shared memory: one process writes, one reads.


_HEAD = struct.Struct("<QII")  # number from 1, length, checksum over both and the content
_CHECKED = struct.Struct("<QI")


class Ring:
    """Ring buffer of slots.

    A slot is valid when its checksum is right: a reader on another core never takes a half-written
    slot, in whatever order writes become visible.

    Attributes:
        lost: Slots that were overwritten before they were read.
    """

    def __init__(self, memory: SharedMemory, slots: int) -> None:
        """Uses initially zeroed memory; both sides give the same number of slots."""
        self._view = memory.view
        self._slots, self._slot_size = slots, memory.size // slots
        self._number = 0  # last one written or read, on this side
        self.lost = 0

    @staticmethod
    def size(content: int, slots: int) -> int:
        """Memory for slots of this content size, [bytes]."""
        return slots * (content + _HEAD.size)

    @property
    def largest_content(self) -> int:
        """Capacity of a slot, [bytes]."""
        return self._slot_size - _HEAD.size

    def put(self, content: bytes) -> None:
        """Writes the next slot.

        Raises:
            ValueError: The content does not fit.
        """
        if len(content) > self.largest_content:
            raise ValueError(f"{len(content)} bytes do not fit into a slot")
        self._number += 1
        at = self._offset(self._number)
        begin = at + _HEAD.size
        self._view[begin : begin + len(content)] = content
        checksum = _checksum(self._number, content)
        _HEAD.pack_into(self._view, at, self._number, len(content), checksum)

    def take(self) -> Iterator[bytes]:
        """Contents written since the last call, in order."""
        while True:
            at = self._offset(self._number + 1)
            number, length, checksum = _HEAD.unpack_from(self._view, at)
            if number <= self._number or length > self.largest_content:
                return
            begin = at + _HEAD.size
            content = bytes(self._view[begin : begin + length])
            if checksum != _checksum(number, content):
                return  # still being written
            self.lost += number - self._number - 1
            self._number = number
            yield content

    def _offset(self, number: int) -> int:
        return (number - 1) % self._slots * self._slot_size


def _checksum(number: int, content: bytes) -> int:
    return zlib.crc32(content, zlib.crc32(_CHECKED.pack(number, len(content))))


# Encoding of records and events in the rings.


_STATES = tuple(State)
_NUMBERS = {state: number for number, state in enumerate(_STATES)}
_NO_POSE = (math.nan,) * 7
#: Fields of a record after its state, as in the layout: a value each, then one per drive each.
_SCALARS = (
    "cycle", "at", "index", "rate", "missing", "rejected", "error_frames", "following_error",
    "lateness", "press",
)  # fmt: skip
_PER_DRIVE = ("targets", "actual", "torques", "words", "tension_known")
_scalars_of, _rows_of = attrgetter(*_SCALARS), attrgetter(*_PER_DRIVE)


class CycleRecordCodec:
    """Binary layout of a cycle record of a rig with m cables.

    Attributes:
        size: [bytes].
    """

    def __init__(self, cables: int) -> None:
        self._cables = cables
        self._layout = struct.Struct(f"<B Qd dd HQQ ddQ {4 * cables}i {cables}? 7d")
        self.size = self._layout.size

    def pack(self, record: CycleRecord, pose: Pose | None) -> bytes:
        """Encodes a record, and the simulated platform's pose if known."""
        pose_values = (*pose.position, *pose.quaternion) if pose is not None else _NO_POSE
        per_drive = chain.from_iterable(_rows_of(record))
        state = _NUMBERS[record.state]
        return self._layout.pack(state, *_scalars_of(record), *per_drive, *pose_values)

    def unpack(self, content: bytes) -> tuple[CycleRecord, Pose | None]:
        """The inverse of `pack`."""
        values = iter(self._layout.unpack(content))
        state = _STATES[next(values)]
        scalars = {name: next(values) for name in _SCALARS}
        rows: dict[str, Any] = {name: tuple(islice(values, self._cables)) for name in _PER_DRIVE}
        record = CycleRecord(state=state, **scalars, **rows)
        pose_values = tuple(values)
        if math.isnan(pose_values[0]):
            return record, None
        return record, Pose.from_quaternion(pose_values[:3], pose_values[3:])


def pack_event(event: LoopEvent, most: int) -> bytes:
    """Encodes an event within a number of bytes; cuts the middle of a long text."""
    text = event.text
    while len(content := json.dumps({**asdict(event), "text": text}).encode()) > most:
        keep = len(text) * 2 // 5
        text = f"{text[:keep]} … {text[len(text) - keep :]}"
    return content


def unpack_event(content: bytes) -> LoopEvent:
    """The inverse of `pack_event`."""
    return LoopEvent(**json.loads(content))


# Operator requests and both sides' heartbeats, in shared memory.


#: The supervisor counts as hung after this time without a heartbeat, [s].
SILENCE = 2.0

_BEATS, _LENGTH = struct.Struct("<Q"), struct.Struct("<H")
_LONGEST_TEXT = 400
_STOP, _HOLD, _PERCENT, _BEAT, _CYCLES, _TROUBLE = 0, 1, 2, 8, 16, 24
_REASON = _TROUBLE + _LENGTH.size + _LONGEST_TEXT
_SIZE = _REASON + _LENGTH.size + _LONGEST_TEXT


class SharedRequests:
    """The supervisor's side; a `RequestBoard`. Each request has its own byte."""

    def __init__(self) -> None:
        self.memory = SharedMemory.create(_SIZE)
        self.memory.view[_PERCENT] = 100
        self._beats = 0

    def ask_stop(self, for_what: StopReason | None = None) -> None:
        """See `RequestBoard`."""
        if for_what is not None and not self.memory.view[_STOP]:
            # Written before the stop, so that its reader has the reason.
            _write(self.memory, _REASON, f"{for_what.code} {for_what.text}")
        self.memory.view[_STOP] = 1

    def ask_hold(self, hold: bool) -> None:
        """See `RequestBoard`."""
        self.memory.view[_HOLD] = int(hold)

    def ask_speed(self, percent: int) -> None:
        """See `RequestBoard`."""
        self.memory.view[_PERCENT] = percent

    def read(self) -> OperatorRequests:
        """See `RequestBoard`."""
        return _read(self.memory)

    def close(self) -> None:
        """Closes the memory; other processes keep theirs."""
        self.memory.close()

    def beat(self) -> None:
        """Gives a heartbeat."""
        self._beats += 1
        _BEATS.pack_into(self.memory.view, _BEAT, self._beats)

    @property
    def cycles(self) -> int:
        """Cycles begun by the other process, recorded or not."""
        return int(_BEATS.unpack_from(self.memory.view, _CYCLES)[0])

    def complain(self, trouble: str) -> None:
        """Reports why the run can no longer be supervised; the first reason is kept."""
        if not _text(self.memory, _TROUBLE):
            _write(self.memory, _TROUBLE, trouble)


class Supervised:
    """The real-time process's side: requests, and whether the supervisor is alive."""

    def __init__(self, memory: SharedMemory, supervisor: int) -> None:
        """Monitors the process with this ID, this process's parent."""
        self._memory, self._supervisor = memory, supervisor
        self._stopped = False
        self._beats, self._heard, self._cycles = 0, time.monotonic(), 0

    def ask_stop(self) -> None:
        """Requests a stop on behalf of this process."""
        self._stopped = True

    def note_cycle(self) -> None:
        """Counts a cycle: this process's heartbeat."""
        self._cycles += 1
        _BEATS.pack_into(self._memory.view, _CYCLES, self._cycles)

    def read(self) -> OperatorRequests:
        """Present requests, with `lost` if the supervisor is gone."""
        requests = _read(self._memory)
        return replace(requests, stop=requests.stop or self._stopped, lost=self._lost())

    def _lost(self) -> str:
        beats = _BEATS.unpack_from(self._memory.view, _BEAT)[0]
        now = time.monotonic()
        if beats != self._beats:
            self._beats, self._heard = beats, now
        if os.getppid() != self._supervisor:
            return "the supervising process has ended"
        if now - self._heard > SILENCE:
            return f"the supervising process was silent for {SILENCE:g} s"
        return _text(self._memory, _TROUBLE)


def _read(memory: SharedMemory) -> OperatorRequests:
    view = memory.view
    stop, hold = bool(view[_STOP]), bool(view[_HOLD])
    code, _, text = (_text(memory, _REASON) if stop else "").partition(" ")
    for_what = StopReason(code, text) if code else None
    return OperatorRequests(stop, hold, view[_PERCENT] / 100.0, for_what=for_what)


def _write(memory: SharedMemory, offset: int, text: str) -> None:
    content = text.encode()[:_LONGEST_TEXT]
    begin = offset + _LENGTH.size
    memory.view[begin : begin + len(content)] = content
    _LENGTH.pack_into(memory.view, offset, len(content))  # last: no text is read half-written


def _text(memory: SharedMemory, offset: int) -> str:
    length = _LENGTH.unpack_from(memory.view, offset)[0]
    begin = offset + _LENGTH.size
    return bytes(memory.view[begin : begin + length]).decode(errors="replace")
