"""CANopen frames: `make_*` builds bytes, `parse_*` reads them and checks the length. Pure.

Source: CiA 301 (identifiers, SYNC, EMCY, heartbeat, NMT); the process data are those that
`drivers.cia402.object_dictionary` maps.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Sequence
from enum import IntEnum
from typing import NamedTuple

import can

from drivers.can_bus import SentFrame
from drivers.cia402.state_machine import ControlWord

NMT_ID = 0x000
SYNC_ID = 0x080
EMCY_BASE = 0x080
TPDO1_BASE = 0x180
RPDO1_BASE = 0x200
SDO_REPLY_BASE = 0x580
SDO_REQUEST_BASE = 0x600
HEARTBEAT_BASE = 0x700

MASTER_NODE = 127
"""Node id under which the master sends its heartbeat; the rig file keeps winches below it."""

_RPDO1 = struct.Struct("<Hi")
_TPDO1 = struct.Struct("<Hih")
_EMCY = struct.Struct("<HB5s")


class NmtCommand(IntEnum):
    """Network management commands."""

    START = 0x01
    STOP = 0x02
    PRE_OPERATIONAL = 0x80
    RESET_NODE = 0x81
    RESET_COMMUNICATION = 0x82


class NmtState(IntEnum):
    """Content of a heartbeat."""

    BOOT_UP = 0x00
    STOPPED = 0x04
    OPERATIONAL = 0x05
    PRE_OPERATIONAL = 0x7F


class Reply(NamedTuple):
    """A drive's reply to SYNC: status word, position [counts], torque [per mille]."""

    status_word: int
    position: int
    torque: int


class Emergency(NamedTuple):
    """An EMCY message: error code, error register, manufacturer's bytes."""

    code: int
    register: int
    detail: bytes


def make_set_point(control_word: int, target: int) -> bytes:
    """RPDO1: 6040h control word, 607Ah target [counts]; 6 bytes.

    Raises:
        struct.error: A value does not fit its object.
    """
    return _RPDO1.pack(control_word, target)


def parse_reply(data: bytes | bytearray) -> Reply | None:
    """TPDO1: 6041h, 6064h and 6077h as a `Reply`; None if the length is wrong."""
    return Reply(*_TPDO1.unpack(data)) if len(data) == _TPDO1.size else None


def make_sync() -> bytes:
    """SYNC without a counter."""
    return b""


def make_heartbeat(state: NmtState) -> bytes:
    """Heartbeat of a node in an NMT state."""
    return bytes((state,))


def parse_heartbeat(data: bytes | bytearray) -> int | None:
    """The NMT state in a heartbeat (toggle bit dropped); None if the length is wrong."""
    return data[0] & 0x7F if len(data) == 1 else None


def make_nmt(command: NmtCommand, node: int) -> bytes:
    """NMT command to one node, or to all with node 0."""
    return bytes((command, node))


def make_emergency(code: int, register: int) -> bytes:
    """EMCY message, its manufacturer-specific bytes zero."""
    return _EMCY.pack(code, register, b"")


def parse_emergency(data: bytes | bytearray) -> Emergency | None:
    """An EMCY message; None if the length is wrong."""
    return Emergency(*_EMCY.unpack(data)) if len(data) == _EMCY.size else None


# The frames that a master sends every cycle, built once and updated. No bus.


class CyclicFrames:
    """One set-point per drive, SYNC, and the master's heartbeat.

    Attributes:
        sync: The SYNC frame, which makes the set-points take effect.
        heartbeat: The master's heartbeat.
    """

    def __init__(self, nodes: Sequence[int]) -> None:
        """Takes the node ids in the order of the winches."""
        rest = make_set_point(ControlWord.QUICK_STOP, 0)
        self._set_points = [SentFrame(RPDO1_BASE + node, rest) for node in nodes]
        self.sync = SentFrame(SYNC_ID, make_sync())
        alive = make_heartbeat(NmtState.OPERATIONAL)
        self.heartbeat = SentFrame(HEARTBEAT_BASE + MASTER_NODE, alive)

    def set_points(
        self, words: Sequence[ControlWord], targets: Sequence[int]
    ) -> Sequence[can.Message]:
        """One set-point frame per drive.

        Raises:
            struct.error: A target does not fit 32 bits.
        """
        for message, word, target in zip(self._set_points, words, targets, strict=True):
            message.data = bytearray(make_set_point(word, target))
        return self._set_points


# Identifiers that only a CiA 402 master sends, and messages about another master.


READS = frozenset({0x40, 0x60, 0x80, 0xA0})
"""SDO requests that change no object: upload and its segments, abort, block upload.

Source: CiA 301, 7.2.4.3, client command specifiers (upper three bits of the first byte).
"""


def commanding_ids(nodes: Iterable[int]) -> frozenset[int]:
    """Identifiers sent only by a master of these drives; SDO requests also by a reading tool."""
    own = {base + node for node in nodes for base in (RPDO1_BASE, SDO_REQUEST_BASE)}
    return frozenset({NMT_ID, SYNC_ID, HEARTBEAT_BASE + MASTER_NODE} | own)


def is_command(can_id: int, data: bytes | bytearray) -> bool:
    """Whether a frame with one of `commanding_ids` commands a drive or may change an object.

    A tool that only reads objects is allowed on the bus, except during configuration.
    """
    is_request = SDO_REQUEST_BASE < can_id < HEARTBEAT_BASE
    return not is_request or (bool(data) and data[0] & 0xE0 not in READS)


def foreign_master_message(can_id: int, data: bytes | bytearray) -> str:
    """Message about another program that sends a frame with one of `commanding_ids`."""
    node = can_id & 0x7F
    if can_id == SYNC_ID:
        return "another program sends SYNC on this bus"
    if can_id == NMT_ID:
        return "another program sends NMT commands on this bus"
    if can_id == HEARTBEAT_BASE + MASTER_NODE:
        return (
            "another program sends the master's heartbeat on this bus, or a device has the node id"
            f" {MASTER_NODE}, as new drives may: give it another one"
        )
    if can_id > SDO_REQUEST_BASE:
        does = "writes" if is_command(can_id, data) else "reads"
        return f"another program {does} objects of drive {node}"
    return f"another program sends set-points to drive {node}"
