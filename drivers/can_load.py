"""Worst-case load of a CAN bus by the cyclic traffic."""

from __future__ import annotations

import math

from model.errors import Refused
from model.files.rig_file import OdriveDocument
from model.rig import Rig

MAX_LOAD = 0.70
"""Above this load a stop frame may wait too long behind others."""

TESTED_HZ = 250.0
"""Highest tested rate; arming refuses shorter cycles."""

FASTEST_TENTHS_MS = round(10_000.0 / TESTED_HZ)
SLOWEST_TENTHS_MS = 1000
"""Longest cycle of a rig file, [0.1 ms]."""

HEARTBEAT_PERIOD = 0.03
"""Period of the heartbeats of master and drives, [s]; two in a row may be lost."""

HEARTBEAT_TIMEOUT = 0.1
"""Time without a heartbeat of master or peer after which a drive stops itself, [s]."""

HEARTBEATS_WAITED = 3.2
"""Periods after which a heartbeat counts as lost; two in a row may be missed."""

SDO_PERIOD = 0.01
"""Part of a cycle for each SDO request and its answer, [s]."""

_SET_POINT_BYTES = 6
_REPLY_BYTES = 8
_SDO_BYTES = 8
_ODRIVE_BYTES = 8
_SYNC_BYTES = 0
_HEARTBEAT_BYTES = 1


def frame_bits(data_bytes: int) -> int:
    """Largest length of a CAN 2.0A data frame on the wire with interframe space, [bit].

    Source: R. I. Davis et al., "Controller Area Network (CAN) schedulability analysis", 2007,
    Eq. 1: 34 of the 47 bits of overhead and all data bits are stuffed, one bit after each four.
    """
    stuffed = 34 + 8 * data_bytes
    return 47 + 8 * data_bytes + (stuffed - 1) // 4


def cycle_bits(drives: int) -> int:
    """Bits of one cycle with worst-case stuffing: SYNC, and a set-point and a reply per drive."""
    pdos = frame_bits(_SET_POINT_BYTES) + frame_bits(_REPLY_BYTES)
    return drives * pdos + frame_bits(_SYNC_BYTES)


def heartbeat_cycles(cycle: float) -> int:
    """Number of cycles between two heartbeats of the master; ``cycle`` in [s]."""
    return max(1, math.floor(HEARTBEAT_PERIOD / cycle + 1e-9))


def heartbeat_timeout(cycle: float) -> float:
    """Heartbeat time-out, [s]: more than three periods; ``cycle`` in [s]."""
    return max(HEARTBEAT_TIMEOUT, HEARTBEATS_WAITED * cycle * heartbeat_cycles(cycle))


def bus_load(drives: int, cycle: float, bitrate: int) -> float:
    """Bus load of CiA 402 drives with heartbeats, as a fraction, with worst-case stuffing.

    Without SDO (`requests_per_cycle`), to which all these frames have priority.

    Args:
        drives: Number of drives m.
        cycle: [s].
        bitrate: [bit/s].
    """
    heartbeats = (drives + 1) * frame_bits(_HEARTBEAT_BYTES) / heartbeat_cycles(cycle)
    return (cycle_bits(drives) + heartbeats) / (cycle * bitrate)


def requests_per_cycle(drives: int, cycle: float, bitrate: int) -> int:
    """Largest number of SDO requests in a cycle; at least one.

    Several are sent only where they and their answers keep the load below `MAX_LOAD`. Arguments as
    for `bus_load`.
    """
    free = (MAX_LOAD - bus_load(drives, cycle, bitrate)) * cycle * bitrate
    return max(1, int(min(cycle / SDO_PERIOD + 1e-9, free / (2 * frame_bits(_SDO_BYTES)))))


def heartbeat_within(settings: OdriveDocument) -> float:
    """Longest time until an ODrive shows a new state, [s]."""
    return HEARTBEATS_WAITED * settings.heartbeat_ms / 1000.0


def odrive_bus_load(drives: int, cycle: float, bitrate: int, settings: OdriveDocument) -> float:
    """Bus load of ODrives, which send estimates, torques and heartbeats periodically."""
    periods = (
        cycle,
        *(ms / 1e3 for ms in (settings.estimates_ms, settings.torques_ms, settings.heartbeat_ms)),
    )
    return drives * frame_bits(_ODRIVE_BYTES) * sum(1.0 / period for period in periods) / bitrate


def _load(rig: Rig, cycle: float) -> float:
    """Load of a rig's bus at a cycle [s]."""
    drives, bitrate = rig.document.drives, rig.document.bus.bitrate
    if isinstance(drives, OdriveDocument):
        return odrive_bus_load(rig.cable_count, cycle, bitrate, drives)
    return bus_load(rig.cable_count, cycle, bitrate)


def check_bus_load(rig: Rig) -> float:
    """The load of a rig's bus, as a fraction.

    Raises:
        Refused: It is above 70 %.
    """
    bus = rig.document.bus
    load = _load(rig, bus.cycle_ms / 1000.0)
    if load > MAX_LOAD:
        raise Refused(
            f"{rig.cable_count} drives every {bus.cycle_ms:g} ms need {load:.0%} of a bus of"
            f" {bus.bitrate} bit/s; the limit is {MAX_LOAD:.0%}",
            where=f"rig {rig.name}: bus",
            why=f"a cycle takes {load * bus.bitrate * bus.cycle_ms / 1e3:.0f} bits at worst;"
            " a stop must still fit",
            next_step=_advice(rig),
            values={"load": load, "limit": MAX_LOAD, "cycle_ms": bus.cycle_ms},
        )
    return load


def _advice(rig: Rig) -> str:
    """Advises the shortest cycle that keeps the limit and that arming accepts."""
    option = ", or lengthen drives.*_ms" if rig.document.drives.type == "odrive" else ""
    for tenths in range(FASTEST_TENTHS_MS, SLOWEST_TENTHS_MS + 1):
        if _load(rig, tenths / 10_000.0) <= MAX_LOAD:
            return f"set bus.cycle_ms to {tenths / 10.0:g} or more{option}, or raise the bitrate"
    return f"raise the bitrate{option}; no permitted cycle is long enough at this rate"
