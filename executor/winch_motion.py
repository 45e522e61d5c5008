"""One motion of winches without a path, from its first cycle to its record."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from cdpr.errors import CdprError, Fault, Refused, StoppedByOperator
from cdpr.kinematics import cable_lengths
from cdpr.poses import Array, Pose
from cdpr.rig import Rig, rig_from_document
from cdpr.winches import WinchMap
from drivers.drive_group import CycleStatus, DriveGroup
from executor.clock import Clock
from executor.custody import Custody
from executor.loop import SETTLING
from executor.machine import State
from executor.records import CycleRecord, LoopEvent
from executor.reference import ReferenceDocument
from executor.winch_laws import WinchLaw
from executor.winch_loop import WinchLoop
from executor.wishes import WishBoard

#: Drives that hold move by no more than this share of the rig's start tolerance.
HELD_SHARE = 0.1


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


def counted_here(rig: Rig, counts: Sequence[int], pose: Pose) -> Rig:
    """The rig as drives that were never referenced are set up for: a guess of what they count.

    Args:
        rig: The robot.
        counts: Where its drives stand, [counts].
        pose: Where its platform is about, ``world_from_platform``.

    Raises:
        TensionInfeasible: The rig cannot hold its platform at home.
    """
    winches = WinchMap(rig)
    there = winches.unstrained(cable_lengths(rig, pose), np.zeros(rig.cable_count))
    home = winches.home_counts + np.asarray(counts) - winches.counts(there)
    winches_here = [
        winch.model_copy(update={"home_counts": round(float(count))})
        for winch, count in zip(rig.document.winches, home, strict=True)
    ]
    return rig_from_document(rig.document.model_copy(update={"winches": winches_here}))


def set_up_here(rig: Rig, told: CycleStatus) -> tuple[Rig, float]:
    """What drives are set up for that move nothing: their limits lie about where they stand.

    The rig file's counts are no guide: a drive that is enabled beyond its own position limits runs
    to them.

    Args:
        rig: The robot.
        told: Where its drives stand.

    Returns:
        The rig, see `counted_here`, and the largest tension, [N].
    """
    return counted_here(rig, told.positions.tolist(), rig.home), rig.max_tension


def careful(rig: Rig, *, limit: float, speed: float) -> Rig:
    """The rig as gate and watch see it while winches move by a law; drives are not set up by it.

    With the platform on a jig or not on its cables at all, no tensions need balance it.

    Args:
        rig: The robot.
        limit: Largest tension, [N].
        speed: Fastest winch, [m/s].
    """
    document = rig.document
    slow = [
        winch.model_copy(update={"max_speed_mm_s": min(winch.max_speed_mm_s, speed * 1000.0)})
        for winch in document.winches
    ]
    cables = document.cables.model_copy(update={"max_tension_n": limit})
    return rig_from_document(document.model_copy(update={"winches": slow, "cables": cables}))


def require_below(rig: Rig, held: CycleStatus, limit: float) -> None:
    """No drive holds more than it may from now on: written to it, the limit would let it slip.

    What closed brakes hold is not known before the drives are enabled.

    Args:
        rig: The robot.
        held: What its drives tell.
        limit: Largest tension, [N].

    Raises:
        Refused: One does; with its cable.
    """
    tensions = rig.tensions_by(held.torques)
    over = [
        f"{name} carries {tension:.1f} N"
        for name, tension in zip(rig.drive_names.values(), tensions.tolist(), strict=True)
        if not tension <= limit
    ]
    if over:
        raise Refused(
            f"{', '.join(over)}, more than the limit of {limit:g} N",
            where="setting the drives' torque limit",
            why="a drive whose torque is limited to less than it holds lets its cable slip",
            next_step="name a higher --limit-n, or take the load off these cables; the drives hold"
            " as before",
        )


def require_held(rig: Rig, stand: WinchesStand, told: CycleStatus) -> None:
    """The drives stand where the motion left them, and hold: nobody commanded them meanwhile.

    Args:
        rig: The robot.
        stand: Where the motion ended.
        told: What the drives tell now.

    Raises:
        Fault: One moved, or does not hold.
    """
    per_metre = np.array([winch.counts_per_metre for winch in rig.winches])
    moved = np.abs((told.positions - stand.counts) / per_metre)
    worst = int(moved.argmax())
    name = list(rig.drive_names.values())[worst]
    if not moved[worst] <= HELD_SHARE * rig.motion.start_tolerance:
        what = f"{name} moved by {moved[worst] * 1000:.2f} mm after all winches were at rest"
    elif told.faults:
        what = "; ".join(text for _, text in told.faults)
    elif not told.holding:
        what = "not all drives hold any more"
    else:
        return
    raise Fault(
        what,
        where="winches",
        why="a drive let go, slipped or was moved by hand; counts and pose do not belong together",
        next_step="look at the platform and the drives, then begin anew",
    )


def move_winches(
    rig: Rig,
    law: WinchLaw,
    group: DriveGroup,
    clock: Clock,
    board: WishBoard,
    custody: Custody,
    *,
    record: Path,
    anew: bool,
    at_rest: Callable[[WinchesStand], ReferenceDocument | None],
    on_cycle: Callable[[CycleRecord], None],
    on_event: Callable[[LoopEvent], None],
) -> WinchesStand:
    """Moves by a law and ends with the drives holding by themselves, whatever happens.

    Args:
        rig: The robot as its drives count (see `counted_here`), and as it is watched (`careful`).
        law: What the winches are told.
        group: The drives, configured.
        clock: Real or simulated.
        board: What the operator wants.
        custody: Of the rig as its file is.
        record: What the latch names, should this not come to its end.
        anew: The drives are to be referenced again afterwards.
        at_rest: Called after a motion that came to its end, while nobody else may move the drives;
            the reference that it makes is kept.
        on_cycle: Called after every cycle.
        on_event: Called for every event.

    Raises:
        Refused: The bus is latched, or the drives do not stand where the law begins; nothing was
            enabled.
        HardwareMissing: A drive does not answer.
        StoppedByOperator: The operator wanted to stop before anything moved.
    """
    custody.require_free()
    last: deque[CycleRecord] = deque(maxlen=SETTLING)

    def take(cycle: CycleRecord) -> None:
        if not last or cycle.state is not State.SECURING or np.isfinite(cycle.following_error):
            last.append(cycle)
        on_cycle(cycle)

    loop = WinchLoop(rig, law, group, clock, wishes=board.read, on_cycle=take, on_event=on_event)
    loop.arm()
    if board.read().stop:
        raise StoppedByOperator("stopped before anything moved")
    custody.begin(record, custody.still_counts(law.reach[0]), anew=anew)
    try:
        loop.run()
        stand = _stand(rig, loop, last)
        reference = at_rest(stand) if stand.state is State.FINISHED else None
        if reference is not None:
            custody.take(reference)
    finally:
        not_kept = _kept(custody, loop, record, last)
    if not_kept:
        on_event(LoopEvent(last[-1].cycle if last else 0, clock.time, "recorder", not_kept))
        stand = replace(stand, state=State.LATCHED, cause=stand.cause or not_kept)
    return stand


def _stand(rig: Rig, loop: WinchLoop, last: Sequence[CycleRecord]) -> WinchesStand:
    unknown = [np.full(rig.cable_count, np.nan)]
    torques = np.array([cycle.torques for cycle in last] or unknown, dtype=np.float64)
    counts = np.array([cycle.actual for cycle in last] or unknown, dtype=np.float64)
    tensions = rig.tensions_by(torques.mean(axis=0))
    return WinchesStand(loop.machine.state, loop.cause, counts.mean(axis=0), tensions)


def _kept(custody: Custody, loop: WinchLoop, record: Path, last: Sequence[CycleRecord]) -> str:
    """Keeps how it ended; why it could not, if so: the motion is over, and is told all the same."""
    stands_at = last[-1].actual if last else None
    try:
        custody.end(
            loop.machine.state, loop.cause, record, holding=loop.holding, stands_at=stands_at
        )
    except CdprError as error:
        return f"{error.what} ({error.where}: {error.why})"
    return ""
