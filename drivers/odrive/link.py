"""Questions to ODrives and their answers while they are set up. One thread."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence

import can

from drivers.bus import SentFrame, bus_name, hears_itself, take, transmit
from drivers.bus_faults import ForeignMaster
from drivers.drive_group import Pump
from drivers.error_frames import error_frame_fault
from drivers.odrive.dbc import Layout, Layouts
from drivers.odrive.messages import can_id, node_and_command
from drivers.own_frames import OwnFrames

RESPONSE_TIMEOUT = 0.5
"""For the answer to a question, [s]."""

ECHO_WAIT = 0.05
"""A second device with the same node id answers within this time of the first, [s]."""

OPCODE_READ, OPCODE_WRITE = 0, 1

PUMPED = 0.01
"""Time that is counted for each pump of simulated drives, [s]."""


def commanding_ids(layouts: Layouts, nodes: Sequence[int]) -> frozenset[int]:
    """Identifiers that only a master that moves these drives sends."""
    moving = (layouts.set_input_pos, layouts.set_axis_state, layouts.clear_errors, layouts.estop)
    return frozenset(can_id(node, layout.command) for node in nodes for layout in moving)


def foreign_text(identifier: int) -> str:
    """What another program does when it sends a frame of one of these identifiers."""
    return f"another program commands drive {node_and_command(identifier)[0]}"


class SetupLink:
    """The bus while drives are set up."""

    def __init__(
        self, bus: can.BusABC, pump: Pump | None, layouts: Layouts, nodes: Sequence[int]
    ) -> None:
        """Takes an open bus, ``pump`` as for `drivers.drive_group.make_drive_group`, the drives."""
        self._bus, self._pump, self._layouts = bus, pump, layouts
        self._own = OwnFrames(commanding_ids(layouts, nodes), hears_itself=hears_itself(bus))

    def tell(self, node: int, layout: Layout, *values: float) -> None:
        """Sends a message to one drive."""
        self._send(node, layout.command, layout.pack(*values))

    def ask(self, node: int, layout: Layout) -> None:
        """Asks one drive for a message; without data it is a question."""
        self._send(node, layout.command, b"")

    def read(self, node: int, endpoint: int) -> None:
        """Asks for the value of an endpoint."""
        data = self._layouts.rxsdo.pack(OPCODE_READ, endpoint, 0)
        self._send(node, self._layouts.rxsdo.command, data[:4])

    def write(self, node: int, endpoint: int, raw: int, size: int) -> None:
        """Sets the value of an endpoint, of so many bytes."""
        data = self._layouts.rxsdo.pack(OPCODE_WRITE, endpoint, raw)
        self._send(node, self._layouts.rxsdo.command, data[: 4 + size])

    def answers(self, layout: Layout, timeout: float) -> Iterator[tuple[int, tuple[float, ...]]]:
        """Node and values of every message of a kind that comes within a time [s].

        Raises:
            BusFault: The bus failed, or another program commands a drive.
        """
        for message in self._frames(timeout):
            node, command = node_and_command(message.arbitration_id)
            if command != layout.command:
                continue
            data = bytes(message.data)
            if layout is self._layouts.txsdo and len(data) > 4:  # as long as its value is
                data = data.ljust(8, b"\0")
            values = layout.unpack(data)
            if values is not None:
                yield node, values

    def _send(self, node: int, command: int, data: bytes) -> None:
        identifier = can_id(node, command)
        self._own.sent(identifier)
        transmit(self._bus, SentFrame(identifier, data))

    def _frames(self, timeout: float) -> Iterator[can.Message]:
        for left in self._waits(timeout):
            while (message := take(self._bus, left)) is not None:
                if message.is_error_frame:
                    fault = error_frame_fault(
                        message.arbitration_id, message.data, bus_name(self._bus)
                    )
                    if fault is not None:
                        raise fault
                elif not (message.is_extended_id or message.is_remote_frame):
                    if self._own.is_foreign(message.arbitration_id):
                        text = foreign_text(message.arbitration_id)
                        raise ForeignMaster(text, bus_name(self._bus))
                    yield message
                if left > 0.0:
                    break

    def _waits(self, timeout: float) -> Iterator[float]:
        """How long to wait for the next frame; with simulated drives a cycle passes each time."""
        if self._pump is not None:
            for _ in range(math.ceil(timeout / PUMPED)):
                self._pump()
                yield 0.0
            return
        deadline = time.monotonic() + timeout
        while (left := deadline - time.monotonic()) > 0.0:
            yield left
