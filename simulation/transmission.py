"""What lies between a motor's shaft and the cable on its drum: play and steps. Pure."""

from __future__ import annotations

import numpy as np

from cdpr.poses import Array


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
