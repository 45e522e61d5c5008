"""The one sender of SYNC: it keeps the cycle from the first reading of positions to the last SYNC.

Whatever else is waited for (the operator's word, a file on disk, a camera), the cycle goes on, so
that no drive loses its master. No drive is commanded to follow set-points when the SYNC before is
too old (`executor.safety.monitor`): that is decided when a cycle begins and once more between its
set-points and its SYNC, since this process may be suspended in between. Where it was suspended
between that decision and the SYNC, a quick stop follows at once.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Sequence
from contextlib import suppress
from typing import TypeVar

import numpy as np

from drivers.drive_group import CycleStatus, DriveGroup, GroupCommand
from drivers.factory import drive_states
from executor.realtime.scheduling import Clock
from executor.safety.monitor import MISSING_CYCLES, USUAL_TIMEOUT, SyncAge
from executor.state_machine import together
from model.errors import CdprError, Fault, HardwareMissing
from model.rig import Rig

# Which drives fell silent where no watch looks at them: around a motion, not in it.


class ReplyTimeout:
    """Counts, for each drive, the cycles in a row without an answer; too many stay too many."""

    def __init__(self, rig: Rig) -> None:
        """Of the drives of a rig, before the first cycle."""
        self._names = tuple(rig.drive_names.values())
        self._cycles = [0] * rig.cable_count

    def take(self, status: CycleStatus) -> None:
        """Counts a cycle."""
        self._cycles = [
            n + 1 if is_missing else (n if n >= MISSING_CYCLES else 0)
            for n, is_missing in zip(self._cycles, status.missing.tolist(), strict=True)
        ]

    def require_none(self, doing: str, *, where: str, why: str, next_step: str) -> None:
        """All drives were heard.

        Args:
            doing: What was going on, as in "while the drives settled".
            where: As of every error.
            why: Likewise.
            next_step: Likewise.

        Raises:
            HardwareMissing: Drives fell silent; with their names.
        """
        gone = [
            name for name, n in zip(self._names, self._cycles, strict=True) if n >= MISSING_CYCLES
        ]
        if gone:
            which, cause = together(gone, len(self._cycles))
            what = f"{which} stopped answering {doing}{cause}"
            raise HardwareMissing(what, where=where, why=why, next_step=next_step)


#: Without any answer to SYNC for so long a drive is not waited for at the end, [s].
GIVEN_UP_AFTER = 0.5

Word = TypeVar("Word")


class SyncMaster:
    """Keeps the cycle of one drive group.

    Attributes:
        group: The drives; others read from it and command it, and only this sends its cycles.
        clock: Real or simulated.
        rule: How old the last SYNC may be.
        status: What the drives reported last; None before the first reading.
    """

    def __init__(self, rig: Rig, group: DriveGroup, clock: Clock) -> None:
        """Takes configured drives; nothing is sent yet."""
        self.group, self.clock = group, clock
        timeout = group.capabilities.sync_timeout
        self.rule = SyncAge(USUAL_TIMEOUT if timeout is None else timeout)
        self.status: CycleStatus | None = None
        self._rig, self._cycle = rig, rig.cycle
        self._synced: float | None = None
        self._overdue = 0.0
        self._enabled_after: float | None = None  # SYNC before one that enables, [s] of the clock

    @property
    def age(self) -> float:
        """Of the last SYNC, in cycles; 0 before the first one."""
        return 0.0 if self._synced is None else (self.clock.now - self._synced) / self._cycle

    def begin(self) -> float:
        """Waits for the next cycle; how late it begins, in cycles."""
        return self.clock.next_cycle()

    def exchange(self, targets: Sequence[int]) -> CycleStatus:
        """Sends this cycle's frames and takes the replies; the cycle has begun.

        Raises:
            Fault: The bus failed.
        """
        self._overdue, self._enabled_after = 0.0, None
        self.group.send_cycle(targets, self._may_send_now)
        if self._enabled_after is not None:
            age = (self.clock.now - self._enabled_after) / self._cycle
            if not self.rule.may_enable(age):
                self._overdue = age
                self.stop_now()
        self.status = self.group.receive(self.clock.time_left())
        return self.status

    @property
    def overdue(self) -> float:
        """Age of the last SYNC [cycles] that made this cycle a stop; 0 when it is none."""
        return self._overdue

    def _may_send_now(self, enables: bool) -> bool:
        """Asked just before every SYNC."""
        before, age, self._synced = self._synced, self.age, self.clock.now
        if not enables:
            return True
        if self.rule.may_enable(age):
            self._enabled_after = before
            return True
        self._overdue = age
        return False

    def stop_now(self) -> None:
        """Sends the stop to all drives in one batch; see `DriveGroup.quick_stop_now`."""
        self._synced = self.clock.now
        self.group.quick_stop_now()

    def read_positions(self) -> CycleStatus:
        """Cycles until every drive has reported its position; see `DriveGroup.read_positions`.

        Raises:
            HardwareMissing: A drive does not answer; with its node.
            Fault: The bus failed.
        """

        def pace() -> float:
            self.begin()
            self._synced = self.clock.now
            return self.clock.time_left()

        self.status = self.group.read_positions(pace)
        return self.status

    def rest(self) -> CycleStatus:
        """One cycle in which drives stay as they are.

        Raises:
            Fault: The bus failed.
        """
        self.begin()
        return self.exchange(self.group.targets.tolist())

    def freshen(self) -> None:
        """A cycle in which drives stay as they are, where the last SYNC is a whole cycle old.

        What has to be done between two cycles may take longer than one on a slow computer.

        Raises:
            Fault: The bus failed.
        """
        if self.age >= 1.0:
            self.rest()

    def keep_until(self, heard: Callable[[], Word | None]) -> Word:
        """Cycles, with the drives as they are, until something is heard.

        Args:
            heard: Asked every cycle; None as long as there is nothing.

        Raises:
            HardwareMissing: A drive fell silent.
            Fault: The bus failed.
        """
        silence = ReplyTimeout(self._rig)
        while (word := heard()) is None:
            silence.take(self.rest())
            silence.require_none(
                "before the motion began",
                where="arming",
                why="it lost power or the bus",
                next_step="check power and wiring, then start again; nothing was enabled",
            )
        return word

    def leave(self, cycle: Callable[[], bool]) -> CycleStatus:
        """The ordered end, with drives that hold on their own or by command.

        Their monitoring of this master is switched off while SYNC goes on, heartbeat first and SYNC
        last. Then SYNC and heartbeat cease, and every drive is asked for its state once more; where
        a monitoring could not be switched off, only after its time-out is over.

        Args:
            cycle: Does one cycle; false when no further one is wanted.

        Returns:
            What the drives report after the last SYNC.

        Raises:
            Fault: The bus failed.
        """
        self.group.command(GroupCommand.END_MONITORING)
        given_up = round(GIVEN_UP_AFTER / self._cycle)
        silent = np.zeros(self._rig.cable_count, dtype=np.int64)
        for _ in range(round(self.group.capabilities.unmonitored_within / self._cycle)):
            if all(silent[drive] >= given_up for drive in self.group.ending) or not cycle():
                break
            if self.status is not None:
                silent = np.where(self.status.missing, silent + 1, 0)
        if self.group.is_monitored:
            for _ in range(math.ceil(self.group.capabilities.master_timeout / self._cycle) + 1):
                self.clock.next_cycle()
        return self.look()

    def look(self) -> CycleStatus:
        """Asks every drive how it stands, without SYNC; see `DriveGroup.read_state`.

        Raises:
            Fault: The bus failed.
        """
        self._synced = None

        def pace() -> float:
            self.clock.next_cycle()
            return self.clock.time_left()

        self.status = self.group.read_state(pace)
        return self.status

    def leave_unmoved(self) -> None:
        """The ordered end of drives that were never enabled; a bus that fails is left as it is."""

        def cycle() -> bool:
            self.rest()
            return True

        with suppress(CdprError):
            self.leave(cycle)


def left_otherwise(
    rig: Rig, before: CycleStatus, after: CycleStatus, but: Collection[int] = ()
) -> str:
    """Which drives report another state after the last SYNC than before it; empty when none does.

    Args:
        rig: The robot.
        before: What the drives reported before they were left.
        after: What they reported after the last SYNC.
        but: Drives, from 0, that are left out: what became of them is known.
    """
    rows = zip(
        rig.drive_names.values(),
        drive_states(rig, before.status_words.tolist()),
        drive_states(rig, after.status_words.tolist()),
        after.missing.tolist(),
        strict=True,
    )
    changed = [
        f"{name} {'does not answer' if silent else f'went from {old} to {new}'}"
        for drive, (name, old, new, silent) in enumerate(rows)
        if (silent or old != new) and drive not in but
    ]
    return f"drives left the state they held in: {', '.join(changed)}" if changed else ""


def late_fault(age: float) -> Fault:
    """A cycle that could not be sent in time, outside a motion along a path."""
    return Fault(
        f"a cycle began {age - 1.0:.1f} cycles late",
        where="executor",
        why="another program held the processor; the drives may have stopped on their own",
        next_step="run `cdpr doctor RIG` for real-time scheduling, then `cdpr reset RIG`",
    )
