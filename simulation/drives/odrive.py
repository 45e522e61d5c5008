"""A simulated ODrive, based on CANSimple, independent of the master.

It sends heartbeats, estimates and torques periodically. A set-point takes effect on arrival. When
the axis is armed, its brake begins to open; until it is open the motor neither moves nor carries
the cable. When it is disarmed, by the master, its watchdog or an error, the torque is removed and
the brake closes.

Source: ODrive documentation, "CAN Protocol" (firmware 0.6). Assumptions where it is not specific:
the watchdog runs while the axis is enabled (`OdriveSettings.watchdog_at_rest` changes that); every
frame to the drive feeds it, reads too, as in firmware 0.5 (`OdriveSettings.fed_by_reads`; source:
ODrive, Firmware/communication/can/can_simple.cpp, do_command); errors prevent enabling.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import can
import numpy as np

from drivers.can_bus import receive_frame
from drivers.odrive.endpoints import read_endpoints
from drivers.odrive.messages import (
    BROADCAST,
    AxisError,
    AxisState,
    ControlMode,
    InputMode,
    Layout,
    Layouts,
    can_id,
    node_and_command,
    read_layouts,
)
from drivers.plausibility import winding_signs
from model.files.rig_file import OdriveDocument
from model.pose import Array, Pose
from model.rig import Rig
from model.scene import Load
from simulation.drives.power import Motor
from simulation.rig import SimulatedRig

Frame = bytes | bytearray
Send = Callable[[int, Frame], None]

SUCCESS, DISARMED, NOT_CALIBRATED = 0, 3, 14
"""Procedure results."""

SUPPLY = 48.0
"""[V]."""

SETTLED = 0.25
"""Part of a cycle without a set-point after which all drives have received theirs."""
LONGEST_WAIT = 2.0
"""Cycles after which torques are updated although set-points never pause."""


@dataclass(slots=True)
class OdriveSettings:
    """Non-volatile settings of a drive, as written with odrivetool.

    Attributes:
        watchdog: Time without being fed after which the axis is disarmed, [s]; None when off.
        heartbeat: Period, [s].
        estimates: Period, [s].
        torques: Period, [s].
        brake_opens: Time from arming the axis until its brake is open, [s].
        watchdog_at_rest: The watchdog also runs while the axis is idle, as in firmware 0.5.
        fed_by_reads: Every frame feeds the watchdog; otherwise only set-points and states do.
        firmware: Major, minor, revision.
        board: Product line, version, variant.
        values: Other endpoints by number, as four raw bytes.
        stuck: Endpoints that ignore writes (set by tests).
    """

    watchdog: float | None
    heartbeat: float
    estimates: float
    torques: float
    brake_opens: float
    watchdog_at_rest: bool = False
    fed_by_reads: bool = True
    firmware: tuple[int, int, int] = (0, 6, 11)
    board: tuple[int, int, int] = (4, 4, 58)
    values: dict[int, int] = field(default_factory=dict)
    stuck: set[int] = field(default_factory=set)


class SimulatedOdrive:
    """One ODrive and its motor.

    Attributes:
        node: Node id.
        settings: Written with odrivetool.
        motor: What it moves.
        state: Axis state.
        errors: Active errors of the axis.
        calibrated: Required for enabling the axis (set from outside).
        torque: Actual torque, set by the rig, [N·m].
        supply: Motor supply, [V] (set from outside).
        silent: Messages that it does not send: ``heartbeat``, ``estimates``, ``torques`` (set from
            outside).
        deaf: It neither receives nor sends, as with its bus cable unplugged (set from outside).
    """

    def __init__(
        self,
        node: int,
        settings: OdriveSettings,
        layouts: Layouts,
        counts_per_turn: int,
        torque_constant: float,
        position: float,
        top_speed: float,
        send: Send,
    ) -> None:
        """Powers the drive on: idle, with its brake closed.

        Args:
            settings: Written with odrivetool.
            counts_per_turn: Counts of the motor per turn of the drive.
            torque_constant: Of the motor, [N·m/A].
            position: Of the motor, [counts].
            top_speed: Of the motor, [counts/s].
            send: Sends a frame (identifier, data).
        """
        self.node, self.settings = node, settings
        self._layouts, self._send_frame = layouts, send
        self._per_turn, self._torque_constant = counts_per_turn, torque_constant
        self.motor = Motor(position, position, top_speed)
        self._top_speed = top_speed
        self.calibrated, self.supply, self.torque = True, SUPPLY, 0.0
        self.silent: set[str] = set()
        self.deaf = False
        self._due = {"heartbeat": 0.0, "estimates": 0.0, "torques": 0.0}
        self._commands: dict[int, tuple[Layout, Callable[..., None]]] = {
            layout.command: (layout, act)
            for layout, act in (
                (layouts.set_axis_state, self._set_axis_state),
                (layouts.set_controller_mode, self._set_controller_mode),
                (layouts.set_input_pos, self._set_input_pos),
                (layouts.set_limits, self._set_limits),
                (layouts.clear_errors, self._clear_errors),
                (layouts.estop, self._estop),
            )
        }
        self.power_on()

    def power_on(self) -> None:
        """Starts or restarts: errors and limits are cleared, the motor keeps its position."""
        self.state, self.errors, self.result = AxisState.IDLE, 0, SUCCESS
        self._mode: tuple[int, int] = (0, 0)
        self._target = self.motor.position
        self._unfed = self._opening = 0.0
        self._largest_torque = float("inf")
        self.motor.top_speed = self._top_speed
        self.motor.release()

    @property
    def armed(self) -> bool:
        """The axis controls its motor; its brake is open, or opening."""
        return self.state is AxisState.CLOSED_LOOP_CONTROL

    @property
    def torque_on(self) -> bool:
        """The motor holds or moves the cable; otherwise the brake does."""
        return self.armed and self._opening <= 1e-9

    def advance(self, elapsed: float) -> None:
        """Advances time, [s]: the motor moves, the watchdog runs, messages are sent."""
        if elapsed <= 0.0:
            return
        if self.torque_on:
            self.motor.follow(self._target, 0.0, elapsed, self._limited_direction())
        self._opening -= min(elapsed, self._opening)
        if self.armed or self.settings.watchdog_at_rest:
            self._unfed += elapsed
            watchdog = self.settings.watchdog
            if watchdog is not None and self._unfed > watchdog + 1e-9:
                self.fail(AxisError.WATCHDOG_TIMER_EXPIRED)
        for kind in self._due:
            self._due[kind] -= elapsed
            if self._due[kind] <= 1e-9:
                self._due[kind] += getattr(self.settings, kind)
                self._send_periodic(kind)

    def receive(self, command: int, data: Frame) -> None:
        """Processes a frame for this drive."""
        if self.deaf:
            return
        if self.settings.fed_by_reads:
            self._unfed = 0.0
        if command in self._commands:
            layout, act = self._commands[command]
            values = layout.unpack(data)
            if values is not None:
                act(*values)
        elif not data:
            self._answer(command)
        elif command == self._layouts.rxsdo.command:
            self._on_sdo(bytes(data))

    def fail(self, error: int) -> None:
        """Raises an error: the axis is disarmed, its brake closes."""
        self.errors |= error
        self._disarm(DISARMED)

    def _disarm(self, result: int) -> None:
        self.state, self.result = AxisState.IDLE, result
        self.motor.release()

    def _limited_direction(self) -> int:
        """Sign of the direction blocked by the current limit, or 0."""
        if abs(self.torque) < self._largest_torque:
            return 0
        return 1 if self.torque > 0 else -1

    def _set_axis_state(self, wanted: int) -> None:
        self._unfed = 0.0
        if wanted == AxisState.IDLE:
            self._disarm(SUCCESS)
        elif wanted == AxisState.CLOSED_LOOP_CONTROL and not self.armed:
            position_control = self._mode == (ControlMode.POSITION, InputMode.PASSTHROUGH)
            if self.errors or not self.calibrated or not position_control:
                self.result = DISARMED if self.errors else NOT_CALIBRATED
                return
            self.motor.release()
            self.state, self.result = AxisState.CLOSED_LOOP_CONTROL, SUCCESS
            self._opening = self.settings.brake_opens

    def _set_controller_mode(self, control: int, entry: int) -> None:
        self._mode = (control, entry)

    def _set_input_pos(self, turns: float, _speed: float, _torque: float) -> None:
        self._unfed = 0.0
        self._target = turns * self._per_turn

    def _set_limits(self, speed: float, current: float) -> None:
        self.motor.top_speed = min(self._top_speed, speed * self._per_turn)
        self._largest_torque = current * self._torque_constant

    def _clear_errors(self) -> None:
        self.errors = 0

    def _estop(self) -> None:
        self.fail(AxisError.ESTOP_REQUESTED)

    def _answer(self, command: int) -> None:
        """Answers a request, which is a remote frame or a data frame without data."""
        if command == self._layouts.get_version.command:
            self._send(self._layouts.get_version, 2, *self.settings.board, *self.settings.firmware)
        elif command == self._layouts.get_bus_voltage_current.command:
            self._send(self._layouts.get_bus_voltage_current, self.supply, 0.0)

    def _on_sdo(self, data: bytes) -> None:
        """Reads or writes an endpoint; a write is confirmed, as since firmware 0.6.11."""
        opcode, endpoint, raw = (
            int(v) for v in self._layouts.rxsdo.unpack(data.ljust(8, b"\0")) or (0, 0, 0)
        )
        if opcode and endpoint not in self.settings.stuck:
            self.settings.values[endpoint] = raw
        self._send(self._layouts.txsdo, endpoint, self.settings.values.get(endpoint, 0))

    def _send_periodic(self, kind: str) -> None:
        if kind in self.silent:
            return
        if kind == "heartbeat":
            self._send(self._layouts.heartbeat, self.errors, self.state, self.result)
        elif kind == "estimates":
            turns = self.motor.position / self._per_turn
            self._send(
                self._layouts.get_encoder_estimates, turns, self.motor.speed / self._per_turn
            )
        else:
            self._send(self._layouts.get_torques, self.torque, self.torque)

    def _send(self, layout: Layout, *values: float) -> None:
        if not self.deaf:
            self._send_frame(can_id(self.node, layout.command), layout.pack(*values))


# Simulated ODrives on one bus, and the plant behind them.


class SimulatedOdriveRig(SimulatedRig[SimulatedOdrive]):
    """ODrives and their platform, without a common clock on the bus.

    In one process time advances by a cycle with each `pump`; in real time `serve` follows the
    clock.
    """

    def __init__(
        self, rig: Rig, bus: can.BusABC, start_pose: Pose, load: Load | None = None
    ) -> None:
        """Arguments and errors as for `SimulatedRig`; settings come from the rig file."""
        document = rig.document.drives
        if not isinstance(document, OdriveDocument):
            raise TypeError("the rig has no ODrives")
        self._document = document
        layouts = self._layouts = read_layouts(document.dbc)
        reports = (
            layouts.heartbeat,
            layouts.get_encoder_estimates,
            layouts.get_torques,
            layouts.get_version,
            layouts.get_bus_voltage_current,
            layouts.txsdo,
        )
        self._reports = frozenset(layout.command for layout in reports)
        self._since_update = self._since_set_point = 0.0
        # Drives that report more often than once a cycle do so at different positions.
        self._steps = max(1, math.ceil(rig.document.bus.cycle_ms / document.estimates_ms))
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
            _settings(self._document, self._layouts, brake=winch.brake),
            self._layouts,
            winch.counts_per_turn,
            self._document.motor_torque_constant_nm_a,
            position,
            top_speed,
            self._send,
        )

    def pump(self) -> None:
        """Processes every waiting frame, then advances a cycle; see `SimulatedRig.pump`."""
        while (message := receive_frame(self._bus, 0.0)) is not None:
            self._handle(message)
        for _ in range(self._steps):
            self._advance(self._cycle / self._steps)
        self._finish_torque_update()

    def _advance(self, elapsed: float) -> None:
        """Updates the torques only once per cycle, as finding the equilibrium is slow.

        The platform's inertia averages over the milliseconds in which some drives have received the
        set-point of a cycle and others have not; the equilibrium of such positions is not reached.
        """
        super()._advance(elapsed)
        self._since_update += elapsed
        self._since_set_point += elapsed
        is_between_cycles = self._since_set_point >= SETTLED * self._cycle
        due = self._cycle if is_between_cycles else LONGEST_WAIT * self._cycle
        if self._since_update >= due - 1e-9:
            self._since_update = 0.0
            self.cycles += 1
            self._begin_torque_update()

    def _handle(self, message: can.Message) -> None:
        if message.is_extended_id or message.is_error_frame:
            return
        node, command = node_and_command(message.arbitration_id)
        if message.data and command in self._reports:  # a drive's own, echoed by UDP multicast
            return
        if node == BROADCAST:
            addressed = self.drives
        else:
            addressed = (self._by_node[node],) if node in self._by_node else ()
        if command == self._layouts.set_input_pos.command:
            self._since_set_point = 0.0
        for drive in addressed:
            drive.receive(command, message.data)


def _settings(document: OdriveDocument, layouts: Layouts, *, brake: bool) -> OdriveSettings:
    """Settings as if the rig file's values had been written with odrivetool.

    A brake takes as long to open as the rig file allows.
    """
    watchdog = document.watchdog_ms
    settings = OdriveSettings(
        watchdog=watchdog / 1000.0 if watchdog is not None else None,
        heartbeat=document.heartbeat_ms / 1000.0,
        estimates=document.estimates_ms / 1000.0,
        torques=document.torques_ms / 1000.0,
        brake_opens=document.brake_opens_ms / 1000.0 if brake else 0.0,
    )
    if document.endpoints is not None:
        known = read_endpoints(Path(document.endpoints), document, layouts)
        settings.firmware, settings.board = known.firmware, known.board
    return settings
