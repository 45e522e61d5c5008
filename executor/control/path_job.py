"""Motion along a checked path, as a job of the real-time process."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from executor.control.loop import Loop
from executor.control.preconditions import require_still_referenced
from executor.control.sync_master import SyncMaster
from executor.interlock.reference import HomingReference
from executor.realtime.job import ReadyDrives
from executor.realtime.shared_memory import SharedMemory
from executor.state_machine import ON_PATH, CycleRecord, LoopEvent
from executor.supervision import OperatorRequests
from executor.trajectory.dwell import Schedule
from executor.trajectory.setpoints import CheckedSetpoints
from model.files.rig_file import RigDocument
from model.pose import Pose
from model.rig import rig_from_document
from model.scene import Load


@dataclass(frozen=True, slots=True, eq=False)
class PathMotion:
    """See `MotionTask` in `executor.realtime.job`.

    Attributes:
        rig: The rig file.
        cables: Number of cables.
        cycle: [s].
        hash: Fingerprint of the set-points when they were checked.
        setpoints: The set-points, int32, shape (n, m), sealed.
        pose_every: Cycles between true poses of the simulated platform; 0 for none.
        loads: Payload changes of the simulated platform, by table index.
        reference: The drives' homing reference, if any.
    """

    rig: RigDocument
    cables: int
    cycle: float
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

    def loop(
        self,
        drives: ReadyDrives,
        master: SyncMaster,
        *,
        requests: Callable[[], OperatorRequests],
        on_cycle: Callable[[CycleRecord], None],
        on_event: Callable[[LoopEvent], None],
    ) -> Loop:
        """See `MotionTask`."""
        return Loop(
            self.checked_setpoints(),
            master,
            requests=requests,
            on_cycle=on_cycle,
            on_event=on_event,
        )

    def require(self, drives: ReadyDrives, positions: Sequence[int]) -> None:
        """See `MotionTask`."""
        restarted = drives.group.restarted
        require_still_referenced(drives.rig, self.reference, restarted, positions)

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
