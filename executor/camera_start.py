"""Waiting until cameras are open, which takes a while, and may be told to end meanwhile."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

from cdpr.errors import Fault
from executor.camera_process import CameraProcess

#: How long processes may take to import their libraries, to compile what finds tags' edges (once on
#: a machine) and to open their cameras, all together, [s].
START_TIMEOUT = 180.0
#: How long a wish to stop may wait to be heard, [s].
HEARING = 0.1


def wait_until_ready(
    processes: Sequence[CameraProcess], unless_stopped: Callable[[], None]
) -> None:
    """Waits until all cameras are open; the first one that fails ends it.

    Args:
        processes: They open their cameras at the same time.
        unless_stopped: Asked again and again; what it raises ends the waiting.

    Raises:
        CdprError: A camera cannot be used, for the reason told.
    """
    waiting, latest = list(processes), time.monotonic() + START_TIMEOUT
    while waiting:
        unless_stopped()
        step = HEARING / len(waiting)
        waiting = [process for process in waiting if not process.is_ready(step)]
        if waiting and time.monotonic() > latest:
            names = ", ".join(process.name for process in waiting)
            raise Fault(
                f"camera {names} did not open within {START_TIMEOUT:.0f} s",
                where="cameras",
                why="the device or the network that it is on does not answer",
                next_step="check the camera with `cdpr doctor RIG --camera SOURCE`",
            )
