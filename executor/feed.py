"""The feed: how fast the table is walked through. One row a cycle, or slowing down to a stop."""

from __future__ import annotations

import math

import numpy as np
import ruckig
from numpy.typing import NDArray

from cdpr.rig import Motion


class Feed:
    """A place in the table that advances with every cycle that is sent, never by a clock.

    Normal feed is exactly one row a cycle. After `stop` the rate goes to zero, jerk-limited, so all
    drives slow down together along the path.
    """

    def __init__(self, rows: int, cycle: float, motion: Motion) -> None:
        """A feed at row 0.

        Args:
            rows: Length of the table.
            cycle: [s].
            motion: Limits; at the path's full speed the stop keeps its acceleration and jerk.
        """
        self.index = 0.0
        self._last = rows - 1
        self._stopping: ruckig.InputParameter | None = None
        self._answer = ruckig.OutputParameter(1)
        self._generator = ruckig.Ruckig(1, 1.0)  # unit of time: a cycle; of way: a row
        self._acceleration = motion.acceleration / motion.speed * cycle
        self._jerk = motion.jerk / motion.speed * cycle**2

    @property
    def at_rest(self) -> bool:
        """True when it will not advance any more."""
        if self.index >= self._last:
            return True
        return self._stopping is not None and self._stopping.current_velocity[0] <= 0.0

    def stop(self) -> None:
        """Begins to slow down; further calls change nothing."""
        if self._stopping is not None:
            return
        request = ruckig.InputParameter(1)
        request.control_interface = ruckig.ControlInterface.Velocity
        request.current_position, request.current_velocity = [self.index], [1.0]
        request.current_acceleration, request.target_acceleration = [0.0], [0.0]
        request.target_velocity = [0.0]
        request.max_acceleration, request.max_jerk = [self._acceleration], [self._jerk]
        self._stopping = request

    def advance(self) -> float:
        """The place of the next cycle."""
        if self.at_rest:
            return self.index
        if self._stopping is None:
            self.index = min(self.index + 1.0, float(self._last))
            return self.index
        # Ruckig keeps its plan in the answer: a new one each cycle would end the ramp at once.
        answer = self._answer
        result = self._generator.update(self._stopping, answer)
        answer.pass_to_input(self._stopping)
        if result == ruckig.Result.Finished:
            self._stopping.current_velocity = [0.0]
        self.index = min(max(self.index, answer.new_position[0]), float(self._last))
        return self.index


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
