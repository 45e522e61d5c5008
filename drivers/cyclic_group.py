"""Common base of drive groups of all protocols: one thread, one bus, one state."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from typing import Protocol

import can

from drivers.can_bus import (
    echoes_own_frames,
    lost_frames,
    receive_frame,
    transmit,
)
from drivers.can_errors import (
    BusFault,
    EchoFilter,
    ErrorFrames,
    ForeignMaster,
    ReceiveOverflow,
    bus_text,
)
from drivers.can_load import check_bus_load
from drivers.drive_group import WHOLE_BUS, CycleStatus, GroupState, Pump
from drivers.plausibility import largest_steps
from drivers.setup_refusals import SETTING_UP
from model.errors import Refused
from model.rig import Rig

# One cycle on a bus: send frames, receive replies, check the bus. One thread.


MOST_STALE = 4096
"""Largest number of waiting frames per cycle; more than any bus carries in a few cycles."""


class ReplyListener(Protocol):
    """Processes frames of the drives."""

    @property
    def complete(self) -> bool:
        """Whether every drive has answered in this cycle."""

    def take(self, can_id: int, data: bytes | bytearray, *, stale: bool = False) -> None:
        """Processes one frame; a stale reply belongs to an earlier cycle."""


class CyclicBus:
    """Sends and receives the frames of a cycle.

    Bus faults are kept until `end_cycle` raises them, so that the replies of the cycle are still
    processed. Each kind is raised once.
    """

    def __init__(
        self,
        bus: can.BusABC,
        commanding: frozenset[int],
        foreign_master_message: Callable[[int, bytes | bytearray], str],
        is_command: Callable[[int, bytes | bytearray], bool],
    ) -> None:
        """Takes an open bus.

        Args:
            bus: Owned by the caller.
            commanding: Identifiers that only a master sends.
            foreign_master_message: Message about another master, by its frame.
            is_command: Whether a frame with one of the identifiers commands, by its data; drives
                and harmless requests may share an identifier with a command.
        """
        self._bus, self._where = bus, bus_text(bus)
        self._own = EchoFilter(commanding, echoes_own_frames=echoes_own_frames(bus))
        self._foreign_master_message, self._is_command = foreign_master_message, is_command
        self._errors = ErrorFrames(bus)
        self._lost = lost_frames(bus)
        self._found: list[BusFault] = []
        self._raised: set[str] = set()

    @property
    def error_frames(self) -> int:
        """Number of error frames so far."""
        return self._errors.total

    def send(self, messages: Iterable[can.Message]) -> None:
        """Sends frames back to back.

        Raises:
            BusFault: The bus did not accept a frame; the others were still sent.
        """
        failure: BusFault | None = None
        for message in messages:
            try:
                transmit(self._bus, message)
                if self._is_command(message.arbitration_id, message.data):
                    self._own.sent(message.arbitration_id)
            except BusFault as error:
                failure = failure or error
        if failure is not None:
            raise failure

    def forget_waiting(self) -> None:
        """Discards waiting frames; an overflow until now is not a fault.

        Raises:
            BusFault: The bus failed.
        """
        while receive_frame(self._bus, 0.0) is not None:
            pass
        self._lost = lost_frames(self._bus)

    def discard_stale(self, listener: ReplyListener) -> None:
        """Discards replies that came too late for their cycle.

        Raises:
            BusFault: The bus failed, or is flooded.
        """
        for _ in range(MOST_STALE):
            message = receive_frame(self._bus, 0.0)
            if message is None:
                return
            self._process(message, listener, stale=True)
        raise ReceiveOverflow(f"more than {MOST_STALE} frames waited to be read", self._where)

    def take_replies(self, listener: ReplyListener, timeout: float) -> None:
        """Processes frames until every drive has answered or the time [s] is over.

        Raises:
            BusFault: The bus failed.
        """
        deadline = time.monotonic() + timeout
        left = timeout
        for _ in range(MOST_STALE):
            if listener.complete or left < 0.0:  # other frames must not delay the cycle
                return
            message = receive_frame(self._bus, left)
            if message is None:
                return
            self._process(message, listener, stale=False)
            if timeout > 0.0:  # with 0 all waiting frames are processed
                left = deadline - time.monotonic()

    def forget_faults(self) -> None:
        """Forgets faults after a reset by the operator; persisting ones are raised again."""
        self._found.clear()
        self._raised.clear()

    def end_cycle(self) -> None:
        """Checks the bus.

        Raises:
            BusFault: A new fault was found.
        """
        self._find(self._errors.end_cycle())
        lost = lost_frames(self._bus)
        if lost > self._lost:
            what = f"{lost - self._lost} received frames were lost"
            self._find(ReceiveOverflow(what, self._where, {"lost_frames": lost - self._lost}))
            self._lost = lost
        while self._found:
            fault = self._found.pop(0)
            if fault.code not in self._raised:
                self._raised.add(fault.code)
                raise fault

    def _find(self, fault: BusFault | None) -> None:
        if fault is not None:
            self._found.append(fault)

    def _process(self, message: can.Message, listener: ReplyListener, *, stale: bool) -> None:
        if message.is_error_frame:
            self._find(self._errors.take(message))
            return
        if message.is_extended_id or message.is_remote_frame:
            return
        can_id, data = message.arbitration_id, message.data
        if self._is_command(can_id, data) and self._own.is_foreign(can_id):
            self._find(ForeignMaster(self._foreign_master_message(can_id, data), self._where))
        else:
            listener.take(can_id, data, stale=stale)


class GroupMonitor(ReplyListener, Protocol):
    """Last state of every drive."""

    def end_cycle(self) -> None:
        """Ends a cycle."""


class CyclicGroup(ABC):
    """A group with cyclic frames and replies; see `drivers.drive_group.DriveGroup`.

    Subclasses create `_cyclic` and `_watch` with every configuration.
    """

    _cyclic: CyclicBus
    _watch: GroupMonitor

    def __init__(self, rig: Rig, bus: can.BusABC, pump: Pump | None) -> None:
        """Takes an open bus and sends nothing yet; arguments as for `make_drive_group`."""
        check_bus_load(rig)
        self._rig, self._bus, self._pump = rig, bus, pump
        self._nodes = tuple(winch.node_id for winch in rig.winches)
        self._max_steps = largest_steps(rig, rig.cycle)
        self._state = GroupState.OFFLINE
        self._faults: list[tuple[int, str]] = []

    @abstractmethod
    def _latch(self, found: list[tuple[int, str]]) -> None:
        """Latches faults; the group stops if there are any."""

    @abstractmethod
    def _check_faults(self) -> None:
        """Faults that the drives reported in this cycle."""

    @abstractmethod
    def _advance(self) -> None:
        """Checks whether the transition in progress has finished or timed out."""

    @abstractmethod
    def _status(self) -> CycleStatus:
        """What the drives reported in this cycle."""

    @property
    def state(self) -> GroupState:
        """State of the group."""
        return self._state

    def receive(self, timeout_s: float) -> CycleStatus:
        """Receives the replies of this cycle; see `DriveGroup.receive`."""
        self._online()
        if self._pump is not None:
            self._pump()
            timeout_s = 0.0
        try:
            self._cyclic.take_replies(self._watch, timeout_s)
            self._cyclic.end_cycle()
        except BusFault as fault:
            self._latch_bus(fault)
            raise
        self._watch.end_cycle()
        self._check_faults()
        self._advance()
        return self._status()

    def close(self) -> None:
        """Detaches from the bus without sending anything."""
        self._state = GroupState.OFFLINE

    def _discard_stale(self) -> None:
        """Discards replies that came too late for their cycle.

        Raises:
            BusFault: The bus failed; the group is stopped.
        """
        try:
            self._cyclic.discard_stale(self._watch)
        except BusFault as fault:
            self._latch_bus(fault)
            raise

    def _latch_bus(self, fault: BusFault) -> None:
        """Latches a bus fault, so that the group stops even if the caller ignores the error."""
        self._latch([(WHOLE_BUS, fault.what)])

    def _online(self) -> None:
        if self._state is GroupState.OFFLINE:
            raise Refused(
                "the drives are not configured",
                where="drive group",
                next_step="call configure() first",
            )

    def _refuse_enabled(self) -> None:
        """Refuses configuration while drives are enabled or stopping.

        Raises:
            Refused: They are.
        """
        if self._state in (GroupState.ENABLING, GroupState.ENABLED) or self.stopping:
            raise Refused(
                "the drives are enabled; they cannot be configured now",
                where=SETTING_UP,
                next_step="stop them first",
            )

    @property
    def stopping(self) -> bool:
        """Whether a stop needs more cycles; False if the drives finish it themselves."""
        return False

    def _refuse_latched(self, wish: str) -> None:
        """Refuses a command after a fault; only stop and reset are allowed.

        Raises:
            Refused: A fault is latched.
        """
        if self._state is GroupState.FAULT:
            raise Refused(
                f"cannot {wish}: a fault is latched",
                where="drive group",
                why="; ".join(text for _, text in self._faults),
                next_step="find the cause, then reset the fault",
            )
