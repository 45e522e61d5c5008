"""A ring of slots in shared memory: one process writes, one reads, and neither waits."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator

from executor.shared_memory import SharedMemory

_HEAD = struct.Struct("<QII")  # number from 1, length, checksum over both and the content
_CHECKED = struct.Struct("<QI")


class Ring:
    """Slots that are written round and round.

    A slot counts when its checksum is right, so that a reader on another core never takes half a
    slot for a whole one, whatever the order in which writes become visible there.

    Attributes:
        lost: Slots that were written over before they were read.
    """

    def __init__(self, memory: SharedMemory, slots: int) -> None:
        """Lays a ring over memory that was empty at first; both sides with the same count."""
        self._view = memory.view
        self._slots, self._slot_size = slots, memory.size // slots
        self._number = 0  # last one written or read, on this side
        self.lost = 0

    @staticmethod
    def size(content: int, slots: int) -> int:
        """Memory for slots of so much content, [bytes]."""
        return slots * (content + _HEAD.size)

    @property
    def largest_content(self) -> int:
        """What fits into a slot, [bytes]."""
        return self._slot_size - _HEAD.size

    def put(self, content: bytes) -> None:
        """Writes the next slot.

        Raises:
            ValueError: It does not fit.
        """
        if len(content) > self.largest_content:
            raise ValueError(f"{len(content)} bytes do not fit into a slot")
        self._number += 1
        at = self._place(self._number)
        begin = at + _HEAD.size
        self._view[begin : begin + len(content)] = content
        checksum = _checksum(self._number, content)
        _HEAD.pack_into(self._view, at, self._number, len(content), checksum)

    def take(self) -> Iterator[bytes]:
        """What was written since the last call, in order."""
        while True:
            at = self._place(self._number + 1)
            number, length, checksum = _HEAD.unpack_from(self._view, at)
            if number <= self._number or length > self.largest_content:
                return
            begin = at + _HEAD.size
            content = bytes(self._view[begin : begin + length])
            if checksum != _checksum(number, content):
                return  # being written just now
            self.lost += number - self._number - 1
            self._number = number
            yield content

    def _place(self, number: int) -> int:
        return (number - 1) % self._slots * self._slot_size


def _checksum(number: int, content: bytes) -> int:
    return zlib.crc32(content, zlib.crc32(_CHECKED.pack(number, len(content))))
