"""What a simulated rig needs of its drives, whatever they speak."""

from __future__ import annotations

from enum import Enum
from typing import Protocol

from simulation.drive_motion import Motor


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
