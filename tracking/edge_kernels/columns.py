"""What is known of one edge, as columns of an array.

Along an edge places are told by q, from -1 at the first pixel that was read to 1 at the last one.
"""

from __future__ import annotations

OFFSET = 0
"""How far the edge lies outside of where it was looked for, at q = 0, [px]."""
TILT = 1
"""Change of that distance from q = 0 to q = 1, [px]."""
SPREAD = 2
"""Standard deviation of the blur across the edge, pixels included, [px]."""
BOXED = 3
"""Kind of that blur: 0 a bell (lens), 1 a box (motion, or one pixel along the grid)."""
MIDDLE = 4
"""Where q = 0 lies, from the edge's first corner, [px]."""
HALF = 5
"""Half of the way that was read: from q = 0 to q = 1, [px]."""
OFFSET_VARIANCE = 6
COVARIANCE = 7
TILT_VARIANCE = 8
SHARE = 9
"""Share of the edge that looks like one."""
COLUMNS = 10
