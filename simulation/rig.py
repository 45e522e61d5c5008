"""A simulated rig for any drive protocol: m drives on one bus, and the plant."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from enum import Enum
from typing import Generic, Protocol, TypeVar

import can
import numpy as np

from drivers.can_bus import SentFrame, receive_frame, transmit
from drivers.can_errors import BusDown
from model.pose import Array, Pose
from model.rig import Rig
from model.scene import Load
from model.winches import WinchMap
from simulation.drives.power import Motor
from simulation.ground_truth import (
    rig_as_built,
    simulation_of,
    stiffness_as_built,
    winches_as_built,
)
from simulation.plant import Plant

# Transmission between motor and drum: backlash and steps. Pure.


class Transmission:
    """Drums that follow their motors with backlash, in whole steps.

    A drum rests while its motor reverses through the backlash, as with gears or with cable friction
    in guides.
    """

    def __init__(self, backlash: Array, step: float, at: Array) -> None:
        """Starts with every drum in the middle of its backlash.

        Args:
            backlash: Shape (m,), [counts].
            step: [counts].
            at: Positions of the motors, shape (m,), [counts].
        """
        self._half, self._step = np.abs(backlash) / 2.0, step
        self._drums = np.array(at, dtype=np.float64)

    def drums(self, motors: Array) -> Array:
        """Positions of the drums for positions of the motors, shape (m,), [counts]."""
        self._drums = np.clip(self._drums, motors - self._half, motors + self._half)
        if self._step == 1.0:
            return self._drums.copy()
        whole: Array = np.rint(self._drums / self._step) * self._step
        return whole


# Interface of simulated drives of any protocol.


class WinchDrive(Protocol):
    """Interface of a simulated drive.

    Attributes:
        motor: What it moves.
        torque: Actual torque, set by the rig, in the unit of its protocol.
    """

    motor: Motor
    torque: float

    @property
    def state(self) -> Enum:
        """State in terms of its protocol."""

    @property
    def torque_on(self) -> bool:
        """The motor holds or moves the cable; otherwise the brake does."""

    def advance(self, elapsed: float) -> None:
        """Advances time, [s]."""


Frame = bytes | bytearray

TOP_SPEED_RESERVE = 1.5
"""Top speed of a simulated motor, relative to its winch's speed limit."""

IDLE_WAIT = 0.005
"""Longest wait for a frame before the drives' time-outs are checked, [s]."""


@dataclass(frozen=True, slots=True, eq=False)
class RehearsalStatus:
    """Status reported by `SimulatedRig.serve`.

    Attributes:
        cycles: Number of cycles.
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

    Drums follow the motors, and the drives' torques follow the tensions. Updates of the torques run
    step by step to allow other work in between, as finding the equilibrium may take long.

    Attributes:
        drives: In the order of the winches.
        plant: What they move.
        cycles: Number of cycles.
        per_newton: Torque by tension, shape (m,), in the unit of the drives' protocol.
    """

    def __init__(
        self, rig: Rig, bus: can.BusABC, start_pose: Pose, load: Load | None = None
    ) -> None:
        """Powers the drives on at the positions of a pose according to the rig file.

        If the rig is built as in its file, the platform hangs there under working tensions,
        otherwise near it.

        Args:
            rig: The robot.
            bus: An open bus for the drives, owned by the caller.
            start_pose: ``world_from_platform``.
            load: Payload of the platform.

        Raises:
            TensionInfeasible: The cables cannot hold the platform there.
            Fault: The bus did not accept the drives' first frames, or the platform has no
                equilibrium there.
        """
        self._rig, self._bus = rig, bus
        self._cycle = rig.cycle
        self.plant = Plant(rig_as_built(rig), start_pose, load, stiffness_as_built(rig))
        self.cycles = 0
        self.per_newton = self._torque_per_newton()
        start = WinchMap(rig).counts_at(start_pose, load)
        winches = winches_as_built(rig)
        per_metre = np.array([winch.counts_per_metre for winch in rig.winches])
        play = per_metre * winches.backlash_mm / 1000.0
        self._transmission = Transmission(play, winches.step_counts, start)
        self.plant.settle_counts(self._transmission.drums(start))
        self._tension_noise = winches.tension_noise_n
        self._random = np.random.default_rng([simulation_of(rig).seed, 0x7E45])
        self._counts, self._ahead = start, np.zeros(len(start))
        self._friction_torque = self._friction()
        self._update: Iterator[None] | None = None
        self.drives: tuple[Drive, ...] = ()
        self.drives = tuple(
            self._make_drive(number, float(counts), self._top_speed(number))
            for number, counts in enumerate(start)
        )

    @abstractmethod
    def _torque_per_newton(self) -> Array:
        """Torque by tension, shape (m,), in the unit of the drives' protocol."""

    def _friction(self) -> float:
        """Friction torque of the drive trains, in the unit of the drives' protocol."""
        return 0.0

    @abstractmethod
    def _make_drive(self, number: int, position: float, top_speed: float) -> Drive:
        """Creates a drive by index of its winch, position [counts] and top speed [counts/s]."""

    @abstractmethod
    def _handle(self, message: can.Message) -> None:
        """Passes a frame to its drive."""

    @abstractmethod
    def pump(self) -> None:
        """Processes every waiting frame, and answers.

        Raises:
            Fault: The bus failed, or the platform has no equilibrium.
        """

    def _top_speed(self, number: int) -> float:
        winch = self._rig.winches[number]
        return TOP_SPEED_RESERVE * winch.max_speed * abs(winch.counts_per_metre)

    @property
    def pose(self) -> Pose:
        """True pose of the platform, ``world_from_platform``."""
        self._settle()
        return self.plant.pose

    @property
    def tensions(self) -> Array:
        """True cable tensions, shape (m,), [N]."""
        self._settle()
        return self.plant.tensions

    def carry(self, load: Load) -> None:
        """Changes the load of the platform.

        Raises:
            Fault: The platform has no equilibrium with this load.
        """
        self._settle()
        self.plant.carry(load)

    def advance(self, seconds: float) -> None:
        """Advances time without frames, in steps of at most a cycle."""
        while seconds > 1e-12:
            step = min(seconds, self._cycle)
            self._advance(step)
            self._finish_torque_update()
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

        Drives answer at once; the equilibrium is computed between frames, in at most half of the
        time, and torques follow it. If this process is delayed, the drives' time stops, so that
        they do not report a lost master. While the interface is down they neither receive nor send,
        and continue when it is up again.

        Args:
            stop_requested: Called every few milliseconds; True ends the simulation.
            on_status: Called every ``status_period`` seconds, between two frames.
            status_period: [s].
            clock: Monotonic seconds.

        Raises:
            Fault: The bus failed, or the platform has no equilibrium.
        """
        try:
            last = reported = clock()
            wait = IDLE_WAIT
            while not stop_requested():
                message = self._receive(wait)
                now = clock()
                self._let_pass(now - last, message)
                last = now
                if message is not None:
                    self._handle(message)
                    wait = 0.0
                    continue
                wait = IDLE_WAIT
                if self._update is not None:
                    self._continue_torque_update(self._update)
                    wait = clock() - now  # leaves half of the processor to a master
                if on_status is not None and now - reported >= status_period:
                    reported = now
                    on_status(self.status())
        except KeyboardInterrupt:
            return

    def _let_pass(self, waited: float, message: can.Message | None) -> None:
        """Advances by the time waited, at most a cycle."""
        self._advance(min(waited, self._cycle))

    def status(self) -> RehearsalStatus:
        """Present state, with the pose of the last torque update."""
        states = tuple(drive.state for drive in self.drives)
        return RehearsalStatus(self.cycles, states, self.plant.pose, self.plant.tensions)

    def _receive(self, wait: float) -> can.Message | None:
        """The next frame within a time [s]; None while the interface is down."""
        try:
            return receive_frame(self._bus, wait)
        except BusDown:
            time.sleep(IDLE_WAIT)  # the kernel returns at once, but time must pass
            return None

    def _advance(self, elapsed: float) -> None:
        for drive in self.drives:
            drive.advance(elapsed)

    def _begin_torque_update(self) -> None:
        """Begins an update to the present positions, unless one is in progress."""
        if self._update is None:
            self._update = self._updating(self._positions())

    def _continue_torque_update(self, update: Iterator[None]) -> None:
        """Makes one step of the update in progress.

        Raises:
            Fault: The platform has no equilibrium.
        """
        try:
            next(update)
        except StopIteration:
            self._update = None

    def _finish_torque_update(self) -> None:
        """Makes all remaining steps; errors as for `_continue_torque_update`."""
        while self._update is not None:
            self._continue_torque_update(self._update)

    def _settle(self) -> None:
        """Moves the platform to its equilibrium, if any drum has moved.

        Raises:
            Fault: The platform has no equilibrium.
        """
        counts = self._positions()
        if not np.array_equal(counts, self._counts):
            self.plant.settle_counts(self._transmission.drums(counts))
            self._counts = counts

    def _updating(self, counts: Array) -> Iterator[None]:
        """Moves the platform to its equilibrium, then sets the torques.

        Args:
            counts: Positions of the motors, shape (m,), [counts].
        """
        if not np.array_equal(counts, self._counts):
            yield from self.plant.settling_counts(self._transmission.drums(counts))
            if self._friction_torque > 0.0:  # a motor at rest keeps its last friction torque
                moved = np.sign(counts - self._counts)
                self._ahead = np.where(moved == 0.0, self._ahead, moved)
            self._counts = counts
        tensions = self.plant.tensions
        if self._tension_noise > 0.0:
            noise = self._random.standard_normal(len(tensions))
            tensions = tensions + self._tension_noise * noise
        torques = tensions * self.per_newton + self._friction_torque * self._ahead
        for drive, torque in zip(self.drives, torques.tolist(), strict=True):
            drive.torque = torque if drive.torque_on else 0.0

    def _positions(self) -> Array:
        """Positions of the motors, shape (m,), [counts]."""
        return np.array([drive.motor.position for drive in self.drives])

    def _send(self, can_id: int, data: Frame) -> None:
        with suppress(BusDown):  # no node is reached
            transmit(self._bus, SentFrame(can_id, data))
