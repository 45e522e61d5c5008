"""Reads the state of ODrives without changing anything, from their cyclic messages."""

from __future__ import annotations

from pathlib import Path

import can
import numpy as np

from drivers.can_bus import EchoFilter, echoes_own_frames
from drivers.cyclic_group import CyclicBus
from drivers.drive_group import DriveSnapshot, Pump
from drivers.odrive.configure import commanding_ids, foreign_master_message
from drivers.odrive.dbc import OWN_DBC, read_layouts
from drivers.odrive.monitor import OdriveWatch
from drivers.plausibility import largest_steps, winding_signs
from model.errors import HardwareMissing
from model.files.rig_file import OdriveDocument
from model.rig import Rig

ATTEMPTS, TIMEOUT = 20, 0.1


def look(rig: Rig, document: OdriveDocument, bus: can.BusABC, pump: Pump | None) -> DriveSnapshot:
    """State, position and torque of every axis; see `drivers.factory.read_drives`."""
    layouts = read_layouts(Path(document.dbc) if document.dbc else OWN_DBC)
    nodes = [winch.node_id for winch in rig.winches]
    own = EchoFilter(commanding_ids(layouts, nodes), echoes_own_frames=echoes_own_frames(bus))
    cyclic = CyclicBus(bus, own, foreign_master_message)
    watch = OdriveWatch(
        rig, document, layouts, largest_steps(rig, rig.document.bus.cycle_ms / 1000.0)
    )
    cyclic.forget_waiting()
    for _ in range(ATTEMPTS):
        watch.begin_cycle()
        if pump is not None:
            pump()
        cyclic.take_replies(watch, TIMEOUT if pump is None else 0.0)
        cyclic.end_cycle()
        watch.end_cycle()
        if watch.states_known and not any(watch.missing):
            break
    else:
        silent = [n for n, gone in zip(nodes, watch.missing, strict=True) if gone]
        raise HardwareMissing(
            f"no {'position' if silent else 'heartbeat'} from drives"
            f" {', '.join(map(str, silent or nodes))}",
            where="listening to the drives",
            why="a drive has no power, is not on the bus, or sends its messages less often"
            " than the rig file says",
            next_step="check power, wiring and the message periods",
        )
    per_mille = winding_signs(rig) * 1000.0 / [winch.rated_torque for winch in rig.winches]
    return DriveSnapshot(
        positions=np.array(watch.positions, dtype=np.int64),
        torques=np.rint(np.array(watch.torques) * per_mille).astype(np.int64),
        status_words=np.array(watch.status_words, dtype=np.int64),
        # Their settings outlive their power, so a loss of power leaves no trace.
        restarted=tuple(winch.node_id for winch in rig.winches if not winch.absolute),
    )
