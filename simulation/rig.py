"""A rig in software, whatever its drives speak: m drives on one bus, and the plant behind them."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from enum import Enum
from typing import Generic, Protocol, TypeVar

import can
import numpy as np

from drivers.can_bus import SentFrame, take, transmit
from drivers.can_errors import BusDown
from model.kinematics import cables_at
from model.pose import Array, Pose
from model.rig import Rig
from model.scene import Load
from model.statics.gravity import working_tensions
from model.winches import WinchMap
from simulation.drives.motion import Motor
from simulation.ground_truth import (
    rig_as_built,
    simulation_of,
    stiffness_as_built,
    winches_as_built,
)
from simulation.plant import Plant

# From the motors to the platform and back: drums turn with them, the drives feel their cables.


# What lies between a motor's shaft and the cable on its drum: play and steps. Pure.


class Transmission:
    """Drums that follow their motors with backlash, and stand only at whole steps.

    A drum rests while its motor turns back through the backlash, as in a gear or with cable that
    rubs in its guides.
    """

    def __init__(self, backlash: Array, step: float, at: Array) -> None:
        """Begins with every drum in the middle of its backlash.

        Args:
            backlash: Shape (m,), [counts].
            step: [counts].
            at: Positions of the motors, shape (m,), [counts].
        """
        self._half, self._step = np.abs(backlash) / 2.0, step
        self._drums = np.array(at, dtype=np.float64)

    def drums(self, motors: Array) -> Array:
        """Where the drums stand with the motors there, shape (m,), [counts]."""
        self._drums = np.clip(self._drums, motors - self._half, motors + self._half)
        if self._step == 1.0:
            return self._drums.copy()
        whole: Array = np.rint(self._drums / self._step) * self._step
        return whole


# What a simulated rig needs of its drives, whatever they speak.


class WinchDrive(Protocol):
    """What a rig needs of a simulated drive.

    Attributes:
        motor: What it moves.
        torque: Actual torque, set by the rig, in the unit of its protocol.
    """

    motor: Motor
    torque: float

    @property
    def state(self) -> Enum:
        """Its state in the words of its protocol."""
        ...

    @property
    def torque_on(self) -> bool:
        """The motor holds or moves the cable; otherwise the brake does."""
        ...

    def advance(self, elapsed: float) -> None:
        """Lets time pass, [s]."""
        ...


class DriveTrain:
    """Moves the platform to the motors' positions; sets the drives' cable tensions.

    Feeling goes step by step, for who has something else to do meanwhile: it may take long to find
    the platform's place.

    Attributes:
        per_newton: Torque by tension, shape (m,), in the unit of the drives' protocol.
    """

    def __init__(
        self, rig: Rig, plant: Plant, counts: Array, per_newton: Array, friction: float = 0.0
    ) -> None:
        """Moves the platform to where the drums stand with the motors at given positions.

        Args:
            rig: The robot, with the ``simulation`` section of its file.
            plant: What the drums move.
            counts: Positions of the motors, shape (m,), [counts].
            per_newton: Torque by tension, shape (m,), in the unit of the drives' protocol.
            friction: Torque that a motor spends on itself and no cable feels, in that unit.

        Raises:
            Fault: The platform has no equilibrium there.
        """
        self._plant, self._counts, self.per_newton = plant, counts, per_newton
        winches = winches_as_built(rig)
        per_metre = np.array([winch.counts_per_metre for winch in rig.winches])
        play = per_metre * winches.backlash_mm / 1000.0
        self._transmission = Transmission(play, winches.step_counts, counts)
        plant.settle_counts(self._transmission.drums(counts))
        self._tension_noise = winches.tension_noise_n
        self._random = np.random.default_rng([simulation_of(rig).seed, 0x7E45])
        self._friction, self._ahead = friction, np.zeros(len(counts))
        self._feeling: Iterator[None] | None = None

    @property
    def feeling(self) -> bool:
        """The drives have begun to feel their cables, and are still about it."""
        return self._feeling is not None

    def begin_feeling(self, drives: Sequence[WinchDrive]) -> None:
        """The drives begin to feel the cables as they are now, unless they are still about it."""
        if self._feeling is None:
            self._feeling = self._felt(drives)

    def go_on_feeling(self) -> None:
        """One step, if there is one to do.

        Raises:
            Fault: The platform has no equilibrium.
        """
        if self._feeling is None:
            return
        try:
            next(self._feeling)
        except StopIteration:
            self._feeling = None

    def finish_feeling(self) -> None:
        """All steps that are left; errors as for `go_on_feeling`."""
        while self._feeling is not None:
            self.go_on_feeling()

    def settle(self, drives: Sequence[WinchDrive]) -> None:
        """The platform goes where the drums let it; nothing to do while none has turned.

        Raises:
            Fault: The platform has no equilibrium.
        """
        counts = _positions(drives)
        if not np.array_equal(counts, self._counts):
            self._plant.settle_counts(self._transmission.drums(counts))
            self._counts = counts

    def _felt(self, drives: Sequence[WinchDrive]) -> Iterator[None]:
        """The platform goes where the drums let it; then the drives feel its cables."""
        counts = _positions(drives)
        if not np.array_equal(counts, self._counts):
            yield from self._plant.settling_counts(self._transmission.drums(counts))
            if self._friction > 0.0:  # a motor at rest keeps the torque with which it came to rest
                turned = np.sign(counts - self._counts)
                self._ahead = np.where(turned == 0.0, self._ahead, turned)
            self._counts = counts
        told = self._plant.tensions
        if self._tension_noise > 0.0:
            told = told + self._tension_noise * self._random.standard_normal(len(told))
        torques = told * self.per_newton + self._friction * self._ahead
        for drive, torque in zip(drives, torques.tolist(), strict=True):
            drive.torque = torque if drive.torque_on else 0.0


def _positions(drives: Sequence[WinchDrive]) -> Array:
    """Of the motors, shape (m,), [counts]."""
    return np.array([drive.motor.position for drive in drives])


Frame = bytes | bytearray

TOP_SPEED_RESERVE = 1.5
"""A simulated motor turns this much faster than its winch's speed limit."""

IDLE_WAIT = 0.005
"""Longest wait for a frame before time-outs of the drives are looked at, [s]."""


@dataclass(frozen=True, slots=True, eq=False)
class RehearsalStatus:
    """What `SimulatedRig.serve` reports while it runs.

    Attributes:
        cycles: Cycles seen.
        states: State of each drive.
        pose: Of the platform, ``world_from_platform``.
        tensions: Shape (m,), [N].
    """

    cycles: int
    states: tuple[Enum, ...]
    pose: Pose
    tensions: Array


Drive = TypeVar("Drive", bound=WinchDrive)


class SimulatedRig(ABC, Generic[Drive]):
    """Simulated drives and their platform on one end of a CAN bus.

    Attributes:
        drives: In the order of the winches.
        plant: What they move.
        cycles: Cycles seen.
    """

    def __init__(
        self, rig: Rig, bus: can.BusABC, start_pose: Pose, load: Load | None = None
    ) -> None:
        """Switches the drives on where the rig file says that they stand at a pose.

        There the platform hangs under working tensions, if the rig is built as its file says; if
        not, near it.

        Args:
            rig: The robot.
            bus: An open bus for the drives; the caller's.
            start_pose: ``world_from_platform``.
            load: What the platform carries.

        Raises:
            TensionInfeasible: The cables cannot hold the platform there.
            Fault: The bus did not take the drives' first frames.
        """
        self._rig, self._bus = rig, bus
        self._cycle = rig.cycle
        self.plant = Plant(rig_as_built(rig), start_pose, load, stiffness_as_built(rig))
        self.cycles = 0
        per_newton = self._torque_per_newton()
        start = _counts_as_told(rig, start_pose, load)
        self._drive_train = DriveTrain(rig, self.plant, start, per_newton, self._friction())
        self.drives: tuple[Drive, ...] = ()
        self.drives = tuple(
            self._make_drive(number, float(counts), self._top_speed(number))
            for number, counts in enumerate(start)
        )

    @abstractmethod
    def _torque_per_newton(self) -> Array:
        """Torque by tension, shape (m,), in the unit of the drives' protocol."""

    def _friction(self) -> float:
        """Torque of the drive trains that no cable feels, in the unit of the drives' protocol."""
        return 0.0

    @abstractmethod
    def _make_drive(self, number: int, position: float, top_speed: float) -> Drive:
        """Switches a drive on: its place among the winches, position [counts], speed [counts/s]."""

    @abstractmethod
    def _handle(self, message: can.Message) -> None:
        """Hands a frame to whom it is for."""

    @abstractmethod
    def pump(self) -> None:
        """Works off every frame that waits, and answers.

        Raises:
            Fault: The bus failed, or the platform has no equilibrium.
        """

    def _top_speed(self, number: int) -> float:
        winch = self._rig.winches[number]
        return TOP_SPEED_RESERVE * winch.max_speed * abs(winch.counts_per_metre)

    @property
    def pose(self) -> Pose:
        """Where the platform truly is, ``world_from_platform``."""
        self._settle()
        return self.plant.pose

    @property
    def tensions(self) -> Array:
        """Of the cables, shape (m,), [N]."""
        self._settle()
        return self.plant.tensions

    def carry(self, load: Load) -> None:
        """The platform carries something else from now on.

        Raises:
            Fault: The platform has no equilibrium with it.
        """
        self._settle()
        self.plant.carry(load)

    def advance(self, seconds: float) -> None:
        """Lets time pass without a frame, in cycles at most: time-outs run, motors move."""
        while seconds > 1e-12:
            step = min(seconds, self._cycle)
            self._advance(step)
            self._finish_feeling()
            seconds -= step

    def serve(
        self,
        stop_requested: Callable[[], bool],
        on_status: Callable[[RehearsalStatus], None] | None = None,
        *,
        status_period: float = 0.5,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Answers in real time until stopped or interrupted from the keyboard.

        Drives answer at once; the platform's place is found while nothing is to be answered, in
        half of that time at most, and torques wait for it. When this process is held up, the
        drives' time stands still: they do not blame the master for it. While the interface is down
        they receive and send nothing, as if unplugged, and continue when it is up again.

        Args:
            stop_requested: Asked every few milliseconds; true ends it.
            on_status: Called every ``status_period`` seconds, between two frames.
            status_period: [s].
            clock: Monotonic seconds.

        Raises:
            Fault: The bus failed, or the platform has no equilibrium.
        """
        try:
            last = told = clock()
            wait = IDLE_WAIT
            while not stop_requested():
                message = self._heard(wait)
                now = clock()
                self._let_pass(now - last, message)
                last = now
                if message is not None:
                    self._handle(message)
                    wait = 0.0
                    continue
                wait = IDLE_WAIT
                if self._drive_train.feeling:
                    self._drive_train.go_on_feeling()
                    wait = clock() - now  # a master on the same processor has its turn, too
                if on_status is not None and now - told >= status_period:
                    told = now
                    on_status(self.status())
        except KeyboardInterrupt:
            return

    def _let_pass(self, waited: float, message: can.Message | None) -> None:
        """Time that passed until a frame came, or none did; of a longer time only a cycle."""
        self._advance(min(waited, self._cycle))

    def status(self) -> RehearsalStatus:
        """Where everything stands, the platform where the drives felt it last."""
        states = tuple(drive.state for drive in self.drives)
        return RehearsalStatus(self.cycles, states, self.plant.pose, self.plant.tensions)

    def _heard(self, wait: float) -> can.Message | None:
        """The next frame, if one comes within a time [s]; none while the interface is down."""
        try:
            return take(self._bus, wait)
        except BusDown:
            time.sleep(IDLE_WAIT)  # the kernel reports it at once, and time must pass all the same
            return None

    def _advance(self, elapsed: float) -> None:
        for drive in self.drives:
            drive.advance(elapsed)

    def _feel(self) -> None:
        """The drives begin to feel the cables as they are now, unless they are still about it."""
        self._drive_train.begin_feeling(self.drives)

    def _finish_feeling(self) -> None:
        self._drive_train.finish_feeling()

    def _settle(self) -> None:
        self._drive_train.settle(self.drives)

    def _send(self, can_id: int, data: Frame) -> None:
        with suppress(BusDown):  # no node is reached
            transmit(self._bus, SentFrame(can_id, data))


def _counts_as_told(rig: Rig, pose: Pose, load: Load | None) -> Array:
    """Whole drive positions that hold a pose, by the rig file, shape (m,), [counts]."""
    winches = WinchMap(rig)
    tensions = working_tensions(rig, pose, load).tensions
    return np.rint(winches.counts(winches.unstrained(cables_at(rig, pose).lengths, tensions)))
