"""A simulated CiA 402 drive on a CANopen bus; it knows the standard, not the master.

Set-points are taken and replies sent at SYNC; a reply tells what was so at that SYNC, before the
new set-point acts. Time goes on only by `advance`. The drive has a brake that is closed whenever
there is no torque, so that its drum stays where it is.

Source: CiA 301, CiA 402-2. Where they leave a choice to the maker: SYNC is overdue after three
periods of 1006h; a drive that stopped by itself can be enabled again only after its control word
has shown something else than "enable operation".
"""

from __future__ import annotations

from collections.abc import Callable

from canopen.sdo.server import SdoServer

from drivers.cia402.frames import (
    EMCY_BASE,
    HEARTBEAT_BASE,
    SDO_REPLY_BASE,
    SDO_REQUEST_BASE,
    TPDO1_BASE,
    NmtCommand,
    NmtState,
    make_emergency,
    make_heartbeat,
    make_reply,
    parse_heartbeat,
    parse_set_point,
)
from drivers.cia402.states import TORQUE_ON, DriveState
from simulation.drive_motion import Motor
from simulation.drive_objects import PDO_OFF, DriveObjects

Frame = bytes | bytearray
Send = Callable[[int, Frame], None]

MISSED_SYNC_PERIODS = 3
SLIP_SHARE = 0.005
"""A motor that is loaded with twice the torque that it can hold slips at this share of its top
speed, and comes back at no more."""

LIFE_GUARD = 0x8130
PDO_LENGTH = 0x8210
SET_POINT_OVERDUE = 0x8250
SYNC_OVERDUE = 0x8700
FOLLOWING_ERROR = 0x8611

_STATUS_CODES = {
    DriveState.NOT_READY: 0x0000,
    DriveState.SWITCH_ON_DISABLED: 0x0040,
    DriveState.READY_TO_SWITCH_ON: 0x0021,
    DriveState.SWITCHED_ON: 0x0023,
    DriveState.OPERATION_ENABLED: 0x0027,
    DriveState.QUICK_STOP_ACTIVE: 0x0007,
    DriveState.FAULT_REACTION_ACTIVE: 0x000F,
    DriveState.FAULT: 0x0008,
}
_VOLTAGE_AND_REMOTE = 0x0210
_FOLLOWS_COMMAND = 0x1000
_FOLLOWING_ERROR_BIT = 0x2000


class SimulatedDrive:
    """One drive and its motor.

    Attributes:
        node: CANopen node id.
        objects: Its object dictionary.
        motor: What it moves.
        state: CiA 402 state.
        nmt: NMT state.
        torque: Actual torque, set by the plant, [per mille of rated torque].
        silent: It hears and says nothing, as with its bus cable pulled (set from outside).
    """

    def __init__(self, node: int, position: float, top_speed: float, send: Send) -> None:
        """Switches a drive on: it announces itself and waits in PRE-OPERATIONAL.

        Args:
            node: CANopen node id.
            position: Of the motor, [counts].
            top_speed: Of the motor, [counts/s].
            send: Puts a frame (identifier, data) on the bus.
        """
        self.node = node
        self._bus_send = send
        self.motor = Motor(position, position, top_speed)
        self.silent = False
        self._sdo_ids = SDO_REQUEST_BASE + node
        self.power_on()

    def power_on(self) -> None:
        """Starts, or starts again: everything set up is lost, the motor stays where it is."""
        self.objects = DriveObjects(self.node)
        self.objects.measured(0x6041, 0, lambda: self.status_word)
        self.objects.measured(0x6061, 0, lambda: self.objects[0x6060, 0])
        self.objects.measured(0x6064, 0, lambda: round(self.motor.position))
        self.objects.measured(0x6077, 0, lambda: round(self.torque))
        self._server = SdoServer(  # type: ignore[no-untyped-call]
            SDO_REQUEST_BASE + self.node, SDO_REPLY_BASE + self.node, self.objects
        )
        self._server.network = _Replies(self)  # type: ignore[assignment]
        self.state, self.torque = DriveState.SWITCH_ON_DISABLED, 0.0
        self.nmt = NmtState.PRE_OPERATIONAL
        self.motor.release()
        self._control_word = 0
        self._waiting: tuple[int, int, int] | None = None
        self._target = self.motor.position
        self._time_to_target = 0.0
        self._may_leave_stop = True
        self._since_sync: float | None = None
        self._since_set_point: float | None = None
        self._since_heartbeat: dict[int, float] = {}
        self._watched = self._heartbeat_consumers()
        self._to_own_heartbeat = 0.0
        self._error_time = 0.0
        self._at_limit = False
        self._send(HEARTBEAT_BASE + self.node, make_heartbeat(NmtState.BOOT_UP))

    @property
    def status_word(self) -> int:
        """6041h as it is now."""
        word = _STATUS_CODES[self.state] | _VOLTAGE_AND_REMOTE
        if self.state is DriveState.OPERATION_ENABLED:
            word |= _FOLLOWS_COMMAND
        if self._error_time > 0.0:
            word |= _FOLLOWING_ERROR_BIT
        return word

    @property
    def torque_on(self) -> bool:
        """The motor holds or moves the cable; otherwise the brake does."""
        return self.state in TORQUE_ON

    def advance(self, elapsed: float) -> None:
        """Lets time pass, [s]: the motor moves, time-outs run, heartbeats are due."""
        if elapsed <= 0.0:
            return
        self._move(elapsed)
        self._check_following(elapsed)
        self._watch_bus(elapsed)
        self._produce_heartbeat(elapsed)

    def on_sync(self) -> None:
        """SYNC: reply with what is, then act on the set-point that was waiting."""
        if self.silent or self.nmt is not NmtState.OPERATIONAL:
            return
        self._since_sync = 0.0
        if not self.objects[0x1800, 1] & PDO_OFF and self.objects[0x1800, 2] == 1:
            reply = make_reply(self.status_word, round(self.motor.position), round(self.torque))
            self._send(TPDO1_BASE + self.node, reply)
        if self._waiting is not None:
            word, target, _ = self._waiting
            self._waiting = None
            self._take_target(target)
            self._take_control_word(word)

    def on_set_point(self, data: Frame) -> None:
        """RPDO1: kept until the next SYNC."""
        if self.silent or self.nmt is not NmtState.OPERATIONAL or self.objects[0x1400, 1] & PDO_OFF:
            return
        set_point = parse_set_point(data)
        if set_point is None or self.objects[0x1600, 0] != 3:
            self._emergency(PDO_LENGTH)
            return
        self._waiting = set_point
        self._since_set_point = 0.0

    def on_sdo(self, data: Frame) -> None:
        """An SDO request."""
        if not self.silent and len(data) == 8 and self.nmt is not NmtState.STOPPED:
            self._server.on_request(  # type: ignore[no-untyped-call]
                self._server.rx_cobid, data, 0.0
            )
            self._watched = self._heartbeat_consumers()

    def on_nmt(self, command: int, node: int) -> None:
        """An NMT command."""
        if self.silent or node not in (0, self.node):
            return
        if command == NmtCommand.START:
            self.nmt = NmtState.OPERATIONAL
            self._since_sync = self._since_set_point = None
        elif command == NmtCommand.PRE_OPERATIONAL:
            self.nmt = NmtState.PRE_OPERATIONAL
        elif command == NmtCommand.STOP:
            self.nmt = NmtState.STOPPED
            self._lose_bus(LIFE_GUARD)
        elif command in (NmtCommand.RESET_NODE, NmtCommand.RESET_COMMUNICATION):
            self.power_on()

    def on_heartbeat(self, node: int, data: Frame) -> None:
        """The heartbeat of another node; watched from the first one on."""
        if not self.silent and node in self._watched and parse_heartbeat(data) is not None:
            self._since_heartbeat[node] = 0.0

    def fail(self, code: int) -> None:
        """A fault inside the drive: fault reaction, then FAULT."""
        if self.state in (DriveState.FAULT, DriveState.FAULT_REACTION_ACTIVE):
            return
        self._emergency(code)
        if self.torque_on:
            self.state = DriveState.FAULT_REACTION_ACTIVE
        else:
            self._power_off(DriveState.FAULT)

    def _move(self, elapsed: float) -> None:
        load = self._limited_direction()
        deceleration = float(self.objects[0x6085, 0])
        if self.state is DriveState.OPERATION_ENABLED:
            self.motor.follow(self._target, self._time_to_target, elapsed, load)
            self._time_to_target = max(0.0, self._time_to_target - elapsed)
        elif self.state is DriveState.QUICK_STOP_ACTIVE:
            self.motor.ramp_down(deceleration, elapsed, load)
        elif self.state is DriveState.FAULT_REACTION_ACTIVE:
            self.motor.ramp_down(deceleration, elapsed, load)
            if self.motor.speed == 0.0:
                self._power_off(DriveState.FAULT)
        if load and self.torque_on:
            room = 1.0 - abs(self.torque) / max(1, self.objects[0x6072, 0])
            speed = SLIP_SHARE * self.motor.top_speed * max(-1.0, min(1.0, room))
            self.motor.yield_to(load, speed * elapsed)

    def _limited_direction(self) -> int:
        """At its torque limit the motor cannot pull further the way it is pulling.

        A load above it turns the motor back; it is at its limit until it is where it is to be.
        """
        pull = 1 if self.torque > 0 else -1
        if abs(self.torque) >= self.objects[0x6072, 0]:
            self._at_limit = True
        elif self.motor.following_error * pull <= 0.0:
            self._at_limit = False
        return pull if self._at_limit else 0

    def _check_following(self, elapsed: float) -> None:
        """Following error above 6065h for longer than 6066h."""
        window = self.objects[0x6065, 0]
        if not self.torque_on or window == 0xFFFFFFFF:
            self._error_time = 0.0
        elif abs(self.motor.following_error) > window:
            self._error_time += elapsed
            if self._error_time > self.objects[0x6066, 0] / 1000.0:
                self.fail(FOLLOWING_ERROR)
        else:
            self._error_time = 0.0

    def _watch_bus(self, elapsed: float) -> None:
        """SYNC, set-points and heartbeats, each from its first arrival on."""
        period = self.objects[0x1006, 0] / 1e6
        if self._since_sync is not None:
            self._since_sync += elapsed
            if period and self._since_sync > MISSED_SYNC_PERIODS * period + 1e-9:
                self._since_sync = None
                self._lose_bus(SYNC_OVERDUE)
        deadline = self.objects[0x1400, 5] / 1000.0
        if self._since_set_point is not None:
            self._since_set_point += elapsed
            if deadline and self._since_set_point > deadline + 1e-9:
                self._since_set_point = None
                self._lose_bus(SET_POINT_OVERDUE)
        for node in list(self._since_heartbeat):
            self._since_heartbeat[node] += elapsed
            if node not in self._watched:
                del self._since_heartbeat[node]
            elif self._since_heartbeat[node] > self._watched[node] + 1e-9:
                del self._since_heartbeat[node]
                self._lose_bus(LIFE_GUARD)

    def _heartbeat_consumers(self) -> dict[int, float]:
        """Nodes and times [s] of the heartbeat consumer, 1016h."""
        entries = (self.objects[0x1016, sub] for sub in range(1, 9))
        return {e >> 16 & 0x7F: (e & 0xFFFF) / 1000.0 for e in entries if e & 0xFFFF}

    def _produce_heartbeat(self, elapsed: float) -> None:
        period = self.objects[0x1017, 0] / 1000.0
        if not period:
            return
        self._to_own_heartbeat -= elapsed
        if self._to_own_heartbeat <= 1e-9:
            self._to_own_heartbeat = period
            self._send(HEARTBEAT_BASE + self.node, make_heartbeat(self.nmt))

    def _lose_bus(self, code: int) -> None:
        """Abort connection option code 6007h; it matters while the drive is enabled."""
        if self.state is not DriveState.OPERATION_ENABLED:
            return
        option = self.objects[0x6007, 0]
        if option == 1:
            self.fail(code)
            return
        self._emergency(code)
        if option == 2:
            self._power_off(DriveState.SWITCH_ON_DISABLED)
        elif option == 3:
            self._quick_stop()

    def _take_target(self, target: int) -> None:
        """A target outside the software limits (607Dh) is not approached further than they are."""
        low, high = self.objects[0x607D, 1], self.objects[0x607D, 2]
        self._target = float(max(low, min(high, target)))
        exponent = self.objects[0x60C2, 2]
        self._time_to_target = self.objects[0x60C2, 1] * 10.0**exponent

    def _take_control_word(self, word: int) -> None:
        rising = word & 0x80 and not self._control_word & 0x80
        self._control_word = word
        if self.state in (DriveState.FAULT, DriveState.FAULT_REACTION_ACTIVE):
            if rising and self.state is DriveState.FAULT:
                self.state = DriveState.SWITCH_ON_DISABLED
                self._emergency(0)
            return
        if word & 0x02 == 0:
            self._power_off(DriveState.SWITCH_ON_DISABLED)
        elif word & 0x04 == 0:
            self._command_quick_stop()
        elif word & 0x01 == 0:
            self._command_shutdown()
        elif word & 0x08 == 0:
            self._command_switch_on()
        else:
            self._command_enable()

    def _command_quick_stop(self) -> None:
        self._may_leave_stop = True
        if self.state is DriveState.OPERATION_ENABLED:
            self._quick_stop()
            self._may_leave_stop = True
        elif self.state is not DriveState.QUICK_STOP_ACTIVE:
            self._power_off(DriveState.SWITCH_ON_DISABLED)

    def _command_shutdown(self) -> None:
        if self.state is not DriveState.QUICK_STOP_ACTIVE:
            self._power_off(DriveState.READY_TO_SWITCH_ON)
        self._may_leave_stop = True

    def _command_switch_on(self) -> None:
        self._may_leave_stop = True
        if self.state in (DriveState.READY_TO_SWITCH_ON, DriveState.OPERATION_ENABLED):
            self._power_off(DriveState.SWITCHED_ON)

    def _command_enable(self) -> None:
        leaving_stop = self.state is DriveState.QUICK_STOP_ACTIVE and self._may_leave_stop
        if leaving_stop and self.objects[0x605A, 0] < 5:
            return
        if leaving_stop or self.state is DriveState.SWITCHED_ON:
            self.state = DriveState.OPERATION_ENABLED

    def _quick_stop(self) -> None:
        """Quick stop option code 605Ah: 5 to 8 hold afterwards, the others take the torque off."""
        self.state = DriveState.QUICK_STOP_ACTIVE
        self._may_leave_stop = False
        if self.objects[0x605A, 0] < 5:
            self._power_off(DriveState.SWITCH_ON_DISABLED)

    def _power_off(self, state: DriveState) -> None:
        """Brake closed, torque off."""
        self.state, self.torque = state, 0.0
        self.motor.release()
        self._error_time = 0.0

    def _emergency(self, code: int) -> None:
        self.objects[0x603F, 0] = code
        self.objects[0x1001, 0] = 1 if code else 0
        self._send(EMCY_BASE + self.node, make_emergency(code, 1 if code else 0))

    def _send(self, can_id: int, data: Frame) -> None:
        if not self.silent:
            self._bus_send(can_id, data)


class _Replies:
    """Where canopen's SDO server sends its answers."""

    def __init__(self, drive: SimulatedDrive) -> None:
        self._drive = drive

    def send_message(self, can_id: int, data: Frame) -> None:
        self._drive._send(can_id, data)
