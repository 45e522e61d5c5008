"""One simulated drive and everything it sends, driven by frames of literal bytes."""

from __future__ import annotations

import struct
from typing import Any

from simulation.drives.cia402 import SimulatedDrive

NODE = 5
CYCLE = 0.01
SPEED = 100_000.0  # counts/s

# Status word, bits 6, 5, 3..0, by state; CiA 402-2.
MASK = 0x6F
DISABLED, READY, ON, ENABLED, STOPPED, REACTING, FAULT = 0x40, 0x21, 0x23, 0x27, 0x07, 0x0F, 0x08

THREE = (0x60400010, 0x607A0020, 0x60B20010)
TWO = (0x60400010, 0x607A0020)
REPLY = (0x60410010, 0x60640020, 0x60770010)


class Line:
    """One drive and everything it sends."""

    def __init__(self, **of_the_drive: Any) -> None:
        self.sent: list[tuple[int, bytes]] = []
        self.drive = SimulatedDrive(
            NODE, 1000.0, SPEED, lambda i, d: self.sent.append((i, bytes(d))), **of_the_drive
        )
        self.target = 1000
        self.word = 0
        self.position: int | None = None
        self.torque: int | None = None

    def take(self, can_id: int) -> list[bytes]:
        found = [data for i, data in self.sent if i == can_id]
        self.sent = [(i, data) for i, data in self.sent if i != can_id]
        return found

    def ask(self, command: int, index: int, sub: int, data: bytes = b"") -> None:
        self.drive.on_sdo(struct.pack("<BHB", command, index, sub) + data.ljust(4, b"\0"))

    def sdo(self, command: int, index: int, sub: int, data: bytes = b"") -> bytes:
        self.ask(command, index, sub, data)
        (reply,) = self.take(0x585)
        return reply

    def write(self, index: int, sub: int, form: str, value: int) -> bytes:
        data = struct.pack(form, value)
        return self.sdo(0x23 | (4 - len(data)) << 2, index, sub, data)

    def abort(self, index: int, sub: int, form: str, value: int) -> int:
        """The abort code of a write; 0 where it was taken."""
        reply = self.write(index, sub, form, value)
        return struct.unpack_from("<I", reply, 4)[0] if reply[0] == 0x80 else 0

    def read(self, index: int, sub: int) -> int:
        reply = self.sdo(0x40, index, sub)
        assert reply[0] != 0x80, reply.hex()
        return int.from_bytes(reply[4 : 8 - (reply[0] >> 2 & 3)], "little")

    def map(self, base: int, objects: tuple[int, ...]) -> None:
        """By the rules: off, no entries, entries, their number; it stays off."""
        cob = {0x1400: 0x205, 0x1800: 0x185}[base]
        self.write(base, 1, "<I", 0x80000000 + cob)
        self.write(base, 2, "<B", 1)
        self.write(base + 0x200, 0, "<B", 0)
        for sub, entry in enumerate(objects, start=1):
            assert self.abort(base + 0x200, sub, "<I", entry) == 0
        self.write(base + 0x200, 0, "<B", len(objects))

    def set_up(self, mapping: tuple[int, ...] = THREE, **options: int) -> None:
        values = {"abort_option": 3, "stop_option": 6, "period_us": 10_000} | options
        self.map(0x1400, mapping)
        self.map(0x1800, REPLY)
        self.write(0x1400, 1, "<I", 0x205)
        self.write(0x1800, 1, "<I", 0x185)
        self.write(0x6060, 0, "<b", 8)
        self.write(0x60C2, 1, "<B", 10)
        self.write(0x6007, 0, "<h", values["abort_option"])
        self.write(0x605A, 0, "<h", values["stop_option"])
        self.write(0x1006, 0, "<I", values["period_us"])
        self.write(0x6065, 0, "<I", 500)
        self.write(0x6066, 0, "<H", 20)
        self.drive.on_nmt(0x01, NODE)

    def set_point(self, word: int, target: int | None = None) -> None:
        self.drive.on_pdo(0x205, struct.pack("<Hih", word, target or self.target, 0))

    def sync(self, word: int | None, target: int | None = None) -> int | None:
        """One cycle; the status word's state bits that the SYNC after it reports."""
        if target is not None:
            self.target = target
        if word is not None:
            self.set_point(word)
        self.drive.advance(CYCLE)
        self.drive.on_sync()
        replies = self.take(0x185)
        if not replies:
            self.position = None
            return None
        self.word, self.position, self.torque = struct.unpack("<Hih", replies[-1])
        return self.word & MASK

    def state_after(self, word: int) -> int | None:
        self.sync(word)
        return self.sync(None)

    def enable(self) -> None:
        for word in (0x06, 0x07, 0x0F):
            self.sync(word)
        assert self.state_after(0x0F) == ENABLED

    def emergencies(self) -> list[int]:
        return [struct.unpack_from("<H", data)[0] for data in self.take(0x085)]


def ready(**of_the_drive: Any) -> Line:
    """A drive that is set up, and hears SYNC."""
    line = Line(**of_the_drive)
    line.set_up()
    return line
