"""A run along a checked path in the real-time process, from arming to its end."""

from __future__ import annotations

from collections.abc import Callable
from datetime import UTC, datetime

from cdpr.errors import CdprError
from executor.announcing import load_changes
from executor.course import course_of
from executor.custody import Custody
from executor.execution import Outcome
from executor.machine import State
from executor.path_motion import PathMotion
from executor.prepare import PreparedRun
from executor.real_time_job import MakeDrives
from executor.real_time_process import real_time_process
from executor.recorder import Recorder
from executor.shared_board import SharedBoard


def run_in_real_time(
    prepared: PreparedRun,
    make_drives: MakeDrives,
    board: SharedBoard,
    recorder: Recorder,
    *,
    pose_every: int,
    need_real_time: bool,
    before_motion: Callable[[str], None],
) -> Outcome:
    """Moves along the path in a process of its own; ends with the drives holding by themselves.

    Args:
        prepared: The checked run.
        make_drives: Opens and configures the drives; called in that process; picklable.
        board: What the operator wants.
        recorder: Takes in what happens.
        pose_every: Cycles from one true pose of the simulated platform to the next; 0 for none.
        need_real_time: Refuse to arm when the system denies real-time scheduling.
        before_motion: Called when all is armed, with what was denied; what it raises prevents the
            motion.

    Raises:
        CdprError: The bus is latched, or the process could not arm the drives, for the reason told;
            nothing was enabled.
        StoppedByOperator: The operator wanted to stop before anything moved.
    """
    custody = Custody(prepared.rig)
    reference = custody.require_ready()
    motion = PathMotion.of(
        course_of(prepared.checked),
        pose_every=pose_every,
        loads=load_changes(prepared.scene, prepared.checked.table.stands),
        reference=reference,
    )
    with real_time_process(motion, make_drives, board, need_real_time=need_real_time) as process:
        denied = process.arm(recorder).denied
        custody.begin(recorder.folder.path, reference)
        try:
            before_motion(denied)
        except BaseException:
            custody.prevented()
            raise
        started = datetime.now(UTC)
        ended = process.run()
        try:
            custody.end(
                ended.state,
                ended.cause,
                recorder.folder.path,
                holding=ended.holding,
                stands_at=recorder.log.last_positions,
            )
        except CdprError as error:  # the motion is over: its record is finished all the same
            text = f"{error.what} ({error.where}: {error.why})"
            process.tell("recorder", text)
            return Outcome(State.LATCHED, ended.cause or text, recorder.log, ended.holding, started)
        return Outcome(ended.state, ended.cause, recorder.log, ended.holding, started)
