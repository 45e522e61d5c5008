"""The object dictionary of a simulated drive: what it has, what it starts with, what it refuses."""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass

import canopen

Key = tuple[int, int]

NOT_THERE = 0x06020000
NO_SUB_INDEX = 0x06090011
READ_ONLY = 0x06010002
WRONG_LENGTH = 0x06070010
OUT_OF_RANGE = 0x06090030
PDO_IS_ON = 0x06010000

PDO_OFF = 0x80000000


@dataclass(slots=True)
class _Entry:
    form: str
    value: int
    writable: bool


class DriveObjects:
    """Values of a drive's objects, behind canopen's SDO server.

    Attributes:
        refusals: Abort code by object, for drives that refuse something (tests set it).
        stuck: Objects that take a value and do not keep it (tests set it).
    """

    def __init__(self, node: int) -> None:
        """Starts with the values a drive has when it is switched on."""
        # canopen's server asks its node for a dictionary; the values are kept here instead.
        self.object_dictionary = canopen.ObjectDictionary()  # type: ignore[no-untyped-call]
        self.refusals: dict[Key, int] = {}
        self.stuck: set[Key] = set()
        self._readers: dict[Key, Callable[[], int]] = {}
        self._entries: dict[Key, _Entry] = {}
        for (index, sub), form, value, writable in _defaults(node):
            self._entries[index, sub] = _Entry(form, value, writable)

    def __getitem__(self, key: Key) -> int:
        """The value of an object."""
        return self._entries[key].value

    def __setitem__(self, key: Key, value: int) -> None:
        """Sets a value from inside the drive; no check."""
        self._entries[key].value = value

    def measured(self, index: int, sub: int, read: Callable[[], int]) -> None:
        """Makes an object tell a value of the moment."""
        self._readers[index, sub] = read

    def get_data(self, index: int, subindex: int, check_readable: bool = False) -> bytes:
        """What an SDO upload gives.

        Raises:
            canopen.SdoAbortedError: There is no such object.
        """
        entry = self._find((index, subindex))
        reader = self._readers.get((index, subindex))
        return struct.pack(entry.form, reader() if reader else entry.value)

    def set_data(
        self, index: int, subindex: int, data: bytes, check_writable: bool = False
    ) -> None:
        """Takes an SDO download.

        Raises:
            canopen.SdoAbortedError: The object is not there, is read-only, has another length, or
                may not have this value now.
        """
        key = index, subindex
        entry = self._find(key)
        if not entry.writable:
            raise canopen.SdoAbortedError(READ_ONLY)
        if len(data) != struct.calcsize(entry.form):
            raise canopen.SdoAbortedError(WRONG_LENGTH)
        (value,) = struct.unpack(entry.form, data)
        self._check(key, value)
        if key not in self.stuck:
            entry.value = value

    def _find(self, key: Key) -> _Entry:
        if key in self.refusals:
            raise canopen.SdoAbortedError(self.refusals[key])
        entry = self._entries.get(key)
        if entry is None:
            known = any(index == key[0] for index, _ in self._entries)
            raise canopen.SdoAbortedError(NO_SUB_INDEX if known else NOT_THERE)
        return entry

    def _check(self, key: Key, value: int) -> None:
        """A PDO is mapped only while it is off, and its mapping only while it counts none."""
        index, sub = key
        if index in (0x1600, 0x1A00):
            off = self[index - 0x200, 1] & PDO_OFF
            if not off or (sub > 0 and self[index, 0] != 0):
                raise canopen.SdoAbortedError(PDO_IS_ON)
        if key in ((0x60C2, 1), (0x6085, 0)) and value == 0:
            raise canopen.SdoAbortedError(OUT_OF_RANGE)


def _defaults(node: int) -> list[tuple[Key, str, int, bool]]:
    return [
        *_communication(node),
        *_drive_profile(),
        *(((0x1016, sub), "<I", 0, True) for sub in range(1, 9)),
    ]


def _communication(node: int) -> list[tuple[Key, str, int, bool]]:
    return [
        ((0x1000, 0), "<I", 0x00020192, False),  # servo drive, CiA 402
        ((0x1001, 0), "<B", 0, False),
        ((0x1006, 0), "<I", 0, True),
        ((0x1007, 0), "<I", 0, True),
        ((0x1016, 0), "<B", 8, False),
        ((0x1017, 0), "<H", 0, True),
        ((0x1018, 0), "<B", 4, False),
        ((0x1018, 1), "<I", 0, False),
        ((0x1018, 2), "<I", 0, False),
        ((0x1018, 3), "<I", 0, False),
        ((0x1018, 4), "<I", node, False),
        ((0x1029, 0), "<B", 1, False),
        ((0x1029, 1), "<B", 0, True),
        ((0x1400, 0), "<B", 5, False),
        ((0x1400, 1), "<I", 0x200 + node, True),
        ((0x1400, 2), "<B", 255, True),
        ((0x1400, 5), "<H", 0, True),
        ((0x1401, 0), "<B", 2, False),
        ((0x1401, 1), "<I", 0x300 + node, True),
        ((0x1401, 2), "<B", 255, True),
        ((0x1600, 0), "<B", 1, True),
        ((0x1600, 1), "<I", 0x60400010, True),
        ((0x1600, 2), "<I", 0, True),
        ((0x1600, 3), "<I", 0, True),
        ((0x1800, 0), "<B", 2, False),
        ((0x1800, 1), "<I", 0x40000180 + node, True),
        ((0x1800, 2), "<B", 255, True),
        ((0x1801, 0), "<B", 2, False),
        ((0x1801, 1), "<I", 0x40000280 + node, True),
        ((0x1801, 2), "<B", 255, True),
        ((0x1A00, 0), "<B", 1, True),
        ((0x1A00, 1), "<I", 0x60410010, True),
        ((0x1A00, 2), "<I", 0, True),
        ((0x1A00, 3), "<I", 0, True),
    ]


def _drive_profile() -> list[tuple[Key, str, int, bool]]:
    return [
        ((0x6007, 0), "<h", 1, True),
        ((0x603F, 0), "<H", 0, False),
        ((0x6040, 0), "<H", 0, True),
        ((0x6041, 0), "<H", 0, False),
        ((0x605A, 0), "<h", 2, True),
        ((0x605C, 0), "<h", 1, True),
        ((0x605E, 0), "<h", 2, True),
        ((0x6060, 0), "<b", 0, True),
        ((0x6061, 0), "<b", 0, False),
        ((0x6064, 0), "<i", 0, False),
        ((0x6065, 0), "<I", 0xFFFFFFFF, True),
        ((0x6066, 0), "<H", 0, True),
        ((0x6072, 0), "<H", 1000, True),
        ((0x6077, 0), "<h", 0, False),
        ((0x607A, 0), "<i", 0, True),
        ((0x607D, 0), "<B", 2, False),
        ((0x607D, 1), "<i", -(2**31), True),
        ((0x607D, 2), "<i", 2**31 - 1, True),
        ((0x6085, 0), "<I", 1_000_000, True),
        ((0x60B2, 0), "<h", 0, True),
        ((0x60C2, 0), "<B", 2, False),
        ((0x60C2, 1), "<B", 1, True),
        ((0x60C2, 2), "<b", -3, True),
        ((0x6502, 0), "<I", 0x80, False),  # cyclic synchronous position
    ]
