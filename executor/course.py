"""What the loop sends: checked set-points and their fingerprint.

A `CheckedTable` has the poses and the proof; the loop needs only this part of it, which can also
be handed to another process and be compared there with what was checked.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from cdpr.rig import Rig

if TYPE_CHECKING:
    from executor.setpoints import CheckedTable

Setpoints = NDArray[np.int32]


def fingerprint(cycle: float, setpoints: Setpoints) -> str:
    """SHA-256 over set-points and their cycle [s]."""
    digest = hashlib.sha256(repr(cycle).encode())
    digest.update(np.ascontiguousarray(setpoints).tobytes())
    return "sha256:" + digest.hexdigest()


@dataclass(frozen=True, eq=False)
class Course:
    """Set-points for the loop.

    Attributes:
        rig: The rig they were checked for.
        cycle: Time of a cycle, [s].
        setpoints: One row a cycle, shape (n, m), [counts]; read-only.
        hash: Their fingerprint when they were checked; arming compares.
    """

    rig: Rig
    cycle: float
    setpoints: Setpoints
    hash: str

    def __len__(self) -> int:
        """Number of rows."""
        return len(self.setpoints)

    @property
    def unchanged(self) -> bool:
        """The set-points are still those that were checked; computed anew every time."""
        return fingerprint(self.cycle, self.setpoints) == self.hash


def course_of(checked: CheckedTable) -> Course:
    """The course of a checked table."""
    return Course(checked.rig, checked.table.cycle, checked.table.setpoints, checked.hash)
