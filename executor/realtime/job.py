"""What the real-time process is given when it starts, and what it says to its supervisor."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Protocol

from drivers.drive_group import DriveGroup
from executor.control.sync_master import SyncMaster
from executor.realtime.shared_memory import CycleRecordCodec, Ring, SharedMemory
from executor.state_machine import CycleRecord, LoopEvent, State
from executor.supervision import OperatorRequests
from model.errors import CdprError
from model.pose import Pose
from model.rig import Rig
from model.scene import Load

#: Slots for cycles: longer than a supervisor may be silent, at the fastest rate.
CYCLE_SLOTS = 4096
#: Slots for events, and what fits into one, [bytes].
EVENT_SLOTS, EVENT_SIZE = 256, 4096


@dataclass(frozen=True, slots=True)
class ReadyDrives:
    """Configured drives.

    Attributes:
        rig: The robot as the drives were set up for it.
        group: All of them.
        true_pose: Where the simulated platform is; None on a real bus.
        carry: Gives the simulated platform another load; on a real bus it happens by itself.
        restarted: Nodes that were found without this program's set-up when they were opened.
        remarks: What the drives cannot do, a sentence each.
    """

    rig: Rig
    group: DriveGroup
    true_pose: Callable[[], Pose] | None
    carry: Callable[[Load], None]
    restarted: tuple[int, ...]
    remarks: tuple[str, ...] = ()

    def true_pose_now(self) -> Pose | None:
        """Where the simulated platform is at this moment; None on a real bus."""
        return None if self.true_pose is None else self.true_pose()


#: Opens the bus and configures the drives; called in the process that will move them.
MakeDrives = Callable[[], AbstractContextManager[ReadyDrives]]


class Procedure(Protocol):
    """What is done with the drives of a motion, cycle by cycle.

    Attributes:
        cause: Why it did not finish.
        error: The same where the operator is to see it as an error of its own; else None.
        holding: Every cable was held when the drives were last heard.
    """

    cause: str
    error: CdprError | None
    holding: bool

    @property
    def stands_at(self) -> tuple[int, ...]:
        """Where the drives were when they were last heard, from arming on, [counts]."""
        ...

    def arm(self, require: Callable[[Sequence[int]], None]) -> None:
        """Makes all ready; see `executor.control.loop.Loop.arm`.

        Raises:
            CdprError: It cannot be; nothing was enabled.
        """
        ...

    def run(self) -> State:
        """Does it; in the end the drives hold by themselves, or were released."""
        ...


class MotionTask(Protocol):
    """What is done with ready drives; it can be sent to a process that is being started."""

    @property
    def cables(self) -> int:
        """How many."""
        ...

    @property
    def cycle(self) -> float:
        """Time from one SYNC to the next, [s]."""
        ...

    def loop(
        self,
        drives: ReadyDrives,
        master: SyncMaster,
        *,
        wishes: Callable[[], OperatorRequests],
        on_cycle: Callable[[CycleRecord], None],
        on_event: Callable[[LoopEvent], None],
    ) -> Procedure:
        """What does it; arguments as for `executor.control.loop.Loop`.

        Raises:
            CdprError: It cannot begin where the drives stand; nothing was enabled.
        """
        ...

    def require(self, drives: ReadyDrives, positions: Sequence[int]) -> None:
        """What must hold of the drives' positions [counts] when they are armed.

        Raises:
            Refused: It does not; nothing was enabled.
        """
        ...

    def after(self, record: CycleRecord, drives: ReadyDrives) -> Pose | None:
        """A cycle is over; where the simulated platform is, if somebody wants to know that now."""
        ...

    def close(self) -> None:
        """Lets go of the shared memory that it made."""
        ...


class Records(Protocol):
    """Takes in what happens during a motion."""

    def take_cycle(self, record: CycleRecord, true_pose: Pose | None) -> None:
        """A cycle is over; where the simulated platform is then, if that was wanted."""
        ...

    def take_event(self, event: LoopEvent) -> None:
        """Something happened."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class Job:
    """Everything for one motion; it can be sent to a process that is being started.

    Attributes:
        motion: What to do.
        board: Wishes and sign of life.
        cycles: Status ring.
        events: Ring of events.
        make_drives: Called in the process.
        need_real_time: Refuse to arm when the system denies real-time scheduling.
    """

    motion: MotionTask
    board: SharedMemory
    cycles: SharedMemory
    events: SharedMemory
    make_drives: MakeDrives
    need_real_time: bool

    @classmethod
    def of(
        cls,
        motion: MotionTask,
        board: SharedMemory,
        make_drives: MakeDrives,
        *,
        need_real_time: bool,
    ) -> Job:
        """A job with rings of its own."""
        return cls(
            motion=motion,
            board=board,
            cycles=SharedMemory.create(
                Ring.size(CycleRecordCodec(motion.cables).size, CYCLE_SLOTS)
            ),
            events=SharedMemory.create(Ring.size(EVENT_SIZE, EVENT_SLOTS)),
            make_drives=make_drives,
            need_real_time=need_real_time,
        )

    def close(self) -> None:
        """Lets go of the shared memory that it and its motion made."""
        self.motion.close()
        for memory in (self.cycles, self.events):
            memory.close()


@dataclass(frozen=True, slots=True)
class Armed:
    """All is ready to move; nothing is enabled.

    Attributes:
        denied: What the system did not grant; nothing when it granted all.
        stands_at: Where the drives stand, [counts].
        restarted: Nodes that were found without this program's set-up.
        remarks: What the drives cannot do, a sentence each.
    """

    denied: str
    stands_at: tuple[int, ...]
    restarted: tuple[int, ...] = ()
    remarks: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class Ended:
    """The motion is over.

    Attributes:
        state: How it ended.
        cause: Why it did not finish, if it did not.
        holding: Every cable was held when the drives were last heard.
        true_pose: Where the simulated platform is; None on a real bus.
        error: The cause as an error of its own, where it is to be raised.
    """

    state: State
    cause: str
    holding: bool
    true_pose: Pose | None
    error: CdprError | None = None


@dataclass(frozen=True, slots=True)
class Failed:
    """It came to an end before the motion, or after it."""

    error: CdprError


class Go:
    """The supervisor's word to move."""


class Gone:
    """The supervisor changed its mind, or is gone."""


class ReadDrives:
    """The supervisor asks for the drives' state after the motion; a `CycleStatus` answers it."""
