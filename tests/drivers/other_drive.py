"""An independent drive: canopen's LocalNode and a separate CiA 402 state machine.

It has only what the standards ask for, sets bits of the status word that are the maker's, boots in
SWITCH ON DISABLED, answers late, and takes set-points at SYNC.
"""

from __future__ import annotations

import struct
import threading
import time
from collections import deque

import can
import canopen
from canopen.objectdictionary import (
    INTEGER8,
    INTEGER16,
    INTEGER32,
    UNSIGNED8,
    UNSIGNED16,
    UNSIGNED32,
    ODRecord,
    ODVariable,
)

MAKERS_BITS = 0xC710  # manufacturer, target reached, remote, voltage: of no interest to a master
#: Status words of CiA 402, table "state coding", bits 0 to 3, 5 and 6.
DISABLED, READY, ON, ENABLED, STOPPING = 0x40, 0x21, 0x23, 0x27, 0x07

RECORDS: dict[int, dict[int, tuple[int, int]]] = {
    0x1016: {0: (UNSIGNED8, 2), 1: (UNSIGNED32, 0), 2: (UNSIGNED32, 0)},
    0x1018: {0: (UNSIGNED8, 1), 1: (UNSIGNED32, 0x2E3)},
    0x1400: {0: (UNSIGNED8, 2), 1: (UNSIGNED32, 0), 2: (UNSIGNED8, 255)},
    0x1600: {0: (UNSIGNED8, 0), **{sub: (UNSIGNED32, 0) for sub in range(1, 9)}},
    0x1800: {0: (UNSIGNED8, 2), 1: (UNSIGNED32, 0), 2: (UNSIGNED8, 255)},
    0x1A00: {0: (UNSIGNED8, 0), **{sub: (UNSIGNED32, 0) for sub in range(1, 9)}},
    0x607D: {0: (UNSIGNED8, 2), 1: (INTEGER32, -(2**31)), 2: (INTEGER32, 2**31 - 1)},
    0x60C2: {0: (UNSIGNED8, 2), 1: (UNSIGNED8, 1), 2: (INTEGER8, -3)},
}
VARIABLES: dict[int, tuple[int, int]] = {
    0x1000: (UNSIGNED32, 0xFFFF0192),
    0x1001: (UNSIGNED8, 0),
    0x1006: (UNSIGNED32, 0),
    0x1017: (UNSIGNED16, 0),
    0x6007: (INTEGER16, 1),
    0x6040: (UNSIGNED16, 0),
    0x6041: (UNSIGNED16, DISABLED | MAKERS_BITS),
    0x605A: (INTEGER16, 2),
    0x6060: (INTEGER8, 0),
    0x6061: (INTEGER8, 0),
    0x6064: (INTEGER32, 0),
    0x6065: (UNSIGNED32, 0),
    0x6066: (UNSIGNED16, 0),
    0x6072: (UNSIGNED16, 0),
    0x6077: (INTEGER16, 0),
    0x607A: (INTEGER32, 0),
    0x6085: (UNSIGNED32, 0),
    0x6502: (UNSIGNED32, 0x1ED),
}
"""Not there, as in many drives: 1007h, 1029h, 1400h:05 (no RPDO deadline), 605Ch, 605Eh."""


def dictionary(missing: frozenset[int] = frozenset()) -> canopen.ObjectDictionary:
    """Objects with their values after switching on."""
    objects = canopen.ObjectDictionary()
    for index, (kind, value) in VARIABLES.items():
        if index not in missing:
            objects.add_object(_variable(f"{index:04X}", index, 0, kind, value))
    for index, subs in RECORDS.items():
        record = ODRecord(f"{index:04X}", index)
        for sub, (kind, value) in subs.items():
            record.add_member(_variable(f"{index:04X}:{sub}", index, sub, kind, value))
        objects.add_object(record)
    return objects


def _variable(name: str, index: int, sub: int, kind: int, value: int) -> ODVariable:
    variable = ODVariable(name, index, sub)
    variable.data_type, variable.default, variable.access_type = kind, value, "rw"
    return variable


class OtherDrive:
    """One drive on an end of the bus of its own, in a thread of its own."""

    def __init__(
        self,
        bus: can.BusABC,
        node: int,
        position: int,
        *,
        late: float = 0.0,
        missing: frozenset[int] = frozenset(),
    ) -> None:
        self.node, self.position, self.torque = node, position, 120
        self.state, self.words = DISABLED, deque[int](maxlen=10_000)
        self.operational = False
        self._bus, self._late = bus, late
        self._waiting: tuple[int, int] | None = None
        self._over = threading.Event()
        self._network = canopen.Network(bus)
        self._local = self._network.create_node(node, dictionary(missing))
        self._local.add_write_callback(self._written)
        self._local.nmt.send_command(0x80)  # boots: the message, then pre-operational
        self._thread = threading.Thread(target=self._serve)
        self._thread.start()

    def close(self) -> None:
        self._over.set()
        self._thread.join()
        self._local.nmt.stop_heartbeat()

    @property
    def status_word(self) -> int:
        return self.state | MAKERS_BITS

    def _written(self, *, index: int, od: ODVariable, data: bytes, **_: object) -> None:
        if index == 0x6060:
            self._local.set_data(0x6061, 0, data)
        elif index in (0x1600, 0x1A00) and od.subindex:
            self._require(int.from_bytes(data, "little") >> 16)

    def _require(self, index: int) -> None:
        """What is not there cannot be mapped."""
        if index not in self._local.object_dictionary:
            raise canopen.SdoAbortedError(0x06040041)

    def _serve(self) -> None:
        while not self._over.is_set():
            message = self._bus.recv(0.01)
            if message is None or message.is_error_frame:
                continue
            number, data = message.arbitration_id, bytes(message.data)
            if number == 0x000 and data[1] in (0, self.node):
                self.operational = data[0] == 0x01
                self._network.notify(number, bytearray(data), 0.0)
            elif number == 0x080:
                self._on_sync()
            elif number == 0x200 + self.node and len(data) == 6:
                word, target = struct.unpack("<Hi", data)
                self._waiting = word, target
            elif number == 0x600 + self.node:
                time.sleep(self._late)
                self._local.set_data(0x6041, 0, struct.pack("<H", self.status_word))
                self._network.notify(number, bytearray(data), 0.0)

    def _on_sync(self) -> None:
        if not self.operational:
            return
        reply = struct.pack("<Hih", self.status_word, self.position, self.torque)
        time.sleep(self._late)  # within the cycle
        answer = can.Message(arbitration_id=0x180 + self.node, data=reply, is_extended_id=False)
        self._bus.send(answer)
        if self._waiting is not None:
            word, target = self._waiting
            self._waiting = None
            self.words.append(word)
            self.state = self._after(word & 0x0F)
            if self.state == ENABLED:
                self.position = target

    def _after(self, word: int) -> int:
        """Transitions 2 to 12 and 16 of CiA 402."""
        if not word & 0x02:
            return DISABLED
        if not word & 0x04:
            return STOPPING if self.state in (ENABLED, STOPPING) else DISABLED
        if not word & 0x01:
            return self.state if self.state == STOPPING else READY
        if word == 0x07:
            return {READY: ON, ON: ON, ENABLED: ON}.get(self.state, self.state)
        return ENABLED if self.state in (ON, ENABLED, STOPPING) else self.state
