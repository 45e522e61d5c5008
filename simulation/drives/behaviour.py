"""Named behaviours of simulated CiA 402 drives that the standards allow and real drives show.

`STRICT` is the default, which enforces CiA 301 and CiA 402 literally. Other behaviours add
difficulties; only ``maps-when-operational`` accepts more, as many drives do.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from types import MappingProxyType
from typing import Any

from model.errors import BadInput

NOT_THERE = 0x06020000


def _nothing() -> Mapping[Any, Any]:
    return MappingProxyType({})


@dataclass(frozen=True, slots=True)
class DriveBehaviour:
    """Choices within the standards, and known deviations of real drives.

    Attributes:
        sync_periods: SYNC is overdue after this number of periods of 1006h.
        heartbeat_loss_is_fault: A lost heartbeat is a fault, regardless of 6007h.
        maps_when_operational: A disabled PDO can be mapped in NMT operational too.
        sdo_delay: Delay of every SDO answer, [s].
        sdo_late: Additional delay of every seventh SDO answer, [s].
        sdo_twice: Delay after which every SDO answer is repeated, [s]; None: never.
        sdo_lost: Every N-th SDO answer is lost; 0: none.
        absent: Abort code by index and sub-index (None: all) of missing objects.
        ranges: Smallest and largest value by object, within the EDS file's.
        mode_delay: Delay of the mode (6061h) after 6060h, [s].
        mode_when_enabled: The mode follows only while the drive is enabled.
        enable_delay: Time from the command to enable to "operation enabled", [s]: the motor is
            magnetised and its brake opens.
        warning: EMCY code of a warning that comes and goes while enabled; 0: none.
        flicker: Bits 4, 7 to 11 and 13 to 15 of the status word change at every SYNC.
        boot_delay: Time from power-on or reset to the boot-up message, [s].
        position_noise: Standard deviation of 6064h, [counts].
        torque_noise: Standard deviation of 6077h, [per mille].
        friction: Friction torque of the drive train, [per mille].
        stick: Following error at which a resting motor jumps, [counts].
        limits_monitored: The actual position outside 607Dh is a fault under torque (8612h).
        limit_switch: Travel from the position at power-on to a limit switch, [counts]; 0: none.
            Beyond it the drive stops soon after each SYNC that enables it, without an EMCY; its
            replies, filled in after the set-points, always show operation enabled.
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
    enable_delay: float = 0.0
    warning: int = 0
    flicker: bool = False
    boot_delay: float = 0.0
    position_noise: float = 0.0
    torque_noise: float = 0.0
    friction: float = 0.0
    stick: float = 0.0
    limits_monitored: bool = False
    limit_switch: float = 0.0

    @property
    def answers_late(self) -> bool:
        """Whether some answers to a master are delayed."""
        late = (self.sdo_delay, self.sdo_late, self.sdo_twice, self.boot_delay, self.mode_delay)
        return any(late)


STRICT = DriveBehaviour()

Put = Callable[[DriveBehaviour, str], DriveBehaviour]
"""Returns a behaviour with one added, given its value."""


@dataclass(frozen=True, slots=True)
class NamedBehaviour:
    """One entry of the table of behaviours.

    Attributes:
        name: Name on the command line.
        value: Meaning of its value; empty if it takes none.
        example: Default value; empty if a value is required.
        text: Description in one line.
        put: Returns a behaviour with this one added, given the value.
    """

    name: str
    value: str
    example: str
    text: str
    put: Put


def _switch(name: str, text: str, **changes: Any) -> NamedBehaviour:
    """A behaviour without a value."""
    return NamedBehaviour(name, "", "", text, lambda behaviour, _: replace(behaviour, **changes))


def _number(
    key: str,
    scale: float = 1,
    low: float = 0.0,
    high: float = 1e9,
    read: Callable[[str], float] = float,
) -> Put:
    def put(behaviour: DriveBehaviour, text: str) -> DriveBehaviour:
        value = read(text)
        if not low <= value <= high:
            raise ValueError
        changes: dict[str, Any] = {key: value * scale}
        return replace(behaviour, **changes)

    return put


def _count(key: str, base: int = 10) -> Put:
    return _number(key, low=1, high=0xFFFF, read=partial(int, base=base))


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
    _switch("strict", "CiA 301 and CiA 402 as written; the default"),
    NamedBehaviour(
        "sync-periods",
        "PERIODS",
        "1.5",
        "periods of 1006h after which SYNC is overdue, from 1 to 3; strict: 3",
        _number("sync_periods", low=1.0, high=STRICT.sync_periods),
    ),
    _switch(
        "heartbeat-loss-is-fault",
        "a lost heartbeat is a fault: torque off, although 6007h requests a quick stop",
        heartbeat_loss_is_fault=True,
    ),
    _switch(
        "maps-when-operational",
        "a disabled PDO can be mapped in NMT operational; strict: only in pre-operational",
        maps_when_operational=True,
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
        "accepts an object's values only from LOW to HIGH, within the EDS file's range, and answers"
        " others with 06090030h:"
        " range=6066/0..0",
        _range,
    ),
    NamedBehaviour(
        "mode-late", "MS", "50", "delay of 6061h after 6060h", _number("mode_delay", 1e-3)
    ),
    _switch(
        "mode-when-enabled",
        "6061h follows 6060h only while the drive is enabled",
        mode_when_enabled=True,
    ),
    NamedBehaviour(
        "enable-late",
        "MS",
        "200",
        "delay of the state operation enabled: the motor is magnetised and its brake opens",
        _number("enable_delay", 1e-3),
    ),
    NamedBehaviour(
        "warning",
        "CODE",
        "4210",
        "while enabled, a warning (EMCY code, status word bit 7) comes and goes; it keeps running",
        _count("warning", 16),
    ),
    _switch(
        "status-flicker",
        "bits 4, 7 to 11 and 13 to 15 of the status word change at every SYNC",
        flicker=True,
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
    _switch(
        "limits-monitored",
        "an actual position outside 607Dh is a fault under torque (EMCY 8612h)",
        limits_monitored=True,
    ),
    NamedBehaviour(
        "limit-switch",
        "COUNTS",
        "2000",
        "beyond this travel a limit switch stops the drive without an EMCY after each SYNC that"
        " enables it; all replies show operation enabled",
        _number("limit_switch"),
    ),
)

_BY_NAME = {behaviour.name: behaviour for behaviour in BEHAVIOURS}


def behaviour_named(names: Iterable[str], base: DriveBehaviour = STRICT) -> DriveBehaviour:
    """The behaviour with the given names, each ``NAME`` or ``NAME=VALUE``.

    Raises:
        BadInput: A name is unknown, or its value is invalid.
    """
    for text in names:
        name, equals, value = text.partition("=")
        named = _BY_NAME.get(name)
        if named is None:
            raise BadInput(
                f"unknown behaviour {name!r} of simulated drives",
                where="--drive-behaviour",
                why="known behaviours: " + ", ".join(_BY_NAME),
                next_step="list them with `cdpr sim RIG --drive-behaviour list`",
            )
        if equals and not named.value:
            raise BadInput(f"{name} takes no value", where="--drive-behaviour")
        try:
            base = named.put(base, value if equals else named.example)
        except ValueError:
            raise BadInput(
                f"{text!r} is not valid",
                where="--drive-behaviour",
                why=f"{name} needs a value: {name}={named.value}; {named.text}",
                next_step="see `cdpr sim RIG --drive-behaviour list`",
            ) from None
    return base


def table() -> list[tuple[str, str]]:
    """Name with value and its default, and description, of each behaviour."""
    return [(_usage(behaviour), behaviour.text) for behaviour in BEHAVIOURS]


def _usage(behaviour: NamedBehaviour) -> str:
    name, value, default = behaviour.name, behaviour.value, behaviour.example
    if default:
        return f"{name}[={value}] ({default})"
    return f"{name}={value}" if value else name
