"""How fast pictures are measured now."""

from __future__ import annotations

from collections import deque

import numpy as np

#: Live figures are those of so many of the newest pictures.
NEWEST = 10


class Pace:
    """Of the newest pictures: how many a second, and how long one takes."""

    def __init__(self) -> None:
        """None was measured yet."""
        self._times: deque[float] = deque(maxlen=NEWEST)
        self._seconds: deque[float] = deque(maxlen=NEWEST)

    def take(self, time: float, seconds: float) -> None:
        """One more picture.

        Args:
            time: On a clock that only goes forward, [s].
            seconds: How long it took to measure, [s]; NaN where nothing was measured.
        """
        self._times.append(time)
        self._seconds.append(seconds)

    @property
    def pictures_per_second(self) -> float | None:
        """None before there are two."""
        took = self._times[-1] - self._times[0] if self._times else 0.0
        return round((len(self._times) - 1) / took, 1) if took > 0.0 else None

    @property
    def measuring_ms(self) -> float | None:
        """Median time for one; None where none was measured."""
        known = [one for one in self._seconds if np.isfinite(one)]
        return round(float(np.median(known)) * 1e3, 2) if known else None
