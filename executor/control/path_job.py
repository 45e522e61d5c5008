"""A motion along a checked path as a job of the real-time process."""

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
    """See `Motion` in `executor.realtime.job`.

    Attributes:
        rig: The rig file.
        cables: How many.
        cycle: [s].
        hash: Fingerprint of the set-points when they were checked.
        setpoints: The set-points, int32, shape (n, m), sealed.
        pose_every: Cycles from one true pose of the simulated platform to the next; 0 for none.
        loads: What the simulated platform carries, by place in the table.
        reference: Where the drives were referenced, if they were.
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
        course: CheckedSetpoints,
        *,
        pose_every: int,
        loads: Schedule[Load],
        reference: HomingReference | None,
    ) -> PathMotion:
        """With set-points in shared memory of its own."""
        return cls(
            rig=course.rig.document,
            cables=course.rig.cable_count,
            cycle=course.cycle,
            hash=course.hash,
            setpoints=SharedMemory.sealed(np.ascontiguousarray(course.setpoints).tobytes()),
            pose_every=pose_every,
            loads=loads,
            reference=reference,
        )

    def course(self) -> CheckedSetpoints:
        """The set-points as this process sees them; arming compares them with what was checked."""
        rig = rig_from_document(self.rig)
        numbers = np.frombuffer(self.setpoints.view, dtype=np.int32)
        return CheckedSetpoints(rig, self.cycle, numbers.reshape(-1, rig.cable_count), self.hash)

    def loop(
        self,
        drives: ReadyDrives,
        master: SyncMaster,
        *,
        wishes: Callable[[], OperatorRequests],
        on_cycle: Callable[[CycleRecord], None],
        on_event: Callable[[LoopEvent], None],
    ) -> Loop:
        """See `Motion`."""
        return Loop(self.course(), master, wishes=wishes, on_cycle=on_cycle, on_event=on_event)

    def require(self, drives: ReadyDrives, positions: Sequence[int]) -> None:
        """See `Motion`."""
        restarted = drives.group.restarted
        require_still_referenced(drives.rig, self.reference, restarted, positions)

    def after(self, record: CycleRecord, drives: ReadyDrives) -> Pose | None:
        """See `Motion`."""
        if record.state in ON_PATH:
            for load in self.loads.due(record.index):
                drives.carry(load)
        wanted = self.pose_every and record.cycle % self.pose_every == 0
        return drives.true_pose_now() if wanted else None

    def close(self) -> None:
        """See `Motion`."""
        self.setpoints.close()
