"""From the motors to the platform and back: drums turn with them, the drives feel their cables."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from enum import Enum
from typing import Protocol

import numpy as np

from model.pose import Array
from model.rig import Rig
from simulation.drives.motion import Motor
from simulation.ground_truth import simulation_of, winches_as_built
from simulation.plant import Plant

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
