"""The identifiers that only a CiA 402 master sends, and what another one does with them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from drivers.cia402.pdo import (
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
    """The same while drives are set up: no other master may access their objects then."""
    return commanding_ids(nodes) | {SDO_REQUEST_BASE + node for node in nodes}


def foreign_master_message(can_id: int) -> str:
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
