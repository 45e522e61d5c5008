"""Simulated CiA 402 drives on one bus, and the plant behind them."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from math import inf
from pathlib import Path

import can
import numpy as np

from drivers.can_bus import receive_frame
from drivers.cia402.pdo import (
    HEARTBEAT_BASE,
    MASTER_NODE,
    NMT_ID,
    RPDO1_BASE,
    SDO_REPLY_BASE,
    SDO_REQUEST_BASE,
    SYNC_ID,
    TPDO1_BASE,
)
from drivers.cia402.profile import profile_of
from drivers.plausibility import winding_signs
from model.pose import Array, Pose
from model.rig import Rig
from model.scene import Load
from simulation.drives.behaviour import STRICT, DriveBehaviour
from simulation.drives.cia402 import SimulatedDrive
from simulation.drives.eds_file import eds_of
from simulation.drives.pdo import TOLERANCE
from simulation.rig import Frame, SimulatedRig

PDO_IDS = range(TPDO1_BASE, SDO_REPLY_BASE)
"""Identifiers of process data."""

PATIENCE = 2.0
"""Longest simulated time that passes while a request awaits its answer, [s]."""

FINEST = 0.001
"""Smallest time step of the drives, [s]; shorter times are accumulated."""


class SimulatedCia402Rig(SimulatedRig[SimulatedDrive]):
    """CiA 402 drives and their platform, with time locked to SYNC as in real drives.

    Exactly one cycle passes between two SYNCs regardless of jitter, and more only while none
    arrives. Replies contain the positions at their SYNC. Torques belong to the positions at the
    previous SYNC, as in a drive that filters them, or are older if `serve` took longer to find the
    platform's equilibrium.
    """

    def __init__(
        self,
        rig: Rig,
        bus: can.BusABC,
        start_pose: Pose,
        load: Load | None = None,
        *,
        behaviour: DriveBehaviour = STRICT,
        eds: Path | None = None,
    ) -> None:
        """Powers the drives on; the first arguments and errors as for `SimulatedRig`.

        Args:
            bus: An open bus for the drives, owned by the caller.
            start_pose: ``world_from_platform``.
            load: Payload of the platform.
            behaviour: Choices within the standards.
            eds: EDS file (default: that of the rig file's drive profile).

        Raises:
            BadInput: The EDS file cannot be used.
        """
        self.behaviour = behaviour
        self._eds = eds_of(rig, eds)
        super().__init__(rig, bus, start_pose, load)
        self._handlers = self._routes()
        self._pdo_handlers: dict[int, Callable[[int, Frame], None]] | None = None
        self._cyclic = {SYNC_ID, *(RPDO1_BASE + drive.node for drive in self.drives)}
        self._begun = False
        self._passed = 0.0  # the drives' time since the last SYNC
        self._waited = 0.0  # accumulated time too short for a step

    def _torque_per_newton(self) -> Array:
        """Torque per newton, [per mille of rated torque]."""
        one_newton = np.ones(self._rig.cable_count)
        per_mille: Array = winding_signs(self._rig) * self._rig.torques_by(one_newton)
        return per_mille

    def _make_drive(self, number: int, position: float, top_speed: float) -> SimulatedDrive:
        winch = self._rig.winches[number]
        return SimulatedDrive(
            winch.node_id,
            position,
            top_speed,
            self._send,
            eds=self._eds,
            behaviour=self.behaviour,
            counts_per_turn=winch.counts_per_turn,
            profile=profile_of(self._rig),
        )

    def _friction(self) -> float:
        """In per mille of rated torque."""
        return self.behaviour.friction

    def pump(self) -> None:
        """Processes every waiting frame; time advances by one cycle per cycle of the master.

        A cycle begins with its first set-point, or with its SYNC if there is none.

        Raises:
            Fault: The bus failed, or the platform has no equilibrium.
        """
        idle, synced = True, False
        while (message := receive_frame(self._bus, 0.0)) is not None:
            idle = False
            if message.arbitration_id in self._cyclic and not self._begun:
                self._advance(self._cycle)
                self._begun = True
            is_sync = message.arbitration_id == SYNC_ID
            self._begun, synced = self._begun and not is_sync, synced or is_sync
            self._handle(message)
            self._finish_torque_update()
        if self.behaviour.answers_late and not self._begun and not synced:
            self._wait_for_answers(idle)

    def _wait_for_answers(self, idle: bool) -> None:
        """Advances time until the next answer, for which the master waits.

        With SYNC, the master's cycles advance the time instead. An idle master waits for a delayed
        mode.
        """
        wait = min(drive.until_answer(idle) for drive in self.drives)
        if wait < inf:
            self.advance(min(wait, PATIENCE) + 2.0 * TOLERANCE)

    def _let_pass(self, waited: float, message: can.Message | None) -> None:
        self._waited += waited
        if message is not None and message.arbitration_id == SYNC_ID:
            self._advance(self._cycle - self._passed)
            self._passed = self._waited = 0.0
        elif self._waited >= FINEST:  # time passes regardless of other frames
            step = min(self._waited, self._cycle)
            self._advance(step)
            self._passed += step
            self._waited = 0.0

    def _routes(self) -> dict[int, Callable[[Frame], None]]:
        """Handler of each identifier."""
        routes: dict[int, Callable[[Frame], None]] = {
            NMT_ID: self._on_nmt,
            SYNC_ID: self._on_sync,
            HEARTBEAT_BASE + MASTER_NODE: lambda data: self._on_heartbeat(MASTER_NODE, data),
        }
        for drive in self.drives:
            routes[SDO_REQUEST_BASE + drive.node] = partial(self._on_sdo, drive)
        return routes

    def _handle(self, message: can.Message) -> None:
        if message.is_extended_id or message.is_error_frame or message.is_remote_frame:
            return
        can_id = message.arbitration_id
        if can_id in PDO_IDS:
            if self._pdo_handlers is None:
                self._pdo_handlers = {i: d.on_pdo for d in self.drives for i in d.pdo_ids}
            take_pdo = self._pdo_handlers.get(can_id)
            if take_pdo is not None:
                take_pdo(can_id, message.data)
            return
        handler = self._handlers.get(can_id)
        if handler is not None:
            handler(message.data)

    def _on_sdo(self, drive: SimulatedDrive, data: Frame) -> None:
        self._pdo_handlers = None  # the request may change process data
        drive.on_sdo(data)

    def _on_sync(self, data: Frame) -> None:
        """The drives reply before the search for the platform's equilibrium, which may be slow."""
        self.cycles += 1
        for drive in self.drives:
            drive.on_sync()
        self._begin_torque_update()

    def _on_nmt(self, data: Frame) -> None:
        if len(data) == 2:
            self._pdo_handlers = None
            for drive in self.drives:
                drive.on_nmt(data[0], data[1])

    def _on_heartbeat(self, node: int, data: Frame) -> None:
        for drive in self.drives:
            if drive.node != node:
                drive.on_heartbeat(node, data)

    def _send(self, can_id: int, data: Frame) -> None:
        """Sends to the bus and to the other drives, which share this end of it."""
        super()._send(can_id, data)
        if can_id > HEARTBEAT_BASE:
            self._on_heartbeat(can_id - HEARTBEAT_BASE, data)
