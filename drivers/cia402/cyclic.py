"""The cyclic frames on the bus: set-points and SYNC out, replies in. One thread, no library."""

from __future__ import annotations

import time
from collections.abc import Sequence

import can

from cdpr.errors import Fault
from drivers.bus import take, transmit
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
from drivers.cia402.states import ControlWord
from drivers.cia402.watch import DriveWatch


class CyclicBus:
    """Sends and takes what belongs to a cycle; its frames are built once and filled each cycle."""

    def __init__(self, bus: can.BusABC, nodes: Sequence[int]) -> None:
        """Takes an open bus and the node ids in the order of the winches."""
        self._bus = bus
        rest = make_set_point(ControlWord.QUICK_STOP, 0)
        self._set_points = [_frame(RPDO1_BASE + node, rest) for node in nodes]
        self._sync = _frame(SYNC_ID, make_sync())
        alive = make_heartbeat(NmtState.OPERATIONAL)
        self._heartbeat = _frame(HEARTBEAT_BASE + MASTER_NODE, alive)

    def send_cycle(self, words: Sequence[ControlWord], targets: Sequence[int]) -> None:
        """One set-point a drive, then SYNC.

        Raises:
            Fault: The bus did not take a frame; the others were sent all the same.
            struct.error: A target does not fit 32 bits; nothing was sent.
        """
        for message, word, target in zip(self._set_points, words, targets, strict=True):
            message.data = bytearray(make_set_point(word, target))
        failure: Fault | None = None
        for message in (*self._set_points, self._sync):
            try:
                transmit(self._bus, message)
            except Fault as error:
                failure = failure or error
        if failure is not None:
            raise failure

    def send_heartbeat(self) -> None:
        """The master's sign of life.

        Raises:
            Fault: The bus did not take it.
        """
        transmit(self._bus, self._heartbeat)

    def discard_stale(self, watch: DriveWatch) -> None:
        """Replies that came too late for their cycle are thrown away, never used as new ones.

        Raises:
            Fault: The bus failed.
        """
        while (message := take(self._bus, 0.0)) is not None:
            if _is_data(message):
                watch.take(message.arbitration_id, message.data, stale=True)

    def take_replies(self, watch: DriveWatch, timeout: float) -> None:
        """Hands frames over until every drive has answered or the time [s] is over.

        Raises:
            Fault: The bus failed.
        """
        deadline = time.monotonic() + timeout
        left = timeout
        while not watch.complete:
            message = take(self._bus, max(0.0, left))
            if message is None:
                return
            if _is_data(message):
                watch.take(message.arbitration_id, message.data)
            left = deadline - time.monotonic()


def _frame(can_id: int, data: bytes) -> can.Message:
    return can.Message(arbitration_id=can_id, data=data, is_extended_id=False)


def _is_data(message: can.Message) -> bool:
    return not (message.is_extended_id or message.is_error_frame or message.is_remote_frame)
