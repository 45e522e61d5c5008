"""How a rig stands after its power was gone: drives count from anywhere, cables hang slack."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from cdpr.poses import Array, read_only
from cdpr.rig import Rig
from simulation.drive_motion import Motor
from simulation.plant import Plant

#: Counters start this far from where they were, at most, [turns of the motor].
MOST_TURNS = 100.0


@dataclass(frozen=True, slots=True, eq=False)
class PowerLoss:
    """What became of the drums and of their counters.

    Attributes:
        miscounted: What each drive counts too much from now on, shape (m,), [counts].
        slack: What each drum has paid out meanwhile, shape (m,), [m].
        on_a_stand: The platform was caught by a stand; otherwise it hangs on what is taut.
    """

    miscounted: Array
    slack: Array
    on_a_stand: bool

    @classmethod
    def drawn(cls, rig: Rig, seed: int, most_slack: float, *, on_a_stand: bool) -> PowerLoss:
        """A random one.

        Args:
            rig: The robot.
            seed: Of the random numbers.
            most_slack: The longest slack of a cable, [m].
            on_a_stand: Whether a stand keeps the platform where it is.
        """
        random = np.random.default_rng(seed)
        per_turn = np.array([w.counts_per_rev for w in rig.document.winches], dtype=np.float64)
        turns = random.uniform(-MOST_TURNS, MOST_TURNS, rig.cable_count)
        slack = random.uniform(0.0, most_slack, rig.cable_count)
        return cls(read_only(np.rint(turns * per_turn)), read_only(slack), on_a_stand)

    def happen_to(self, rig: Rig, plant: Plant, motors: Iterable[Motor]) -> None:
        """Turns the drums and sets their counters; the platform goes where that leaves it.

        Raises:
            Fault: The platform has no equilibrium there.
        """
        if self.on_a_stand:
            plant.put_on_a_stand()
        plant.miscounted = self.miscounted
        for winch, motor, more, slack in zip(
            rig.winches, motors, self.miscounted, self.slack, strict=True
        ):
            motor.position += float(more) + round(slack * winch.counts_per_metre)
            motor.demand = motor.position
