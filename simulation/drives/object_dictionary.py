"""The object dictionary of a simulated drive: objects, defaults, refusals."""

from __future__ import annotations

import heapq
import struct
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from itertools import count
from math import inf

from model.files.drive_profile_file import ProfileDocument, object_key
from simulation.drives.behaviour import NOT_THERE, STRICT, DriveBehaviour
from simulation.drives.eds_file import Eds, Key, ObjectDescription

NO_DUPLICATE_CONSUMER = 0x06040043
NOT_MAPPABLE = 0x06040041
PDO_TOO_LONG = 0x06040042
UNSUPPORTED_ACCESS = 0x06010000
WRITE_ONLY = 0x06010001
READ_ONLY = 0x06010002
WRONG_LENGTH = 0x06070010
NO_SUB_INDEX = 0x06090011
OUT_OF_RANGE = 0x06090030
MAXIMUM_BELOW_MINIMUM = 0x06090036
NOT_IN_THIS_STATE = 0x08000022

HEARTBEAT_CONSUMERS, SOFTWARE_LIMITS = 0x1016, 0x607D

DEVICE_NAME = b"cdpr simulated drive"

_SIMULATED = {
    (0x1008, 0): DEVICE_NAME,
    (0x1009, 0): b"none",
    (0x100A, 0): b"simulation",
}
"""Override the EDS file: a simulated drive must not be mistaken for a real one."""


class Abort(Exception):
    """An SDO transfer ends with this abort code."""

    def __init__(self, code: int) -> None:
        super().__init__(f"SDO abort {code:08X}h")
        self.code = code


class DriveObjects:
    """Values of a drive's objects, as described by its EDS file.

    Attributes:
        refusals: Abort code by object that the drive refuses (set by tests).
        stuck: Objects that accept a value without storing it (set by tests).
        judge: Returns the abort code of a write in the present state; 0 to accept it.
        changed: Called after an object has changed.
    """

    def __init__(self, eds: Eds, node: int, behaviour: DriveBehaviour = STRICT) -> None:
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
        """Resets the communication profile area (1000h to 1FFFh) to its power-on values."""
        self._restore(range(0x1000, 0x2000))

    def __getitem__(self, key: Key) -> int:
        """The value of a numeric object."""
        value = self._values[key]
        assert isinstance(value, int)
        return value

    def __setitem__(self, key: Key, value: int) -> None:
        """Sets a value from inside the drive, without checks."""
        if key not in self._described:
            raise KeyError(f"{key[0]:04X}h:{key[1]:02X}")
        self._values[key] = value
        self.changed(key, value)

    def __contains__(self, key: object) -> bool:
        """Whether the drive has an object."""
        return key in self._described

    def get(self, key: Key, without: int) -> int:
        """The value of an object, or a default if the drive lacks it."""
        return self[key] if key in self._described else without

    def keep(self, keys: Iterable[Key], values: Iterable[int]) -> None:
        """Stores values received in process data."""
        self._values.update(zip(keys, values, strict=True))

    def indices(self) -> list[int]:
        """Indices of all objects of the drive, in the order of the EDS file."""
        return list(dict.fromkeys(index for index, _ in self._described))

    def note(self, key: Key, value: int) -> None:
        """Stores a value that the drive reports, if it has the object."""
        if key in self._described:
            self._values[key] = value

    def values(self) -> dict[Key, int | bytes]:
        """All stored values."""
        return dict(self._values)

    def subs(self, index: int) -> list[int]:
        """Sub-indices of an object."""
        return [sub for i, sub in self._described if i == index]

    def described(self, key: Key) -> ObjectDescription | None:
        """Description of an object in the EDS file; None if the drive lacks it."""
        return self._described.get(key)

    def is_dummy(self, index: int) -> bool:
        """Whether a data type may fill gaps of an RPDO."""
        return index in self._eds.dummies

    def has_mode(self, mode: int) -> bool:
        """Whether 6502h or the EDS file lists a mode; bit 0 is mode 1, mode 0 means none."""
        modes = self.get((0x6502, 0), 0xFFFFFFFF)
        listed = 0 < mode <= 32 and bool(modes >> (mode - 1) & 1)
        return mode <= 0 or listed or mode in self._eds.unlisted_modes

    def measured(self, index: int, sub: int, read: Callable[[], int]) -> None:
        """Makes an object return a live value."""
        self._readers[index, sub] = read
        self.changed((index, sub), 0)

    def reader(self, key: Key) -> Callable[[], int]:
        """Reader of a numeric object."""
        return self._readers.get(key) or (lambda: self[key])

    def get_data(self, index: int, sub: int) -> bytes:
        """Data of an SDO upload.

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
        """Stores the data of an SDO download.

        Raises:
            Abort: The object is missing, read-only or of another length, or may not have this value
                now.
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
        if refused := (
            self._out_of_range(key, value, described)
            or self._contradiction(key, value)
            or self.judge(key, value)
        ):
            raise Abort(refused)
        if key not in self.stuck:
            self._values[key] = value
            self.changed(key, value)

    def _out_of_range(self, key: Key, value: int, described: ObjectDescription) -> int:
        low, high = self._behaviour.ranges.get(key, (value, value))
        inside = low <= value <= high and described.holds(value)
        return 0 if inside else OUT_OF_RANGE

    def _contradiction(self, key: Key, value: int) -> int:
        """Abort code of a value that contradicts other sub-indices; 0 for none."""
        index, sub = key
        if index == HEARTBEAT_CONSUMERS and value & 0xFFFF:
            entries = (self[index, other] for other in self.subs(index) if other not in (0, sub))
            taken = [entry >> 16 & 0x7F for entry in entries if entry & 0xFFFF]
            return NO_DUPLICATE_CONSUMER if value >> 16 & 0x7F in taken else 0
        if index == SOFTWARE_LIMITS:
            low, high = (value if one == sub else self.get((index, one), value) for one in (1, 2))
            return MAXIMUM_BELOW_MINIMUM if low > high else 0
        return 0

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
    """Abort code of an object declared absent by the behaviour; 0 for others."""
    index, sub = key
    return behaviour.absent.get((index, sub)) or behaviour.absent.get((index, None), 0)


# SDO server of a simulated drive, whose answers may be late, repeated or lost.
#
# Source: CiA 301 (4.2), 7.2.4: expedited and segmented transfers, abort codes. Block transfers,
# which are optional, are not supported.


TOGGLE_NOT_ALTERNATED = 0x05030000
UNKNOWN_COMMAND = 0x05040001
OUT_OF_MEMORY = 0x05040005

LATE_EVERY = 7
LONGEST_DOWNLOAD = 1024

_HEAD = struct.Struct("<BHB")


class SdoServer:
    """Answers requests of 8 bytes.

    Attributes:
        next_due: Time of the next answer, [s]; infinity without any.
    """

    def __init__(
        self, objects: DriveObjects, behaviour: DriveBehaviour, send: Callable[[bytes], None]
    ) -> None:
        """Serves a drive's objects; ``send`` sends an answer."""
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
        """Processes one request; its answer is sent at once or by `deliver`."""
        try:
            answer = self._answer(data)
        except Abort as abort:
            self._upload = self._download = None
            answer = _HEAD.pack(0x80, *self._key) + abort.code.to_bytes(4, "little")
        if answer is not None:
            self._reply(answer.ljust(8, b"\0"), now)

    def _reply(self, answer: bytes, now: float) -> None:
        """Sends an answer late, twice or never, according to the behaviour."""
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
        if kind == 4:  # abort by the client
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


# Units of a drive's speed and acceleration in counts, by 60A8h to 60AAh. Pure.
#
# Source: CiA 402-2, objects 60A8h to 60AAh: bits 31 to 24 prefix, 23 to 16 numerator, 15 to 8
# denominator; Maxon EPOS4 firmware specification for C0h, revolutions a minute.


POSITION_UNIT, VELOCITY_UNIT, ACCELERATION_UNIT = 0x60A8, 0x60A9, 0x60AA

_COUNTS, _REVOLUTIONS, _RPM = 0xB5, 0xB4, 0xC0
_SECONDS = {0x00: 1.0, 0x03: 1.0, 0x47: 60.0, 0x56: 1.0, 0x57: 1.0}
"""Seconds in each denominator: none, s, min, s² (CiA 303-2: 57h; 56h in some files)."""


def counts_in(unit: int, counts_per_turn: float) -> float | None:
    """Counts, counts/s or counts/s² in one unit; None for an unknown unit.

    Args:
        unit: Value of 60A8h, 60A9h or 60AAh; 0 for counts.
        counts_per_turn: Of the motor shaft.
    """
    if unit == 0:
        return 1.0
    prefix = unit >> 24 & 0xFF
    exponent = prefix - 0x100 if prefix & 0x80 else prefix
    per_turn = {_COUNTS: 1.0, _REVOLUTIONS: counts_per_turn, _RPM: counts_per_turn / 60.0}
    numerator, seconds = per_turn.get(unit >> 16 & 0xFF), _SECONDS.get(unit >> 8 & 0xFF)
    if numerator is None or seconds is None:
        return None
    return numerator * 10.0**exponent / seconds


# Settings of a drive's motion, from its objects.


@dataclass(frozen=True, slots=True)
class MotionSettings:
    """What the objects of a drive state about its motion.

    Attributes:
        deceleration: Of a quick stop (6085h), [counts/s²].
        max_torque: Torque limit, [per mille of rated torque].
        window: Largest following error (6065h), [counts]; infinity if it is not monitored.
        window_time: Time for which it may be exceeded (6066h), [s].
        offset: Added to every target (60B0h), [counts].
        limits: Smallest and largest target (607Dh), [counts]; infinite until a restart, if one is
            needed, as this drive stores nothing.
        interpolation: Time in which a target is reached (60C2h), [s].
        stop_option: Quick stop option code (605Ah).
    """

    deceleration: float
    max_torque: float
    window: float
    window_time: float
    offset: int
    limits: tuple[float, float]
    interpolation: float
    stop_option: int


def motion_settings(
    objects: DriveObjects, counts_per_turn: float, profile: ProfileDocument
) -> MotionSettings:
    """Reads the settings of a drive's motion; an absent object limits nothing.

    Args:
        counts_per_turn: Of the motor shaft.
        profile: Of its make: what limits its torque, and when its position limits are in force.
    """
    get = objects.get
    unit = get((ACCELERATION_UNIT, 0), get((VELOCITY_UNIT, 0), 0))  # of speed, per second
    acceleration = counts_in(unit, counts_per_turn) or 1.0
    home = get((0x607C, 0), 0)  # the drive subtracts it from its limits: CiA 402-2
    low, high = get((SOFTWARE_LIMITS, 1), -(2**31)), get((SOFTWARE_LIMITS, 2), 2**31 - 1)
    window = get((0x6065, 0), 0xFFFFFFFF)
    limiting, rated = (0x6072, 0), 1000.0
    if (limit := profile.torque_limit) is not None:
        limiting, rated = object_key(limit.object), limit.rated_value or 1000.0
        if limit.rated is not None:
            rated = get(object_key(limit.rated), 0)
    return MotionSettings(
        deceleration=max(1e-3, get((0x6085, 0), 1_000_000) * acceleration),
        max_torque=1000.0 * get(limiting, 2**32) / rated if rated else 0.0,
        window=inf if window == 0xFFFFFFFF else window,
        window_time=get((0x6066, 0), 0) / 1000.0,
        offset=get((0x60B0, 0), 0),
        limits=(-inf, inf) if profile.limits_need_restart else (low - home, high - home),
        interpolation=get((0x60C2, 1), 1) * 10.0 ** get((0x60C2, 2), -3),
        stop_option=get((0x605A, 0), 2),
    )
