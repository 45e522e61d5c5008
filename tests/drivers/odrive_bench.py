"""A master and simulated ODrives on one virtual bus, and files of endpoints for them."""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import can

from drivers.can_bus import BusSettings, InProcessBus, open_bus
from drivers.drive_group import CycleStatus, GroupCommand, GroupState
from drivers.odrive.endpoints import wanted_settings
from drivers.odrive.group import OdriveGroup
from drivers.odrive.messages import read_layouts
from model.rig import Rig, load_rig, rig_from_document
from simulation.drives.odrive import SimulatedOdrive, SimulatedOdriveRig

CONFIGS = Path(__file__).parents[2] / "configs"
ODRIVE_RIG = CONFIGS / "gachon_8_6_odrive.yaml"
_CHANNELS = itertools.count()


def odrive_rig(brakes: bool = True, **changes: Any) -> Rig:
    """The ready rig with other `drives`."""
    document = load_rig(ODRIVE_RIG).document
    winches = [winch.model_copy(update={"brake": brakes}) for winch in document.winches]
    drives = document.drives.model_copy(update=changes)
    return rig_from_document(document.model_copy(update={"drives": drives, "winches": winches}))


def write_endpoints(path: Path, rig: Rig, firmware: str = "0.6.11") -> Path:
    """A file in the form of ODrive's flat_endpoints.json."""
    document: Any = rig.document.drives
    types = {bool: "bool", int: "uint32", float: "float"}
    wanted = wanted_settings(document, read_layouts(document.dbc))
    names = {w.name: types[type(w.value)] for w in wanted}
    endpoints = {
        name: {"id": 200 + i, "type": kind} for i, (name, kind) in enumerate(names.items())
    }
    path.write_text(
        json.dumps({"fw_version": firmware, "hw_version": "4.4.58", "endpoints": endpoints})
    )
    return path


@dataclass
class OdriveBench:
    """Both ends of a bus in one thread; a cycle passes with each awaited reply."""

    rig: Rig
    group: OdriveGroup
    rehearsal: SimulatedOdriveRig
    ear: can.BusABC

    @property
    def drives(self) -> tuple[SimulatedOdrive, ...]:
        return self.rehearsal.drives

    def cycle(self, targets: list[int] | None = None) -> CycleStatus:
        self.group.send_cycle(self.group.targets.tolist() if targets is None else targets)
        return self.group.receive(0.0)

    def cycles(self, count: int) -> CycleStatus:
        for _ in range(count):
            status = self.cycle()
        return status

    def enable(self) -> CycleStatus:
        self.group.configure()
        self.group.read_positions()
        self.group.command(GroupCommand.ENABLE)
        for _ in range(60):
            status = self.cycle()
            if status.state is not GroupState.ENABLING:
                break
        return status

    def frames(self) -> list[can.Message]:
        """Frames since the last call."""
        heard = []
        while (message := self.ear.recv(0.0)) is not None:
            heard.append(message)
        return heard


@contextmanager
def odrive_bench(rig: Rig | None = None, echo: bool = False) -> Iterator[OdriveBench]:
    """Drives at home, not configured; with ``echo`` the master receives its own frames."""
    rig = rig or odrive_rig()
    settings = BusSettings("virtual", f"odrive-{next(_CHANNELS)}")
    own = InProcessBus(settings.channel, receive_own_messages=echo)
    with own as master, open_bus(settings) as far, open_bus(settings) as ear:
        rehearsal = SimulatedOdriveRig(rig, far, rig.home)
        yield OdriveBench(
            rig, OdriveGroup(rig, master, rehearsal.pump, max_tension=None), rehearsal, ear
        )
