"""Looks at CiA 402 drives without changing anything: questions by SDO, and nothing else."""

from __future__ import annotations

from collections.abc import Sequence

import can
import numpy as np

from drivers.cia402.configure import is_still_set_up, require_answers
from drivers.cia402.object_dictionary import settings_for
from drivers.cia402.profile import profile_of
from drivers.cia402.sdo import SetupNetwork
from drivers.drive_group import DriveSnapshot, Pump
from drivers.plausibility import winding_signs
from model.errors import CdprError
from model.rig import Rig
from model.winches import WinchMap


def look(rig: Rig, bus: can.BusABC, pump: Pump | None) -> DriveSnapshot:
    """Status word, position and torque of every drive; see `drivers.factory.read_drives`."""
    nodes = [winch.node_id for winch in rig.winches]
    timeout = profile_of(rig).sdo_timeout_ms / 1000.0
    network = SetupNetwork(bus, pump, nodes, timeout=timeout)
    network.discard_waiting()
    require_answers(network, nodes)
    winch_map = WinchMap(rig)

    def read(index: int, name: str, size: int) -> list[int]:
        data = [network.client(node).read(index, 0, name, size) for node in nodes]
        return [int.from_bytes(value, "little", signed=True) for value in data]

    words = [word & 0xFFFF for word in read(0x6041, "status word", 2)]
    return DriveSnapshot(
        positions=np.array(read(0x6064, "position actual value", 4), dtype=np.int64),
        torques=np.array(read(0x6077, "torque actual value", 2), dtype=np.int64)
        * winding_signs(rig),
        status_words=np.array(words, dtype=np.int64),
        restarted=tuple(
            node
            for drive, node in enumerate(nodes)
            if not is_still_set_up(network, node, settings_for(rig, drive, winch_map, None))
        ),
    )


# Whether drives say by themselves that they are simulated.


#: What simulated drives have as 1008h, the manufacturer device name. Source: CiA 301, 7.5.2.8.
SIMULATED = b"cdpr simulated drive"


def say_simulated(bus: can.BusABC, pump: Pump | None, nodes: Sequence[int]) -> bool:
    """Whether every drive has the name of a simulated one; real ones need not have a name.

    Asks the drives one after another, up to the first that is none. One that does not answer counts
    as real here: the set-up that follows says what is wrong with it.

    Args:
        bus: An open bus.
        pump: As for `drivers.factory.make_drive_group`.
        nodes: All drives.
    """
    network = SetupNetwork(bus, pump, nodes)
    network.discard_waiting()
    try:
        return all(
            network.client(node).read_if_there(0x1008, 0, "manufacturer device name") == SIMULATED
            for node in nodes
        )
    except CdprError:
        return False
