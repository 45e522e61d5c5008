"""Takes in what the loop tells of a run: cycles to the log, events to the disk, pictures asked."""

from __future__ import annotations

from collections.abc import Callable

from cdpr.poses import Pose
from executor.announcing import announcements
from executor.machine import ON_PATH
from executor.prepare import PreparedRun
from executor.records import CycleRecord, LoopEvent
from executor.run_folder import RunEvent, RunFolder
from executor.run_log import RunLog
from executor.status import RunStatus

#: Asks for a picture: time since the start of the run [s], the same moment on the monotonic clock
#: [s], where the simulated platform is then, and where the drives' positions put it.
Trigger = Callable[[float, float, Pose | None, Pose | None], None]


class Recorder:
    """The record of one run while it goes on."""

    def __init__(
        self,
        prepared: PreparedRun,
        folder: RunFolder,
        status: RunStatus,
        *,
        trigger: Trigger | None,
        every: int,
        progress: Callable[[float], None],
        announce: Callable[[str], None],
    ) -> None:
        """Nothing happened yet.

        Args:
            prepared: What is run.
            folder: Where events are written as they happen.
            status: Kept up to date for those who ask.
            trigger: Called for every picture.
            every: Cycles from one picture to the next.
            progress: Called now and then with the number of rows that are done.
            announce: Told in a sentence when a stop is reached and left.
        """
        self.log = RunLog(prepared.rig, prepared.scene, prepared.checked)
        self._announcements = announcements(prepared.scene, prepared.checked.table.stands)
        self._announce = announce
        self.folder = folder
        """Where events are written."""
        self._status = status
        self._trigger, self._progress = trigger, progress
        self.every = every
        """Cycles from one picture to the next."""
        self._began: float | None = None
        self.last = 0.0
        """When the last cycle began, on the loop's clock, [s]."""

    def wants_pose(self, cycle: int) -> bool:
        """Whether a picture will be asked for in this cycle."""
        return self._trigger is not None and cycle % self.every == 0

    def take_cycle(self, record: CycleRecord, true_pose: Pose | None) -> None:
        """A cycle is over.

        Args:
            record: What happened in it.
            true_pose: Where the simulated platform is, in cycles with a picture.
        """
        if self._began is None:
            self._began = record.at
        self.last = record.at
        self.log.add(record)
        self._status.take_cycle(record)
        if record.state in ON_PATH:
            for code, text in self._announcements.due(record.index):
                self.take_event(LoopEvent(record.cycle, record.at, code, text))
                self._announce(text)
        if record.cycle % self.every:
            return
        self._progress(record.index)
        if self._trigger is not None:
            by_drives = self.log.pose_by_drives(record)
            self._trigger(record.at - self._began, record.at, true_pose, by_drives)

    def take_event(self, event: LoopEvent) -> None:
        """Something happened; it is on disk when this returns.

        Raises:
            Fault: The disk is full or gone.
        """
        time = 0.0 if self._began is None else event.at - self._began
        told = RunEvent(round(time, 6), event.code, event.text)
        self._status.take_event(told)
        self.folder.append_event(told)
