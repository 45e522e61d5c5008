"""Tells frames that only a master sends apart: ours, and those of another master. No bus."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from drivers.cia402.frames import (
    HEARTBEAT_BASE,
    MASTER_NODE,
    NMT_ID,
    RPDO1_BASE,
    SDO_REQUEST_BASE,
    SYNC_ID,
)


def commanding_ids(nodes: Iterable[int]) -> frozenset[int]:
    """Identifiers that only a master that moves these drives sends.

    A tool that only reads objects may be on the bus; it is not one.
    """
    set_points = {RPDO1_BASE + node for node in nodes}
    return frozenset({NMT_ID, SYNC_ID, HEARTBEAT_BASE + MASTER_NODE} | set_points)


def set_up_ids(nodes: Sequence[int]) -> frozenset[int]:
    """The same while drives are set up: nobody else may read or write their objects then."""
    return commanding_ids(nodes) | {SDO_REQUEST_BASE + node for node in nodes}


def foreign_text(can_id: int) -> str:
    """What another program does when it sends a frame of one of these identifiers."""
    node = can_id & 0x7F
    if can_id == SYNC_ID:
        return "another program sends SYNC on this bus"
    if can_id == NMT_ID:
        return "another program sends NMT commands on this bus"
    if can_id == HEARTBEAT_BASE + MASTER_NODE:
        return "another program sends the master's heartbeat on this bus"
    if can_id > SDO_REQUEST_BASE:
        return f"another program reads or writes objects of drive {node}"
    return f"another program sends set-points to drive {node}"


class OwnFrames:
    """What was sent, so that a bus on which a sender hears itself does not look like two masters.

    On such a bus each frame that was sent excuses one that comes in.
    """

    #: Frames of one identifier that may be on their way back; lost ones excuse no more than these.
    MOST_CREDIT = 8

    def __init__(self, ids: frozenset[int], *, hears_itself: bool) -> None:
        """Takes the identifiers to watch and whether the bus brings back what was sent."""
        self._ids = ids
        self._credit: dict[int, int] | None = dict.fromkeys(ids, 0) if hears_itself else None

    def sent(self, can_id: int) -> None:
        """Notes a frame that was sent."""
        if self._credit is not None and can_id in self._credit:
            self._credit[can_id] = min(self.MOST_CREDIT, self._credit[can_id] + 1)

    def is_foreign(self, can_id: int) -> bool:
        """Whether a frame that came in is another master's."""
        if can_id not in self._ids:
            return False
        if self._credit is None:
            return True
        if self._credit[can_id] > 0:
            self._credit[can_id] -= 1
            return False
        return True
