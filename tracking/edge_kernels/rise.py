"""How brightness rises across a blurred edge."""

from __future__ import annotations

import math

import numpy as np

from cdpr.compiled import compiled
from cdpr.poses import Array

#: Beyond so many standard deviations a blurred edge is flat.
FLAT = 4.5
_STEPS = 64  # of the table, a standard deviation
_ROOT_3 = math.sqrt(3.0)


def _bell_table() -> Array:
    """Integral and height of the bell at the table's steps, shape (n, 2)."""
    x = np.arange(-FLAT * _STEPS, FLAT * _STEPS + 1.0) / _STEPS
    share = [0.5 + 0.5 * math.erf(v / math.sqrt(2.0)) for v in x.tolist()]
    return np.column_stack([share, np.exp(-0.5 * x * x) / math.sqrt(2.0 * math.pi)])


_BELL = _bell_table()


@compiled
def rise(x: float, boxed: float) -> tuple[float, float, float]:
    """Share of the step at ``x`` standard deviations behind the edge, to 1e-10.

    A mixture of a step seen through a bell and of one seen through a box of the same deviation. As
    it is symmetric, no symmetric blur moves an edge that is fitted with it, whatever its kind.

    Returns:
        The share (0 dark, 1 bright), its change with ``x`` (to 1e-7), and that with ``boxed``.
    """
    if x <= -FLAT:
        return 0.0, 0.0, 0.0
    if x >= FLAT:
        return 1.0, 0.0, 0.0
    step = int((x + FLAT) * _STEPS + 0.5)
    near = step / _STEPS - FLAT
    d, height = x - near, _BELL[step, 1]
    half, bend = 0.5 * d * d, near * near - 1.0
    bell = _BELL[step, 0] + height * (d - half * near + half * d * bend / 3.0)  # Taylor's series
    bell_slope = height * (1.0 - near * d + bend * half)
    box, box_slope = 0.0, 0.0
    if x >= _ROOT_3:
        box = 1.0
    elif x > -_ROOT_3:
        box, box_slope = 0.5 + x / (2.0 * _ROOT_3), 0.5 / _ROOT_3
    more = box - bell
    return bell + boxed * more, bell_slope + boxed * (box_slope - bell_slope), more
