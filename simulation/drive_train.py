"""From the motors to the platform and back: drums turn with them, the drives feel their cables."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from cdpr.poses import Array
from cdpr.rig import Rig
from simulation.as_built import simulation_of, winches_as_built
from simulation.plant import Plant
from simulation.transmission import Transmission
from simulation.winch_drive import WinchDrive


class DriveTrain:
    """Moves the platform as the motors stand, and tells the drives how their cables pull.

    Feeling goes step by step, for who has something else to do meanwhile: it may take long to find
    the platform's place.

    Attributes:
        per_newton: Torque by tension, shape (m,), in the unit of the drives' protocol.
    """

    def __init__(self, rig: Rig, plant: Plant, counts: Array, per_newton: Array) -> None:
        """Moves the platform to where the drums stand with the motors at given positions.

        Args:
            rig: The robot, with the ``simulation`` section of its file.
            plant: What the drums move.
            counts: Positions of the motors, shape (m,), [counts].
            per_newton: Torque by tension, shape (m,), in the unit of the drives' protocol.

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
            self._counts = counts
        told = self._plant.tensions
        if self._tension_noise > 0.0:
            told = told + self._tension_noise * self._random.standard_normal(len(told))
        torques = told * self.per_newton
        for drive, torque in zip(drives, torques.tolist(), strict=True):
            drive.torque = torque if drive.torque_on else 0.0


def _positions(drives: Sequence[WinchDrive]) -> Array:
    """Of the motors, shape (m,), [counts]."""
    return np.array([drive.motor.position for drive in drives])
