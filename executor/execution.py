"""The motion of a prepared run in this process, in simulated time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime

from cdpr.poses import Pose
from cdpr.scene import Load
from drivers.drive_group import DriveGroup
from executor.announcing import load_changes
from executor.clock import Clock
from executor.course import course_of
from executor.loop import Loop
from executor.machine import ON_PATH, State
from executor.prepare import PreparedRun
from executor.recorder import Recorder
from executor.records import CycleRecord
from executor.run_log import RunLog
from executor.wishes import WishBoard


@dataclass(frozen=True, slots=True, eq=False)
class Outcome:
    """What the motion left behind.

    Attributes:
        state: Where the run ended.
        cause: Why it did not finish, if it did not.
        log: Its cycles.
        holding: Every cable was held when the drives were last heard.
        started: When, UTC.
    """

    state: State
    cause: str
    log: RunLog
    holding: bool
    started: datetime


def run_here(
    prepared: PreparedRun,
    group: DriveGroup,
    clock: Clock,
    board: WishBoard,
    recorder: Recorder,
    *,
    true_pose: Callable[[], Pose] | None,
    carry: Callable[[Load], None],
    before_motion: Callable[[], None],
) -> Outcome:
    """Moves along the path; ends with the drives holding by themselves.

    Args:
        prepared: The checked run.
        group: Configured drives.
        clock: Simulated time.
        board: What the operator wants.
        recorder: Takes in what happens.
        true_pose: Where the simulated platform is.
        carry: Gives the simulated platform another load.
        before_motion: Called when all is armed; what it raises prevents the motion.

    Raises:
        Refused: Arming was refused; nothing was enabled.
        HardwareMissing: A drive does not answer.
    """
    loads = load_changes(prepared.scene, prepared.checked.table.stands)

    def on_cycle(record: CycleRecord) -> None:
        if record.state in ON_PATH:
            for load in loads.due(record.index):
                carry(load)
        wanted = true_pose is not None and recorder.wants_pose(record.cycle)
        recorder.take_cycle(record, true_pose() if wanted and true_pose else None)

    loop = Loop(
        course_of(prepared.checked),
        group,
        clock,
        wishes=board.read,
        on_cycle=on_cycle,
        on_event=recorder.take_event,
    )
    loop.arm()
    before_motion()
    started = datetime.now(UTC)
    loop.run()
    return Outcome(loop.machine.state, loop.cause, recorder.log, loop.holding, started)
