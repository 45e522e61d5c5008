"""The object dictionary of a simulated drive: what it has, what it starts with, what it refuses."""

from __future__ import annotations

from collections.abc import Callable, Iterable

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
