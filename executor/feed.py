"""The feed: how fast the table is walked through. One row a cycle, slower, or not at all."""

from __future__ import annotations

import math

import numpy as np
import ruckig
from numpy.typing import NDArray

from cdpr.rig import Motion


class Feed:
    """A place in the table that advances with every cycle that is sent, never by a clock.

    Normal feed is exactly one row a cycle. From one rate to another it goes jerk-limited, so all
    drives change their speed together along the path. It never runs backwards and never faster
    than the table was made for.
    """

    def __init__(self, rows: int, cycle: float, motion: Motion) -> None:
        """A feed at row 0, at its full rate.

        Args:
            rows: Length of the table.
            cycle: [s].
            motion: Limits; at the path's full speed a change of rate keeps its acceleration and
                jerk.
        """
        self.index = 0.0
        self._last = rows - 1
        self._generator = ruckig.Ruckig(1, 1.0)  # unit of time: a cycle; of way: a row
        self._ramp = ruckig.InputParameter(1)
        self._ramp.control_interface = ruckig.ControlInterface.Velocity
        self._ramp.current_velocity = self._ramp.target_velocity = [1.0]
        self._ramp.max_acceleration = [motion.acceleration / motion.speed * cycle]
        self._ramp.max_jerk = [motion.jerk / motion.speed * cycle**2]
        # Ruckig keeps its plan in the answer: a new one each cycle would end the ramp at once.
        self._answer = ruckig.OutputParameter(1)
        self._steady = True

    @property
    def rate(self) -> float:
        """Rows a cycle, now; from 0 to 1."""
        return float(min(max(self._ramp.current_velocity[0], 0.0), 1.0))

    @property
    def wanted(self) -> float:
        """The rate that it goes to."""
        return float(self._ramp.target_velocity[0])

    @property
    def at_end(self) -> bool:
        """It has come to the last row."""
        return self.index >= self._last

    @property
    def at_rest(self) -> bool:
        """It will not advance any more, unless another rate is asked for."""
        return self.at_end or (self._steady and self.rate <= 0.0)

    def go_to(self, rate: float) -> None:
        """Begins to change to another rate; asking again for the same one changes nothing.

        Raises:
            ValueError: It is not from 0 to 1; the table was proved for no faster feed.
        """
        if not 0.0 <= rate <= 1.0:
            raise ValueError(f"a feed of {rate} rows a cycle is not from 0 to 1")
        if rate == self.wanted:
            return
        self._ramp.target_velocity = [rate]
        self._steady = False

    def stop(self) -> None:
        """Begins to slow down to rest."""
        self.go_to(0.0)

    def advance(self) -> float:
        """The place of the next cycle."""
        if self.at_rest:
            return self.index
        step = self.rate if self._steady else self._ramped()
        self.index = min(self.index + step, float(self._last))
        return self.index

    def _ramped(self) -> float:
        """Rows passed in one cycle of a ramp."""
        before = self._ramp.current_position[0]
        result = self._generator.update(self._ramp, self._answer)
        self._answer.pass_to_input(self._ramp)
        if result == ruckig.Result.Finished:
            self._steady = True
            self._ramp.current_velocity = self._ramp.target_velocity
            self._ramp.current_acceleration = [0.0]
        return float(min(max(self._answer.new_position[0] - before, 0.0), 1.0))


def targets_at(setpoints: NDArray[np.int32], index: float) -> tuple[int, ...]:
    """The set-points at a place in the table; between rows on the straight line of counts."""
    row = math.floor(index)
    if row >= len(setpoints) - 1:
        return tuple(int(v) for v in setpoints[-1])
    share = index - row
    if share == 0.0:
        return tuple(int(v) for v in setpoints[row])
    first, second = setpoints[row].astype(np.int64), setpoints[row + 1].astype(np.int64)
    # Rounded always the same way: to even, a step of n counts could become n + 1.
    mixed = np.floor(first + share * (second - first) + 0.5)
    return tuple(int(v) for v in mixed)
