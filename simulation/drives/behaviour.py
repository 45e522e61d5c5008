"""What simulated CiA 402 drives do that standards allow and makers' drives do, each by a name.

`STRICT` is the default: it holds a master to CiA 301 and CiA 402 literally. There is no kinder
preset; every other behaviour makes life harder.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any

from model.errors import BadInput

NOT_THERE = 0x06020000


def _nothing() -> Mapping[Any, Any]:
    return MappingProxyType({})


@dataclass(frozen=True, slots=True)
class DriveBehaviour:
    """Where the standards leave a choice, and what makers' drives are known to do.

    Attributes:
        sync_periods: SYNC is overdue after this many periods of 1006h.
        heartbeat_loss_is_fault: A lost heartbeat is a fault, whatever 6007h says.
        maps_when_operational: A PDO that is off can be mapped in NMT operational, too.
        sdo_delay: Every SDO answer takes this long, [s].
        sdo_late: Every seventh SDO answer takes this much longer, [s].
        sdo_twice: Every SDO answer comes again this much later, [s]; None: once.
        sdo_lost: Every SDO answer of this number is lost; 0: none.
        absent: Abort code by index and sub-index (None: all) of objects that the drive has not got.
        ranges: Smallest and largest value by object, in place of the EDS file's.
        mode_delay: The mode (6061h) follows 6060h so late, [s].
        mode_when_enabled: And it does so only while the drive is enabled.
        warning: EMCY code of a warning that comes and goes while the drive stays enabled; 0: none.
        flicker: Bits 4, 7 and 8 to 15 of the status word change at every SYNC.
        boot_delay: Time from switching on or a reset to the boot-up message, [s].
        position_noise: Standard deviation of 6064h, [counts].
        torque_noise: Standard deviation of 6077h, [per mille].
        friction: Torque that turns the drive train and no cable feels, [per mille].
        stick: The motor stands until its following error is so large, then jumps, [counts].
    """

    sync_periods: float = 3.0
    heartbeat_loss_is_fault: bool = False
    maps_when_operational: bool = False
    sdo_delay: float = 0.0
    sdo_late: float = 0.0
    sdo_twice: float | None = None
    sdo_lost: int = 0
    absent: Mapping[tuple[int, int | None], int] = field(default_factory=_nothing)
    ranges: Mapping[tuple[int, int], tuple[int, int]] = field(default_factory=_nothing)
    mode_delay: float = 0.0
    mode_when_enabled: bool = False
    warning: int = 0
    flicker: bool = False
    boot_delay: float = 0.0
    position_noise: float = 0.0
    torque_noise: float = 0.0
    friction: float = 0.0
    stick: float = 0.0

    @property
    def answers_late(self) -> bool:
        """Something that a master asks for comes only after time has passed."""
        late = (self.sdo_delay, self.sdo_late, self.sdo_twice, self.boot_delay, self.mode_delay)
        return any(late)


STRICT = DriveBehaviour()


@dataclass(frozen=True, slots=True)
class NamedBehaviour:
    """One line of the table.

    Attributes:
        name: What the command line calls it.
        value: What its value means; empty where it takes none.
        example: The value in the text of ``list``, and the default; empty: a value is needed.
        says: What the drive does, in one line.
        put: A behaviour with it, from one without it and the value.
    """

    name: str
    value: str
    example: str
    says: str
    put: Callable[[DriveBehaviour, str], DriveBehaviour]


def _switch(**changes: Any) -> Callable[[DriveBehaviour, str], DriveBehaviour]:
    return lambda behaviour, _text: replace(behaviour, **changes)


def _number(
    key: str, scale: float = 1.0, low: float = 0.0
) -> Callable[[DriveBehaviour, str], DriveBehaviour]:
    def put(behaviour: DriveBehaviour, text: str) -> DriveBehaviour:
        value = float(text)
        if not low <= value < 1e9:
            raise ValueError
        changes: dict[str, Any] = {key: value * scale}
        return replace(behaviour, **changes)

    return put


def _count(key: str, base: int = 10) -> Callable[[DriveBehaviour, str], DriveBehaviour]:
    def put(behaviour: DriveBehaviour, text: str) -> DriveBehaviour:
        value = int(text, base)
        if not 1 <= value <= 0xFFFF:
            raise ValueError
        changes: dict[str, Any] = {key: value}
        return replace(behaviour, **changes)

    return put


_OBJECT = re.compile(r"([0-9a-f]{4})h?(?::([0-9a-f]{1,2}))?$", re.IGNORECASE)


def _object(text: str) -> tuple[int, int | None]:
    matched = _OBJECT.match(text)
    if matched is None:
        raise ValueError
    return int(matched[1], 16), int(matched[2], 16) if matched[2] else None


def _absent(behaviour: DriveBehaviour, text: str) -> DriveBehaviour:
    key, _, code = text.partition("/")
    abort = int(code.rstrip("hH"), 16) if code else NOT_THERE
    if not 0x05000000 <= abort <= 0x08FFFFFF:
        raise ValueError
    return replace(behaviour, absent=MappingProxyType({**behaviour.absent, _object(key): abort}))


def _range(behaviour: DriveBehaviour, text: str) -> DriveBehaviour:
    key, _, limits = text.partition("/")
    index, sub = _object(key)
    low, high = (int(limit, 0) for limit in limits.split(".."))
    if low > high:
        raise ValueError
    ranges = {**behaviour.ranges, (index, sub or 0): (low, high)}
    return replace(behaviour, ranges=MappingProxyType(ranges))


BEHAVIOURS: tuple[NamedBehaviour, ...] = (
    NamedBehaviour(
        "strict", "", "", "CiA 301 and CiA 402 as written; the default", lambda b, _text: b
    ),
    NamedBehaviour(
        "sync-periods",
        "PERIODS",
        "1.5",
        "periods of 1006h after which SYNC is overdue; strict: 3",
        _number("sync_periods", low=1.0),
    ),
    NamedBehaviour(
        "heartbeat-loss-is-fault",
        "",
        "",
        "a lost heartbeat is a fault: torque off, although 6007h requests a quick stop",
        _switch(heartbeat_loss_is_fault=True),
    ),
    NamedBehaviour(
        "maps-when-operational",
        "",
        "",
        "a disabled PDO can be mapped in NMT operational; strict: only in pre-operational",
        _switch(maps_when_operational=True),
    ),
    NamedBehaviour(
        "sdo-delay", "MS", "300", "delay of every SDO answer", _number("sdo_delay", 1e-3)
    ),
    NamedBehaviour(
        "sdo-late",
        "MS",
        "800",
        "extra delay of every seventh SDO answer, which may then follow the next request",
        _number("sdo_late", 1e-3),
    ),
    NamedBehaviour(
        "sdo-twice",
        "MS",
        "0",
        "every SDO answer is repeated after this delay",
        _number("sdo_twice", 1e-3),
    ),
    NamedBehaviour("sdo-lost", "N", "5", "every N-th SDO answer is lost", _count("sdo_lost")),
    NamedBehaviour(
        "absent",
        "INDEX[:SUB][/ABORT]",
        "",
        "an object is missing; access is answered with this abort code, by default 06020000:"
        " absent=1400:05/06010000",
        _absent,
    ),
    NamedBehaviour(
        "range",
        "INDEX[:SUB]/LOW..HIGH",
        "",
        "accepts an object's values only from LOW to HIGH, and answers others with 06090030h:"
        " range=6066/0..0",
        _range,
    ),
    NamedBehaviour(
        "mode-late", "MS", "50", "delay of 6061h after 6060h", _number("mode_delay", 1e-3)
    ),
    NamedBehaviour(
        "mode-when-enabled",
        "",
        "",
        "6061h follows 6060h only while the drive is enabled",
        _switch(mode_when_enabled=True),
    ),
    NamedBehaviour(
        "warning",
        "CODE",
        "4210",
        "while enabled, a warning (EMCY code, status word bit 7) comes and goes; it keeps running",
        _count("warning", 16),
    ),
    NamedBehaviour(
        "status-flicker",
        "",
        "",
        "bits 4, 7 and 8 to 15 of the status word change at every SYNC",
        _switch(flicker=True),
    ),
    NamedBehaviour(
        "boot-late",
        "MS",
        "2000",
        "delay of the boot-up message; no request is answered before it",
        _number("boot_delay", 1e-3),
    ),
    NamedBehaviour(
        "position-noise",
        "COUNTS",
        "2",
        "standard deviation of the reported position",
        _number("position_noise"),
    ),
    NamedBehaviour(
        "torque-noise",
        "PER_MILLE",
        "10",
        "standard deviation of the reported torque",
        _number("torque_noise"),
    ),
    NamedBehaviour(
        "friction",
        "PER_MILLE",
        "50",
        "friction of the drive train: torque against the motion that is not cable tension",
        _number("friction"),
    ),
    NamedBehaviour(
        "stick-slip",
        "COUNTS",
        "40",
        "stick-slip: the motor rests until its lag reaches this value, then jumps",
        _number("stick"),
    ),
)

_BY_NAME = {behaviour.name: behaviour for behaviour in BEHAVIOURS}


def behaviour_named(names: Iterable[str], base: DriveBehaviour = STRICT) -> DriveBehaviour:
    """The behaviour with all of these names, each ``NAME`` or ``NAME=VALUE``.

    Raises:
        BadInput: A name is unknown, or its value has no meaning.
    """
    for text in names:
        name, equals, value = text.partition("=")
        named = _BY_NAME.get(name)
        if named is None:
            raise BadInput(
                f"there is no behaviour {name!r} of a simulated drive",
                where="--drive-behaviour",
                why="there are: " + ", ".join(_BY_NAME),
                next_step="`cdpr sim RIG --drive-behaviour list` explains them",
            )
        if equals and not named.value:
            raise BadInput(f"{name} takes no value", where="--drive-behaviour")
        try:
            base = named.put(base, value if equals else named.example)
        except ValueError:
            raise BadInput(
                f"{text!r} is not valid",
                where="--drive-behaviour",
                why=f"{name} needs a value: {name}={named.value}; {named.says}",
                next_step="`cdpr sim RIG --drive-behaviour list` explains it",
            ) from None
    return base


def table() -> list[tuple[str, str]]:
    """Name with its value, and what it does, of each behaviour."""
    return [(b.name + (f"={b.value}" if b.value else ""), b.says) for b in BEHAVIOURS]
