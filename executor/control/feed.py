"""The feed: how fast the table is walked through. One row a cycle, slower, or not at all."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from executor.trajectory.time_scaling import speed_change
from model.rig import Motion


class Feed:
    """A place in the table that advances with every cycle that is sent, never by a clock.

    Normal feed is exactly one row a cycle. From one rate to another it goes jerk-limited, so all
    drives change their speed together along the path. It never runs backwards and never faster
    than the table was made for.
    """

    def __init__(self, rows: int, cycle: float, motion: Motion, *, rate: float = 1.0) -> None:
        """A feed at row 0.

        Args:
            rows: Length of the table.
            cycle: [s].
            motion: Limits; at the path's full speed a change of rate keeps its acceleration and
                jerk.
            rate: At first; the full one for a table that begins at rest.
        """
        self.index = 0.0
        self._last = rows - 1
        self._acceleration = motion.acceleration / motion.speed * cycle  # [rows a cycle²]
        self._jerk = motion.jerk / motion.speed * cycle**2  # [rows a cycle³]
        self._change = speed_change((rate, 0.0), rate, self._acceleration, self._jerk)
        self._passed = 0.0  # of the change, [cycles]
        self._wanted = rate
        self._steady = True

    @property
    def rate(self) -> float:
        """Rows a cycle, now; from 0 to 1."""
        return min(max(self._change.at(self._passed)[1], 0.0), 1.0)

    @property
    def wanted(self) -> float:
        """The rate that it goes to."""
        return self._wanted

    @property
    def at_end(self) -> bool:
        """It has come to the last row."""
        return self.index >= self._last

    @property
    def at_rest(self) -> bool:
        """It will not advance any more, unless another rate is asked for."""
        return self.at_end or (self._steady and self.rate <= 0.0)

    @property
    def rows_to_rest(self) -> float:
        """How far it advances if it begins to slow down now."""
        _, *now = self._change.at(self._passed)
        ramp = speed_change((now[0], now[1]), 0.0, self._acceleration, self._jerk)
        return ramp.at(ramp.duration)[0]

    def extend(self, rows: int) -> None:
        """The table has become longer.

        Raises:
            ValueError: It has not.
        """
        if rows - 1 < self._last:
            raise ValueError(f"a table of {self._last + 1} rows cannot become one of {rows}")
        self._last = rows - 1

    def go_to(self, rate: float) -> None:
        """Begins to change to another rate; asking again for the same one changes nothing.

        Raises:
            ValueError: It is not from 0 to 1; the table was proved for no faster feed.
        """
        if not 0.0 <= rate <= 1.0:
            raise ValueError(f"a feed of {rate} rows a cycle is not from 0 to 1")
        if rate == self.wanted:
            return
        _, *now = self._change.at(self._passed)
        self._change = speed_change((now[0], now[1]), rate, self._acceleration, self._jerk)
        self._passed, self._wanted, self._steady = 0.0, rate, False

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
        before, _, _ = self._change.at(self._passed)
        self._passed += 1.0
        after, _, _ = self._change.at(self._passed)
        self._steady = self._passed >= self._change.duration
        return min(max(after - before, 0.0), 1.0)


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
