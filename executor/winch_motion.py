"""One motion of winches without a path, from its first cycle to its record."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cdpr.kinematics import cable_lengths
from cdpr.poses import Array, Pose
from cdpr.rig import Rig, rig_from_document
from cdpr.winches import WinchMap
from drivers.drive_group import DriveGroup
from executor.clock import Clock
from executor.custody import Custody
from executor.loop import SETTLING
from executor.machine import State
from executor.records import CycleRecord, LoopEvent
from executor.winch_laws import WinchLaw
from executor.winch_loop import WinchLoop
from executor.wishes import WishBoard


@dataclass(frozen=True, slots=True, eq=False)
class WinchesStand:
    """Where winches stand after a motion.

    Attributes:
        state: How it ended.
        cause: Why it did not finish, if it did not.
        counts: Positions of the drives, at rest, shape (m,), [counts]; NaN when none was told.
        tensions: By their torques, at rest, shape (m,), [N]; NaN when none was told.
    """

    state: State
    cause: str
    counts: Array
    tensions: Array


def unreferenced(rig: Rig, counts: Sequence[int], pose: Pose, *, limit: float, speed: float) -> Rig:
    """The rig as drives that were never referenced are set up for: a guess that limits them.

    Args:
        rig: The robot.
        counts: Where its drives stand, [counts].
        pose: Where its platform is about, ``world_from_platform``.
        limit: Largest tension, [N]; the drives' torque limit comes from it.
        speed: Of the winches, [m/s].

    Raises:
        TensionInfeasible: The platform cannot be held with so little tension.
    """
    winches = WinchMap(rig)
    there = winches.unstrained(cable_lengths(rig, pose), np.zeros(rig.cable_count))
    home = winches.home_counts + np.asarray(counts) - winches.counts(there)
    document = rig.document
    slow = [
        winch.model_copy(
            update={
                "home_counts": round(float(count)),
                "max_speed_mm_s": min(winch.max_speed_mm_s, speed * 1000.0),
            }
        )
        for winch, count in zip(document.winches, home, strict=True)
    ]
    cables = document.cables.model_copy(update={"max_tension_n": limit})
    changed = document.model_copy(update={"winches": slow, "cables": cables})
    return rig_from_document(changed)


def move_winches(
    rig: Rig,
    law: WinchLaw,
    group: DriveGroup,
    clock: Clock,
    board: WishBoard,
    *,
    record: Path,
    anew: bool,
    on_cycle: Callable[[CycleRecord], None],
    on_event: Callable[[LoopEvent], None],
) -> WinchesStand:
    """Moves by a law and ends with the drives holding by themselves, whatever happens.

    Args:
        rig: The robot as its drives are set up (see `unreferenced`).
        law: What the winches are told.
        group: The drives, configured.
        clock: Real or simulated.
        board: What the operator wants.
        record: What the latch names, should this not come to its end.
        anew: The drives are to be referenced again afterwards.
        on_cycle: Called after every cycle.
        on_event: Called for every event.

    Raises:
        Refused: The bus is latched, or the drives do not stand where the law begins; nothing was
            enabled.
        HardwareMissing: A drive does not answer.
    """
    custody = Custody(rig)
    custody.require_free()
    last: deque[CycleRecord] = deque(maxlen=SETTLING)

    def take(cycle: CycleRecord) -> None:
        if not last or cycle.state is not State.SECURING or np.isfinite(cycle.following_error):
            last.append(cycle)
        on_cycle(cycle)

    loop = WinchLoop(rig, law, group, clock, wishes=board.read, on_cycle=take, on_event=on_event)
    loop.arm()
    custody.begin(record, custody.still_counts(law.reach[0]), anew=anew)
    try:
        loop.run()
    finally:
        custody.end(
            loop.machine.state,
            loop.cause,
            record,
            holding=loop.holding,
            stands_at=last[-1].actual if last else None,
        )
    rated = np.array([winch.torque_constant for winch in rig.winches])
    unknown = [np.full(rig.cable_count, np.nan)]
    torques = np.array([cycle.torques for cycle in last] or unknown, dtype=np.float64)
    counts = np.array([cycle.actual for cycle in last] or unknown, dtype=np.float64)
    tensions = torques.mean(axis=0) / 1000.0 * rated
    return WinchesStand(loop.machine.state, loop.cause, counts.mean(axis=0), tensions)
