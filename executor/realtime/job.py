"""Jobs of the real-time process, and the messages between it and its supervisor."""

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

#: Slots for cycles: more than a supervisor may be silent for, at the fastest rate.
CYCLE_SLOTS = 4096
#: Slots for events, and the size of one, [bytes].
EVENT_SLOTS, EVENT_SIZE = 256, 4096


@dataclass(frozen=True, slots=True)
class ReadyDrives:
    """Configured drives.

    Attributes:
        rig: The robot that the drives are configured for.
        group: All of them.
        true_pose: Returns the true pose of the simulated platform; None on a real bus.
        carry: Changes the payload of the simulated platform; no effect on a real bus.
        restarted: Nodes found without this program's configuration when opened.
        remarks: Missing capabilities of the drives, a sentence each.
    """

    rig: Rig
    group: DriveGroup
    true_pose: Callable[[], Pose] | None
    carry: Callable[[Load], None]
    restarted: tuple[int, ...]
    remarks: tuple[str, ...] = ()

    def true_pose_now(self) -> Pose | None:
        """Present true pose of the simulated platform; None on a real bus."""
        return None if self.true_pose is None else self.true_pose()


#: Opens the bus and configures the drives; called in the process that will move them.
MakeDrives = Callable[[], AbstractContextManager[ReadyDrives]]


class Procedure(Protocol):
    """Cyclic procedure on the drives of a motion.

    Attributes:
        cause: Why it did not finish.
        error: The same, where it is to be raised as an error; else None.
        holding: Every cable was held at the drives' last reply.
    """

    cause: str
    error: CdprError | None
    holding: bool

    @property
    def positions(self) -> tuple[int, ...]:
        """Last reported positions of the drives, from arming on, [counts]."""
        ...

    def arm(self, require: Callable[[Sequence[int]], None]) -> None:
        """Arms the drives; see `executor.control.loop.Loop.arm`.

        Raises:
            CdprError: Arming failed; nothing was enabled.
        """
        ...

    def run(self) -> State:
        """Runs to the end, where the drives hold on their own, or are released."""
        ...


class MotionTask(Protocol):
    """A task for ready drives; picklable, to be passed to a new process."""

    @property
    def cables(self) -> int:
        """Number of cables."""
        ...

    @property
    def cycle(self) -> float:
        """SYNC period, [s]."""
        ...

    def loop(
        self,
        drives: ReadyDrives,
        master: SyncMaster,
        *,
        requests: Callable[[], OperatorRequests],
        on_cycle: Callable[[CycleRecord], None],
        on_event: Callable[[LoopEvent], None],
    ) -> Procedure:
        """The procedure; arguments as for `executor.control.loop.Loop`.

        Raises:
            CdprError: It cannot begin at the present positions; nothing was enabled.
        """
        ...

    def require(self, drives: ReadyDrives, positions: Sequence[int]) -> None:
        """Checks the drive positions [counts] when arming.

        Raises:
            Refused: The check failed; nothing was enabled.
        """
        ...

    def after(self, record: CycleRecord, drives: ReadyDrives) -> Pose | None:
        """Called after a cycle; the simulated platform's true pose if due, else None."""
        ...

    def close(self) -> None:
        """Releases the shared memory that it made."""
        ...


class Records(Protocol):
    """Takes the cycles and events of a motion."""

    def take_cycle(self, record: CycleRecord, true_pose: Pose | None) -> None:
        """Takes a cycle, and the simulated platform's true pose if known."""
        ...

    def take_event(self, event: LoopEvent) -> None:
        """Takes an event."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class Job:
    """Everything for one motion; picklable, to be passed to a new process.

    Attributes:
        motion: The motion.
        board: Operator requests and heartbeats.
        cycles: Ring of cycle records.
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
        """A job with its own rings."""
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
        """Releases the shared memory that it and its motion made."""
        self.motion.close()
        for memory in (self.cycles, self.events):
            memory.close()


@dataclass(frozen=True, slots=True)
class Armed:
    """Ready to move; nothing is enabled.

    Attributes:
        denied: What the system denied; empty if nothing.
        positions: Of the drives, [counts].
        restarted: Nodes found without this program's configuration.
        remarks: Missing capabilities of the drives, a sentence each.
    """

    denied: str
    positions: tuple[int, ...]
    restarted: tuple[int, ...] = ()
    remarks: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class Ended:
    """The motion is over.

    Attributes:
        state: Final state.
        cause: Why it did not finish, if it did not.
        holding: Every cable was held at the drives' last reply.
        true_pose: Of the simulated platform; None on a real bus.
        error: The cause, where it is to be raised as an error.
    """

    state: State
    cause: str
    holding: bool
    true_pose: Pose | None
    error: CdprError | None = None


@dataclass(frozen=True, slots=True)
class Failed:
    """The process failed before or after the motion."""

    error: CdprError


class Go:
    """Command of the supervisor to move."""


class Gone:
    """The supervisor withdrew, or is gone."""


class ReadDrives:
    """Request for the drives' status after the motion; answered by a `CycleStatus`."""
