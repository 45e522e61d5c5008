"""Reads and writes objects of drives by SDO, without a thread and without canopen's client.

An answer is matched to a request by object and kind, so that late, duplicate or foreign answers are
ignored. The caller of a request receives the frames itself: a receiving thread would share the bus
with the cyclic loop, and would end when the interface goes down.

Source: CiA 301, 7.2.4 (SDO protocols).
"""

from __future__ import annotations

import struct
import time
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from math import ceil

import can

from drivers.can_bus import SentFrame, echoes_own_frames, receive_frame, transmit
from drivers.can_errors import EchoFilter, OtherMaster, error_frame_fault
from drivers.cia402.error_codes import abort_text
from drivers.cia402.pdo import (
    EMCY_BASE,
    HEARTBEAT_BASE,
    MASTER_NODE,
    NMT_ID,
    SDO_REPLY_BASE,
    SDO_REQUEST_BASE,
    NmtCommand,
    NmtState,
    commanding_ids,
    foreign_master_message,
    make_nmt,
    parse_heartbeat,
)
from drivers.cia402.sdo_jobs import SdoRequest, parse_value
from drivers.cia402.state_machine import DriveState, state_of
from drivers.drive_group import Pump
from drivers.setup_refusals import DriveRestarted, SdoAborted
from model.errors import CdprError, Fault, HardwareMissing, Refused

RESPONSE_TIMEOUT = 2.0
"""Time-out of a request unless the drive's profile states another, [s]."""

ATTEMPTS = 2
"""Attempts per transfer: a request or its answer may be lost while a drive starts up."""

CONTACT_REPEAT = 0.5
"""Period of repeated requests at first contact, [s]."""

ECHO_WAIT = 0.05
"""Time within which a second device with the same node id answers, [s]."""

NOT_NOW = frozenset({0x08000020, 0x08000021, 0x08000022})
"""Abort codes of an object that exists but cannot be transferred in the present state."""

TIMED_OUT, WRITE_ONLY = 0x05040000, 0x06010001
"""Abort codes: SDO protocol timed out; attempt to read a write-only object."""

Key = tuple[int, int, int]
"""Kind of an answer, index and sub-index."""

_UPLOAD, _DOWNLOAD, _SEGMENT, _ABORT = 0x40, 0x60, 0x00, 0x80
_SEGMENTS = (_SEGMENT, _SEGMENT | 0x10)
_KIND = 0xE0
_HEAD = struct.Struct("<BHB")


class _Aborted(Exception):
    """The drive aborted the transfer."""

    def __init__(self, code: int) -> None:
        super().__init__(f"{code:08X}h")
        self.code = code


class _NoAnswer(Exception):
    """No answer within the time-out."""


class SetupNetwork:
    """The bus during configuration: sends NMT and SDO frames and receives the replies.

    Attributes:
        emergencies: Data of the last EMCY of each drive, by identifier.
        silent: Nodes without an answer when last contacted.
    """

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
            pump: As for `drivers.factory.make_drive_group`.
            timeout: Of one request, [s].
            clock: Monotonic, [s].
        """
        self._bus, self._pump = bus, pump
        self.timeout, self.clock = timeout, clock
        self._clients: dict[int, Client] = {}
        self._states: dict[int, int | None] = {}
        self._nodes, self._refuses_restarts = frozenset(nodes), False
        self.emergencies: dict[int, bytes] = {}
        self.silent: list[int] = []
        self._own = EchoFilter(
            commanding_ids(nodes), echoes_own_frames=echoes_own_frames(bus), batch=len(nodes)
        )

    def client(self, node: int) -> Client:
        """The SDO client for a node."""
        if node not in self._clients:
            self._clients[node] = Client(node, self)
        return self._clients[node]

    def is_stopped(self, node: int) -> bool:
        """Whether the node's last heartbeat says NMT *stopped*, where it answers no SDO."""
        return self._states.get(node) == NmtState.STOPPED

    def refuse_restarts(self) -> None:
        """From now on a drive's boot-up is a `DriveRestarted`; until now it merely started."""
        self._refuses_restarts = True

    def command(self, command: NmtCommand, node: int) -> None:
        """Sends an NMT command to one node."""
        self.send(NMT_ID, make_nmt(command, node))

    def send(self, can_id: int, data: bytes) -> None:
        """Sends a frame, and expects its echo."""
        self._own.sent(can_id)
        transmit(self._bus, SentFrame(can_id, data))

    def silent_nodes(self, nodes: Iterable[int]) -> list[int]:
        """Requests the device type (1000h) from all nodes at once; returns those without an answer.

        Requests are repeated, as a booting drive receives nothing. All silent drives together cost
        one time-out.
        """
        waiting = [self.client(node) for node in nodes]
        begin, times = self.clock(), ATTEMPTS
        if self._pump is None:  # for simulated drives time advances with each request
            times = max(times, ceil(self.timeout / CONTACT_REPEAT))
        for number in range(1, times + 1):
            for client in waiting:
                client.ask_device_type()
            self._await(waiting, begin + min(number * CONTACT_REPEAT, self.timeout))
            waiting = [client for client in waiting if client.waits]
        for client in waiting:
            client.give_up()
        self.silent = [client.node for client in waiting]
        return self.silent

    def _await(self, clients: Sequence[Client], deadline: float) -> None:
        """Receives answers until all have arrived or the deadline has passed."""
        while any(client.waits for client in clients):
            if not self.receive_until(deadline) and (self._pump or self.clock() >= deadline):
                return

    def nodes_answering_twice(self) -> list[int]:
        """Nodes that sent more answers than they got requests."""
        deadline = self.clock() + ECHO_WAIT
        while self.receive_until(deadline):
            pass
        return [node for node, client in self._clients.items() if client.has_surplus]

    def receive_until(self, deadline: float) -> bool:
        """Processes one frame; past the deadline all that arrived while the program was held up."""
        if (left := deadline - self.clock()) > 0.0:
            return self.process_frame(left)
        self.process_waiting()
        return False

    def process_waiting(self) -> None:
        """Processes all frames received so far."""
        while self.process_frame(0.0):
            pass

    def discard_waiting(self) -> None:
        """Discards frames received earlier."""
        while receive_frame(self._bus, 0.0) is not None:
            pass

    def process_frame(self, timeout: float) -> bool:
        """Processes one frame; False if none arrives within the time [s].

        Raises:
            Refused: The frame is another master's, or a drive's that restarted.
            BusFault: The bus failed.
        """
        if self._pump is not None:
            self._pump()
            timeout = 0.0  # simulated drives have answered by now, or never will
        message = receive_frame(self._bus, timeout)
        if message is None:
            return False
        if message.is_error_frame:
            fault = error_frame_fault(self._bus, message)
            if fault is not None:
                raise fault
        elif not (message.is_remote_frame or message.is_extended_id):
            self._refuse_foreign(message)
            node = message.arbitration_id - HEARTBEAT_BASE
            if 0 < node < MASTER_NODE:
                state = self._states[node] = parse_heartbeat(message.data)
                if state == NmtState.BOOT_UP and self._refuses_restarts and node in self._nodes:
                    raise DriveRestarted(node)
            if message.arbitration_id - EMCY_BASE in self._nodes:
                self.emergencies[message.arbitration_id] = bytes(message.data)
            if client := self._clients.get(message.arbitration_id - SDO_REPLY_BASE):
                client.take(bytes(message.data))
        return True

    def wait(self, seconds: float) -> None:
        """Processes frames for some time; returns at once with simulated drives."""
        deadline = self.clock() + seconds
        while self.receive_until(deadline) or (self._pump is None and self.clock() < deadline):
            pass

    def _refuse_foreign(self, message: can.Message) -> None:
        if self._own.is_foreign(message.arbitration_id):
            raise OtherMaster(foreign_master_message(message.arbitration_id, message.data))


class Client:
    """SDO client of one drive, with one request at a time."""

    def __init__(self, node: int, network: SetupNetwork) -> None:
        self.node = node
        self._network = network
        self._wanted: Key | None = None
        self._answer: bytes | None = None
        self._asked: Counter[Key] = Counter()
        self._answered: Counter[Key] = Counter()
        self._unexpected = 0  # answers without a request

    @property
    def waits(self) -> bool:
        """Whether a request awaits its answer."""
        return self._wanted is not None and self._answer is None

    @property
    def has_surplus(self) -> bool:
        """Whether a request was answered more often than sent: two devices have this node id."""
        return any(self._answered[key] > times for key, times in self._asked.items())

    def no_answer(self, where: str) -> CdprError:
        """The error for a missing answer: silence, or answers to other requests."""
        if not self._unexpected:
            return silent(self.node, where)
        return Refused(
            f"drive {self.node} answered a different request",
            where=where,
            why="two devices have this node id, or another program accesses the drive",
            next_step="give each device on the bus a unique node id; end other programs",
            values={"node": self.node},
        )

    def take(self, data: bytes) -> None:
        """Processes a frame of the drive; it is ignored if it answers no open request."""
        if len(data) != 8:
            return
        command, index, sub = _HEAD.unpack_from(data)
        kind = command & _KIND
        if kind in (_SEGMENT, _ABORT):
            known = [key for key in self._asked if _answers(key, command, index, sub)]
        else:
            known = [key for key in [(kind, index, sub)] if key in self._asked]
        segments = [key for key in known if key[0] in _SEGMENTS]
        # A segment names no object: it counts for the open request, or else for any.
        own = [key for key in segments if key == self._wanted]
        self._answered.update((own or segments)[:1] or known)
        self._unexpected += not known
        if self.waits and self._wanted is not None and _answers(self._wanted, command, index, sub):
            self._answer = data

    def ask_device_type(self) -> None:
        """Sends the request of first contact; see `waits`."""
        self._ask(SdoRequest(0x1000, 0).frame(), (_UPLOAD, 0x1000, 0))

    def give_up(self) -> None:
        """Stops waiting for the answer to the open request."""
        self._wanted = None

    def read(self, index: int, sub: int, name: str, size: int = 4) -> bytes:
        """Reads an object.

        Args:
            size: Size of the value if the answer does not state it, [bytes].

        Raises:
            HardwareMissing: The drive does not answer.
            Refused: It aborts the transfer.
        """
        target = f"{index:04X}h:{sub:02X} {name}"
        return self._attempt(lambda: self._read(index, sub, size), target)

    def read_state(self) -> DriveState:
        """The state in the status word; errors as `read`."""
        return state_of(int.from_bytes(self.read(0x6041, 0, "status word", 2), "little"))

    def read_if_there(self, index: int, sub: int, name: str, size: int = 4) -> bytes | None:
        """Reads an optional object as `read`; None if the drive lacks it (`means_absent`).

        Raises:
            HardwareMissing: The drive does not answer.
            Refused: It may have the object, and aborts the transfer.
        """
        try:
            return self.read(index, sub, name, size)
        except SdoAborted as error:
            if means_absent(error):
                return None
            raise

    def write(self, index: int, sub: int, data: bytes, name: str) -> None:
        """Writes an object of one to four bytes.

        Raises:
            HardwareMissing: The drive does not answer.
            Refused: It aborts the transfer.
        """
        target = f"{index:04X}h:{sub:02X} {name}"
        request = SdoRequest(index, sub, data).frame()
        self._attempt(lambda: self._exchange(request, (_DOWNLOAD, index, sub)), target)

    def _read(self, index: int, sub: int, size: int) -> bytes:
        reply = self._exchange(SdoRequest(index, sub).frame(), (_UPLOAD, index, sub))
        is_expedited = reply[0] & 0x02
        return parse_value(reply, size) if is_expedited else self._read_segments(index, sub)

    def _read_segments(self, index: int, sub: int) -> bytes:
        """Reads the data of a segmented transfer, in segments of up to seven bytes."""
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
        """Sends one request and returns its answer."""
        self._ask(request, wanted)
        deadline = self._network.clock() + self._network.timeout
        while self._answer is None:
            if not self._network.receive_until(deadline) and self._answer is None:
                self.give_up()
                raise _NoAnswer
        answer, self._wanted, self._answer = self._answer, None, None
        if answer[0] == _ABORT:
            raise _Aborted(int.from_bytes(answer[4:], "little"))
        return answer

    def _attempt(self, transfer: Callable[[], bytes], target: str) -> bytes:
        """Runs a transfer with repetitions; errors name node and object."""
        where = f"drive {self.node}, object {target}"
        for attempt in range(1, ATTEMPTS + 1):
            try:
                return transfer()
            except _Aborted as error:
                text = abort_text(error.code)
                raise SdoAborted(self.node, target, error.code, text) from None
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


def _answers(wanted: Key, command: int, index: int, sub: int) -> bool:
    """Whether a frame answers the wanted kind and object.

    A segment names no object; its toggle bit distinguishes it from the previous one.
    """
    kind, wanted_index, wanted_sub = wanted
    if command == _ABORT:
        return (index, sub) == (wanted_index, wanted_sub)
    if kind in _SEGMENTS:
        return command & (_KIND | 0x10) == kind
    return command & _KIND == kind and (index, sub) == (wanted_index, wanted_sub)


def means_absent(error: SdoAborted) -> bool:
    """Whether the refusal of a read means that the drive lacks the object.

    Drives use many abort codes for that; only these say nothing about it: a time-out, and those
    of the present state.
    """
    return error.abort_code not in (TIMED_OUT, *NOT_NOW)


def silent(node: int, where: str) -> HardwareMissing:
    """A drive does not answer."""
    return HardwareMissing(
        f"drive {node} does not answer",
        where=where,
        why="no power, a wrong node id or bit rate, or the drive is on another bus",
        next_step="check power, wiring and node id; for simulated drives, start `cdpr sim`",
        values={"node": node},
    )
