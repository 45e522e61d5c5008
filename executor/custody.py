"""Who may move what hangs on a bus: every motion there begins and ends here.

On a bus of this process alone (``virtual``) nothing is kept: its drives end with the process.
"""

from __future__ import annotations

from pathlib import Path

from cdpr.rig import Rig
from drivers.bus import IN_PROCESS, BusSettings
from executor.latch import Latch
from executor.machine import State


class Custody:
    """Of the bus of one rig."""

    def __init__(self, rig: Rig) -> None:
        """Looks at nothing yet."""
        self._rig = rig
        settings = BusSettings.of(rig)
        self._latch = None if settings.interface == IN_PROCESS else Latch(settings)

    def require_free(self) -> None:
        """Nothing moves on a bus on which a fault is latched, or a run is under way.

        Raises:
            Refused: So it is; with the cause.
        """
        if self._latch is not None:
            self._latch.require_released()

    def begin(self, record: Path) -> None:
        """The drives are about to move; if that does not come to its end, the latch tells of it.

        Args:
            record: Where the motion is on record.

        Raises:
            Refused: The bus is latched, or cannot be.
        """
        if self._latch is not None:
            self._latch.engage(self._rig.name, record)

    def prevented(self) -> None:
        """Nothing moved after all."""
        if self._latch is not None:
            self._latch.release()

    def end(self, state: State, cause: str, record: Path) -> None:
        """The motion is over: the bus is released when it ended well, else latched."""
        if self._latch is not None:
            self._latch.settle(self._rig.name, state, cause, record)
