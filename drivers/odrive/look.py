"""Looks at ODrives without changing anything: listens to what they tell by themselves."""

from __future__ import annotations

from pathlib import Path

import can
import numpy as np

from cdpr.drives_file import OdriveDocument
from cdpr.errors import HardwareMissing
from cdpr.rig import Rig
from drivers.bus import hears_itself
from drivers.cyclic_bus import CyclicBus
from drivers.drive_group import DrivesSeen, Pump
from drivers.odrive.dbc import OWN_DBC, read_layouts
from drivers.odrive.link import commanding_ids, foreign_text
from drivers.odrive.watch import OdriveWatch
from drivers.own_frames import OwnFrames
from drivers.reply_check import largest_steps
from drivers.torque import winding_signs

ATTEMPTS, TIMEOUT = 20, 0.1


def look(rig: Rig, document: OdriveDocument, bus: can.BusABC, pump: Pump | None) -> DrivesSeen:
    """State, position and torque of every axis; see `drivers.drive_group.look_at_drives`."""
    layouts = read_layouts(Path(document.dbc) if document.dbc else OWN_DBC)
    nodes = [winch.node_id for winch in rig.winches]
    own = OwnFrames(commanding_ids(layouts, nodes), hears_itself=hears_itself(bus))
    cyclic = CyclicBus(bus, own, foreign_text)
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
            why="a drive has no power or is not on the bus, or it sends its messages more seldom"
            " than the rig file says",
            next_step="check power, wiring and the message periods",
        )
    per_mille = winding_signs(rig) * 1000.0 / [winch.rated_torque for winch in rig.winches]
    return DrivesSeen(
        positions=np.array(watch.positions, dtype=np.int64),
        torques=np.rint(np.array(watch.torques) * per_mille).astype(np.int64),
        status_words=np.array(watch.status_words, dtype=np.int64),
        # Their settings outlive their power, so nothing tells whether it was gone.
        restarted=tuple(winch.node_id for winch in rig.winches if not winch.absolute),
    )
