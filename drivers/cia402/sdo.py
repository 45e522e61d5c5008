"""Reading and writing objects of drives with canopen, without a thread.

canopen waits for replies that a receiving thread of python-can hands over. That thread dies for
good when the interface goes down, and it would share the bus with the cyclic loop, so here the
caller of a request takes the frames off the bus itself.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import TypeVar

import can
import canopen
from canopen.sdo.client import SdoClient

from cdpr.errors import CdprError, Fault, HardwareMissing, Refused
from drivers.bus import bus_name, hears_itself, take, transmit
from drivers.bus_faults import ForeignMaster
from drivers.cia402.frames import (
    NMT_ID,
    SDO_REPLY_BASE,
    SDO_REQUEST_BASE,
    NmtCommand,
    make_nmt,
)
from drivers.cia402.master_ids import foreign_text, set_up_ids
from drivers.cia402.texts import abort_text
from drivers.drive_group import Pump
from drivers.error_frames import error_frame_fault
from drivers.own_frames import OwnFrames
from drivers.set_up_refusals import SETTING_UP

RESPONSE_TIMEOUT = 0.5
"""For the answer to one request, [s]."""

ATTEMPTS = 2
"""A first request may be lost while a drive starts up."""

T = TypeVar("T")

ECHO_WAIT = 0.05
"""A second device with the same node id answers within this time of the first, [s]."""

OBJECT_DOES_NOT_EXIST = frozenset({0x06020000, 0x06090011})


class SetupNetwork:
    """The bus during set-up: sends NMT and SDO frames and takes the replies."""

    def __init__(self, bus: can.BusABC, pump: Pump | None, nodes: Sequence[int]) -> None:
        """Takes an open bus, ``pump`` as for `drivers.drive_group.make_drive_group`, the drives."""
        self._bus, self._pump = bus, pump
        self._network = canopen.Network(bus)
        self._clients: dict[int, _Client] = {}
        self._own = OwnFrames(set_up_ids(nodes), hears_itself=hears_itself(bus))

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
        self.note_sent(NMT_ID)
        transmit(self._bus, can.Message(arbitration_id=NMT_ID, data=data, is_extended_id=False))

    def note_sent(self, can_id: int) -> None:
        """A frame of this identifier goes out; it is not another master's when it comes back."""
        self._own.sent(can_id)

    def nodes_answering_twice(self) -> list[int]:
        """Nodes from which more answers have come than requests went to them."""
        deadline = time.monotonic() + ECHO_WAIT
        while (left := deadline - time.monotonic()) > 0.0 and self.hand_over(left):
            pass
        return [node for node, client in self._clients.items() if client.has_surplus]

    def take_waiting(self) -> None:
        """Hands over all that has come in up to now."""
        while self.hand_over(0.0):
            pass

    def discard_waiting(self) -> None:
        """Forgets frames that came in before; they say nothing about now."""
        while take(self._bus, 0.0) is not None:
            pass

    def hand_over(self, timeout: float) -> bool:
        """Hands one frame over; false when none came within the time [s].

        Raises:
            Refused: It is another master's.
            BusFault: The bus failed.
        """
        if self._pump is not None:
            self._pump()
            timeout = 0.0  # drives of this process have answered by now, or never will
        message = take(self._bus, timeout)
        if message is None:
            return False
        if message.is_error_frame:
            self._judge_error(message)
        elif not (message.is_remote_frame or message.is_extended_id):
            self._refuse_foreign(message.arbitration_id)
            self._network.notify(message.arbitration_id, message.data, message.timestamp)
        return True

    def _judge_error(self, message: can.Message) -> None:
        where = bus_name(self._bus)
        fault = error_frame_fault(message.arbitration_id, message.data, where)
        if fault is not None:
            raise fault

    def _refuse_foreign(self, can_id: int) -> None:
        if self._own.is_foreign(can_id):
            raise Refused(
                foreign_text(can_id),
                where=SETTING_UP,
                why=ForeignMaster.cause,
                next_step=ForeignMaster.remedy,
            )


class _NoAnswer(canopen.SdoCommunicationError):
    """Nothing came in time."""


class _Client(SdoClient):
    """canopen's SDO client, which takes its replies off the bus while it waits."""

    def __init__(self, node: int, network: SetupNetwork) -> None:
        nothing_known = canopen.ObjectDictionary()  # type: ignore[no-untyped-call]
        super().__init__(  # type: ignore[no-untyped-call]
            SDO_REQUEST_BASE + node, SDO_REPLY_BASE + node, nothing_known
        )
        self.node = node
        self._setup = network
        self._gave_up = False

    @property
    def has_surplus(self) -> bool:
        """Whether an answer waits that no request asked for; a late one does not count."""
        return not (self._gave_up or self.responses.empty())

    def send_request(self, request: bytes) -> None:
        """Puts a request on the bus."""
        self._setup.note_sent(SDO_REQUEST_BASE + self.node)
        super().send_request(request)  # type: ignore[no-untyped-call]

    def request_response(self, sdo_request: bytes) -> bytes:
        """Sends one request and returns the reply.

        Raises:
            canopen.SdoAbortedError: The drive said no.
            canopen.SdoCommunicationError: It did not answer.
        """
        while not self.responses.empty():  # replies to requests given up before
            self.responses.get_nowait()
        self.send_request(sdo_request)
        deadline = time.monotonic() + RESPONSE_TIMEOUT
        while self.responses.empty():
            left = deadline - time.monotonic()
            if left <= 0.0 or not self._setup.hand_over(left):
                self._gave_up = True
                raise _NoAnswer("no answer")
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
                    raise _no_sense(self.node, where, error) from error
            except can.CanError as error:
                raise Fault(
                    f"the bus did not take a frame: {error}",
                    where=where,
                    next_step="check cable, termination and bit rate",
                ) from error
        raise AssertionError("the last attempt either returned or raised")


def _no_sense(node: int, where: str, error: canopen.SdoCommunicationError) -> CdprError:
    """No answer, or one to another question."""
    if not isinstance(error, _NoAnswer):
        return Refused(
            f"drive {node} answers something else than it was asked: {error}",
            where=where,
            why="two devices have this node id, or another program talks to the drive",
            next_step="give every device on the bus its own node id; end other programs",
            values={"node": node},
        )
    return HardwareMissing(
        f"drive {node} does not answer",
        where=where,
        why="it has no power, another node id or another bit rate, or it is not on this bus",
        next_step="check power, wiring and node id; for simulated drives start `cdpr sim`",
        values={"node": node},
    )
