"""Creates the drive group of a rig file, and reads the state of its drives.

The libraries of a protocol are loaded only when used.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import can

from drivers.can_bus import SentFrame, receive_frame, transmit
from drivers.cia402.pdo import EMCY_BASE, HEARTBEAT_BASE, SDO_REPLY_BASE, SDO_REQUEST_BASE
from drivers.cia402.profile import power_bits, profile_of
from drivers.cia402.sdo_jobs import SdoRequest
from drivers.cia402.state_machine import (
    FAULTED,
    HOLDS,
    TORQUE_ON,
    WITHOUT_TORQUE,
    DriveState,
    state_of,
    without_power,
)
from drivers.drive_group import CycleStatus, DriveGroup, DriveSnapshot, Pump
from drivers.odrive.messages import (
    ERROR_FLAG,
    AxisState,
    can_id,
    read_layouts,
    state_in,
    state_text,
)
from model.rig import Rig

STOPS_ALONE_WITHIN = 1.0
"""Least time for drives that lost their master to notice and come to rest, [s]."""


def drive_states(rig: Rig, status_words: Sequence[int]) -> tuple[str, ...]:
    """Text of the status words of a `CycleStatus`."""
    if rig.document.drives.type == "odrive":
        return tuple(state_text(word) for word in status_words)
    return tuple(state_of(word).value for word in status_words)


TorqueState = Literal["enabled", "holding", "none"]


@dataclass(frozen=True, slots=True)
class DriveFlags:
    """What a status word means, for drives of any protocol.

    Attributes:
        torque: ``enabled`` to follow set-points, ``holding`` on its own, or ``none``: the torque
            then measures no tension.
        in_fault: Whether the drive is in fault.
    """

    torque: TorqueState
    in_fault: bool


def drive_flags(rig: Rig, status_words: Sequence[int]) -> tuple[DriveFlags, ...]:
    """Meaning of the status words of a `CycleStatus`."""
    if rig.document.drives.type == "odrive":
        armed = AxisState.CLOSED_LOOP_CONTROL
        return tuple(
            DriveFlags("enabled" if state_in(word) == armed else "none", bool(word & ERROR_FLAG))
            for word in status_words
        )

    def flags_of(state: DriveState) -> DriveFlags:
        alone: TorqueState = "holding" if state in TORQUE_ON else "none"
        torque = "enabled" if state is DriveState.OPERATION_ENABLED else alone
        return DriveFlags(torque, state in FAULTED)

    return tuple(flags_of(state_of(word)) for word in status_words)


def stop_alone(rig: Rig, status_words: Sequence[int]) -> tuple[bool, ...]:
    """Whether drives are in the state expected after the loss of their master.

    CiA 402 drives are then in quick stop under torque; ODrives are idle, and a brake holds.

    Args:
        status_words: Reported status word of each drive.
    """
    if rig.document.drives.type == "odrive":
        return tuple(state_in(word) == AxisState.IDLE for word in status_words)
    return tuple(state_of(word) is DriveState.QUICK_STOP_ACTIVE for word in status_words)


def time_to_stop_alone(rig: Rig) -> float:
    """Time until drives that lost their master are at rest and report it, [s].

    ODrives follow their last set-point until the watchdog expires; their next heartbeat shows it.
    """
    drives = rig.document.drives
    if drives.type != "odrive":
        return STOPS_ALONE_WITHIN
    return max(STOPS_ALONE_WITHIN, ((drives.watchdog_ms or 0.0) + drives.heartbeat_ms) / 1000.0)


def without_torque(rig: Rig, status_words: Sequence[int]) -> tuple[int, ...]:
    """Nodes of drives that do not hold their cables under torque.

    None for ODrives: they hold by closed brakes.

    Args:
        status_words: Reported status word of each drive.
    """
    if rig.document.drives.type == "odrive":
        return ()
    rows = zip(rig.winches, status_words, strict=True)
    return tuple(winch.node_id for winch, word in rows if state_of(word) not in HOLDS)


def holding_nodes(rig: Rig, status: CycleStatus) -> set[int]:
    """Nodes that hold by torque; those of ODrives hold by brakes, all or none."""
    released = without_torque(rig, status.status_words.tolist())
    nodes = {*rig.drive_names} if status.holding or released else set[int]()
    return nodes.difference(released)


def may_have_released(rig: Rig, missing: Sequence[bool]) -> tuple[int, ...]:
    """Nodes of silent drives without a brake: one that lost its power has released its cable.

    Args:
        missing: Whether each drive did not answer.
    """
    rows = zip(rig.winches, missing, strict=True)
    return tuple(winch.node_id for winch, silent in rows if silent and not winch.brake)


def shows_no_torque(status_word: int) -> bool:
    """Whether a CiA 402 drive is certainly not enabled, nor stopped by a fault."""
    return state_of(status_word) in {*WITHOUT_TORQUE, DriveState.SWITCHED_ON}


def unready_remarks(rig: Rig, status_words: Sequence[int]) -> list[str]:
    """Which drives at rest cannot be enabled, and why; one text per reason.

    None for ODrives, whose states name it.

    Args:
        status_words: Reported status word of each drive.
    """
    if rig.document.drives.type == "odrive":
        return []
    bits = power_bits(profile_of(rig))
    names: dict[str, list[str]] = {}
    for name, word in zip(rig.drive_names.values(), status_words, strict=True):
        for reason in without_power(word, bits):
            names.setdefault(reason, []).append(name)
    return [f"{', '.join(found)}: {reason}" for reason, found in names.items()]


def blocked_in_fault(rig: Rig, status_words: Sequence[int]) -> tuple[int, ...]:
    """Nodes of drives in fault that cannot be reset, as others hold the platform.

    None for ODrives: if one disarms itself, all are disarmed.

    Args:
        status_words: Reported status word of each drive.
    """
    if rig.document.drives.type == "odrive":
        return ()
    from drivers.cia402.monitor import blocked

    return tuple(blocked(dict(zip(rig.drive_names, map(state_of, status_words), strict=True))))


def cycles_until_reported(rig: Rig) -> int:
    """Cycles from the one that sends a set-point to the one that reports the position it commands.

    CiA 402 drives apply a set-point at its SYNC, and answer with their position at that SYNC.
    ODrives have no SYNC: they apply it on arrival, and report their position later in the cycle.
    """
    return 0 if rig.document.drives.type == "odrive" else 1


def nodes_present(rig: Rig, bus: can.BusABC, within: float = 0.5) -> set[int]:
    """Nodes of the rig's drives that are heard on a bus; changes nothing.

    CiA 402 drives are asked for their device type (1000h); ODrives send heartbeats.

    Args:
        rig: The robot; its winches name the nodes.
        bus: An open bus, owned by the caller.
        within: Time in which all must answer, [s].

    Raises:
        Fault: The bus failed.
    """
    document = rig.document.drives
    senders: dict[int, int] = {}
    if document.type == "odrive":
        heartbeat = read_layouts(document.dbc).heartbeat.command
        senders = {can_id(node, heartbeat): node for node in rig.drive_names}
    else:
        for node in rig.drive_names:
            for base in (SDO_REPLY_BASE, HEARTBEAT_BASE, EMCY_BASE):
                senders[base + node] = node
            transmit(bus, SentFrame(SDO_REQUEST_BASE + node, SdoRequest(0x1000, 0).frame()))
    present = set[int]()
    deadline = time.monotonic() + within
    while not present >= {*rig.drive_names} and (left := deadline - time.monotonic()) > 0.0:
        message = receive_frame(bus, left)
        if message and not (message.is_error_frame or message.is_remote_frame):
            present.add(senders.get(message.arbitration_id, 0))
    return present - {0}


def check_drive_files(rig: Rig) -> str:
    """What the drives of a rig are, after a check of the files that they need.

    Raises:
        BadInput: A file or package is missing, or a file is invalid or does not fit the rig.
    """
    drives = rig.document.drives
    if drives.type == "cia402":
        profile_of(rig)
        return f"CANopen, profile {drives.profile}"
    from drivers.odrive.configure import check_rig
    from drivers.odrive.endpoints import read_endpoints

    layouts = read_layouts(drives.dbc)
    check_rig(rig, drives, layouts)
    if drives.endpoints is None:
        return "ODrives; their settings are not read back: the rig file has no drives.endpoints"
    read_endpoints(Path(drives.endpoints), drives, layouts)
    return "ODrives; their settings are read back"


def read_drives(
    rig: Rig,
    bus: can.BusABC,
    pump: Pump | None = None,
    *,
    to_reset: bool = False,
    partial: bool = False,
) -> DriveSnapshot:
    """Reads the state of drives at rest; changes nothing, not even their configuration.

    Args:
        rig: The robot; its winches name the nodes.
        bus: An open bus, owned by the caller.
        pump: As for `make_drive_group`.
        to_reset: Takes drives in NMT *stopped*, which answer nothing, to *pre-operational*.
        partial: Reads those that answer, if some do not.

    Raises:
        HardwareMissing: A drive does not answer; if ``partial``, it stopped answering.
        Refused: A drive refuses a request, or is in NMT *stopped* without ``to_reset`` or
            ``partial``.
        Fault: The bus failed.
    """
    document = rig.document.drives
    if document.type == "odrive":
        from drivers.odrive.group import read_axes

        return read_axes(rig, document, bus, pump, partial=partial)
    from drivers.cia402.inspection import read_states

    return read_states(rig, bus, pump, to_reset=to_reset, partial=partial)


def make_drive_group(
    rig: Rig, bus: can.BusABC, pump: Pump | None = None, *, max_tension: float | None = None
) -> DriveGroup:
    """The drives of a rig, not configured yet.

    Args:
        rig: The robot; its winches name the nodes.
        bus: An open bus, owned by the caller.
        pump: For drives simulated in this process (`SimulatedCia402Rig.pump`): called instead of
            waiting for answers.
        max_tension: Tension that sets the torque limit, [N]; the rig's if None. A limit below the
            present tension lets the cable slip as soon as `configure` writes it.

    Raises:
        Refused: The bus is too slow for the rig's cycle.
        BadInput: The rig's numbers do not fit the drives, or a required package or file is
            missing.
    """
    if rig.document.drives.type == "odrive":
        from drivers.odrive.group import OdriveGroup

        return OdriveGroup(rig, bus, pump, max_tension=max_tension)
    from drivers.cia402.group import Cia402Group

    return Cia402Group(rig, bus, pump, max_tension=max_tension)
