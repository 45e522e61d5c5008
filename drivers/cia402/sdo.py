"""Reading and writing objects of drives with canopen, without a thread.

canopen waits for replies that a receiving thread of python-can hands over. That thread dies for
good when the interface goes down, and it would share the bus with the cyclic loop, so here the
caller of a request takes the frames off the bus itself.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TypeVar

import can
import canopen
from canopen.sdo.client import SdoClient

from cdpr.errors import Fault, HardwareMissing, Refused
from drivers.bus import take, transmit
from drivers.cia402.frames import (
    NMT_ID,
    SDO_REPLY_BASE,
    SDO_REQUEST_BASE,
    SYNC_ID,
    NmtCommand,
    make_nmt,
)
from drivers.cia402.texts import abort_text
from drivers.drive_group import Pump

RESPONSE_TIMEOUT = 0.5
"""For the answer to one request, [s]."""

ATTEMPTS = 2
"""A first request may be lost while a drive starts up."""

T = TypeVar("T")

OBJECT_DOES_NOT_EXIST = frozenset({0x06020000, 0x06090011})


class SetupNetwork:
    """The bus during set-up: sends NMT and SDO frames and takes the replies."""

    def __init__(self, bus: can.BusABC, pump: Pump | None) -> None:
        """Takes an open bus; ``pump`` as for `drivers.drive_group.make_drive_group`."""
        self._bus, self._pump = bus, pump
        self._network = canopen.Network(bus)
        self._clients: dict[int, _Client] = {}
        self.foreign_sync = False
        """A SYNC came by: another master is at work on this bus."""
        self._network.subscribe(SYNC_ID, self._on_sync)

    def client(self, node: int) -> _Client:
        """The SDO client for a node."""
        if node not in self._clients:
            client = _Client(node, self)
            client.network = self._network
            self._network.subscribe(SDO_REPLY_BASE + node, client.on_response)
            self._clients[node] = client
        return self._clients[node]

    def command(self, command: NmtCommand, node: int) -> None:
        """Sends an NMT command to one node."""
        data = make_nmt(command, node)
        transmit(self._bus, can.Message(arbitration_id=NMT_ID, data=data, is_extended_id=False))

    def discard_waiting(self) -> None:
        """Forgets frames that came in before; they say nothing about now."""
        while take(self._bus, 0.0) is not None:
            pass

    def hand_over(self, timeout: float) -> bool:
        """Hands one frame over; false when none came within the time [s]."""
        if self._pump is not None:
            self._pump()
            timeout = 0.0  # drives of this process have answered by now, or never will
        message = take(self._bus, timeout)
        if message is None:
            return False
        if not (message.is_error_frame or message.is_remote_frame or message.is_extended_id):
            self._network.notify(message.arbitration_id, message.data, message.timestamp)
        return True

    def _on_sync(self, can_id: int, data: bytearray, timestamp: float) -> None:
        self.foreign_sync = True


class _Client(SdoClient):
    """canopen's SDO client, which takes its replies off the bus while it waits."""

    def __init__(self, node: int, network: SetupNetwork) -> None:
        nothing_known = canopen.ObjectDictionary()  # type: ignore[no-untyped-call]
        super().__init__(  # type: ignore[no-untyped-call]
            SDO_REQUEST_BASE + node, SDO_REPLY_BASE + node, nothing_known
        )
        self.node = node
        self._setup = network

    def request_response(self, sdo_request: bytes) -> bytes:
        """Sends one request and returns the reply.

        Raises:
            canopen.SdoAbortedError: The drive said no.
            canopen.SdoCommunicationError: It did not answer.
        """
        while not self.responses.empty():  # replies to requests given up before
            self.responses.get_nowait()
        self.send_request(sdo_request)  # type: ignore[no-untyped-call]
        deadline = time.monotonic() + RESPONSE_TIMEOUT
        while self.responses.empty():
            left = deadline - time.monotonic()
            if left <= 0.0 or not self._setup.hand_over(left):
                raise canopen.SdoCommunicationError("no answer")
        reply: bytes = self.read_response()  # type: ignore[no-untyped-call]
        return reply

    def read(self, index: int, sub: int, name: str) -> bytes:
        """Reads an object.

        Raises:
            HardwareMissing: The drive does not answer.
            Refused: It will not read the object.
        """
        return self._attempt(lambda: self.upload(index, sub), f"{index:04X}h:{sub:02X} {name}")

    def read_if_there(self, index: int, sub: int, name: str) -> bytes | None:
        """Reads an object that not every drive has; None where it has not.

        Raises:
            HardwareMissing: The drive does not answer.
            Refused: It has the object and will not read it.
        """
        try:
            return self.read(index, sub, name)
        except Refused as error:
            if error.values.get("abort_code") in OBJECT_DOES_NOT_EXIST:
                return None
            raise

    def write(self, index: int, sub: int, data: bytes, name: str) -> None:
        """Writes an object.

        Raises:
            HardwareMissing: The drive does not answer.
            Refused: It will not take the value.
        """
        place = f"{index:04X}h:{sub:02X} {name}"
        self._attempt(lambda: self.download(index, sub, data), place)

    def _attempt(self, transfer: Callable[[], T], place: str) -> T:
        """Runs a transfer; the library's errors become ours, with node and object."""
        where = f"drive {self.node}, object {place}"
        for attempt in range(1, ATTEMPTS + 1):
            try:
                return transfer()
            except canopen.SdoAbortedError as error:
                raise Refused(
                    f"the drive refused: {abort_text(error.code)}",
                    where=where,
                    next_step="compare the object with the drive's manual and its EDS file",
                    values={"node": self.node, "object": place, "abort_code": error.code},
                ) from error
            except canopen.SdoCommunicationError as error:
                if attempt == ATTEMPTS:
                    raise _silent(self.node, where) from error
            except can.CanError as error:
                raise Fault(
                    f"the bus did not take a frame: {error}",
                    where=where,
                    next_step="check cable, termination and bit rate",
                ) from error
        raise _silent(self.node, where)


def _silent(node: int, where: str) -> HardwareMissing:
    return HardwareMissing(
        f"drive {node} does not answer",
        where=where,
        why="it has no power, another node id or another bit rate, or it is not on this bus",
        next_step="check power, wiring and node id; for simulated drives start `cdpr sim`",
        values={"node": node},
    )
