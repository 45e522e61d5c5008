"""A motion along a checked path as a job of the real-time process."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from cdpr.poses import Pose
from cdpr.rig import rig_from_document
from cdpr.rig_file import RigDocument
from cdpr.scene import Load
from executor.announcing import Schedule
from executor.arming import require_still_referenced
from executor.clock import Clock
from executor.course import Course
from executor.loop import Loop
from executor.machine import ON_PATH
from executor.real_time_job import ReadyDrives
from executor.records import CycleRecord, LoopEvent
from executor.reference import ReferenceDocument
from executor.shared_memory import SharedMemory
from executor.wishes import Wishes


@dataclass(frozen=True, slots=True, eq=False)
class PathMotion:
    """See `Motion` in `executor.real_time_job`.

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
    reference: ReferenceDocument | None

    @classmethod
    def of(
        cls,
        course: Course,
        *,
        pose_every: int,
        loads: Schedule[Load],
        reference: ReferenceDocument | None,
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

    def course(self) -> Course:
        """The set-points as this process sees them; arming compares them with what was checked."""
        rig = rig_from_document(self.rig)
        numbers = np.frombuffer(self.setpoints.view, dtype=np.int32)
        return Course(rig, self.cycle, numbers.reshape(-1, rig.cable_count), self.hash)

    def loop(
        self,
        drives: ReadyDrives,
        clock: Clock,
        *,
        wishes: Callable[[], Wishes],
        on_cycle: Callable[[CycleRecord], None],
        on_event: Callable[[LoopEvent], None],
    ) -> Loop:
        """See `Motion`."""
        course = self.course()
        require_still_referenced(course.rig, self.reference, drives.group)
        return Loop(
            course, drives.group, clock, wishes=wishes, on_cycle=on_cycle, on_event=on_event
        )

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
