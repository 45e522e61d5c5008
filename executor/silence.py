"""Which drives fell silent where no watch looks at them: around a motion, not in it."""

from __future__ import annotations

from cdpr.errors import HardwareMissing
from cdpr.rig import Rig
from drivers.drive_group import CycleStatus
from executor.safety.watch import MISSING_CYCLES


class Silence:
    """Counts, for each drive, the cycles in a row without an answer; too many stay too many."""

    def __init__(self, rig: Rig) -> None:
        """Of the drives of a rig, before the first cycle."""
        self._names = tuple(rig.drive_names.values())
        self._cycles = [0] * rig.cable_count

    def take(self, status: CycleStatus) -> None:
        """Counts a cycle."""
        self._cycles = [
            n + 1 if is_missing else (n if n >= MISSING_CYCLES else 0)
            for n, is_missing in zip(self._cycles, status.missing.tolist(), strict=True)
        ]

    def require_none(self, doing: str, *, where: str, why: str, next_step: str) -> None:
        """All drives were heard.

        Args:
            doing: What was going on, as in "while the drives settled".
            where: As of every error.
            why: Likewise.
            next_step: Likewise.

        Raises:
            HardwareMissing: Drives fell silent; with their names.
        """
        gone = [
            name for name, n in zip(self._names, self._cycles, strict=True) if n >= MISSING_CYCLES
        ]
        if gone:
            what = f"{', '.join(gone)} fell silent {doing}"
            raise HardwareMissing(what, where=where, why=why, next_step=next_step)
