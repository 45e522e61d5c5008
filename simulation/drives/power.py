"""The drive function of a simulated CiA 402 drive: state machine, modes, motion and faults.

It is independent of the bus: commands are control words, reports are EMCY codes. Commands are
level-sensitive; only a fault reset needs a rising edge.

Source: CiA 402-2.
"""

from __future__ import annotations

import math
import random
from abc import ABC, abstractmethod
from dataclasses import dataclass

from drivers.cia402.state_machine import FAULTED, TORQUE_ON, DriveState
from simulation.drives.behaviour import DriveBehaviour
from simulation.drives.object_dictionary import DriveObjects, MotionSettings
from simulation.drives.pdo import Deadlines

# Motion of the motor: following set-points, ramping down, holding. Pure.


@dataclass(slots=True)
class Motor:
    """Position of a motor shaft, and its demand.

    Attributes:
        position: Actual position, [counts].
        demand: Position demanded by the controller, [counts].
        speed: Of the demand, [counts/s].
        top_speed: Largest speed of the motor, [counts/s].
        jammed: The shaft does not move (set from outside).
        stick: Following error at which a resting motor jumps, [counts]; 0 without stick-slip.
    """

    position: float
    demand: float
    top_speed: float
    speed: float = 0.0
    jammed: bool = False
    stick: float = 0.0

    @property
    def following_error(self) -> float:
        """Demand minus actual position, [counts]."""
        return self.demand - self.position

    def follow(self, target: float, time_left: float, elapsed: float, load: int) -> None:
        """Interpolates towards a target due after ``time_left`` [s].

        Args:
            target: [counts].
            time_left: Until the target is due, before this step, [s].
            elapsed: Length of this step, [s].
            load: Sign of the direction blocked by the torque limit, or 0.
        """
        if time_left <= elapsed:
            moved = target - self.demand
        else:
            moved = (target - self.demand) * elapsed / time_left
        self.speed = moved / elapsed if elapsed > 0.0 else 0.0
        self.demand += moved
        self._turn(elapsed, load)

    def ramp_down(self, deceleration: float, elapsed: float, load: int) -> None:
        """Slows down at a rate [counts/s²] and then holds; ``load`` as for `follow`."""
        stopping = min(elapsed, abs(self.speed) / deceleration)
        slowed = 0.0  # exactly: a rounding remainder of the speed might never decay
        if stopping == elapsed:
            slowed = self.speed - math.copysign(deceleration * stopping, self.speed)
        self.demand += 0.5 * (self.speed + slowed) * stopping
        self.speed = slowed
        self._turn(elapsed, load)

    def yield_to(self, load: int, distance: float) -> None:
        """Moves a motor at its torque limit, back with the load or forward against it.

        Args:
            load: Sign of the direction in which the motor pulls.
            distance: Motion in that direction, [counts], up to the demand; negative with the load.
        """
        if not self.jammed:
            self.position += load * min(distance, max(0.0, self.following_error * load))

    def release(self) -> None:
        """Torque off, brake closed: the shaft stays, and the demand is set to it."""
        self.demand, self.speed = self.position, 0.0

    def _turn(self, elapsed: float, load: int) -> None:
        if self.jammed:
            return
        wanted = self.demand - self.position
        if self.stick and abs(wanted) < self.stick:
            return
        reachable = self.top_speed * elapsed
        moved = max(-reachable, min(reachable, wanted))
        if moved * load <= 0.0:
            self.position += moved


# The drive function.

SLIP_SHARE = 0.005
"""Slip speed of a motor loaded with twice its torque limit, as a fraction of its top speed; also
the limit of the return speed."""

WARNING_LASTS = 0.5
"""Time for which a warning is present or absent, [s]."""

SWITCH_DELAY = 0.0005
"""Time from a SYNC that enables a drive until its limit switch stops it again, [s]."""

CYCLIC_POSITION = 8
FOLLOWING_ERROR, POSITION_LIMIT = 0x8611, 0x8612
MODE_FOLLOWS, WARNING_CHANGES, ENABLES = TIMED = ("mode", "warning", "enabling")
"""Timed events of the power stage."""

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
_WARNING_BIT = 0x0080
_INTERNAL_LIMIT = 0x0800
_FOLLOWS_COMMAND = 0x1000
_FOLLOWING_ERROR_BIT = 0x2000


class PowerStage(ABC):
    """State machine and motor of one drive.

    Attributes:
        behaviour: Choices within the standards.
        objects: Its object dictionary.
        motor: What it moves.
        torque: Actual torque, set by the plant, [per mille of rated torque].
    """

    objects: DriveObjects
    _deadlines: Deadlines
    _motion: MotionSettings

    def __init__(self, motor: Motor, behaviour: DriveBehaviour, seed: int) -> None:
        """Takes the motor; `_switch_on` must be called next.

        Args:
            motor: What it moves.
            behaviour: Choices within the standards.
            seed: Of all noise.
        """
        self.motor, self.behaviour = motor, behaviour
        self._random = random.Random(seed)
        self._now, self._start = 0.0, motor.position

    @abstractmethod
    def _emergency(self, code: int) -> None:
        """Reports an error, or with 0 the end of one."""

    def _switch_on(self) -> None:
        """Sets the power-on state; the motor keeps its position."""
        self.state, self.torque = DriveState.NOT_READY, 0.0
        self.motor.release()
        self._control_word = 0
        self._mode: int = self.objects.get((0x6060, 0), 0)
        self._wanted_mode = self._mode
        self._target = self.motor.position
        self._time_to_target = self._error_time = 0.0
        self._at_limit = self._is_clipped = self._warned = False
        self._fault_code = self._flicker = 0

    @property
    def state(self) -> DriveState:
        """CiA 402 state."""
        return self._state

    @state.setter
    def state(self, state: DriveState) -> None:
        self._state = state
        self._torque_on = state in TORQUE_ON
        self._enabled = state is DriveState.OPERATION_ENABLED
        self._status = _STATUS_CODES[state] | _VOLTAGE_AND_REMOTE

    @property
    def status_word(self) -> int:
        """Present value of 6041h."""
        return self._status_shown()

    def _status_shown(self) -> int:
        word = self._status
        if self._enabled and self._mode == CYCLIC_POSITION:
            word |= _INTERNAL_LIMIT if self._is_clipped else _FOLLOWS_COMMAND
        if self._at_limit and self._torque_on:
            word |= _INTERNAL_LIMIT
        if self._error_time > 0.0:
            word |= _FOLLOWING_ERROR_BIT
        if self._warned:
            word |= _WARNING_BIT
        return word ^ self._flicker

    @property
    def torque_on(self) -> bool:
        """The motor holds or moves the cable; otherwise the brake does."""
        return self._torque_on

    def fail(self, code: int) -> None:
        """Raises a drive fault: fault reaction, then FAULT."""
        if self.state in FAULTED:
            return
        self._fault_code = code
        self._emergency(code)
        self._react_to_fault()

    def _react_to_fault(self) -> None:
        """605Eh: 0 removes the torque at once, others after a ramp."""
        if self.state in FAULTED:
            return
        if self.torque_on and self.objects.get((0x605E, 0), 2) != 0:
            self.state = DriveState.FAULT_REACTION_ACTIVE
        else:
            self._power_off(DriveState.FAULT)

    def _connection_lost(self, code: int) -> None:
        """Abort connection option code 6007h: 1 a fault, 2 disable voltage, 3 quick stop."""
        option = self.objects.get((0x6007, 0), 1)
        if option == 1:
            self._fault_code = code
            self._react_to_fault()
        elif self.state in FAULTED:
            return
        elif option == 2:
            self._power_off(DriveState.SWITCH_ON_DISABLED)
        elif option == 3:
            self._command_quick_stop()

    def _position_shown(self) -> int:
        position = self.motor.position
        if self.behaviour.position_noise:
            position += self._random.gauss(0.0, self.behaviour.position_noise)
        return (round(position) + 0x80000000 & 0xFFFFFFFF) - 0x80000000  # a counter of 32 bits

    def _torque_shown(self) -> int:
        torque = self.torque
        if self.behaviour.torque_noise:
            torque += self._random.gauss(0.0, self.behaviour.torque_noise)
        return max(-0x8000, min(0x7FFF, round(torque)))

    def _move(self, elapsed: float) -> None:
        load = self._limited_direction()
        if self._enabled:
            self.motor.follow(self._target, self._time_to_target, elapsed, load)
            left = self._time_to_target - elapsed
            self._time_to_target = left if left > 0.0 else 0.0
        elif self._state is DriveState.QUICK_STOP_ACTIVE:
            self.motor.ramp_down(self._motion.deceleration, elapsed, load)
            if self._motion.stop_option < 5 and self.motor.speed == 0.0:
                self._power_off(DriveState.SWITCH_ON_DISABLED)  # transition 12
        elif self.state is DriveState.FAULT_REACTION_ACTIVE:
            self.motor.ramp_down(self._motion.deceleration, elapsed, load)
            if self.motor.speed == 0.0:
                self._power_off(DriveState.FAULT)
        if load and self._torque_on:
            room = 1.0 - abs(self.torque) / max(1, self._motion.max_torque)
            speed = SLIP_SHARE * self.motor.top_speed * max(-1.0, min(1.0, room))
            self.motor.yield_to(load, speed * elapsed)

    def _limited_direction(self) -> int:
        """Sign of the direction blocked by the torque limit, or 0.

        A load above the limit moves the motor back; it stays at the limit until it reaches its
        demand.
        """
        limited = abs(self.torque) >= self._motion.max_torque
        if not (limited or self._at_limit):
            return 0
        pull = 1 if self.torque > 0 else -1
        self._at_limit = limited or self.motor.following_error * pull > 0.0
        return pull if self._at_limit else 0

    def _check_following(self, elapsed: float) -> None:
        """Following error above 6065h for longer than 6066h."""
        motor = self.motor
        if self._torque_on and abs(motor.demand - motor.position) > self._motion.window:
            self._error_time += elapsed
            if self._error_time > self._motion.window_time:
                self.fail(FOLLOWING_ERROR)
        else:
            self._error_time = 0.0

    def _check_limits(self) -> None:
        """Actual position outside 607Dh."""
        low, high = self._motion.limits
        if self._torque_on and not low <= self.motor.position <= high:
            self.fail(POSITION_LIMIT)

    def _take_mode(self, mode: int) -> None:
        """6060h: at once, late, or only while enabled, according to the behaviour."""
        if not self.objects.has_mode(mode):
            return
        self._wanted_mode = mode
        if self.behaviour.mode_when_enabled and self.state is not DriveState.OPERATION_ENABLED:
            return
        self._change_mode()

    def _change_mode(self) -> None:
        if self.behaviour.mode_delay:
            self._deadlines.expect(MODE_FOLLOWS, self._now + self.behaviour.mode_delay)
        else:
            self._mode = self._wanted_mode

    def _take_target(self, target: int) -> None:
        """Takes a target plus its offset (60B0h), limited to the software limits (607Dh)."""
        if self._mode != CYCLIC_POSITION:
            return
        target += self._motion.offset
        low, high = self._motion.limits
        self._target = float(low if target < low else high if target > high else target)
        self._is_clipped = self._target != target
        self._time_to_target = self._motion.interpolation

    def _take_control_word(self, word: int) -> None:
        """Executes a command; level-sensitive, except for the rising edge of a reset."""
        rising = word & 0x80 and not self._control_word & 0x80
        self._control_word = word
        if self._enabled and word & 0x8F == 0x0F:
            return
        if self.state in FAULTED:
            if rising and self.state is DriveState.FAULT:
                self.state = DriveState.SWITCH_ON_DISABLED
                self._fault_code = 0
                self._emergency(0)
            return
        if rising or self.state is DriveState.NOT_READY:
            return
        if word & 0x02 == 0:
            if self.state is not DriveState.SWITCH_ON_DISABLED:
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
        """Transitions 7, 10 and 11."""
        if self.state is DriveState.OPERATION_ENABLED:
            self._quick_stop()
        elif self.state is not DriveState.QUICK_STOP_ACTIVE:
            self._power_off(DriveState.SWITCH_ON_DISABLED)

    def _command_shutdown(self) -> None:
        """Transitions 2, 6 and 8."""
        if self.state is not DriveState.QUICK_STOP_ACTIVE:
            self._power_off(DriveState.READY_TO_SWITCH_ON)

    def _command_switch_on(self) -> None:
        """Transitions 3 and 5; withdraws a command to enable that has not taken effect."""
        self._deadlines.forget(ENABLES)
        if self.state in (DriveState.READY_TO_SWITCH_ON, DriveState.OPERATION_ENABLED):
            self._power_off(DriveState.SWITCHED_ON)

    def _command_enable(self) -> None:
        """Transitions 4 and 16, and 3 with 4; 16 only if 605Ah holds after a quick stop."""
        if self.state is DriveState.QUICK_STOP_ACTIVE:
            if self._motion.stop_option >= 5:
                self._enable()
        elif self.state in (DriveState.READY_TO_SWITCH_ON, DriveState.SWITCHED_ON):
            if not self.behaviour.enable_delay:
                self._enable()
            elif ENABLES not in self._deadlines:
                self.state = DriveState.SWITCHED_ON
                self._deadlines.expect(ENABLES, self._now + self.behaviour.enable_delay)

    def _enable(self) -> None:
        self.state = DriveState.OPERATION_ENABLED
        if self._mode != self._wanted_mode and MODE_FOLLOWS not in self._deadlines:
            self._change_mode()
        if self._mode != CYCLIC_POSITION:
            self._target = self.motor.demand
        if self.behaviour.warning and WARNING_CHANGES not in self._deadlines:
            self._deadlines.expect(WARNING_CHANGES, self._now + WARNING_LASTS)

    def _happens(self, what: object) -> None:
        """An event of `TIMED` is due."""
        if what == MODE_FOLLOWS:
            self._mode = self._wanted_mode
        elif what == ENABLES:
            self._enable()
        else:
            self._warn()

    def _warn(self) -> None:
        """Raises or clears a warning, without other effects."""
        enabled, was = self.state is DriveState.OPERATION_ENABLED, self._warned
        self._warned = enabled and not was
        if self._warned != was:
            self._emergency(self.behaviour.warning if self._warned else 0)
        if enabled:
            self._deadlines.expect(WARNING_CHANGES, self._now + WARNING_LASTS)

    def _quick_stop(self) -> None:
        """605Ah: 5 to 8 hold after the ramp, 1 to 4 then remove the torque, 0 at once."""
        self.state = DriveState.QUICK_STOP_ACTIVE
        if self._motion.stop_option == 0:
            self._power_off(DriveState.SWITCH_ON_DISABLED)

    @property
    def _is_at_switch(self) -> bool:
        """Whether the motor is beyond its limit switch."""
        distance = self.behaviour.limit_switch
        return bool(distance) and abs(self.motor.position - self._start) > distance

    def _stop_at_switch(self) -> None:
        """The motor moves for `SWITCH_DELAY`, then the limit switch stops it without an EMCY."""
        if self._enabled:
            self._move(SWITCH_DELAY)
            self._quick_stop()

    def _power_off(self, state: DriveState) -> None:
        """Brake closed, torque off."""
        self._deadlines.forget(ENABLES)
        self.state, self.torque = state, 0.0
        self.motor.release()
        self._error_time = 0.0
