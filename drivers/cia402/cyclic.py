"""The cyclic frames on the bus: set-points and SYNC out, replies in. One thread, no library."""

from __future__ import annotations

import time
from collections.abc import Sequence

import can

from drivers.bus import SentFrame, bus_name, hears_itself, lost_frames, take, transmit
from drivers.bus_faults import BusFault, ForeignMaster, ReceiveOverflow
from drivers.cia402.frames import (
    HEARTBEAT_BASE,
    MASTER_NODE,
    RPDO1_BASE,
    SYNC_ID,
    NmtState,
    make_heartbeat,
    make_set_point,
    make_sync,
)
from drivers.cia402.own_frames import OwnFrames, commanding_ids, foreign_text
from drivers.cia402.states import ControlWord
from drivers.cia402.watch import DriveWatch
from drivers.error_frames import ErrorFrames

MOST_STALE = 4096
"""Frames that may wait at the beginning of a cycle; more than any bus carries in a few of them."""


class CyclicBus:
    """Sends and takes what belongs to a cycle; its frames are built once and filled each cycle.

    What is wrong with the bus itself is kept until `end_cycle` raises it, so that the replies of
    the cycle are taken in all the same. Each kind is raised once.
    """

    def __init__(self, bus: can.BusABC, nodes: Sequence[int]) -> None:
        """Takes an open bus and the node ids in the order of the winches."""
        self._bus, self._where = bus, bus_name(bus)
        self._own = OwnFrames(commanding_ids(nodes), hears_itself=hears_itself(bus))
        self._errors = ErrorFrames(self._where)
        self._lost = lost_frames(bus)
        self._found: list[BusFault] = []
        self._raised: set[str] = set()
        rest = make_set_point(ControlWord.QUICK_STOP, 0)
        self._set_points = [_frame(RPDO1_BASE + node, rest) for node in nodes]
        self._sync = _frame(SYNC_ID, make_sync())
        alive = make_heartbeat(NmtState.OPERATIONAL)
        self._heartbeat = _frame(HEARTBEAT_BASE + MASTER_NODE, alive)

    @property
    def error_frames(self) -> int:
        """Error frames that came so far."""
        return self._errors.total

    def send_cycle(self, words: Sequence[ControlWord], targets: Sequence[int]) -> None:
        """One set-point a drive, then SYNC.

        Raises:
            BusFault: The bus did not take a frame; the others were sent all the same.
            struct.error: A target does not fit 32 bits; nothing was sent.
        """
        for message, word, target in zip(self._set_points, words, targets, strict=True):
            message.data = bytearray(make_set_point(word, target))
        failure: BusFault | None = None
        for message in (*self._set_points, self._sync):
            try:
                self._send(message)
            except BusFault as error:
                failure = failure or error
        if failure is not None:
            raise failure

    def send_heartbeat(self) -> None:
        """The master's sign of life.

        Raises:
            BusFault: The bus did not take it.
        """
        self._send(self._heartbeat)

    def _send(self, message: can.Message) -> None:
        transmit(self._bus, message)
        self._own.sent(message.arbitration_id)

    def discard_stale(self, watch: DriveWatch) -> None:
        """Replies that came too late for their cycle are thrown away, never used as new ones.

        Raises:
            BusFault: The bus failed, or is flooded.
        """
        for _ in range(MOST_STALE):
            message = take(self._bus, 0.0)
            if message is None:
                return
            self._hand_over(message, watch, stale=True)
        raise ReceiveOverflow(f"more than {MOST_STALE} frames waited to be fetched", self._where)

    def take_replies(self, watch: DriveWatch, timeout: float) -> None:
        """Hands frames over until every drive has answered or the time [s] is over.

        Raises:
            BusFault: The bus failed.
        """
        deadline = time.monotonic() + timeout
        left = timeout
        for _ in range(MOST_STALE):
            if watch.complete or left < 0.0:  # a bus full of other frames must not hold us up
                return
            message = take(self._bus, left)
            if message is None:
                return
            self._hand_over(message, watch, stale=False)
            if timeout > 0.0:  # with 0 all that has arrived is taken
                left = deadline - time.monotonic()

    def forget_faults(self) -> None:
        """After a reset by the operator: what is still wrong is raised again."""
        self._found.clear()
        self._raised.clear()

    def end_cycle(self) -> None:
        """Looks at the health of the bus.

        Raises:
            BusFault: Something about it is wrong, for the first time.
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

    def _hand_over(self, message: can.Message, watch: DriveWatch, *, stale: bool) -> None:
        if message.is_error_frame:
            self._find(self._errors.take(message.arbitration_id, message.data))
        elif message.is_extended_id or message.is_remote_frame:
            return
        elif self._own.is_foreign(message.arbitration_id):
            self._find(ForeignMaster(foreign_text(message.arbitration_id), self._where))
        else:
            watch.take(message.arbitration_id, message.data, stale=stale)


def _frame(can_id: int, data: bytes) -> can.Message:
    return SentFrame(can_id, data)
