"""From one place to another in a given time, at rest at both ends."""

from __future__ import annotations

#: The middle of the step is so many times as fast as the step on average.
PEAK = 1.875


def smooth_step(share: float) -> float:
    """0 to 1 with zero speed and acceleration at both ends."""
    return share**3 * (10.0 - 15.0 * share + 6.0 * share**2)
