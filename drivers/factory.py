"""Makes the drive group that a rig's file names, and reads the state of its drives.

A protocol and its libraries are loaded only when drives that speak it are asked for.
"""

from __future__ import annotations

from collections.abc import Sequence

import can

from drivers.drive_group import DriveGroup, DriveSnapshot, Pump
from model.rig import Rig


def drive_states(rig: Rig, status_words: Sequence[int]) -> tuple[str, ...]:
    """What status words of a `CycleStatus` say, for people."""
    if rig.document.drives.type == "odrive":
        from drivers.odrive.messages import state_text

        return tuple(state_text(word) for word in status_words)
    from drivers.cia402.state_machine import state_of

    return tuple(state_of(word).value for word in status_words)


def stop_alone(rig: Rig, status_words: Sequence[int]) -> tuple[bool, ...]:
    """Whether drives are as they should be once their master is lost.

    Of CiA 402 drives, in quick stop under torque. ODrives are disarmed then, and a brake holds.

    Args:
        rig: The robot.
        status_words: As drives report them, one each.
    """
    if rig.document.drives.type == "odrive":
        return (True,) * len(status_words)
    from drivers.cia402.state_machine import DriveState, state_of

    return tuple(state_of(word) is DriveState.QUICK_STOP_ACTIVE for word in status_words)


def read_drives(rig: Rig, bus: can.BusABC, pump: Pump | None = None) -> DriveSnapshot:
    """Reads the state of drives at rest; changes nothing, not even their configuration.

    Args:
        rig: The robot; its winches name the nodes.
        bus: An open bus; it stays the caller's.
        pump: As for `make_drive_group`.

    Raises:
        HardwareMissing: A drive does not answer.
        Refused: A drive refuses to answer.
        Fault: The bus failed.
    """
    document = rig.document.drives
    if document.type == "odrive":
        from drivers.odrive.group import read_axes

        return read_axes(rig, document, bus, pump)
    from drivers.cia402.inspection import read_states

    return read_states(rig, bus, pump)


def make_drive_group(
    rig: Rig, bus: can.BusABC, pump: Pump | None = None, *, max_tension: float | None = None
) -> DriveGroup:
    """The drives of a rig, not yet configured.

    Args:
        rig: The robot; its winches name the nodes.
        bus: An open bus; it stays the caller's.
        pump: Given when the drives are simulated in this process (`SimulatedCia402Rig.pump`):
            called wherever an answer is waited for, and nothing is waited for after it.
        max_tension: From which the drives' torque limit comes, [N]; the rig's own if None. One that
            is below what a drive holds lets its cable slip as soon as `configure` writes it.

    Raises:
        Refused: The bus is too slow for the rig's cycle.
        BadInput: The rig's numbers do not fit the drives, or a package or file that they need is
            not there.
    """
    if rig.document.drives.type == "odrive":
        from drivers.odrive.group import OdriveGroup

        return OdriveGroup(rig, bus, pump, max_tension=max_tension)
    from drivers.cia402.group import Cia402Group

    return Cia402Group(rig, bus, pump, max_tension=max_tension)
