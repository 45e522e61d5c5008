"""Looks at CiA 402 drives without changing anything: questions by SDO, and nothing else."""

from __future__ import annotations

import can
import numpy as np

from cdpr.rig import Rig
from cdpr.winches import WinchMap
from drivers.cia402.configure import is_still_set_up
from drivers.cia402.objects import settings_for
from drivers.cia402.sdo import SetupNetwork
from drivers.drive_group import DrivesSeen, Pump
from drivers.torque import winding_signs


def look(rig: Rig, bus: can.BusABC, pump: Pump | None) -> DrivesSeen:
    """Status word, position and torque of every drive; see `drivers.drive_group.look_at_drives`."""
    nodes = [winch.node_id for winch in rig.winches]
    network = SetupNetwork(bus, pump, nodes)
    network.discard_waiting()
    winch_map = WinchMap(rig)

    def read(index: int, name: str) -> list[int]:
        data = [network.client(node).read(index, 0, name) for node in nodes]
        return [int.from_bytes(value, "little", signed=True) for value in data]

    words = [word & 0xFFFF for word in read(0x6041, "status word")]
    return DrivesSeen(
        positions=np.array(read(0x6064, "position actual value"), dtype=np.int64),
        torques=np.array(read(0x6077, "torque actual value"), dtype=np.int64) * winding_signs(rig),
        status_words=np.array(words, dtype=np.int64),
        restarted=tuple(
            node
            for drive, node in enumerate(nodes)
            if not is_still_set_up(network, node, settings_for(rig, drive, winch_map, None))
        ),
    )
