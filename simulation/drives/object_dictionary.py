"""The object dictionary of a simulated drive: what it has, what it starts with, what it refuses."""

from __future__ import annotations

import heapq
import struct
from collections.abc import Callable, Iterable
from itertools import count
from math import inf

from simulation.drives.behaviour import STRICT, DriveBehaviour
from simulation.drives.eds_file import Eds, Key, ObjectDescription

NO_DUPLICATE_CONSUMER = 0x06040043
NOT_MAPPABLE = 0x06040041
PDO_TOO_LONG = 0x06040042
UNSUPPORTED_ACCESS = 0x06010000
WRITE_ONLY = 0x06010001
READ_ONLY = 0x06010002
NOT_THERE = 0x06020000
WRONG_LENGTH = 0x06070010
NO_SUB_INDEX = 0x06090011
OUT_OF_RANGE = 0x06090030
NOT_IN_THIS_STATE = 0x08000022

DEVICE_NAME = b"cdpr simulated drive"

_SIMULATED = {
    (0x1008, 0): DEVICE_NAME,
    (0x1009, 0): b"none",
    (0x100A, 0): b"simulation",
}
"""Whatever the EDS file says: a simulated drive must not pass for the maker's."""


class Abort(Exception):
    """An SDO transfer ends with this abort code."""

    def __init__(self, code: int) -> None:
        super().__init__(f"SDO abort {code:08X}h")
        self.code = code


class DriveObjects:
    """Values of a drive's objects, as its EDS file describes them.

    Attributes:
        refusals: Abort code by object, for drives that refuse something (tests set it).
        stuck: Objects that take a value and do not keep it (tests set it).
        judge: Abort code of a write that the drive does not take now; 0 where it does.
        changed: Called after an object has another value.
    """

    def __init__(self, eds: Eds, node: int, behaviour: DriveBehaviour = STRICT) -> None:
        """Starts with the values a drive has when it is switched on."""
        self.refusals: dict[Key, int] = {}
        self.stuck: set[Key] = set()
        self.judge: Callable[[Key, int], int] = lambda _key, _value: 0
        self.changed: Callable[[Key, int], None] = lambda _key, _value: None
        self._eds, self._node = eds, node
        self._behaviour = behaviour
        self._readers: dict[Key, Callable[[], int]] = {}
        self._described = eds.objects
        if behaviour.absent:
            self._described = {k: o for k, o in eds.objects.items() if not _absence(k, behaviour)}
        self._values: dict[Key, int | bytes] = {}
        self._restore(range(0x10000))

    def restore_communication(self) -> None:
        """The communication profile area (1000h to 1FFFh) as after switching on."""
        self._restore(range(0x1000, 0x2000))

    def __getitem__(self, key: Key) -> int:
        """The value of an object that is a number."""
        value = self._values[key]
        assert isinstance(value, int)
        return value

    def __setitem__(self, key: Key, value: int) -> None:
        """Sets a value from inside the drive; no check."""
        if key not in self._described:
            raise KeyError(f"{key[0]:04X}h:{key[1]:02X}")
        self._values[key] = value
        self.changed(key, value)

    def __contains__(self, key: object) -> bool:
        """Whether the drive has an object."""
        return key in self._described

    def get(self, key: Key, without: int) -> int:
        """The value of an object, or another where the drive has not got it."""
        return self[key] if key in self._described else without

    def keep(self, keys: Iterable[Key], values: Iterable[int]) -> None:
        """Values that came in process data."""
        self._values.update(zip(keys, values, strict=True))

    def indices(self) -> list[int]:
        """Of all objects that the drive has, in the order of the EDS file."""
        return list(dict.fromkeys(index for index, _ in self._described))

    def note(self, key: Key, value: int) -> None:
        """Keeps what the drive itself reports, if it has the object."""
        if key in self._described:
            self._values[key] = value

    def values(self) -> dict[Key, int | bytes]:
        """All values as they are kept now."""
        return dict(self._values)

    def subs(self, index: int) -> list[int]:
        """Sub-indices of an object that the drive has."""
        return [sub for i, sub in self._described if i == index]

    def described(self, key: Key) -> ObjectDescription | None:
        """What the EDS file says about an object; None where the drive has not got it."""
        return self._described.get(key)

    def is_dummy(self, index: int) -> bool:
        """Whether a data type may fill gaps of an RPDO."""
        return index in self._eds.dummies

    def measured(self, index: int, sub: int, read: Callable[[], int]) -> None:
        """Makes an object show a value of the moment."""
        self._readers[index, sub] = read
        self.changed((index, sub), 0)

    def reader(self, key: Key) -> Callable[[], int]:
        """What reads an object that is a number."""
        return self._readers.get(key) or (lambda: self[key])

    def get_data(self, index: int, sub: int) -> bytes:
        """What an SDO upload gives.

        Raises:
            Abort: There is no such object, or it cannot be read.
        """
        key = index, sub
        if key in _SIMULATED and key not in self.refusals:
            return _SIMULATED[key]
        described = self._find(key)
        if not described.readable:
            raise Abort(WRITE_ONLY)
        reader = self._readers.get(key)
        value = reader() if reader else self._values[key]
        if isinstance(value, bytes):
            return value
        value &= (1 << 8 * described.length) - 1
        return value.to_bytes(described.length, "little")

    def set_data(self, index: int, sub: int, data: bytes) -> None:
        """Takes an SDO download.

        Raises:
            Abort: The object is not there, is read-only, has another length, or may not have this
                value now.
        """
        key = index, sub
        described = self._find(key)
        if not described.writable:
            raise Abort(READ_ONLY)
        if not described.length:
            self._values[key] = bytes(data)
            return
        if len(data) != described.length:
            raise Abort(WRONG_LENGTH)
        value = int.from_bytes(data, "little", signed=described.signed)
        refused = self._out_of_range(key, value, described) or self.judge(key, value)
        if refused:
            raise Abort(refused)
        if key not in self.stuck:
            self._values[key] = value
            self.changed(key, value)

    def _out_of_range(self, key: Key, value: int, described: ObjectDescription) -> int:
        low, high = self._behaviour.ranges.get(key, (described.low, described.high))
        inside = (low is None or value >= low) and (high is None or value <= high)
        return 0 if inside else OUT_OF_RANGE

    def _find(self, key: Key) -> ObjectDescription:
        if key in self.refusals:
            raise Abort(self.refusals[key])
        described = self._described.get(key)
        if described is None:
            known = any(index == key[0] for index, _ in self._described)
            absent = _absence(key, self._behaviour)
            raise Abort(absent or (NO_SUB_INDEX if known else NOT_THERE))
        return described

    def _restore(self, indices: range) -> None:
        for key, described in self._described.items():
            if key[0] in indices:
                default = described.default
                if described.of_node and isinstance(default, int):
                    default += self._node
                self._values[key] = default


def _absence(key: Key, behaviour: DriveBehaviour) -> int:
    """Abort code of an object that the drive has not got; 0 where nothing is said about it."""
    index, sub = key
    return behaviour.absent.get((index, sub)) or behaviour.absent.get((index, None), 0)


# The SDO server of a simulated drive; its answers may come late, twice or never.
#
# Source: CiA 301 (4.2), 7.2.4: expedited and segmented transfers, abort codes. It knows no block
# transfers, which a server need not.


TOGGLE_NOT_ALTERNATED = 0x05030000
UNKNOWN_COMMAND = 0x05040001
OUT_OF_MEMORY = 0x05040005

LATE_EVERY = 7
LONGEST_DOWNLOAD = 1024

_HEAD = struct.Struct("<BHB")


class SdoServer:
    """Answers requests of 8 bytes.

    Attributes:
        next_due: When the next answer goes out, [s]; infinity while none waits.
    """

    def __init__(
        self, objects: DriveObjects, behaviour: DriveBehaviour, send: Callable[[bytes], None]
    ) -> None:
        """Serves a drive's objects; ``send`` puts an answer on the bus."""
        self._objects, self._behaviour, self._send = objects, behaviour, send
        self._key = 0, 0
        self._upload: bytes | None = None
        self._download: bytearray | None = None
        self._toggle = 0
        self._answers = 0
        self._queue: list[tuple[float, int, bytes]] = []
        self._order = count()
        self.next_due = inf

    def deliver(self, now: float) -> None:
        """Sends the answers that are due by now."""
        while self._queue and self._queue[0][0] <= now + 1e-9:
            self._send(heapq.heappop(self._queue)[2])
        self.next_due = self._queue[0][0] if self._queue else inf

    def on_request(self, data: bytes, now: float) -> None:
        """Works off one request; its answer goes out at once or by `deliver`."""
        try:
            answer = self._answer(data)
        except Abort as abort:
            self._upload = self._download = None
            answer = _HEAD.pack(0x80, *self._key) + abort.code.to_bytes(4, "little")
        if answer is not None:
            self._reply(answer.ljust(8, b"\0"), now)

    def _reply(self, answer: bytes, now: float) -> None:
        """Late, twice or not at all, as the behaviour says."""
        behaviour = self._behaviour
        self._answers += 1
        if behaviour.sdo_lost and self._answers % behaviour.sdo_lost == 0:
            return
        due = now + behaviour.sdo_delay
        if self._answers % LATE_EVERY == 0:
            due += behaviour.sdo_late
        times = [due] if behaviour.sdo_twice is None else [due, due + behaviour.sdo_twice]
        for time in times:
            heapq.heappush(self._queue, (time, next(self._order), answer))
        self.deliver(now)

    def _answer(self, data: bytes) -> bytes | None:
        command = data[0]
        kind = command >> 5
        if kind in (0, 3):  # segments
            return self._take_segment(command, data) if kind == 0 else self._give_segment(command)
        _, index, sub = _HEAD.unpack_from(data)
        self._key = index, sub
        self._upload = self._download = None
        if kind == 1:
            return self._begin_download(command, data)
        if kind == 2:
            return self._begin_upload()
        if kind == 4:  # the client gave up
            return None
        raise Abort(UNKNOWN_COMMAND)

    def _begin_upload(self) -> bytes:
        value = self._objects.get_data(*self._key)
        if 0 < len(value) <= 4:
            return _HEAD.pack(0x43 | (4 - len(value)) << 2, *self._key) + value
        self._upload, self._toggle = value, 0
        return _HEAD.pack(0x41, *self._key) + len(value).to_bytes(4, "little")

    def _give_segment(self, command: int) -> bytes:
        if self._upload is None:
            raise Abort(UNKNOWN_COMMAND)
        self._check_toggle(command)
        part, rest = self._upload[:7], self._upload[7:]
        answer = bytes((self._toggle | (7 - len(part)) << 1 | (not rest),)) + part
        self._upload, self._toggle = rest or None, self._toggle ^ 0x10
        return answer

    def _begin_download(self, command: int, data: bytes) -> bytes:
        if command & 0x02:
            length = 4 - (command >> 2 & 3) if command & 0x01 else 4
            self._objects.set_data(*self._key, bytes(data[4 : 4 + length]))
        else:
            length = int.from_bytes(data[4:8], "little") if command & 0x01 else 0
            if length > LONGEST_DOWNLOAD:
                raise Abort(OUT_OF_MEMORY)
            self._download, self._toggle = bytearray(), 0
        return _HEAD.pack(0x60, *self._key)

    def _take_segment(self, command: int, data: bytes) -> bytes:
        if self._download is None:
            raise Abort(UNKNOWN_COMMAND)
        self._check_toggle(command)
        self._download += data[1 : 8 - (command >> 1 & 7)]
        if len(self._download) > LONGEST_DOWNLOAD:
            raise Abort(WRONG_LENGTH)
        if command & 0x01:
            taken, self._download = bytes(self._download), None
            self._objects.set_data(*self._key, taken)
        answer = bytes((0x20 | self._toggle,))
        self._toggle ^= 0x10
        return answer

    def _check_toggle(self, command: int) -> None:
        if command & 0x10 != self._toggle:
            raise Abort(TOGGLE_NOT_ALTERNATED)
