"""What the real-time process is given when it starts, and what it says to its supervisor."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass

import numpy as np

from cdpr.errors import CdprError
from cdpr.poses import Pose
from cdpr.rig import rig_from_document
from cdpr.rig_file import RigDocument
from cdpr.scene import Load
from drivers.drive_group import DriveGroup
from executor.announcing import Schedule
from executor.course import Course
from executor.machine import State
from executor.reference import ReferenceDocument
from executor.ring import Ring
from executor.shared_memory import SharedMemory
from executor.wire import RecordWire

#: Slots for cycles: longer than a supervisor may be silent, at the fastest rate.
CYCLE_SLOTS = 4096
#: Slots for events, and what fits into one, [bytes].
EVENT_SLOTS, EVENT_SIZE = 256, 4096


@dataclass(frozen=True, slots=True)
class ReadyDrives:
    """Configured drives.

    Attributes:
        group: All of them.
        true_pose: Where the simulated platform is; None on a real bus.
        carry: Gives the simulated platform another load; on a real bus it happens by itself.
        restarted: Nodes that were found without this program's set-up when they were opened.
    """

    group: DriveGroup
    true_pose: Callable[[], Pose] | None
    carry: Callable[[Load], None]
    restarted: tuple[int, ...]


#: Opens the bus and configures the drives; called in the process that will move them.
MakeDrives = Callable[[], AbstractContextManager[ReadyDrives]]


@dataclass(frozen=True, slots=True, eq=False)
class Job:
    """Everything for one motion; it can be sent to a process that is being started.

    Attributes:
        rig: The rig file.
        cycle: [s].
        hash: Fingerprint of the set-points when they were checked.
        setpoints: The set-points, int32, shape (n, m), sealed.
        board: Wishes and sign of life.
        cycles: Status ring.
        events: Ring of events.
        make_drives: Called in the process.
        pose_every: Cycles from one true pose of the simulated platform to the next; 0 for none.
        loads: What the simulated platform carries, by place in the table.
        need_real_time: Refuse to arm when the system denies real-time scheduling.
        reference: Where the drives were referenced, if they were.
    """

    rig: RigDocument
    cycle: float
    hash: str
    setpoints: SharedMemory
    board: SharedMemory
    cycles: SharedMemory
    events: SharedMemory
    make_drives: MakeDrives
    pose_every: int
    loads: Schedule[Load]
    need_real_time: bool
    reference: ReferenceDocument | None

    @classmethod
    def of(
        cls,
        course: Course,
        board: SharedMemory,
        make_drives: MakeDrives,
        *,
        pose_every: int,
        loads: Schedule[Load],
        need_real_time: bool,
        reference: ReferenceDocument | None,
    ) -> Job:
        """A job with shared memory of its own."""
        wire = RecordWire(course.rig.cable_count)
        return cls(
            rig=course.rig.document,
            cycle=course.cycle,
            hash=course.hash,
            setpoints=SharedMemory.sealed(np.ascontiguousarray(course.setpoints).tobytes()),
            board=board,
            cycles=SharedMemory.create(Ring.size(wire.size, CYCLE_SLOTS)),
            events=SharedMemory.create(Ring.size(EVENT_SIZE, EVENT_SLOTS)),
            make_drives=make_drives,
            pose_every=pose_every,
            loads=loads,
            need_real_time=need_real_time,
            reference=reference,
        )

    def course(self) -> Course:
        """The set-points as this process sees them; arming compares them with what was checked."""
        rig = rig_from_document(self.rig)
        numbers = np.frombuffer(self.setpoints.view, dtype=np.int32)
        return Course(rig, self.cycle, numbers.reshape(-1, rig.cable_count), self.hash)

    def close(self) -> None:
        """Lets go of the shared memory that it made."""
        for memory in (self.setpoints, self.cycles, self.events):
            memory.close()


@dataclass(frozen=True, slots=True)
class Armed:
    """All is ready to move; nothing is enabled.

    Attributes:
        denied: What the system did not grant; nothing when it granted all.
    """

    denied: str


@dataclass(frozen=True, slots=True)
class Ended:
    """The motion is over, and the drives hold by themselves; whether all did is told, too."""

    state: State
    cause: str
    holding: bool


@dataclass(frozen=True, slots=True)
class Failed:
    """It came to an end before the motion, or after it."""

    error: CdprError


class Go:
    """The supervisor's word to move."""
