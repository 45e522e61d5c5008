"""Pictures of a platform that stands still, and an operator who may end the looking at any time."""

from __future__ import annotations

import time
from collections.abc import Callable

from cdpr.errors import Fault
from cdpr.poses import Pose
from executor.camera_process import CameraProcess
from executor.camera_start import HEARING
from executor.observer import Trigger
from tracking.measurement import Observation

#: A picture that has not come after so long will not come, [s].
PATIENCE = 20.0


def looks_at_rest(
    process: CameraProcess,
    pictures: int,
    period: float | None,
    true_pose: Pose | None,
    unless_stopped: Callable[[], None],
) -> list[Observation]:
    """What a camera measures in some pictures, one after another.

    Args:
        process: Of the camera, which is open.
        pictures: How many.
        period: Between pictures in simulated time, [s]; None where a real camera takes them.
        true_pose: Where the simulated platform is.
        unless_stopped: Called before each picture and while one is waited for; what it raises ends
            the looking.

    Raises:
        CdprError: The camera failed, for the reason told.
    """
    began, looks = time.monotonic(), []
    for frame in range(pictures):
        unless_stopped()
        asked = time.monotonic()
        since = asked - began if period is None else frame * period
        process.ask(Trigger(frame, since, asked, true_pose))
        looks.append(_answer(process, asked + PATIENCE, unless_stopped))
    return looks


def _answer(
    process: CameraProcess, latest: float, unless_stopped: Callable[[], None]
) -> Observation:
    while True:
        look = process.answer_within(HEARING)
        if look is not None:
            return look.found
        unless_stopped()
        if time.monotonic() > latest:
            raise Fault(
                f"the camera gave no picture for {PATIENCE:g} s",
                where=f"camera {process.name}",
                why="it hangs, or what connects it",
                next_step="check its cable, then begin again",
            )
