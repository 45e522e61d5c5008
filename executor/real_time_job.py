"""What the real-time process is given when it starts, and what it says to its supervisor."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Protocol

from cdpr.errors import CdprError
from cdpr.poses import Pose
from cdpr.rig import Rig
from cdpr.scene import Load
from drivers.drive_group import DriveGroup
from executor.clock import Clock
from executor.loop import Loop
from executor.machine import State
from executor.records import CycleRecord, LoopEvent
from executor.ring import Ring
from executor.shared_memory import SharedMemory
from executor.wire import RecordWire
from executor.wishes import Wishes

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
    """

    rig: Rig
    group: DriveGroup
    true_pose: Callable[[], Pose] | None
    carry: Callable[[Load], None]
    restarted: tuple[int, ...]

    def true_pose_now(self) -> Pose | None:
        """Where the simulated platform is at this moment; None on a real bus."""
        return None if self.true_pose is None else self.true_pose()


#: Opens the bus and configures the drives; called in the process that will move them.
MakeDrives = Callable[[], AbstractContextManager[ReadyDrives]]


class Motion(Protocol):
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
        clock: Clock,
        *,
        wishes: Callable[[], Wishes],
        on_cycle: Callable[[CycleRecord], None],
        on_event: Callable[[LoopEvent], None],
    ) -> Loop:
        """The loop that does it; arguments as for `Loop`.

        Raises:
            CdprError: It cannot begin where the drives stand; nothing was enabled.
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

    motion: Motion
    board: SharedMemory
    cycles: SharedMemory
    events: SharedMemory
    make_drives: MakeDrives
    need_real_time: bool

    @classmethod
    def of(
        cls, motion: Motion, board: SharedMemory, make_drives: MakeDrives, *, need_real_time: bool
    ) -> Job:
        """A job with rings of its own."""
        return cls(
            motion=motion,
            board=board,
            cycles=SharedMemory.create(Ring.size(RecordWire(motion.cables).size, CYCLE_SLOTS)),
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
    """

    denied: str
    stands_at: tuple[int, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Ended:
    """The motion is over.

    Attributes:
        state: How it ended.
        cause: Why it did not finish, if it did not.
        holding: Every cable was held when the drives were last heard.
        true_pose: Where the simulated platform is; None on a real bus.
    """

    state: State
    cause: str
    holding: bool
    true_pose: Pose | None


@dataclass(frozen=True, slots=True)
class Failed:
    """It came to an end before the motion, or after it."""

    error: CdprError


class Go:
    """The supervisor's word to move."""


class Look:
    """The supervisor asks what the drives tell after the motion; a `CycleStatus` answers it."""
