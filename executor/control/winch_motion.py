"""One winch motion without a path, from the first cycle to its record."""

from __future__ import annotations

import json
import os
import shutil
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass, replace
from itertools import compress
from pathlib import Path

import numpy as np

from drivers.drive_group import CycleStatus
from drivers.factory import may_have_released, without_torque
from executor.control.cycle import SETTLING
from executor.interlock.fault_latch import AFTER_A_FAULT
from executor.interlock.interlock import MotionInterlock
from executor.interlock.reference import HomingReference
from executor.realtime.child import Armed, Ended, Records
from executor.realtime.process import Mover
from executor.recording.run_folder import EVENTS, WINCHES
from executor.state_machine import CycleRecord, LoopEvent, State
from model.errors import BadInput, CdprError, Fault
from model.pose import Array, Pose
from model.rig import Rig

#: Drives that hold move by no more than this share of the rig's start tolerance.
HELD_SHARE = 0.1

_CUT_SHORT = Ended(State.LATCHED, "the program was terminated", holding=True, true_pose=None)


@dataclass(frozen=True, slots=True, eq=False)
class WinchResult:
    """Result of a winch motion.

    Attributes:
        state: Final state.
        cause: Why it did not finish, if it did not.
        began: Drive positions before it, shape (m,), [counts].
        counts: Drive positions at rest, shape (m,), [counts]; NaN if unknown.
        tensions: From the drive torques at rest, shape (m,), [N]; NaN if unknown.
        folder: Of its record, as an absolute path; None without one.
    """

    state: State
    cause: str
    began: Array
    counts: Array
    tensions: Array
    folder: Path | None = None


AtRest = Callable[[WinchResult, Pose | None], HomingReference | None]
"""Called after a finished motion, while the drives are locked, with its result and the true pose of
the simulated platform; the reference it returns is kept if the drives held throughout."""


def nothing_at_rest(_result: WinchResult, _true_pose: Pose | None) -> None:
    """Takes no reference; an `AtRest`."""


def require_held(rig: Rig, result: WinchResult, found: CycleStatus) -> None:
    """Requires the drives to hold at the positions where the motion ended.

    Args:
        found: Present status of the drives.

    Raises:
        Fault: A drive moved, or does not hold.
    """
    per_metre = np.array([winch.counts_per_metre for winch in rig.winches])
    moved = np.abs((found.positions - result.counts) / per_metre)
    worst = int(moved.argmax())
    name = list(rig.drive_names.values())[worst]
    if not moved[worst] <= HELD_SHARE * rig.motion.start_tolerance:
        what = f"{name} moved by {moved[worst] * 1000:.2f} mm after all winches were at rest"
    elif found.faults:
        what = "; ".join(text for _, text in found.faults)
    elif found.missing.any():
        silent = compress(rig.drive_names.values(), found.missing.tolist())
        what = f"{', '.join(silent)}: no answer after all winches were at rest"
    elif not found.holding:
        what = "not all drives still hold"
    else:
        return
    raise Fault(
        what,
        where="winches",
        why="a drive released, slipped or was moved by hand; counts and pose do not match",
        next_step=AFTER_A_FAULT,
    )


class _LastCycles:
    """Forwards records, and keeps the last cycles with the winches at rest."""

    def __init__(self, records: Records) -> None:
        self._records = records
        self.cycles: deque[CycleRecord] = deque(maxlen=SETTLING)

    def take_cycle(self, record: CycleRecord, true_pose: Pose | None) -> None:
        settling = record.state is State.SECURING and not np.isfinite(record.following_error)
        if not (self.cycles and settling):
            self.cycles.append(record)
        self._records.take_cycle(record, true_pose)

    def take_event(self, event: LoopEvent) -> None:
        self._records.take_event(event)

    def report_event(self, code: str, text: str) -> None:
        """Records an event after the last cycle; the caller raises or returns it as well."""
        cycle, at = (self.cycles[-1].cycle, self.cycles[-1].at) if self.cycles else (0, 0.0)
        with suppress(CdprError):  # a full disk must not change the outcome
            self._records.take_event(LoopEvent(cycle, at, code, text))


def move_winches(
    mover: Mover,
    rig: Rig,
    interlock: MotionInterlock,
    records: Records,
    *,
    record: Path,
    rehome: bool,
    at_rest: AtRest,
) -> WinchResult:
    """Moves by a law; always ends with the drives holding on their own.

    Args:
        mover: Moves the winches, in this process or in its own.
        rig: The robot as in its file.
        interlock: Of that rig.
        records: Takes cycles and events.
        record: Path that the latch names if the motion does not finish.
        rehome: The drives must be homed again afterwards.
        at_rest: See `AtRest`.

    Raises:
        Refused: The bus is latched, or the drives are not where the law begins; nothing was
            enabled.
        HardwareMissing: A drive does not answer.
        StoppedByOperator: A stop was requested before anything moved.
        CdprError: The drives did not hold or answer after the motion; the fault is latched.
    """
    interlock.require_free()
    last = _LastCycles(records)
    armed = mover.arm(last)
    if armed.denied:
        last.take_event(LoopEvent(0, 0.0, "no_real_time", armed.denied))
    interlock.found_at_rest(armed.positions, armed.restarted, armed.released)
    interlock.begin(record, interlock.still_counts(armed.positions), rehome=rehome)
    ended, found = _CUT_SHORT, None
    try:
        ended = mover.run()
        result = _result(rig, armed.positions, ended, last.cycles)
        if result.state is State.FINISHED:
            reference = at_rest(result, ended.true_pose)
            try:
                found = mover.read_status()
                require_held(rig, result, found)
            except CdprError as error:
                ended = _not_held(rig, ended, found, error.what)
                last.report_event("not_held", error.what)
                raise
            if reference is not None:
                interlock.take(reference)
    finally:
        left = _last_state(rig, armed, ended, last.cycles, found)
        not_recorded = _record_end(interlock, ended, record, *left)
    if not_recorded:
        last.report_event("recorder", not_recorded)
        result = replace(result, state=State.LATCHED, cause=result.cause or not_recorded)
    return result


def _result(
    rig: Rig, began: Sequence[int], ended: Ended, last: Sequence[CycleRecord]
) -> WinchResult:
    unknown = [np.full(rig.cable_count, np.nan)]
    torques = np.array([cycle.torques for cycle in last] or unknown, dtype=np.float64)
    counts = np.array([cycle.actual for cycle in last] or unknown, dtype=np.float64)
    tensions = rig.tensions_by(torques.mean(axis=0))
    before = np.array(began, dtype=np.float64)
    return WinchResult(ended.state, ended.cause, before, counts.mean(axis=0), tensions)


def _not_held(rig: Rig, ended: Ended, found: CycleStatus | None, cause: str) -> Ended:
    """The end of a finished motion after which drives were found faulty."""
    # All held when they last answered, but without power only a brake holds.
    silent = [True] * rig.cable_count if found is None else found.missing.tolist()
    held = ended.holding if found is None else found.holding
    holding = held and not may_have_released(rig, silent)
    return replace(ended, state=State.LATCHED, cause=cause, holding=holding)


def _last_state(
    rig: Rig,
    armed: Armed,
    ended: Ended,
    last: Sequence[CycleRecord],
    found: CycleStatus | None,
) -> tuple[Sequence[int] | None, Sequence[int]]:
    """Last known positions [counts] of the drives, None if unknown; and nodes without torque."""
    if found is not None:
        return found.positions.tolist(), without_torque(rig, found.status_words.tolist())
    if last:
        return last[-1].actual, without_torque(rig, last[-1].words)
    return (None, ()) if ended is _CUT_SHORT else (armed.positions, armed.released)


def _record_end(
    interlock: MotionInterlock,
    ended: Ended,
    record: Path,
    positions: Sequence[int] | None,
    released: Sequence[int],
) -> str:
    """Records the end in the interlock; returns why that failed, else nothing."""
    try:
        interlock.end(
            ended.state,
            ended.cause,
            record,
            holding=ended.holding,
            positions=positions,
            released=released,
        )
    except CdprError as error:
        return f"{error.what} ({error.where}: {error.why})"
    return ""


# Record of a winch motion without a path: a folder with its events and cycles.
#
# ``events.jsonl`` is as in a run folder. ``winches.csv`` has one row a cycle: ``cycle``,
# ``time_s``, ``state``, and per cable ``set_counts_K``, ``counts_K`` and ``torque_per_mille_K`` (of
# rated torque, positive where it pulls the cable in). Both are written during the motion: they
# survive a killed program, and a power cut except for about the last second.


FSYNC_EVERY = 1.0
"""Interval at which a thread forces both files to disk, [s]."""


class _RecordFile:
    """An unbuffered file of lines: closing it has nothing left to write."""

    def __init__(self, path: Path) -> None:
        self._path, self._failed = path, ""
        self._stream = path.open("wb", buffering=0)

    def add(self, line: str) -> None:
        """Appends a line; after a failure, which may leave a partial line, none.

        Raises:
            Fault: The disk is full or gone.
        """
        try:
            data = memoryview(f"{line}\n".encode())
            while data and not self._failed:
                data = data[self._stream.write(data) :]
        except OSError as error:
            self._failed = error.strerror or str(error)
        if self._failed:
            raise Fault(
                f"{self._path.name} cannot be written: {self._failed}",
                where=str(self._path),
                next_step="free some space or choose another folder",
            )

    def fsync(self) -> None:
        """Forces the content to disk."""
        try:
            os.fsync(self._stream.fileno())
        except OSError as error:
            self._failed = self._failed or error.strerror or str(error)

    def close(self) -> None:
        """Closes the file; never raises."""
        with suppress(OSError):
            self._stream.close()


class WinchRecord:
    """Record of one motion; make one with `recording`.

    Attributes:
        folder: Its path.
        cycles: Number of recorded cycles.
        events: Number of recorded events.
    """

    def __init__(
        self, folder: Path, events: _RecordFile, winches: _RecordFile, flusher: ThreadPoolExecutor
    ) -> None:
        """Uses open files and a flushing thread, which the caller closes."""
        self.folder, self.cycles, self.events = folder, 0, 0
        self._events, self._winches, self._flusher = events, winches, flusher
        self._began = float("inf")  # until there is a cycle
        self._flushed, self._flushing = float("-inf"), Future[None]()
        self._flushing.set_result(None)

    def take_cycle(self, record: CycleRecord) -> None:
        """Records a cycle.

        Raises:
            Fault: The disk is full or gone.
        """
        self.cycles += 1
        if self.cycles == 1:
            self._began = record.at
            columns = ("set_counts", "counts", "torque_per_mille")
            cables = range(1, len(record.actual) + 1)
            names = [f"{column}_{cable}" for column in columns for cable in cables]
            self._winches.add(f"cycle,time_s,state,{','.join(names)}")
        numbers = (*record.targets, *record.actual, *record.torques)
        row = (record.cycle, f"{self._time(record.at):.6f}", record.state.value, *numbers)
        self._winches.add(",".join(map(str, row)))
        if record.at - self._flushed >= FSYNC_EVERY and self._flushing.done():
            self._flushed = record.at
            self._flushing = self._flusher.submit(self._flush)

    def take_event(self, event: LoopEvent) -> None:
        """Records an event.

        Raises:
            Fault: The disk is full or gone.
        """
        self.events += 1
        row = {"time_s": round(self._time(event.at), 6), "code": event.code, "text": event.text}
        self._events.add(json.dumps(row, ensure_ascii=False))

    def _flush(self) -> None:
        self._winches.fsync()
        self._events.fsync()

    def _time(self, at: float) -> float:
        """Time since the first cycle, [s]; 0 before it."""
        return max(0.0, at - self._began)


@contextmanager
def recording(folder: Path) -> Iterator[WinchRecord]:
    """Makes the folder; removes it again if the block is refused before it recorded anything.

    Raises:
        BadInput: It cannot be made.
    """
    with ExitStack() as files:
        try:
            folder.mkdir(parents=True)
            events = files.enter_context(closing(_RecordFile(folder / EVENTS)))
            winches = files.enter_context(closing(_RecordFile(folder / WINCHES)))
        except OSError as error:
            raise BadInput(
                "the record of the motion cannot be written",
                where=str(folder),
                why=error.strerror or str(error),
                next_step="change to a writable folder; nothing was moved",
            ) from None
        flusher = files.enter_context(ThreadPoolExecutor(1, "cdpr-record"))
        record = WinchRecord(folder, events, winches, flusher)
        try:
            yield record
        except CdprError:
            if record.cycles == record.events == 0:
                shutil.rmtree(folder, ignore_errors=True)
            raise
