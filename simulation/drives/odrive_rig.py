"""Simulated ODrives on one bus, and the plant behind them."""

from __future__ import annotations

from pathlib import Path

import can
import numpy as np

from drivers.can_bus import take
from drivers.odrive.dbc import OWN_DBC, read_layouts
from drivers.odrive.endpoints import read_endpoints
from drivers.odrive.messages import node_and_command
from drivers.plausibility import winding_signs
from model.files.rig_file import OdriveDocument
from model.pose import Array, Pose
from model.rig import Rig
from model.scene import Load
from simulation.drives.odrive import OdriveSettings, SimulatedOdrive
from simulation.rig import SimulatedRig


class SimulatedOdriveRig(SimulatedRig[SimulatedOdrive]):
    """ODrives and their platform; nothing on the bus gives them a common time.

    In one process a cycle passes with each `pump`; in real time, `serve` follows the clock.
    """

    def __init__(
        self, rig: Rig, bus: can.BusABC, start_pose: Pose, load: Load | None = None
    ) -> None:
        """Arguments and errors as for `SimulatedRig`; the drives hold what the rig file says."""
        document = rig.document.drives
        if not isinstance(document, OdriveDocument):
            raise TypeError("the rig has no ODrives")
        self._document = document
        self._layouts = read_layouts(Path(document.dbc) if document.dbc else OWN_DBC)
        self._since_felt = 0.0
        super().__init__(rig, bus, start_pose, load)
        self._by_node = {drive.node: drive for drive in self.drives}

    def _torque_per_newton(self) -> Array:
        """Torque of the motors in newton metres."""
        winches = self._rig.winches
        lever = np.array([winch.rated_torque / winch.torque_constant for winch in winches])
        torques: Array = winding_signs(self._rig) * lever
        return torques

    def _make_drive(self, number: int, position: float, top_speed: float) -> SimulatedOdrive:
        winch = self._rig.winches[number]
        return SimulatedOdrive(
            winch.node_id,
            _settings(self._document),
            self._layouts,
            winch.counts_per_turn,
            self._document.motor_torque_constant_nm_a,
            position,
            top_speed,
            self._send,
        )

    def pump(self) -> None:
        """Works off every frame that waits, then lets a cycle pass; see `SimulatedRig.pump`."""
        while (message := take(self._bus, 0.0)) is not None:
            self._handle(message)
        self._advance(self._cycle)
        self._finish_feeling()

    def _advance(self, elapsed: float) -> None:
        """The drives feel their cables once a cycle: finding the platform's place takes longest."""
        super()._advance(elapsed)
        self._since_felt += elapsed
        if self._since_felt >= self._cycle - 1e-9:
            self._since_felt = 0.0
            self.cycles += 1
            self._feel()

    def _handle(self, message: can.Message) -> None:
        if message.is_extended_id or message.is_error_frame or message.is_remote_frame:
            return
        node, command = node_and_command(message.arbitration_id)
        drive = self._by_node.get(node)
        if drive is not None:
            drive.hear(command, message.data)


def _settings(document: OdriveDocument) -> OdriveSettings:
    """As if a lab had written the rig file's values with odrivetool."""
    watchdog = document.watchdog_ms
    settings = OdriveSettings(
        watchdog=watchdog / 1000.0 if watchdog is not None else None,
        heartbeat=document.heartbeat_ms / 1000.0,
        estimates=document.estimates_ms / 1000.0,
        torques=document.torques_ms / 1000.0,
    )
    if document.endpoints is not None:
        settings.firmware = read_endpoints(Path(document.endpoints), document).firmware
    return settings
