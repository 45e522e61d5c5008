"""Process data of a simulated drive: checks of parameter writes, and frames by current mapping.

Source: CiA 301 (4.2), 7.5.2.35 to 7.5.2.38: PDO communication and mapping parameters.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Hashable
from dataclasses import dataclass
from math import inf

from simulation.drives.eds_file import Key
from simulation.drives.object_dictionary import (
    NOT_IN_THIS_STATE,
    NOT_MAPPABLE,
    OUT_OF_RANGE,
    PDO_TOO_LONG,
    UNSUPPORTED_ACCESS,
    DriveObjects,
)

CONTROL_WORD, TARGET, MODE = (0x6040, 0), (0x607A, 0), (0x6060, 0)
ACTING = frozenset({CONTROL_WORD, TARGET, MODE})

PDO_OFF = 1 << 31

LONG_ID = 1 << 29
ID_BITS = 0x7FF
FIXED_WHILE_VALID = 0x3FFFFFFF
MOST_BITS = 64
LAST_SYNC_TYPE = 240

PDO_OBJECTS = range(0x1400, 0x1C00)
RPDO, RPDO_MAP, TPDO, TPDO_MAP = (range(b, b + 0x200) for b in (0x1400, 0x1600, 0x1800, 0x1A00))

_LETTERS = {1: "b", 2: "h", 4: "i", 8: "q"}
_RESTRICTED = (
    *((0x000, 0x080), (0x101, 0x180), (0x581, 0x5FF), (0x601, 0x67F), (0x6E0, 0x6FF)),
    (0x701, 0x7FF),
)


@dataclass(frozen=True, slots=True)
class ReceivePdo:
    """A valid RPDO.

    Attributes:
        number: From 0.
        synchronous: Its data take effect at the next SYNC.
        keys: Mapped objects, in order.
        acting: Index and key of objects that take effect at once, the control word last.
        form: Packing of the values.
        deadline: 1400h:05, [s]; 0 for none.
    """

    number: int
    synchronous: bool
    keys: tuple[Key, ...]
    acting: tuple[tuple[int, Key], ...]
    form: struct.Struct
    deadline: float


@dataclass(slots=True)
class TransmitPdo:
    """A valid synchronous TPDO.

    Attributes:
        can_id: Of its frame.
        every: Number of SYNCs per frame.
        readers: Of its objects, in order.
        form: Packing of the values.
        seen: SYNCs since the last frame.
    """

    can_id: int
    every: int
    readers: tuple[Callable[[], int], ...]
    form: struct.Struct
    seen: int = 0

    def is_due(self) -> bool:
        """Whether it is sent at this SYNC."""
        self.seen += 1
        if self.seen < self.every:
            return False
        self.seen = 0
        return True


class ProcessData:
    """The PDOs of one drive.

    Attributes:
        received: Valid RPDOs by identifier.
        sent: Valid synchronous TPDOs.
    """

    def __init__(self, objects: DriveObjects) -> None:
        """Reads communication and mapping parameters from the drive's objects."""
        self._objects = objects
        indices = objects.indices()
        self._rpdos = [i for i in indices if i in RPDO]
        self._tpdos = [i for i in indices if i in TPDO]
        self.rebuild()

    def rebuild(self) -> None:
        """Rebuilds the PDOs after a change of parameters."""
        received, sent = (filter(self._is_valid, each) for each in (self._rpdos, self._tpdos))
        self.received = {self._objects[i, 1] & ID_BITS: self._receive_pdo(i) for i in received}
        self.sent = [self._transmit_pdo(i) for i in sent if self._kind(i) <= LAST_SYNC_TYPE]

    def refused(self, key: Key, value: int, *, may_map: bool) -> int:
        """Abort code of a write to a parameter; 0 to accept it.

        Args:
            may_map: The NMT state allows mapping.
        """
        index, sub = key
        if index in RPDO or index in TPDO:
            return self._communication_refused(index, sub, value)
        if not may_map:
            return NOT_IN_THIS_STATE
        if self._is_valid(index - 0x200) or (sub > 0 and self._objects[index, 0] != 0):
            return UNSUPPORTED_ACCESS
        if sub == 0:
            return self._count_refused(index, value)
        return 0 if value == 0 or self._fits(index, value) else NOT_MAPPABLE

    def _communication_refused(self, index: int, sub: int, value: int) -> int:
        valid = self._is_valid(index)
        if sub == 1:
            kept = self._objects[index, 1]
            changed = (kept ^ value) & (FIXED_WHILE_VALID if index in TPDO else ID_BITS | LONG_ID)
            stays_valid = valid and not value & PDO_OFF
            bad_id = value & FIXED_WHILE_VALID & ~ID_BITS or (
                not value & PDO_OFF and _is_restricted(value & ID_BITS)
            )
            return OUT_OF_RANGE if bad_id or (stays_valid and changed) else 0
        if sub == 2 and LAST_SYNC_TYPE < value < 254:
            return OUT_OF_RANGE  # reserved, or on remote request, which is not supported
        if sub in (3, 6) and valid and index in TPDO:
            return OUT_OF_RANGE  # inhibit time, SYNC start value
        return 0

    def _count_refused(self, index: int, count: int) -> int:
        entries = [self._objects.get((index, sub), 0) for sub in range(1, count + 1)]
        if any((index, sub) not in self._objects for sub in range(1, count + 1)):
            return PDO_TOO_LONG
        if sum(entry & 0xFF for entry in entries) > MOST_BITS:
            return PDO_TOO_LONG
        return 0 if all(self._fits(index, entry) for entry in entries) else NOT_MAPPABLE

    def _fits(self, index: int, entry: int) -> bool:
        """Whether an object can be mapped with the stated length."""
        key, bits = (entry >> 16, entry >> 8 & 0xFF), entry & 0xFF
        if index in RPDO_MAP and key[1] == 0 and self._objects.is_dummy(key[0]):
            return bits in (8, 16, 32)
        described = self._objects.described(key)
        if described is None or described.length not in _LETTERS or bits != 8 * described.length:
            return False
        return described.to_rpdo if index in RPDO_MAP else described.to_tpdo

    def _is_valid(self, index: int) -> bool:
        return (index, 1) in self._objects and not self._objects[index, 1] & PDO_OFF

    def _kind(self, index: int) -> int:
        """Transmission type."""
        return self._objects.get((index, 2), 255)

    def _receive_pdo(self, index: int) -> ReceivePdo:
        keys, form = self._mapped(index + 0x200)
        deadline = self._objects.get((index, 5), 0) / 1000.0
        acting = sorted(
            ((at, key) for at, key in enumerate(keys) if key in ACTING),
            key=lambda one: one[1] == CONTROL_WORD,
        )
        synchronous = self._kind(index) <= LAST_SYNC_TYPE
        return ReceivePdo(index - 0x1400, synchronous, keys, tuple(acting), form, deadline)

    def _transmit_pdo(self, index: int) -> TransmitPdo:
        keys, form = self._mapped(index + 0x200)
        readers = tuple(self._objects.reader(key) for key in keys)
        can_id = self._objects[index, 1] & ID_BITS
        return TransmitPdo(can_id, max(1, self._kind(index)), readers, form)

    def _mapped(self, index: int) -> tuple[tuple[Key, ...], struct.Struct]:
        keys, letters = [], ""
        for sub in range(1, self._objects.get((index, 0), 0) + 1):
            entry = self._objects.get((index, sub), 0)
            key = entry >> 16, entry >> 8 & 0xFF
            described = self._objects.described(key)
            letter = _LETTERS.get((entry & 0xFF) // 8)
            if letter is None or not (described or self._objects.is_dummy(key[0])):
                continue  # an invalid default of the EDS file
            keys.append(key)
            letters += letter if described and described.signed else letter.upper()
        return tuple(keys), struct.Struct("<" + letters)


def _is_restricted(can_id: int) -> bool:
    """Whether CiA 301 reserves an identifier (table "restricted CAN-IDs")."""
    return any(low <= can_id <= high for low, high in _RESTRICTED)


# Deadlines of a simulated drive.


TOLERANCE = 1e-9


class Deadlines:
    """Times [s] by event; checking is cheap as long as none has passed."""

    def __init__(self) -> None:
        self._due: dict[Hashable, float] = {}
        self.earliest = inf

    def __contains__(self, what: object) -> bool:
        """Whether an event has a deadline."""
        return what in self._due

    def expect(self, what: Hashable, due: float) -> None:
        """Sets or replaces the deadline of an event."""
        self._due[what] = due
        if due < self.earliest:
            self.earliest = due

    def forget(self, what: Hashable) -> None:
        """Removes a deadline."""
        self._due.pop(what, None)

    def kept(self) -> list[Hashable]:
        """All events with a deadline."""
        return list(self._due)

    def passed(self, now: float) -> list[Hashable]:
        """Removes and returns the events that are overdue."""
        gone = [what for what, due in self._due.items() if now > due + TOLERANCE]
        for what in gone:
            del self._due[what]
        self.earliest = min(self._due.values(), default=inf)
        return gone
