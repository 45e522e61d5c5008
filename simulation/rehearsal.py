"""Simulated CiA 402 drives on one bus, and the plant behind them."""

from __future__ import annotations

from collections.abc import Callable

import can
import numpy as np

from cdpr.poses import Array, Pose
from cdpr.rig import Rig
from cdpr.scene import Load
from drivers.bus import take
from drivers.cia402.frames import (
    HEARTBEAT_BASE,
    MASTER_NODE,
    NMT_ID,
    RPDO1_BASE,
    SDO_REQUEST_BASE,
    SYNC_ID,
)
from drivers.torque import winding_signs
from simulation.drive import SimulatedDrive
from simulation.simulated_rig import Frame, SimulatedRig

FINEST = 0.001
"""Shorter times are added up before the drives are told of them, [s]: it costs less."""


class Rehearsal(SimulatedRig[SimulatedDrive]):
    """CiA 402 drives and their platform; as in real drives, their time is locked to SYNC.

    One cycle passes from one SYNC to the next, however they jitter, and more only while none comes.
    Positions that a SYNC asks for are those at that SYNC. Torques are those that the drives felt
    when all stood as at the SYNC before, as in a drive that filters them: one cycle old, or more
    where `serve` took longer to find the platform's place.
    """

    def __init__(
        self, rig: Rig, bus: can.BusABC, start_pose: Pose, load: Load | None = None
    ) -> None:
        """Arguments and errors as for `SimulatedRig`."""
        super().__init__(rig, bus, start_pose, load)
        self._handlers = self._routes()
        self._cyclic = {SYNC_ID, *(RPDO1_BASE + drive.node for drive in self.drives)}
        self._begun = False
        self._passed = 0.0  # of the drives' time since the last SYNC
        self._waited = 0.0  # and what is too short to be told to every drive

    def _torque_per_newton(self) -> Array:
        """In per mille of rated torque."""
        one_newton = np.ones(self._rig.cable_count)
        per_mille: Array = winding_signs(self._rig) * self._rig.torques_by(one_newton)
        return per_mille

    def _make_drive(self, number: int, position: float, top_speed: float) -> SimulatedDrive:
        node = self._rig.winches[number].node_id
        return SimulatedDrive(node, position, top_speed, self._send)

    def pump(self) -> None:
        """Works off every frame that waits, and answers; each cycle of the master lets one pass.

        A cycle begins with the first of its set-points, or with its SYNC where none came.

        Raises:
            Fault: The bus failed, or the platform has no equilibrium.
        """
        while (message := take(self._bus, 0.0)) is not None:
            if message.arbitration_id in self._cyclic and not self._begun:
                self._advance(self._cycle)
                self._begun = True
            self._begun = self._begun and message.arbitration_id != SYNC_ID
            self._handle(message)
            self._finish_feeling()

    def _let_pass(self, waited: float, message: can.Message | None) -> None:
        self._waited += waited
        if message is not None and message.arbitration_id == SYNC_ID:
            self._advance(self._cycle - self._passed)
            self._passed = self._waited = 0.0
        elif self._waited >= FINEST:  # time passes whatever else is said on the bus
            step = min(self._waited, self._cycle)
            self._advance(step)
            self._passed += step
            self._waited = 0.0

    def _routes(self) -> dict[int, Callable[[Frame], None]]:
        """What to do with each identifier."""
        routes: dict[int, Callable[[Frame], None]] = {
            NMT_ID: self._on_nmt,
            SYNC_ID: self._on_sync,
            HEARTBEAT_BASE + MASTER_NODE: lambda data: self._on_heartbeat(MASTER_NODE, data),
        }
        for drive in self.drives:
            routes[RPDO1_BASE + drive.node] = drive.on_set_point
            routes[SDO_REQUEST_BASE + drive.node] = drive.on_sdo
        return routes

    def _handle(self, message: can.Message) -> None:
        if message.is_extended_id or message.is_error_frame or message.is_remote_frame:
            return
        handler = self._handlers.get(message.arbitration_id)
        if handler is not None:
            handler(message.data)

    def _on_sync(self, data: Frame) -> None:
        """The drives answer before the platform's place is looked for, which may take long."""
        self.cycles += 1
        for drive in self.drives:
            drive.on_sync()
        self._feel()

    def _on_nmt(self, data: Frame) -> None:
        if len(data) == 2:
            for drive in self.drives:
                drive.on_nmt(data[0], data[1])

    def _on_heartbeat(self, node: int, data: Frame) -> None:
        for drive in self.drives:
            if drive.node != node:
                drive.on_heartbeat(node, data)

    def _send(self, can_id: int, data: Frame) -> None:
        """On the bus, and to the other drives, which sit on the same end of it."""
        super()._send(can_id, data)
        if can_id > HEARTBEAT_BASE:
            self._on_heartbeat(can_id - HEARTBEAT_BASE, data)
