"""The real-time process: its jobs and messages, and its main function, which runs the loop."""

from __future__ import annotations

import signal
from abc import ABC, abstractmethod
from collections.abc import Callable
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass
from functools import partial
from multiprocessing.connection import Connection
from typing import Protocol

from drivers.can_errors import before_motion
from drivers.drive_group import CycleStatus, DriveGroup
from drivers.factory import without_torque
from executor.control.sync_master import SyncMaster
from executor.realtime.scheduling import RealClock, real_time, require_real_time
from executor.realtime.shared_memory import (
    CycleRecordCodec,
    Ring,
    SharedMemory,
    Supervised,
    pack_event,
)
from executor.state_machine import SIMULATED, CycleRecord, LoopEvent, State
from executor.supervision import SupervisorCalls
from model.errors import CdprError, Fault
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

    def arm(self, require: Callable[[CycleStatus], None]) -> None:
        """Arms the drives; see `executor.control.loop.Loop.arm`.

        Raises:
            CdprError: Arming failed; nothing was enabled.
        """

    def run(self) -> State:
        """Runs to the end, where the drives hold on their own, or are released."""


@dataclass(frozen=True, slots=True, eq=False)
class MotionTask(ABC):
    """A task for ready drives; picklable, to be passed to a new process.

    Attributes:
        cables: Number of cables.
        cycle: SYNC period, [s].
    """

    cables: int
    cycle: float

    @abstractmethod
    def loop(self, drives: ReadyDrives, master: SyncMaster, calls: SupervisorCalls) -> Procedure:
        """The procedure; arguments as for `executor.control.loop.Loop`.

        Raises:
            CdprError: It cannot begin at the present positions; nothing was enabled.
        """

    def require(self, drives: ReadyDrives, seen: CycleStatus) -> None:  # noqa: B027
        """Checks the state of the drives when arming; unless overridden, any is allowed.

        Raises:
            Refused: The check failed; nothing was enabled.
        """

    def after(self, record: CycleRecord, drives: ReadyDrives) -> Pose | None:
        """Called after a cycle; the simulated platform's true pose if due, else None."""
        return None

    def close(self) -> None:  # noqa: B027
        """Releases the shared memory that it made."""


class Records(Protocol):
    """Takes the cycles and events of a motion."""

    def take_cycle(self, record: CycleRecord, true_pose: Pose | None) -> None:
        """Takes a cycle, and the simulated platform's true pose if known."""

    def take_event(self, event: LoopEvent) -> None:
        """Takes an event."""


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
        """Releases the shared memory that it made."""
        for memory in (self.cycles, self.events):
            memory.close()


@dataclass(frozen=True, slots=True)
class Armed:
    """Ready to move; nothing is enabled.

    Attributes:
        denied: What the system denied; empty if nothing.
        positions: Of the drives, [counts].
        restarted: Nodes found without this program's configuration.
        released: Nodes that do not hold their cables under torque.
        remarks: Missing capabilities of the drives, a sentence each.
        nodes: Node of each drive, as in the records.
    """

    denied: str
    positions: tuple[int, ...]
    restarted: tuple[int, ...] = ()
    released: tuple[int, ...] = ()
    remarks: tuple[str, ...] = ()
    nodes: tuple[int, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class Ended:
    """The motion is over.

    Attributes:
        state: Final state.
        cause: Why it did not finish, if it did not.
        holding: Every cable was held at the drives' last reply.
        true_pose: Of the simulated platform after a finished motion; None otherwise and on a real
            bus.
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


class SupervisorGone:
    """The supervisor withdrew, or is gone."""


class ReadDrives:
    """Request for the drives' status after the motion; answered by a `CycleStatus`."""


# The process: opens the drives, arms them, runs the loop.

_TERMINAL_SIGNALS = (
    signal.SIGINT, signal.SIGHUP, signal.SIGQUIT, signal.SIGTSTP, signal.SIGTTIN, signal.SIGTTOU
)  # fmt: skip


def serve(job: Job, link: Connection, supervisor: int) -> None:
    """Runs a job; always ends with the drives holding on their own."""
    supervised = Supervised(job.board, supervisor)
    # The supervisor handles signals of the terminal, through the board; if it is suspended or
    # killed, its silence is detected.
    for number in _TERMINAL_SIGNALS:
        signal.signal(number, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, lambda *_: supervised.ask_stop())
    try:
        with job.make_drives() as drives:
            _arm_and_run(job, drives, link, supervised)
    except CdprError as error:
        _send(link, Failed(error))
    except Exception as error:
        _send(link, Failed(Fault(f"the real-time process failed: {type(error).__name__}: {error}")))


def _arm_and_run(job: Job, drives: ReadyDrives, link: Connection, supervised: Supervised) -> None:
    motion = job.motion
    cycles, events = Ring(job.cycles, CYCLE_SLOTS), Ring(job.events, EVENT_SLOTS)
    wire = CycleRecordCodec(motion.cables)

    def on_cycle(record: CycleRecord) -> None:
        cycles.put(wire.pack(record, motion.after(record, drives)))

    def on_event(event: LoopEvent) -> None:
        events.put(pack_event(event, events.largest_content))

    with real_time() as denied:
        require_real_time(denied, needed=job.need_real_time)
        master = SyncMaster(
            drives.rig, drives.group, RealClock(motion.cycle, supervised.note_cycle)
        )
        try:
            with before_motion():
                calls = SupervisorCalls(supervised.read, on_cycle, on_event)
                loop = motion.loop(drives, master, calls)
                loop.arm(partial(motion.require, drives))
            assert master.status is not None
            released = without_torque(drives.rig, master.status.status_words.tolist())
            if drives.group.capabilities.simulated and drives.true_pose is None:  # on a real bus
                on_event(LoopEvent(0, 0.0, SIMULATED, "the drives report that they are simulated"))
            nodes = tuple(drives.rig.drive_names)
            _send(
                link,
                Armed(denied, loop.positions, drives.restarted, released, drives.remarks, nodes),
            )
            with before_motion():
                message = master.cycle_until(lambda: _poll(link))
        except Exception:
            master.leave_disabled()
            raise
        if not isinstance(message, Go):
            master.leave_disabled()
            return
        state = loop.run()
    true_pose = drives.true_pose_now() if state is State.FINISHED else None
    _send(link, Ended(state, loop.cause, loop.holding, true_pose, loop.error))
    # After any other end the supervisor may hang, and requests nothing.
    while state is State.FINISHED and isinstance(_receive(link), ReadDrives):
        _send(link, master.read_state())


def _poll(link: Connection) -> object:
    """Next message of the supervisor or `SupervisorGone`; None if there is none."""
    return (_receive(link) or SupervisorGone()) if link.poll() else None


def _receive(link: Connection) -> object:
    """Next message of the supervisor; None when it closed the link."""
    try:
        return link.recv()
    except (EOFError, OSError):
        return None


def _send(link: Connection, what: Armed | Ended | Failed | CycleStatus) -> None:
    with suppress(OSError):  # the supervisor is gone; the drives still hold
        link.send(what)
