"""The supervisor's side of the real-time process: starts it, reads its records, sends requests."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from multiprocessing.connection import wait

from drivers.drive_group import CycleStatus
from executor.realtime.child import serve
from executor.realtime.job import (
    CYCLE_SLOTS,
    EVENT_SLOTS,
    Armed,
    Ended,
    Failed,
    Go,
    Job,
    MakeDrives,
    MotionTask,
    ReadDrives,
    Records,
)
from executor.realtime.scheduling import interrupts_blocked, one_thread
from executor.realtime.shared_memory import CycleRecordCodec, Ring, SharedRequests, unpack_event
from executor.state_machine import CycleRecord, LoopEvent, State
from model.errors import CdprError, Fault, Refused, StoppedByOperator
from model.progress import SILENT, Listener

#: The rings are looked into, and a sign of life is given, this often, [s].
LOOK = 0.01
#: Looks in a row without a cycle begun, about 3 s, after which a process that moves drives hangs.
#: Looks are counted, not time, so that a supervisor that was suspended itself first reads what it
#: missed.
SILENT_LOOKS = 300
#: A process without a command to move ends within this, [s]; drives may still be asked for a time.
END_TIMEOUT = 10.0


@contextmanager
def real_time_process(
    motion: MotionTask,
    make_drives: MakeDrives,
    board: SharedRequests,
    *,
    need_real_time: bool,
    look_again: Callable[[], str],
    listener: Listener = SILENT,
) -> Iterator[RealTimeProcess]:
    """A process for one motion; it has ended when the block is left.

    Args:
        motion: What to do.
        make_drives: Opens and configures the drives; called in that process; picklable.
        board: What the operator wants.
        need_real_time: Refuse to arm when the system denies real-time scheduling.
        look_again: Asks drives whose process is gone how they stand; what is wrong with it, empty
            where they hold.
        listener: Receives what the drives cannot do.
    """
    job = Job.of(motion, board.memory, make_drives, need_real_time=need_real_time)
    try:
        process = RealTimeProcess(job, board, look_again, listener)
        try:
            yield process
        finally:
            process.close()
    finally:
        job.close()


class RealTimeProcess:
    """One motion in a process of its own; a `WinchMover`."""

    def __init__(
        self, job: Job, board: SharedRequests, look_again: Callable[[], str], listener: Listener
    ) -> None:
        """Starts it; it opens the drives."""
        self._board, self._look_again, self._listener = board, look_again, listener
        self._wire = CycleRecordCodec(job.motion.cables)
        self._cycles, self._events = Ring(job.cycles, CYCLE_SLOTS), Ring(job.events, EVENT_SLOTS)
        self._records: Records | None = None
        self._last: CycleRecord | None = None
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
            records: Takes in what happens from now on.

        Raises:
            CdprError: They could not be, or the operator wants to stop.
        """
        self._records = records
        while True:
            self._board.beat()
            if self._board.read().stop:
                raise StoppedByOperator("stopped before anything moved")
            if wait([self._link, self._process.sentinel], LOOK):
                said = self._heard()
                if isinstance(said, Armed):
                    for remark in said.remarks:
                        self._listener.remark(remark)
                    return said
                raise said.error if isinstance(said, Failed) else self._died()

    def run(self) -> Ended:
        """Says go, and takes in what happens until the motion is over.

        Raises:
            Refused: It was not armed.
        """
        if self._records is None:
            raise Refused("the motion was not armed", where="executor")
        self._board.beat()
        with suppress(OSError):  # it died since it was armed, which is reported below
            self._link.send(Go())
        said: object = None
        over, silent, cycles = False, 0, 0
        while not over and silent < SILENT_LOOKS:
            over = bool(wait([self._link, self._process.sentinel], LOOK))
            self._board.beat()
            if over:
                said = self._heard()
            self._take_in(self._records)
            before, cycles = cycles, self._board.cycles
            silent = 0 if cycles != before else silent + 1
        if isinstance(said, Ended):
            self._ended = True
            return said
        error = said.error if isinstance(said, Failed) else self._died() if over else self._hung()
        self._take_in(self._records)
        self.tell("real_time_lost", error.what)
        doubt = self._look_again()  # they should hold by themselves, as SYNC stays away
        if doubt:
            self.tell("not_held", doubt)
        cause = f"{error.what}; {doubt}" if doubt else error.what
        return Ended(State.LATCHED, cause, holding=not doubt, true_pose=None)

    def stands_now(self) -> CycleStatus:
        """State of the drives after the motion.

        Raises:
            CdprError: One does not answer, or the process is gone.
        """
        with suppress(OSError):  # reported below
            self._link.send(ReadDrives())
        if not self._link.poll(END_TIMEOUT):
            raise self._hung()
        said = self._heard()
        if isinstance(said, CycleStatus):
            return said
        raise said.error if isinstance(said, Failed) else self._died()

    def tell(self, code: str, text: str) -> None:
        """Records an event that happened after the last cycle."""
        cycle, at = (self._last.cycle + 1, self._last.at) if self._last else (0, 0.0)
        if self._records is not None:
            self._record(partial(self._records.take_event, LoopEvent(cycle, at, code, text)))

    def close(self) -> None:
        """Waits for the process; whatever it does, it comes to rest and ends."""
        if not self._ended:  # a stop that is wished from now on is the operator's
            self._board.ask_stop()
        self._link.close()
        self._process.join(END_TIMEOUT)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()
        self._process.close()

    def _heard(self) -> object:
        """What the process said; None when it died without a word."""
        try:
            return self._link.recv()
        except (EOFError, OSError):
            return None

    def _died(self) -> Fault:
        self._process.join(END_TIMEOUT)
        code = self._process.exitcode
        how = f"killed by signal {-code}" if code is not None and code < 0 else f"exit code {code}"
        return Fault(
            f"the real-time process died ({how}); the drives stop and hold on their own"
            " without set-points",
            where="real-time process",
            why="it was killed, or the system ran out of memory",
            next_step="check the platform first, then start again from its pose",
        )

    def _hung(self) -> Fault:
        """Ends a process that hangs: nothing of it may reach the drives any more."""
        self._process.kill()  # a process that is suspended hears no milder signal
        self._process.join()
        return Fault(
            "the real-time process hung and was killed; the drives stop and hold on their own"
            " without set-points",
            where="real-time process",
            why="it was suspended, or is waiting for a device that does not answer",
            next_step="check the platform first, then start again from its pose",
        )

    def _take_in(self, records: Records) -> None:
        """Everything received since the last call; cycles first, as they carry the time."""
        for content in self._cycles.take():
            self._last, true_pose = self._wire.unpack(content)
            self._record(partial(records.take_cycle, self._last, true_pose))
        for content in self._events.take():
            self._record(partial(records.take_event, unpack_event(content)))
        lost = self._cycles.lost + self._events.lost
        if lost:
            self._board.complain(f"{lost} records of the run were lost: they arrived too fast")

    def _record(self, take: Callable[[], None]) -> None:
        """A record that cannot be kept leads to a stop along the path, not to an end of care."""
        try:
            take()
        except CdprError as error:
            self._board.complain(f"recording failed: {error.what}")
        except Exception as error:
            self._board.complain(f"recording failed: {type(error).__name__}: {error}")
