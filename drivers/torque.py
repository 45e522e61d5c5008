"""The sign of a motor's torque: a winch pulls its cable in, whichever way its counts run."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cdpr.rig import Rig


def winding_signs(rig: Rig) -> NDArray[np.int64]:
    """Sign of counts, speed and torque in a drive that winds its cable in, shape (m,).

    A motor that holds a taut cable has torque of this sign: −1 where positive counts pay out.
    """
    return np.array([-1 if w.counts_per_metre > 0 else 1 for w in rig.winches], dtype=np.int64)
