"""Recorder of cycles and events in memory and on disk; requests images."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drivers.factory import cycles_until_reported
from executor.recording.run_folder import RunEvent, RunFolder
from executor.recording.table_files import Integers
from executor.recording.tables import CycleTable, quaternions_of
from executor.remote.status import RunStatus
from executor.state_machine import ON_PATH, CycleRecord, LoopEvent, PlatformPoses, State
from executor.trajectory.dwell import legs_at, stop_events
from executor.trajectory.setpoints import CheckedTrajectory, PreparedRun
from model.errors import CdprError, Fault
from model.kinematics import forward_kinematics, interpolate_quaternions, poses_near
from model.pose import Array, Pose
from model.rig import Rig
from model.scene import Scene

# Log of a run's cycles in memory, and their table.

#: Cycles that are allocated at a time: 40 s at 10 ms.
_CHUNK = 4096
_STATES = tuple(State)

Cycles = NDArray[np.void]


class RunLog:
    """The cycles of one run, in the order in which they were sent; 80 MB an hour at 10 ms."""

    def __init__(self, rig: Rig, scene: Scene, checked: CheckedTrajectory) -> None:
        """An empty log for a run of a checked table."""
        self._rig, self._scene, self._checked = rig, scene, checked
        self._delay = cycles_until_reported(rig)
        self._fits_within = rig.motion.start_tolerance + rig.motion.following_error
        per_drive = (rig.cable_count,)
        self._format = np.dtype(
            [
                *((name, "f8") for name in ("at", "index", "lateness", "following_error")),
                *((name, "i4") for name in ("state", "missing", "rejected", "error_frames")),
                *((name, "i8", per_drive) for name in ("targets", "actual")),
                ("torques", "i4", per_drive),
                ("tension_known", "?", per_drive),
            ]
        )
        self._chunks: list[Cycles] = []
        self._count = 0
        self.last: CycleRecord | None = None
        """The last cycle; None before the first."""
        self.events: list[RunEvent] = []
        """All events, in order."""

    def add(self, record: CycleRecord) -> None:
        """Adds a cycle; takes almost no time."""
        row = self._count % _CHUNK
        if row == 0:
            self._chunks.append(np.empty(_CHUNK, self._format))
        self._chunks[-1][row] = self._packed(record)
        self._count += 1
        self.last = record

    def _packed(self, record: CycleRecord) -> tuple[object, ...]:
        state = _STATES.index(record.state)
        return tuple(
            state if name == "state" else getattr(record, name) for name in self._format.names or ()
        )

    def __len__(self) -> int:
        """Number of cycles."""
        return self._count

    def _cycles(self, first: int, end: int) -> Cycles:
        """Cycles from ``first`` up to ``end``."""
        parts = [
            self._chunks[k][max(first - k * _CHUNK, 0) : end - k * _CHUNK]
            for k in range(first // _CHUNK, -(-end // _CHUNK))
        ]
        return np.concatenate(parts) if parts else np.empty(0, self._format)

    def planned_pose(self, record: CycleRecord) -> Pose | None:
        """Planned pose in a cycle; None beside the path."""
        return self._checked.table.pose(round(record.index)) if record.state in ON_PATH else None

    def encoder_pose(self, record: CycleRecord) -> Pose | None:
        """Platform pose from the encoders in a cycle; None if the positions fit no pose."""
        cycle, row = np.array([self._packed(record)], self._format), round(record.index)
        lengths, _, most_off = self._lengths(cycle, np.array([row]))
        try:
            found = forward_kinematics(self._rig, lengths[0], self._checked.table.pose(row))
        except Fault:
            return None
        return found.pose if found.worst <= most_off[0] else None

    def table(self, first: int = 0, end: int | None = None) -> CycleTable:
        """The table of the run's cycles, or of those from ``first`` up to ``end``.

        May be called from another thread while cycles are added.
        """
        rig, planned = self._rig, self._checked.table
        cycles = self._cycles(first, self._count if end is None else end)
        began = self._chunks[0]["at"][0] if len(cycles) else 0.0
        index = self._reported_index(cycles, first)
        rows, low = np.rint(index).astype(np.int64), np.floor(index).astype(np.int64)
        high = np.minimum(low + 1, len(planned) - 1)
        starts, ends = (quaternions_of(planned.rotations[each]) for each in (low, high))
        lengths, tensions, most_off = self._lengths(cycles, rows)
        encoder, rotations, off = poses_near(
            rig, lengths, planned.positions[rows], planned.rotations[rows]
        )
        fits = off <= most_off  # else a cable is slack, slipped, or was wound in alone
        return CycleTable(
            cycle=np.arange(first, first + len(cycles)),
            time=cycles["at"] - began,
            state=tuple(_STATES[k].value for k in cycles["state"].tolist()),
            path_index=rows,
            leg=legs_at(planned.dwells, index),
            stop=tuple(self._stop_at(row) for row in rows.tolist()),
            travelled=between(planned.travelled, index),
            lateness=cycles["lateness"] * planned.cycle,
            missing=cycles["missing"].astype(np.int64),
            rejected=cycles["rejected"].astype(np.int64),
            error_frames=cycles["error_frames"].astype(np.int64),
            planned=between(planned.positions, index),
            planned_rotation=interpolate_quaternions(starts, ends, index - low),
            encoder=np.where(fits[:, None], encoder, np.nan),
            encoder_rotation=np.where(fits[:, None], quaternions_of(rotations), np.nan),
            following_error=cycles["following_error"].copy(),
            set_counts=cycles["targets"].copy(),
            actual_counts=cycles["actual"].copy(),
            lengths=lengths,
            planned_tensions=between(planned.tensions, index),
            tensions=tensions,
        )

    def _reported_index(self, cycles: Cycles, first: int) -> Array:
        """Table index whose set-points the drives followed when they reported their positions."""
        sent = np.asarray(cycles["index"], dtype=np.float64)
        if not self._delay:
            return sent
        before = self._cycles(first - 1, first)["index"] if first else [0.0]
        earlier = np.concatenate([before, sent[:-1]])[: len(cycles)]
        # A stop sends no further row; a bus fault leaves no record of the cycle that sent the last.
        return np.where(cycles["state"] == _STATES.index(State.LATCHED), sent, earlier)

    def _lengths(self, cycles: Cycles, rows: Integers) -> tuple[Array, Array, Array]:
        """Cable lengths, tensions where known, and how far lengths may be off a pose.

        Shapes (n, m), [m]; (n, m), [N]; and (n,), [m]. Tensions unlike the planned ones stretch the
        cables in ways that no pose has.

        Args:
            rows: Table rows of the set-points sent, shape (n,).
        """
        tensions, known = self._rig.tensions_by(cycles["torques"]), cycles["tension_known"]
        # A drive that follows, but did not answer, has its last torque and position.
        taut = known | np.isfinite(cycles["following_error"])[:, None]
        planned, winches = self._checked.table.tensions[rows], self._checked.winches
        unstrained = winches.unstrained_from_counts(cycles["actual"].astype(np.float64))
        lengths = winches.strained(unstrained, np.where(taut, tensions, planned))
        more_stretch = np.linalg.norm(lengths - winches.strained(unstrained, planned), axis=1)
        return lengths, np.where(known, tensions, np.nan), self._fits_within + more_stretch

    def _stop_at(self, row: int) -> str:
        """Name of the stop at which the platform dwells; empty between stops."""
        for stop, dwell in zip(self._scene.stops, self._checked.table.dwells, strict=True):
            if dwell.first <= row <= dwell.last:
                return stop.name
        return ""


def between(values: Array, index: ArrayLike) -> Array:
    """Rows of a table at one or several fractional indices."""
    index = np.asarray(index, dtype=np.float64)
    low = np.floor(index).astype(np.int64)
    high = np.minimum(low + 1, len(values) - 1)
    share = index - low
    if values.ndim > 1:
        share = share[..., None]
    mixed: Array = (1.0 - share) * values[low] + share * values[high]
    return mixed


# Writing of the record during a run, so that it survives a killed program.
#
# In real time a separate thread writes: neither the loop, which is another process, nor the reading
# of its reports waits for the disk. Writes are queued; a disk that is `BEHIND` seconds behind, full
# or gone causes a path stop. In simulated time the run waits for the disk.


#: Interval of appending cycles, [s]; a killed program loses at most twice that.
EVERY = 0.4
#: Largest delay of the disk, [s]: SD cards hang for a second or two.
BEHIND = 5.0
#: A longer time between two cycles, [s], is one in which the program was suspended.
_SUSPENDED = 2.0
#: Largest number of queued writes: the cycles of `BEHIND` seconds, and many events.
_MOST_WAITING = 512


class _Mark(NamedTuple):
    """How far the cycles are queued or written, and when [s], suspensions not counted.

    Replaced whole, as two threads read it.
    """

    end: int
    at: float


class RecordWriter:
    """Writer of one run's record; its thread, if any, ends with the block.

    Args:
        folder: Run folder.
        log: Of the cycles.
        own_thread: Write in a thread, and fsync.
    """

    def __init__(self, folder: RunFolder, log: RunLog, *, own_thread: bool) -> None:
        self._folder, self._log, self._own_thread = folder, log, own_thread
        self._queued = self._written = _Mark(0, 0.0)
        self._latest, self._suspended = 0.0, 0.0
        self._trouble: CdprError | None = None
        self._waiting: queue.SimpleQueue[Callable[[], object] | None] = queue.SimpleQueue()
        self._thread: threading.Thread | None = None
        if own_thread:
            self._thread = threading.Thread(target=self._write, name="cdpr-record", daemon=True)
            self._thread.start()

    def __enter__(self) -> RecordWriter:
        """Returns itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """See `close`."""
        self.close()

    def take_cycles(self, at: float) -> None:
        """Queues new cycles of the log, the last of which began at this time, [s].

        Raises:
            CdprError: The record cannot be written, or the disk is far behind.
        """
        gap, self._latest = at - self._latest, at
        if not self._queued.end:
            self._queued = self._written = _Mark(0, at)
        elif gap > _SUSPENDED:
            self._suspended += gap
        counted = at - self._suspended
        if gap > EVERY or counted - self._queued.at >= EVERY or not self._queued.end:
            self._queue_cycles(counted)

    def take_event(self, event: RunEvent) -> None:
        """Queues an event.

        Raises:
            CdprError: As for `take_cycles`.
        """
        self._put(partial(self._folder.append_event, event))

    def take_file(self, write: Callable[[], object]) -> None:
        """Queues a function that writes a file, behind all cycles so far.

        It is called also after an earlier failure, as there may be room for it.

        Raises:
            CdprError: The function raised it, and no thread writes.
        """
        with suppress(CdprError):
            self._queue_cycles(self._queued.at)
        if self._thread is None:
            write()
        else:
            self._waiting.put(write)

    @property
    def unwritten(self) -> int:
        """Number of the last cycles that are not written yet, or never will be."""
        return len(self._log) - self._written.end

    def close(self) -> None:
        """Writes the rest, and waits for it; never raises."""
        try:
            self._queue_cycles(self._queued.at)
        except CdprError as error:
            self._trouble = self._trouble or error
        if self._thread is not None:
            self._waiting.put(None)
            self._thread.join()
            self._thread = None

    def _queue_cycles(self, at: float) -> None:
        first = self._queued.end
        if len(self._log) == first:
            return
        self._queued = _Mark(len(self._log), at)
        self._put(partial(self._append, first))

    def _append(self, first: int) -> None:
        """Appends the cycles from this one on, those that were queued since included.

        Otherwise a disk that takes longer than `EVERY` for any write would fall behind for ever.
        """
        if first != self._written.end:  # written already, or not to be written: leave no gap
            return
        newest = self._queued
        table = self._log.table(first, newest.end)
        header = table.csv_header() if first == 0 else ""
        self._folder.append_cycles(header + table.csv_rows(), fsync=self._own_thread)
        self._written = newest

    def _put(self, write: Callable[[], None]) -> None:
        if self._trouble is not None:
            raise self._trouble
        if self._thread is None:
            write()
            return
        behind = self._queued.at - self._written.at
        if behind > BEHIND or self._waiting.qsize() >= _MOST_WAITING:
            self._trouble = Fault(
                f"the disk is {behind:.1f} s behind the run; the limit is {BEHIND:g} s",
                where=str(self._folder.path),
                why="it is too slow, or hangs",
                next_step="choose a run folder on another disk",
            )
            raise self._trouble
        self._waiting.put(write)

    def _write(self) -> None:
        while (write := self._waiting.get()) is not None:
            try:
                write()
            except CdprError as error:
                self._trouble = self._trouble or error
            except Exception as error:
                what = f"recording failed: {type(error).__name__}: {error}"
                self._trouble = self._trouble or Fault(what, where=str(self._folder.path))


#: Takes poses of the platform, and whether an image is due.
FrameTrigger = Callable[[PlatformPoses, bool], None]
#: Longest time between these, also where images are rarer: platforms move along curves, [s].
_BETWEEN_POSES = 0.1


class Recorder:
    """Records one run."""

    def __init__(
        self,
        prepared: PreparedRun,
        folder: RunFolder,
        status: RunStatus,
        *,
        trigger: FrameTrigger | None,
        every: int,
        progress: Callable[[float], None],
        announce: Callable[[str], None],
        on_event: Callable[[RunEvent], None] | None = None,
        own_thread: bool = False,
    ) -> None:
        """Starts without cycles and events.

        Args:
            folder: Takes cycles and events as they happen.
            status: Updated with cycles and events.
            trigger: Called for every image, and between rare ones.
            every: Cycles between images.
            progress: Called regularly with the number of completed rows.
            announce: Called with a sentence when a stop is reached and left.
            on_event: Called with each event, after it is recorded.
            own_thread: Write to disk in a thread, which `writer` ends.
        """
        self.log = RunLog(prepared.rig, prepared.scene, prepared.checked)
        self._announcements = stop_events(prepared.scene, prepared.checked.table.dwells)
        self._announce, self._on_event = announce, on_event
        self.folder = folder
        """Run folder."""
        self.writer = RecordWriter(folder, self.log, own_thread=own_thread)
        """Writes the record; the caller closes it."""
        self._status = status
        self._trigger, self._progress, self._every = trigger, progress, every
        most = max(_BETWEEN_POSES / prepared.checked.table.cycle + 1e-9, 1.0)
        divisors = (k for k in range(1, every + 1) if every % k == 0 and k <= most)
        self.pose_every = max(divisors) if trigger else 0
        """Cycles between poses of the platform; 0 without images."""
        self._began: float | None = None
        self.last = 0.0
        """Start of the last cycle, on the loop's clock, [s]."""
        self.state = State.READY
        """State of the run then."""

    def take_cycle(self, record: CycleRecord, true_pose: Pose | None) -> None:
        """Records a cycle.

        Args:
            true_pose: Of the simulated platform, in cycles with an image.

        Raises:
            CdprError: The record cannot be written; everything else is done.
        """
        if self._began is None:
            self._began = record.at
        self.last, self.state = record.at, record.state
        self.log.add(record)
        self._status.take_cycle(record)
        failure: CdprError | None = None
        if record.state in ON_PATH:
            for code, text in self._announcements.due(record.index):
                self._announce(text)
                try:
                    self.take_event(LoopEvent(record.cycle, record.at, code, text))
                except CdprError as error:
                    failure = failure or error
        if record.cycle % self._every == 0:
            self._progress(record.index)
        if self._trigger is not None and record.cycle % self.pose_every == 0:
            since, log = record.at - self._began, self.log
            known = true_pose, log.encoder_pose(record), log.planned_pose(record)
            is_due = record.cycle % self._every == 0
            self._trigger(PlatformPoses(since, record.at, *known), is_due)
        self.writer.take_cycles(record.at)
        if failure is not None:
            raise failure

    def take_event(self, event: LoopEvent) -> None:
        """Records an event; one from before the first cycle is at its time.

        Raises:
            CdprError: The record cannot be written; the event is still in log and status.
        """
        time = 0.0 if self._began is None else max(0.0, event.at - self._began)
        run_event = RunEvent(round(time, 6), event.code, event.text)
        self.log.events.append(run_event)
        self._status.take_event(run_event)
        try:
            self.writer.take_event(run_event)
        finally:
            if self._on_event is not None:
                self._on_event(run_event)
