"""The frames that a master sends every cycle, built once and filled each time. No bus."""

from __future__ import annotations

from collections.abc import Sequence

import can

from drivers.bus import SentFrame
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


class CyclicFrames:
    """One set-point a drive, SYNC, and the master's sign of life.

    Attributes:
        heartbeat: The master's sign of life.
    """

    def __init__(self, nodes: Sequence[int]) -> None:
        """Takes the node ids in the order of the winches."""
        rest = make_set_point(ControlWord.QUICK_STOP, 0)
        self._set_points = [SentFrame(RPDO1_BASE + node, rest) for node in nodes]
        self._sync = SentFrame(SYNC_ID, make_sync())
        alive = make_heartbeat(NmtState.OPERATIONAL)
        self.heartbeat = SentFrame(HEARTBEAT_BASE + MASTER_NODE, alive)

    def of_cycle(
        self, words: Sequence[ControlWord], targets: Sequence[int]
    ) -> tuple[can.Message, ...]:
        """One set-point a drive, then SYNC.

        Raises:
            struct.error: A target does not fit 32 bits.
        """
        for message, word, target in zip(self._set_points, words, targets, strict=True):
            message.data = bytearray(make_set_point(word, target))
        return (*self._set_points, self._sync)
