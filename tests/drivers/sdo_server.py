"""A bus of scripted SDO servers in simulated time: drives as an EDS file describes them."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable
from functools import lru_cache
from pathlib import Path

import can
import canopen
from canopen.objectdictionary import ODVariable

import simulation

EDS = Path(simulation.__file__).parent / "drives" / "eds"
STANDARD = EDS / "cia402.eds"
FORMS = {2: "<b", 3: "<h", 4: "<i", 5: "<B", 6: "<H", 7: "<I"}
ABSENT, NO_SUB, READ_ONLY = 0x06020000, 0x06090011, 0x06010002
TOO_HIGH, TOO_LOW, CROSSED = 0x06090031, 0x06090032, 0x06090036

Key = tuple[int, int]
Times = Callable[[int, Key], Iterable[float]]
"""When a node answers a request for an object: one time for each answer, [s] after the request."""


def at_once(_node: int, _key: Key) -> Iterable[float]:
    return (0.001,)


def eds_of(profile: str) -> Path:
    return EDS / f"{profile}.eds"


@lru_cache(maxsize=64)
def _dictionary(eds: Path, node: int) -> canopen.ObjectDictionary:
    """Read-only, as each drive stores its values separately."""
    return canopen.import_od(str(eds), node)


class ScriptedDrive:
    """Objects of one drive, with the access and the limits of its EDS file."""

    def __init__(self, node: int, eds: Path) -> None:
        dictionary = _dictionary(eds, node)
        self.node = node
        self.objects: dict[Key, ODVariable] = {}
        for index, entry in dictionary.items():
            if isinstance(entry, ODVariable):
                self.objects[index, 0] = entry
            else:
                self.objects |= {(index, sub): entry[sub] for sub in entry.subindices}
        self.values: dict[Key, int] = {key: od.default or 0 for key, od in self.objects.items()}
        self.aborts: dict[Key, int] = {}
        self.keeps: dict[Key, int] = {}  # kept whatever is written
        self.values[0x6041, 0] = 0x0240
        self.mode_late = 0  # times that 6061h still shows the old mode

    def form(self, key: Key) -> str:
        return FORMS[self.objects[key].data_type]

    def refusal(self, key: Key) -> int:
        if key in self.aborts:
            return self.aborts[key]
        if key in self.objects:
            return 0
        return NO_SUB if any(index == key[0] for index, _ in self.objects) else ABSENT

    def answer(self, request: bytes) -> bytes:
        command, index, sub = struct.unpack_from("<BHB", request)
        key = index, sub
        code = self.refusal(key)
        if not code and command != 0x40:
            code = self._write(key, request[4 : 8 - (command >> 2 & 3)])
        if code:
            return struct.pack("<BHBI", 0x80, index, sub, code)
        if command != 0x40:
            return struct.pack("<BHBI", 0x60, index, sub, 0)
        is_text = self.objects[key].data_type == canopen.objectdictionary.VISIBLE_STRING
        data = b"EDS" if is_text else struct.pack(self.form(key), self._value(key))
        return struct.pack("<BHB", 0x43 | (4 - len(data)) << 2, index, sub) + data.ljust(4, b"\0")

    def _value(self, key: Key) -> int:
        if key == (0x6061, 0):
            if self.mode_late > 0:
                self.mode_late -= 1
                return 0
            return self.values[0x6060, 0]
        return self.values[key]

    def _write(self, key: Key, data: bytes) -> int:
        entry = self.objects[key]
        if entry.access_type == "ro":
            return READ_ONLY
        (value,) = struct.unpack(self.form(key), data)
        if entry.max is not None and value > entry.max:
            return TOO_HIGH
        if entry.min is not None and value < entry.min:
            return TOO_LOW
        if key[0] == 0x607D:
            low, high = (value if sub == key[1] else self.values[0x607D, sub] for sub in (1, 2))
            if low > high:
                return CROSSED
        if key in ((0x1400, 1), (0x1800, 1)):
            value &= ~(1 << 30)  # a drive may keep bit 30 or not
        self.values[key] = self.keeps.get(key, value)
        return 0


class ScriptedBus:
    """The bus interface that `SetupNetwork` needs; time advances only during waits."""

    channel_info = "scripted"

    def __init__(self, drives: Iterable[ScriptedDrive], times: Times = at_once) -> None:
        self.drives = {drive.node: drive for drive in drives}
        self.times, self.now = times, 0.0
        self.sent: list[can.Message] = []
        self.coming: list[tuple[float, can.Message]] = []
        self.stopped: set[int] = set()  # in this NMT state a node answers no SDO

    def clock(self) -> float:
        return self.now

    def send(self, message: can.Message) -> None:
        self.sent.append(message)
        if message.arbitration_id == 0 and message.data[0] == 0x80:
            self.stopped.discard(message.data[1])
        drive = self.drives.get(message.arbitration_id - 0x600)
        if drive is None:
            return
        if drive.node in self.stopped:
            self._receive(0.02, 0x700 + drive.node, b"\x04")
            return
        request = bytes(message.data)
        reply = drive.answer(request)
        key = struct.unpack_from("<HB", request, 1)
        for delay in self.times(drive.node, key):
            self.later(delay, drive.node, reply)

    def later(self, delay: float, node: int, data: bytes) -> None:
        self._receive(delay, 0x580 + node, data)

    def _receive(self, delay: float, identifier: int, data: bytes) -> None:
        message = can.Message(arbitration_id=identifier, data=data, is_extended_id=False)
        self.coming.append((self.now + delay, message))
        self.coming.sort(key=lambda each: each[0])

    def recv(self, timeout: float | None) -> can.Message | None:
        end = self.now + (timeout or 0.0)
        if self.coming and self.coming[0][0] <= end:
            at, message = self.coming.pop(0)
            self.now = max(self.now, at)
            return message
        self.now = end
        return None


def downloads(bus: ScriptedBus) -> list[can.Message]:
    """Requests that would change an object."""
    return [m for m in bus.sent if m.arbitration_id > 0x600 and m.data[0] & 0xE0 == 0x20]
