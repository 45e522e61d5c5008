"""Reading and writing objects of drives by SDO, without a thread and without canopen's client.

An answer counts for a request only when it names the same object and is of the same kind, so that
one that comes late, twice or for another object is never taken for this one's. The caller of a
request takes the frames off the bus itself: a receiving thread would share the bus with the cyclic
loop, and dies for good when the interface goes down.

Source: CiA 301, 7.2.4 (SDO protocols).
"""

from __future__ import annotations

import struct
import time
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from math import ceil

import can

from drivers.can_bus import EchoFilter, bus_name, echoes_own_frames, take, transmit
from drivers.can_errors import SETTING_UP, ForeignMaster, error_frame_fault
from drivers.cia402.error_codes import abort_text
from drivers.cia402.pdo import (
    NMT_ID,
    SDO_REPLY_BASE,
    SDO_REQUEST_BASE,
    NmtCommand,
    foreign_master_message,
    make_nmt,
    set_up_ids,
)
from drivers.cia402.sdo_jobs import OBJECT_DOES_NOT_EXIST
from drivers.drive_group import Pump
from model.errors import CdprError, Fault, HardwareMissing, Refused

RESPONSE_TIMEOUT = 2.0
"""For the answer to one request unless the drive's profile says otherwise, [s]."""

ATTEMPTS = 2
"""A request or its answer may be lost while a drive starts up."""

CONTACT_REPEAT = 0.5
"""So often a drive that has not answered at first contact is asked again, [s]."""

ECHO_WAIT = 0.05
"""A second device with the same node id answers within this time of the first, [s]."""

NOT_NOW = frozenset({0x08000020, 0x08000021, 0x08000022})
"""The drive has the object, and does not transfer it in its present state."""

Key = tuple[int, int, int]
"""Kind of an answer, index and sub-index."""

_UPLOAD, _DOWNLOAD, _SEGMENT = 0x40, 0x60, 0x00
_SEGMENTS = (_SEGMENT, _SEGMENT | 0x10)
_ABORT = 0x80
_KIND = 0xE0
_HEAD = struct.Struct("<BHB")


class _Aborted(Exception):
    """The drive said no, with an abort code."""

    def __init__(self, code: int) -> None:
        super().__init__(f"{code:08X}h")
        self.code = code


class _NoAnswer(Exception):
    """Nothing came in time."""


class SetupNetwork:
    """The bus during set-up: sends NMT and SDO frames and takes the replies."""

    def __init__(
        self,
        bus: can.BusABC,
        pump: Pump | None,
        nodes: Sequence[int],
        *,
        timeout: float = RESPONSE_TIMEOUT,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Takes an open bus and sends nothing yet.

        Args:
            bus: The bus.
            pump: As for `drivers.factory.make_drive_group`.
            nodes: The drives.
            timeout: For the answer to one request, [s].
            clock: Monotonic, [s].
        """
        self._bus, self._pump = bus, pump
        self.timeout, self.clock = timeout, clock
        self._clients: dict[int, Client] = {}
        self._own = EchoFilter(set_up_ids(nodes), echoes_own_frames=echoes_own_frames(bus))

    def client(self, node: int) -> Client:
        """The SDO client for a node."""
        if node not in self._clients:
            self._clients[node] = Client(node, self)
        return self._clients[node]

    def command(self, command: NmtCommand, node: int) -> None:
        """Sends an NMT command to one node."""
        self.send(NMT_ID, make_nmt(command, node))

    def send(self, can_id: int, data: bytes) -> None:
        """Sends a frame; it is not another master's when it comes back."""
        self._own.sent(can_id)
        transmit(self._bus, can.Message(arbitration_id=can_id, data=data, is_extended_id=False))

    def silent_nodes(self, nodes: Iterable[int]) -> list[int]:
        """Asks all nodes for their device type (1000h) at once; those that do not answer.

        They are asked again and again, as a drive hears nothing before it has booted. A silent
        drive costs one time-out, however many of them there are.
        """
        waiting = [self.client(node) for node in nodes]
        begin, times = self.clock(), ATTEMPTS
        if self._pump is None:  # drives of this process let their own time pass as they are asked
            times = max(times, ceil(self.timeout / CONTACT_REPEAT))
        for number in range(1, times + 1):
            for client in waiting:
                client.ask_device_type()
            self._await(waiting, begin + min(number * CONTACT_REPEAT, self.timeout))
            waiting = [client for client in waiting if client.waits]
        for client in waiting:
            client.give_up()
        return [client.node for client in waiting]

    def _await(self, clients: Sequence[Client], deadline: float) -> None:
        """Takes answers until all have come, or it is that late."""
        while any(client.waits for client in clients):
            left = deadline - self.clock()
            if left <= 0.0 or (not self.hand_over(left) and self._pump is not None):
                return

    def nodes_answering_twice(self) -> list[int]:
        """Nodes from which more answers have come than requests went to them."""
        deadline = self.clock() + ECHO_WAIT
        while (left := deadline - self.clock()) > 0.0 and self.hand_over(left):
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
            client = self._clients.get(message.arbitration_id - SDO_REPLY_BASE)
            if client is not None:
                client.take(bytes(message.data))
        return True

    def wait(self, seconds: float) -> None:
        """Lets time pass and takes what comes meanwhile; returns at once with drives of here."""
        deadline = self.clock() + seconds
        while (left := deadline - self.clock()) > 0.0:
            if not self.hand_over(left) and self._pump is not None:
                return

    def _judge_error(self, message: can.Message) -> None:
        where = bus_name(self._bus)
        fault = error_frame_fault(message.arbitration_id, message.data, where)
        if fault is not None:
            raise fault

    def _refuse_foreign(self, can_id: int) -> None:
        if self._own.is_foreign(can_id):
            raise Refused(
                foreign_master_message(can_id),
                where=SETTING_UP,
                why=ForeignMaster.cause,
                next_step=ForeignMaster.remedy,
            )


class Client:
    """Asks one drive, one request at a time."""

    def __init__(self, node: int, network: SetupNetwork) -> None:
        """Takes the node and the bus that it is on."""
        self.node = node
        self._network = network
        self._wanted: Key | None = None
        self._answer: bytes | None = None
        self._asked: Counter[Key] = Counter()
        self._answered: Counter[Key] = Counter()
        self._strange = 0  # answers that no request ever asked for

    @property
    def waits(self) -> bool:
        """A request is out and its answer has not come."""
        return self._wanted is not None and self._answer is None

    @property
    def has_surplus(self) -> bool:
        """A request was answered more often than it was sent: two devices have this node id."""
        return any(self._answered[key] > times for key, times in self._asked.items())

    def no_answer(self, where: str) -> CdprError:
        """Why a request stays without its answer: silence, or answers to other questions."""
        if not self._strange:
            return silent(self.node, where)
        return Refused(
            f"drive {self.node} answered a different request",
            where=where,
            why="two devices have this node id, or another program talks to the drive",
            next_step="give each device on the bus a unique node id; end other programs",
            values={"node": self.node},
        )

    def take(self, data: bytes) -> None:
        """Takes in a frame of the drive; one that answers no open request is thrown away."""
        if len(data) != 8:
            return
        command, index, sub = _HEAD.unpack_from(data)
        known = [key for key in self._asked if _answers(key, command, index, sub)]
        segments = [key for key in known if key[0] in _SEGMENTS]
        # A segment names no object: it counts for the one that is asked for, or for any of them.
        own = [key for key in segments if key == self._wanted]
        self._answered.update((own or segments)[:1] or known)
        self._strange += not known
        if self.waits and self._wanted is not None and _answers(self._wanted, command, index, sub):
            self._answer = data

    def ask_device_type(self) -> None:
        """Sends the request of first contact; `waits` says whether it was answered."""
        self._ask(_upload(0x1000, 0), (_UPLOAD, 0x1000, 0))

    def give_up(self) -> None:
        """The answer to the open request is not waited for any longer; it may still come."""
        self._wanted = None

    def read(self, index: int, sub: int, name: str, size: int = 4) -> bytes:
        """Reads an object.

        Args:
            index: Its index.
            sub: Its sub-index.
            name: For messages.
            size: Of its value, [bytes]; counts where the drive's answer does not state it.

        Raises:
            HardwareMissing: The drive does not answer.
            Refused: It will not read the object.
        """
        place = f"{index:04X}h:{sub:02X} {name}"
        return self._attempt(lambda: self._read(index, sub, size), place)

    def read_if_there(self, index: int, sub: int, name: str, size: int = 4) -> bytes | None:
        """Reads an object that not every drive has; None where it has not; as `read`.

        Raises:
            HardwareMissing: The drive does not answer.
            Refused: It has the object and will not read it.
        """
        try:
            return self.read(index, sub, name, size)
        except Refused as error:
            if error.values.get("abort_code") in OBJECT_DOES_NOT_EXIST:
                return None
            raise

    def write(self, index: int, sub: int, data: bytes, name: str) -> None:
        """Writes an object of one to four bytes.

        Raises:
            HardwareMissing: The drive does not answer.
            Refused: It will not take the value.
        """
        place = f"{index:04X}h:{sub:02X} {name}"
        request = _HEAD.pack(0x23 | (4 - len(data)) << 2, index, sub) + data.ljust(4, b"\0")
        self._attempt(lambda: self._exchange(request, (_DOWNLOAD, index, sub)), place)

    def _read(self, index: int, sub: int, size: int) -> bytes:
        reply = self._exchange(_upload(index, sub), (_UPLOAD, index, sub))
        command = reply[0]
        if command & 0x02:  # expedited: the data are in this frame
            stated = 4 - (command >> 2 & 0x03) if command & 0x01 else size
            return reply[4 : 4 + stated]
        return self._read_segments(index, sub)

    def _read_segments(self, index: int, sub: int) -> bytes:
        """The other legal answer: the data follow in segments of up to seven bytes."""
        data, toggle = b"", 0
        while True:
            request = bytes((0x60 | toggle,)) + bytes(7)
            reply = self._exchange(request, (_SEGMENT | toggle, index, sub))
            data += reply[1 : 8 - (reply[0] >> 1 & 0x07)]
            if reply[0] & 0x01:
                return data
            toggle ^= 0x10

    def _ask(self, request: bytes, wanted: Key) -> None:
        self._wanted, self._answer = wanted, None
        self._asked[wanted] += 1
        self._network.send(SDO_REQUEST_BASE + self.node, request)

    def _exchange(self, request: bytes, wanted: Key) -> bytes:
        """Sends one request and returns its answer.

        Raises:
            _Aborted: The drive said no.
            _NoAnswer: It did not answer in time.
        """
        self._ask(request, wanted)
        deadline = self._network.clock() + self._network.timeout
        while self._answer is None:
            left = deadline - self._network.clock()
            if left <= 0.0 or not self._network.hand_over(left):
                self.give_up()
                raise _NoAnswer
        answer, self._wanted, self._answer = self._answer, None, None
        if answer[0] == _ABORT:
            raise _Aborted(int.from_bytes(answer[4:], "little"))
        return answer

    def _attempt(self, transfer: Callable[[], bytes], place: str) -> bytes:
        """Runs a transfer; errors name node and object."""
        where = f"drive {self.node}, object {place}"
        for attempt in range(1, ATTEMPTS + 1):
            try:
                return transfer()
            except _Aborted as error:
                raise Refused(
                    f"the drive refused: {abort_text(error.code)}",
                    where=where,
                    next_step="compare the object with the drive's manual and its EDS file;"
                    " `cdpr doctor RIG --drives` lists all objects of all drives",
                    values={"node": self.node, "object": place, "abort_code": error.code},
                ) from None
            except _NoAnswer:
                if attempt == ATTEMPTS:
                    raise self.no_answer(where) from None
            except can.CanError as error:
                raise Fault(
                    f"a frame could not be sent: {error}",
                    where=where,
                    next_step="check cable, termination and bit rate",
                ) from error
        raise AssertionError("the last attempt either returned or raised")


def _upload(index: int, sub: int) -> bytes:
    return _HEAD.pack(0x40, index, sub) + bytes(4)


def _answers(wanted: Key, command: int, index: int, sub: int) -> bool:
    """Whether a frame is an answer of the kind and to the object that are waited for.

    A segment names no object; its toggle bit distinguishes it from the one before.
    """
    kind, wanted_index, wanted_sub = wanted
    if command == _ABORT:
        return (index, sub) == (wanted_index, wanted_sub)
    if kind in _SEGMENTS:
        return command & (_KIND | 0x10) == kind
    return command & _KIND == kind and (index, sub) == (wanted_index, wanted_sub)


def silent(node: int, where: str) -> HardwareMissing:
    """A drive does not answer."""
    return HardwareMissing(
        f"drive {node} does not answer",
        where=where,
        why="no power, a wrong node id or bit rate, or the drive is on another bus",
        next_step="check power, wiring and node id; for simulated drives, start `cdpr sim`",
        values={"node": node},
    )
