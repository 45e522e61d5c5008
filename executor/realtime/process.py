"""Motions as their supervisor sees them: in the real-time process, or in this one.

In real time it starts the process, reads its records and sends requests; in simulated time the
loop runs here.
"""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from multiprocessing.connection import wait
from typing import Protocol

from drivers.can_errors import BusFault
from drivers.drive_group import CycleStatus
from drivers.factory import shows_no_torque
from executor.control.sync_master import SyncMaster
from executor.realtime.child import (
    CYCLE_SLOTS,
    EVENT_SLOTS,
    Armed,
    Ended,
    Failed,
    Go,
    Job,
    MakeDrives,
    MotionTask,
    Procedure,
    ReadDrives,
    ReadyDrives,
    Records,
    serve,
)
from executor.realtime.scheduling import (
    Clock,
    ended_at_start,
    exit_text,
    interrupts_blocked,
    one_thread,
)
from executor.realtime.shared_memory import CycleRecordCodec, Ring, SharedRequests, unpack_event
from executor.state_machine import REMARK, CycleRecord, LoopEvent, State
from executor.supervision import RequestBoard, SupervisorCalls, record_failure
from model.errors import CdprError, Fault, HardwareMissing, Refused, StoppedByOperator
from model.progress import SILENT, Listener

#: Interval of reading the rings and of the heartbeat, [s].
POLL_INTERVAL = 0.01
#: Consecutive polls without a new cycle, about 3 s, after which the process counts as hung. Polls
#: are counted, not time, so that a supervisor that was itself suspended first reads what it missed.
SILENT_POLLS = 300
#: A process without a command to move ends within this time, [s]; it may still read the drives.
END_TIMEOUT = 10.0

CheckDrives = Callable[[Collection[int]], str]


class Mover(Protocol):
    """Arms the drives, moves them, and reads their status afterwards."""

    def arm(self, records: Records) -> Armed:
        """Prepares the motion; events from now on go to the records.

        Raises:
            CdprError: Arming failed, or a stop was requested; nothing was enabled.
        """

    def run(self) -> Ended:
        """Moves; the drives hold on their own at the end."""

    def read_status(self) -> CycleStatus:
        """Status of the drives after the motion."""


class MotionHere:
    """Moves drives in this process, in simulated time; a `Mover`."""

    def __init__(
        self,
        motion: MotionTask,
        drives: ReadyDrives,
        clock: Clock,
        board: RequestBoard,
        after_stop: str = "",
    ) -> None:
        """Sends nothing yet; ``after_stop`` is the next step if stopped before anything moved."""
        self._motion, self._drives, self._board = motion, drives, board
        self._master = SyncMaster(drives.rig, drives.group, clock)
        self._after_stop = after_stop
        self._loop: Procedure | None = None

    def arm(self, records: Records) -> Armed:
        """See `Mover`."""
        # Not of `self`, which would keep the memory of the motion until a cycle is collected.
        motion, drives = self._motion, self._drives

        def on_cycle(record: CycleRecord) -> None:
            records.take_cycle(record, motion.after(record, drives))

        calls = SupervisorCalls(self._board.read, on_cycle, records.take_event)
        self._loop = motion.loop(drives, self._master, calls)
        self._loop.arm(partial(motion.require, drives))
        if self._board.read().stop:
            raise StoppedByOperator("stopped before anything moved", next_step=self._after_stop)
        return Armed("", self._loop.positions)

    def run(self) -> Ended:
        """See `Mover`.

        Raises:
            Refused: It was not armed.
        """
        if self._loop is None:
            raise Refused("the motion was not armed", where="executor")
        state = self._loop.run()
        true_pose = self._drives.true_pose_now() if state is State.FINISHED else None
        return Ended(state, self._loop.cause, self._loop.holding, true_pose)

    def read_status(self) -> CycleStatus:
        """See `Mover`."""
        return self._master.read_state()


@contextmanager
def real_time_process(
    motion: MotionTask,
    make_drives: MakeDrives,
    board: SharedRequests,
    *,
    need_real_time: bool,
    check_drives: CheckDrives,
    listener: Listener = SILENT,
) -> Iterator[RealTimeProcess]:
    """A process for one motion; ends when the block is left.

    Args:
        motion: The caller closes it.
        make_drives: Opens and configures the drives; called in that process; picklable.
        need_real_time: Refuse to arm when the system denies real-time scheduling.
        check_drives: Reads the state of drives whose process is gone; returns what is wrong, empty
            if all hold but the nodes given, which were never enabled.
        listener: Receives remarks on missing capabilities of the drives.
    """
    job = Job.of(motion, board.memory, make_drives, need_real_time=need_real_time)
    try:
        process = RealTimeProcess(job, board, check_drives, listener)
        try:
            yield process
        finally:
            process.close()
    finally:
        job.close()


def _event_code(error: CdprError) -> str:
    """Code of the event for an error that ended the motion before it began."""
    if isinstance(error, HardwareMissing):
        return "drive_silent"
    return error.code if isinstance(error, BusFault) else "broken"


class RealTimeProcess:
    """One motion in a process of its own; a `Mover`."""

    def __init__(
        self, job: Job, board: SharedRequests, check_drives: CheckDrives, listener: Listener
    ) -> None:
        self._board, self._check_drives, self._listener = board, check_drives, listener
        self._wire = CycleRecordCodec(job.motion.cables)
        self._cycles, self._events = Ring(job.cycles, CYCLE_SLOTS), Ring(job.events, EVENT_SLOTS)
        self._records: Records | None = None
        self._last: CycleRecord | None = None
        self._nodes: tuple[int, ...] = ()
        self._never_enabled: tuple[int, ...] = ()
        self._ended = False
        context = multiprocessing.get_context("spawn")
        self._link, far_end = context.Pipe()
        self._process = context.Process(
            target=serve, args=(job, far_end, os.getpid()), name="cdpr-real-time", daemon=True
        )
        with one_thread(), interrupts_blocked():
            self._process.start()
        far_end.close()

    def arm(self, records: Records) -> Armed:
        """Waits until the drives are armed.

        Args:
            records: Takes cycles and events from now on, and remarks on the drives.

        Raises:
            CdprError: Arming failed, or the operator requested a stop.
        """
        self._records = records
        while True:
            self._board.beat()
            if self._board.read().stop:
                raise StoppedByOperator("stopped before anything moved")
            if wait([self._link, self._process.sentinel], POLL_INTERVAL):
                message = self._receive()
                if isinstance(message, Armed):
                    self._nodes, self._never_enabled = message.nodes, message.released
                    for remark in message.remarks:
                        self._listener.remark(remark)
                        records.take_event(LoopEvent(0, 0.0, REMARK, remark))
                    return message
                raise message.error if isinstance(message, Failed) else self._not_started()

    def run(self) -> Ended:
        """Starts the motion, and takes its records until it is over.

        Raises:
            Refused: It was not armed.
        """
        if self._records is None:
            raise Refused("the motion was not armed", where="executor")
        self._board.beat()
        with suppress(OSError):  # it died since it was armed, which is reported below
            self._link.send(Go())
        message: object = None
        over, silent, cycles = False, 0, 0
        while not over and silent < SILENT_POLLS:
            over = bool(wait([self._link, self._process.sentinel], POLL_INTERVAL))
            self._board.beat()
            if over:
                message = self._receive()
            self._take_in(self._records)
            before, cycles = cycles, self._board.cycles
            silent = 0 if cycles != before else silent + 1
        if isinstance(message, Ended):
            self._ended = True
            return message
        error = (
            message.error if isinstance(message, Failed) else self._died() if over else self._hung()
        )
        self._take_in(self._records)
        is_lost = not isinstance(message, Failed)
        self._report_event("real_time_lost" if is_lost else _event_code(error), error.what)
        # The others should hold on their own without SYNC.
        doubt = self._check_drives(self._never_enabled)
        if doubt:
            self._report_event("not_held", doubt)
        cause = f"{error.what}; {doubt}" if doubt else error.what
        return Ended(State.LATCHED, cause, holding=not doubt, true_pose=None)

    def read_status(self) -> CycleStatus:
        """Status of the drives after the motion.

        Raises:
            CdprError: A drive does not answer, or the process is gone.
        """
        with suppress(OSError):  # reported below
            self._link.send(ReadDrives())
        if not self._link.poll(END_TIMEOUT):
            raise self._hung()
        message = self._receive()
        if isinstance(message, CycleStatus):
            return message
        raise message.error if isinstance(message, Failed) else self._died()

    def close(self) -> None:
        """Waits for the process to come to rest and end; kills it after a time-out."""
        if not self._ended:  # after the end only the operator requests a stop
            self._board.ask_stop()
        self._link.close()
        self._process.join(END_TIMEOUT)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()
        self._process.close()

    def _report_event(self, code: str, text: str) -> None:
        """Records an event that happened after the last cycle."""
        cycle, at = (self._last.cycle + 1, self._last.at) if self._last else (0, 0.0)
        if self._records is not None:
            self._record(partial(self._records.take_event, LoopEvent(cycle, at, code, text)))

    def _receive(self) -> object:
        """Next message of the process; None when it died."""
        try:
            return self._link.recv()
        except (EOFError, OSError):
            return None

    def _not_started(self) -> Fault:
        self._process.join(END_TIMEOUT)
        return ended_at_start("the real-time process", self._process, "; nothing moved")

    def _died(self) -> Fault:
        self._process.join(END_TIMEOUT)
        how = exit_text(self._process)
        return Fault(
            f"the real-time process died ({how}); no set-points reach the drives",
            where="real-time process",
            why="it was killed, or the system ran out of memory",
            next_step="check the platform first, then start again from its pose",
        )

    def _hung(self) -> Fault:
        """Kills a hung process, so that it can no longer send to the drives."""
        self._process.kill()  # a suspended process ignores SIGTERM
        self._process.join()
        return Fault(
            "the real-time process hung and was killed; no set-points reach the drives",
            where="real-time process",
            why="it was suspended, or is waiting for a device that does not answer",
            next_step="check the platform first, then start again from its pose",
        )

    def _take_in(self, records: Records) -> None:
        """Takes everything received since the last call; cycles first, as they carry the time."""
        for content in self._cycles.take():
            self._last, true_pose = self._wire.unpack(content)
            self._never_enabled = self._still_disabled(self._last)
            self._record(partial(records.take_cycle, self._last, true_pose))
        for content in self._events.take():
            self._record(partial(records.take_event, unpack_event(content)))
        lost = self._cycles.lost + self._events.lost
        if lost:
            self._never_enabled = ()
            self._board.complain(f"{lost} records of the run were lost: they arrived too fast")

    def _still_disabled(self, record: CycleRecord) -> tuple[int, ...]:
        """Drives never enabled up to this cycle; one whose reply is missing may have been."""
        words = {} if record.missing else dict(zip(self._nodes, record.words, strict=True))
        return tuple(
            node for node in self._never_enabled if node in words and shows_no_torque(words[node])
        )

    def _record(self, take: Callable[[], None]) -> None:
        """A record that cannot be kept causes a path stop; supervision continues."""
        try:
            take()
        except Exception as error:
            self._board.complain(record_failure(error))
