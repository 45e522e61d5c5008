"""Every object that is written to a drive before it is enabled, with its value and the reason."""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass

from cdpr.drives_file import Cia402Document
from cdpr.errors import BadInput
from cdpr.rig import Rig
from cdpr.winches import WinchMap
from drivers.bus_load import heartbeat_cycles, heartbeat_timeout
from drivers.cia402.frames import MASTER_NODE, RPDO1_BASE, TPDO1_BASE
from drivers.travel import position_limits

CSP_MODE = 8
"""Cyclic synchronous position."""

MISSED_CYCLES = 3
"""Cycles without SYNC or set-point after which a drive stops by itself."""

PDO_INVALID = 1 << 31
PDO_NO_RTR = 1 << 30

TORQUE_RESERVE = 1.2
"""Torque limit above the largest allowed tension: the following-error watch must trip first."""

_UNSIGNED_MAX = {"<B": 0xFF, "<H": 0xFFFF, "<I": 0xFFFFFFFF}


@dataclass(frozen=True, slots=True)
class Setting:
    """One object to write and read back.

    Attributes:
        index: Object index.
        sub: Sub-index.
        form: Type, as `struct` names it.
        value: What it must hold.
        name: What the standard calls it.
        why: The reason for the value.
        transient: It is written over later in the list, so that only a refusal counts.
        instead: What does its work in drives that do not have the object; nothing where they must.
    """

    index: int
    sub: int
    form: str
    value: int
    name: str
    why: str
    transient: bool = False
    instead: str = ""

    def data(self) -> bytes:
        """The value as the object holds it."""
        return struct.pack(self.form, self.value)

    def __str__(self) -> str:
        """Index, sub-index and name."""
        return f"{self.index:04X}h:{self.sub:02X} {self.name}"


@dataclass(frozen=True, slots=True)
class Expectation:
    """One object to read: ``value & mask`` must be ``expected``."""

    index: int
    sub: int
    mask: int
    expected: int
    name: str
    why: str

    def __str__(self) -> str:
        """Index, sub-index and name."""
        return f"{self.index:04X}h:{self.sub:02X} {self.name}"


#: What a drive must be before anything is written to it.
BEFORE = (
    Expectation(0x1000, 0, 0xFFFF, 402, "device type", "only CiA 402 drives are commanded here"),
    Expectation(0x6502, 0, 0x80, 0x80, "supported drive modes", "cyclic synchronous position"),
)


def identity(rig: Rig) -> tuple[Expectation, ...]:
    """Whose drives they must be, where the rig file says so (1018h)."""
    drives = rig.document.drives
    if not isinstance(drives, Cia402Document):
        return ()
    named = ((1, drives.vendor_id, "vendor id"), (2, drives.product_code, "product code"))
    why = "the rig file names these drives"
    return tuple(
        Expectation(0x1018, sub, 0xFFFFFFFF, value, name, why)
        for sub, value, name in named
        if value is not None
    )


#: What it must tell after the set-up.
AFTER = (Expectation(0x6061, 0, 0xFF, CSP_MODE, "mode of operation display", "the mode was taken"),)

#: Communication parameters of process data that are not used; switched off where they exist.
UNUSED_PDOS = (0x1401, 0x1402, 0x1403, 0x1801, 0x1802, 0x1803)

HEARTBEAT_CONSUMERS = 0x1016


def settings_for(
    rig: Rig, drive: int, winch_map: WinchMap, max_tension: float | None = None
) -> tuple[Setting, ...]:
    """The set-up of one drive, in the order of writing.

    Args:
        rig: The robot.
        drive: Place of its winch in the rig file, from 0.
        winch_map: The rig's lengths and counts.
        max_tension: From which the torque limit comes, [N]; the rig's own if None.

    Raises:
        BadInput: A value of the rig does not fit its object.
    """
    cycle = rig.document.bus.cycle_ms / 1000.0
    return (
        *_process_data(rig.winches[drive].node_id, cycle),
        *_supervision(cycle),
        *_mode(cycle),
        *_reactions(rig, drive, cycle),
        *_limits(rig, drive, winch_map, rig.max_tension if max_tension is None else max_tension),
    )


def heartbeat_consumers(rig: Rig, drive: int, entries: int) -> tuple[Setting, ...]:
    """Whose heartbeat the drive watches: the master's, then its peers', as far as it has entries.

    Args:
        rig: The robot.
        drive: Place of the winch in the rig file, from 0.
        entries: How many producers the drive can watch (1016h:00).
    """
    time_ms = math.ceil(1000 * heartbeat_timeout(rig.document.bus.cycle_ms / 1000.0))
    peers = [w.node_id for i, w in enumerate(rig.winches) if i != drive]
    return tuple(
        Setting(
            HEARTBEAT_CONSUMERS,
            sub,
            "<I",
            node << 16 | time_ms,
            "consumer heartbeat time",
            "stop when the master is gone" if node == MASTER_NODE else "stop when a peer is gone",
        )
        for sub, node in enumerate([MASTER_NODE, *peers][:entries], start=1)
    )


def interpolation_time(cycle: float) -> tuple[int, int]:
    """Value and power of ten of 60C2h for a cycle [s].

    Raises:
        BadInput: The object cannot hold this cycle.
    """
    for exponent in (-3, -4, -5, -6):
        value = cycle * 10.0**-exponent
        if round(value) <= 0xFF and abs(value - round(value)) < 1e-6:
            return round(value), exponent
    raise BadInput(
        f"drives cannot interpolate over a cycle of {1000 * cycle:g} ms",
        where="bus.cycle_ms",
        why="object 60C2h holds a whole number up to 255 times a power of ten",
        next_step="use a rounder number, such as 10, 8 or 4",
    )


def _process_data(node: int, cycle: float) -> tuple[Setting, ...]:
    deadline_ms = math.ceil(1000 * MISSED_CYCLES * cycle)
    received = (0x60400010, 0x607A0020, 0x60B20010)
    sent = (0x60410010, 0x60640020, 0x60770010)
    return (
        *_mapped(0x1400, 0x1600, RPDO1_BASE + node, received),
        Setting(
            *(0x1400, 5, "<H", deadline_ms, "RPDO1 deadline", "stop without set-points"),
            instead="the program sees a drive that stands still, and stops all",
        ),
        Setting(0x1400, 1, "<I", RPDO1_BASE + node, "RPDO1 identifier", "switched on"),
        *_mapped(0x1800, 0x1A00, PDO_NO_RTR | TPDO1_BASE + node, sent),
        Setting(0x1800, 1, "<I", PDO_NO_RTR | TPDO1_BASE + node, "TPDO1 identifier", "switched on"),
    )


def _mapped(
    parameters: int, mapping: int, identifier: int, objects: tuple[int, ...]
) -> tuple[Setting, ...]:
    """Off, no objects, the objects, their number, at each SYNC. Source: CiA 301, 7.5.2.36."""
    off = PDO_INVALID | identifier
    return (
        Setting(parameters, 1, "<I", off, "PDO identifier", "off while it is mapped", True),
        Setting(mapping, 0, "<B", 0, "PDO mapping", "off while it is mapped", True),
        *(
            Setting(mapping, sub, "<I", entry, "PDO mapping", "8 bytes: word, position, torque")
            for sub, entry in enumerate(objects, start=1)
        ),
        Setting(mapping, 0, "<B", len(objects), "PDO mapping", "all three objects"),
        Setting(parameters, 2, "<B", 1, "PDO transmission type", "one SYNC for all drives"),
    )


def _supervision(cycle: float) -> tuple[Setting, ...]:
    period_us = round(1e6 * cycle)
    produced_ms = round(1000 * cycle * heartbeat_cycles(cycle))
    return (
        Setting(0x1006, 0, "<I", period_us, "communication cycle period", "the cycle of the rig"),
        Setting(
            *(0x1007, 0, "<I", period_us, "synchronous window length", "the whole cycle"),
            instead="without it the window has no end",
        ),
        Setting(0x1017, 0, "<H", produced_ms, "producer heartbeat time", "peers watch each other"),
        Setting(
            *(0x1029, 1, "<B", 1, "communication error behaviour", "keep reporting"),
            instead="a drive may leave the NMT state operational, which is a fault",
        ),
    )


def _mode(cycle: float) -> tuple[Setting, ...]:
    value, exponent = interpolation_time(cycle)
    why = "one set-point a cycle"
    return (
        Setting(0x6060, 0, "<b", CSP_MODE, "modes of operation", "cyclic synchronous position"),
        Setting(0x60C2, 1, "<B", value, "interpolation time period value", why),
        Setting(0x60C2, 2, "<b", exponent, "interpolation time index", why),
    )


def _reactions(rig: Rig, drive: int, cycle: float) -> tuple[Setting, ...]:
    winch = rig.winches[drive]
    # A drive at its top speed stands within one cycle, so that drives at different speeds stop
    # within a cycle of each other and the tensions stay near what they were.
    ramp = winch.max_speed / cycle * abs(winch.counts_per_metre)
    window = rig.motion.following_error * abs(winch.counts_per_metre)
    return (
        Setting(0x6007, 0, "<h", 3, "abort connection option code", "stop when the bus is lost"),
        Setting(0x605A, 0, "<h", 6, "quick stop option code", "ramp down, then hold under torque"),
        Setting(
            *(0x605C, 0, "<h", 1, "disable operation option code", "ramp down before torque off"),
            instead="what a drive does when operation is disabled is its maker's choice: read its"
            " manual before `cdpr release`",
        ),
        Setting(
            *(0x605E, 0, "<h", 2, "fault reaction option code", "ramp down before torque off"),
            instead="what a drive does in a fault is its maker's choice: read its manual",
        ),
        _capped(0x6085, "quick stop deceleration", ramp, "stands within one cycle"),
        _capped(0x6065, "following error window", window, "motion.following_error_mm"),
        Setting(0x6066, 0, "<H", math.ceil(1000 * cycle), "following error time out", "one cycle"),
    )


def _limits(rig: Rig, drive: int, winch_map: WinchMap, max_tension: float) -> tuple[Setting, ...]:
    winch = rig.winches[drive]
    torque = math.ceil(1000.0 * TORQUE_RESERVE * max_tension / winch.torque_constant)
    if torque > _UNSIGNED_MAX["<H"]:
        raise BadInput(
            f"max_tension_n is {max_tension / winch.torque_constant:.0f} times the tension at"
            " rated torque",
            where=f"rig {rig.name}: winches[{drive}].torque_constant_n",
            next_step="give the cable tension at rated motor torque",
        )
    low, high = position_limits(rig, drive, winch_map)
    why = "longest and shortest cable of the workspace"
    return (
        Setting(0x6072, 0, "<H", torque, "max torque", "largest allowed tension and a reserve"),
        Setting(0x607D, 1, "<i", low, "min position limit", why),
        Setting(0x607D, 2, "<i", high, "max position limit", why),
    )


def _capped(index: int, name: str, value: float, why: str) -> Setting:
    """As large as the object can hold: the largest value still means the same."""
    return Setting(index, 0, "<I", min(math.ceil(value), _UNSIGNED_MAX["<I"]), name, why)
