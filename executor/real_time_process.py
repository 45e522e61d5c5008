"""The supervisor's side of the real-time process: starts it, takes in what it tells, is told."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable
from contextlib import suppress
from datetime import UTC, datetime
from functools import partial
from multiprocessing.connection import wait

from cdpr.errors import CdprError, Fault, StoppedByOperator
from executor.announcing import load_changes
from executor.course import course_of
from executor.custody import Custody
from executor.execution import Outcome
from executor.machine import State
from executor.prepare import PreparedRun
from executor.real_time_child import serve
from executor.real_time_job import (
    CYCLE_SLOTS,
    EVENT_SLOTS,
    Armed,
    Ended,
    Failed,
    Go,
    Job,
    MakeDrives,
)
from executor.recorder import Recorder
from executor.records import LoopEvent
from executor.ring import Ring
from executor.shared_board import SharedBoard
from executor.spawning import interrupts_blocked, one_thread
from executor.wire import RecordWire, unpack_event

#: The rings are looked into, and a sign of life is given, this often, [s].
LOOK = 0.01
#: A process that was not told to move ends within this, [s]; drives may still be asked for a time.
END_TIMEOUT = 10.0


def run_in_real_time(
    prepared: PreparedRun,
    make_drives: MakeDrives,
    board: SharedBoard,
    recorder: Recorder,
    *,
    pose_every: int,
    need_real_time: bool,
    before_motion: Callable[[str], None],
) -> Outcome:
    """Moves along the path in a process of its own; ends with the drives holding by themselves.

    Args:
        prepared: The checked run.
        make_drives: Opens and configures the drives; called in that process; picklable.
        board: What the operator wants.
        recorder: Takes in what happens.
        pose_every: Cycles from one true pose of the simulated platform to the next; 0 for none.
        need_real_time: Refuse to arm when the system denies real-time scheduling.
        before_motion: Called when all is armed, with what was denied; what it raises prevents the
            motion.

    Raises:
        CdprError: The bus is latched, or the process could not arm the drives, for the reason told;
            nothing was enabled.
        StoppedByOperator: The operator wanted to stop before anything moved.
    """
    custody = Custody(prepared.rig)
    reference = custody.require_ready()
    course = course_of(prepared.checked)
    job = Job.of(
        course,
        board.memory,
        make_drives,
        pose_every=pose_every,
        loads=load_changes(prepared.scene, prepared.checked.table.stands),
        need_real_time=need_real_time,
        reference=reference,
    )
    process = _Process(job, board)
    try:
        denied = process.armed()
        custody.begin(recorder.folder.path, reference)
        try:
            before_motion(denied)
        except BaseException:
            custody.prevented()
            raise
        started = datetime.now(UTC)
        ended = process.supervise(recorder)
        try:
            custody.end(
                ended.state,
                ended.cause,
                recorder.folder.path,
                holding=ended.holding,
                stands_at=recorder.log.last_positions,
            )
        except CdprError as error:  # the motion is over: its record is finished all the same
            ended = process.not_kept(recorder, ended, error)
        return Outcome(ended.state, ended.cause, recorder.log, ended.holding, started)
    finally:
        process.close()
        job.close()


class _Process:
    def __init__(self, job: Job, board: SharedBoard) -> None:
        self._board = board
        self._wire = RecordWire(len(job.rig.winches))
        self._cycles, self._events = Ring(job.cycles, CYCLE_SLOTS), Ring(job.events, EVENT_SLOTS)
        context = multiprocessing.get_context("spawn")
        self._link, far_end = context.Pipe()
        self._process = context.Process(
            target=serve, args=(job, far_end, os.getpid()), name="cdpr-real-time", daemon=True
        )
        with one_thread(), interrupts_blocked():
            self._process.start()
        far_end.close()

    def armed(self) -> str:
        """Waits until the drives are armed; returns what the system denied.

        Raises:
            CdprError: They could not be, or the operator wants to stop.
        """
        while True:
            self._board.beat()
            if self._board.read().stop:
                raise StoppedByOperator("stopped before anything moved")
            if wait([self._link, self._process.sentinel], LOOK):
                said = self._heard()
                if isinstance(said, Armed):
                    return said.denied
                raise said.error if isinstance(said, Failed) else self._died()

    def supervise(self, recorder: Recorder) -> Ended:
        """Says go, and takes in what happens until the motion is over."""
        self._board.beat()
        with suppress(OSError):  # it died since it was armed, which is told below
            self._link.send(Go())
        said: object = None
        over = False
        while not over:
            over = bool(wait([self._link, self._process.sentinel], LOOK))
            self._board.beat()
            if over:
                said = self._heard()
            self._take_in(recorder)
        if isinstance(said, Ended):
            return said
        error = said.error if isinstance(said, Failed) else self._died()
        self._record(partial(recorder.take_event, _lost(recorder, error)))
        return Ended(State.LATCHED, error.what, holding=True)  # by themselves, as SYNC stays away

    def not_kept(self, recorder: Recorder, ended: Ended, error: CdprError) -> Ended:
        """The end of a motion whose latch or reference could not be written: it is a fault."""
        text = f"{error.what} ({error.where}: {error.why})"
        event = LoopEvent(len(recorder.log), recorder.last, "recorder", text)
        self._record(partial(recorder.take_event, event))
        return Ended(State.LATCHED, ended.cause or text, ended.holding)

    def close(self) -> None:
        """Waits for the process; whatever it does, it comes to rest and ends."""
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
            f"the real-time process ended without a word ({how}); the drives stop and hold by"
            " themselves as set-points stay away",
            where="real-time process",
            why="it was killed, or the system ran out of memory",
            next_step="look at the platform first; then start again from where it is",
        )

    def _take_in(self, recorder: Recorder) -> None:
        """Everything that was told since the last time; cycles first, they tell the time."""
        for content in self._cycles.take():
            self._record(partial(recorder.take_cycle, *self._wire.unpack(content)))
        for content in self._events.take():
            self._record(partial(recorder.take_event, unpack_event(content)))
        lost = self._cycles.lost + self._events.lost
        if lost:
            self._board.complain(f"{lost} records of the run were lost: they came too fast")

    def _record(self, take: Callable[[], None]) -> None:
        """A record that cannot be kept leads to a stop along the path, not to an end of care."""
        try:
            take()
        except CdprError as error:
            self._board.complain(f"what records the run failed: {error.what}")
        except Exception as error:
            self._board.complain(f"what records the run failed: {type(error).__name__}: {error}")


def _lost(recorder: Recorder, error: CdprError) -> LoopEvent:
    return LoopEvent(len(recorder.log), recorder.last, "real_time_lost", error.what)
