"""Motions along a checked path."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass
from datetime import UTC, datetime

import numpy as np

from drivers.drive_group import CycleStatus
from drivers.factory import without_torque
from executor.control.loop import Loop
from executor.control.preconditions import require_still_referenced
from executor.control.sync_master import SyncMaster
from executor.interlock.interlock import MotionInterlock
from executor.interlock.reference import HomingReference
from executor.realtime.child import MotionTask, ReadyDrives
from executor.realtime.process import Mover
from executor.realtime.shared_memory import SharedMemory
from executor.recording.recorder import Recorder, RunLog
from executor.state_machine import ON_PATH, CycleRecord, LoopEvent, State
from executor.supervision import SupervisorCalls
from executor.trajectory.dwell import Schedule, load_changes
from executor.trajectory.setpoints import CheckedSetpoints, PreparedRun, checked_setpoints_of
from model.errors import CdprError
from model.files.rig_file import RigDocument
from model.pose import Pose
from model.rig import rig_from_document
from model.scene import Load


@dataclass(frozen=True, slots=True, eq=False)
class PathMotion(MotionTask):
    """A motion along a checked path.

    Attributes:
        rig: The rig file.
        hash: Fingerprint of the set-points when they were checked.
        setpoints: The set-points, int32, shape (n, m), sealed.
        pose_every: Cycles between true poses of the simulated platform; 0 for none.
        loads: Payload changes of the simulated platform, by table index.
        reference: The drives' homing reference, if any.
    """

    rig: RigDocument
    hash: str
    setpoints: SharedMemory
    pose_every: int
    loads: Schedule[Load]
    reference: HomingReference | None

    @classmethod
    def of(
        cls,
        checked: CheckedSetpoints,
        *,
        pose_every: int,
        loads: Schedule[Load],
        reference: HomingReference | None,
    ) -> PathMotion:
        """A motion with its set-points in shared memory."""
        return cls(
            rig=checked.rig.document,
            cables=checked.rig.cable_count,
            cycle=checked.cycle,
            hash=checked.hash,
            setpoints=SharedMemory.sealed(np.ascontiguousarray(checked.setpoints).tobytes()),
            pose_every=pose_every,
            loads=loads,
            reference=reference,
        )

    def checked_setpoints(self) -> CheckedSetpoints:
        """The set-points as read by this process; arming compares their fingerprint."""
        rig = rig_from_document(self.rig)
        numbers = np.frombuffer(self.setpoints.view, dtype=np.int32)
        return CheckedSetpoints(rig, self.cycle, numbers.reshape(-1, rig.cable_count), self.hash)

    def loop(self, drives: ReadyDrives, master: SyncMaster, calls: SupervisorCalls) -> Loop:
        """See `MotionTask`."""
        return Loop(self.checked_setpoints(), master, calls)

    def require(self, drives: ReadyDrives, seen: CycleStatus) -> None:
        """See `MotionTask`."""
        require_still_referenced(drives.rig, self.reference, drives.group.restarted, seen)

    def after(self, record: CycleRecord, drives: ReadyDrives) -> Pose | None:
        """See `MotionTask`."""
        if record.state in ON_PATH:
            for load in self.loads.due(record.index):
                drives.carry(load)
        wanted = self.pose_every and record.cycle % self.pose_every == 0
        return drives.true_pose_now() if wanted else None

    def close(self) -> None:
        """See `MotionTask`."""
        self.setpoints.close()


# A motion from arming to the end.


@dataclass(frozen=True, slots=True, eq=False)
class Outcome:
    """Result of a motion.

    Attributes:
        state: Final state.
        cause: Why it did not finish, if it did not.
        log: Recorded cycles and events.
        holding: Every cable was held at the drives' last reply.
        started: Start time, UTC.
    """

    state: State
    cause: str
    log: RunLog
    holding: bool
    started: datetime


def run_along_path(
    prepared: PreparedRun,
    open_mover: Callable[[PathMotion], AbstractContextManager[Mover]],
    recorder: Recorder,
    *,
    before_motion: Callable[[str], None],
) -> Outcome:
    """Moves along the path; ends with the drives holding on their own.

    Args:
        open_mover: Opens the drives for a motion; see `executor.winch_runs.open_mover`.
        recorder: Records cycles and events.
        before_motion: Called when armed, with what the system denied; an exception prevents the
            motion.

    Raises:
        CdprError: The bus is latched, or the drives could not be armed, as stated; nothing was
            enabled.
        StoppedByOperator: A stop was requested before anything moved.
    """
    interlock = MotionInterlock(prepared.rig)
    reference = interlock.require_ready()
    motion = PathMotion.of(
        checked_setpoints_of(prepared.checked),
        pose_every=recorder.pose_every,
        loads=load_changes(prepared.scene, prepared.checked.table.dwells),
        reference=reference,
    )
    with open_mover(motion) as mover:
        armed = mover.arm(recorder)
        interlock.begin(recorder.folder.path, reference)
        try:
            before_motion(armed.denied)
        except BaseException:
            interlock.cancel()
            raise
        started = datetime.now(UTC)
        ended = mover.run()
        last = recorder.log.last
        try:
            interlock.end(
                ended.state,
                ended.cause,
                recorder.folder.path,
                holding=ended.holding,
                positions=last.actual if last else armed.positions,
                released=without_torque(prepared.rig, last.words) if last else armed.released,
            )
        except CdprError as error:  # the motion is over: its record is still completed
            text = f"{error.what} ({error.where}: {error.why})"
            with suppress(CdprError):  # a full disk must not change the outcome
                recorder.take_event(LoopEvent(0, last.at if last else 0.0, "recorder", text))
            return Outcome(State.LATCHED, ended.cause or text, recorder.log, ended.holding, started)
        return Outcome(ended.state, ended.cause, recorder.log, ended.holding, started)
