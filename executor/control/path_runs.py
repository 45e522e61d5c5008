"""Motions along a checked path: in this process, or in the real-time process."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime

import numpy as np

from drivers.drive_group import CycleStatus, DriveGroup
from drivers.factory import without_torque
from executor.control.loop import Loop
from executor.control.preconditions import require_still_referenced
from executor.control.sync_master import SyncMaster
from executor.interlock.interlock import MotionInterlock
from executor.interlock.reference import HomingReference
from executor.realtime.child import MakeDrives, MotionTask, ReadyDrives
from executor.realtime.process import CheckDrives, real_time_process
from executor.realtime.scheduling import Clock
from executor.realtime.shared_memory import SharedMemory, SharedRequests
from executor.recording.recorder import Recorder, RunLog
from executor.state_machine import ON_PATH, CycleRecord, State
from executor.supervision import RequestBoard, SupervisorCalls
from executor.trajectory.dwell import Schedule, load_changes
from executor.trajectory.setpoints import CheckedSetpoints, PreparedRun, checked_setpoints_of
from model.errors import CdprError
from model.files.rig_file import RigDocument
from model.pose import Pose
from model.progress import SILENT, Listener
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


# A motion from arming to the end, in this process.


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


def run_in_process(
    prepared: PreparedRun,
    group: DriveGroup,
    clock: Clock,
    board: RequestBoard,
    recorder: Recorder,
    *,
    true_pose: Callable[[], Pose] | None,
    carry: Callable[[Load], None],
    before_motion: Callable[[], None],
) -> Outcome:
    """Moves along the path in simulated time; ends with the drives holding on their own.

    Args:
        recorder: Records cycles and events.
        true_pose: Returns the true pose of the simulated platform.
        carry: Changes the payload of the simulated platform.
        before_motion: Called when armed; an exception prevents the motion.

    Raises:
        Refused: Arming was refused; nothing was enabled.
        HardwareMissing: A drive does not answer.
    """
    loads = load_changes(prepared.scene, prepared.checked.table.dwells)

    def on_cycle(record: CycleRecord) -> None:
        if record.state in ON_PATH:
            for load in loads.due(record.index):
                carry(load)
        wanted = true_pose is not None and recorder.wants_pose(record.cycle)
        recorder.take_cycle(record, true_pose() if wanted and true_pose else None)

    loop = Loop(
        checked_setpoints_of(prepared.checked),
        SyncMaster(prepared.rig, group, clock),
        SupervisorCalls(board.read, on_cycle, recorder.take_event),
    )
    loop.arm()
    before_motion()
    started = datetime.now(UTC)
    loop.run()
    return Outcome(loop.machine.state, loop.cause, recorder.log, loop.holding, started)


# In the real-time process, from arming to the end.


def run_in_real_time(
    prepared: PreparedRun,
    make_drives: MakeDrives,
    board: SharedRequests,
    recorder: Recorder,
    *,
    pose_every: int,
    need_real_time: bool,
    check_drives: CheckDrives,
    before_motion: Callable[[str], None],
    listener: Listener = SILENT,
) -> Outcome:
    """Moves along the path in the real-time process; ends with the drives holding.

    Args:
        make_drives: Opens and configures the drives; called in that process; picklable.
        recorder: Records cycles and events.
        pose_every: Cycles between true poses of the simulated platform; 0 for none.
        need_real_time: Refuse to arm when the system denies real-time scheduling.
        check_drives: As for `executor.realtime.process.real_time_process`.
        before_motion: Called when armed, with what the system denied; an exception prevents the
            motion.
        listener: Receives remarks on missing capabilities of the drives.

    Raises:
        CdprError: The bus is latched, or the process could not arm the drives, as stated;
            nothing was enabled.
        StoppedByOperator: A stop was requested before anything moved.
    """
    interlock = MotionInterlock(prepared.rig)
    reference = interlock.require_ready()
    motion = PathMotion.of(
        checked_setpoints_of(prepared.checked),
        pose_every=pose_every,
        loads=load_changes(prepared.scene, prepared.checked.table.dwells),
        reference=reference,
    )
    with real_time_process(
        motion,
        make_drives,
        board,
        need_real_time=need_real_time,
        check_drives=check_drives,
        listener=listener,
    ) as process:
        armed = process.arm(recorder)
        interlock.begin(recorder.folder.path, reference)
        try:
            before_motion(armed.denied)
        except BaseException:
            interlock.cancel()
            raise
        started = datetime.now(UTC)
        ended = process.run()
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
            process.report_event("recorder", text)
            return Outcome(State.LATCHED, ended.cause or text, recorder.log, ended.holding, started)
        return Outcome(ended.state, ended.cause, recorder.log, ended.holding, started)
