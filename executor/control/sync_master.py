"""The only sender of SYNC, from the first reading of positions to the last SYNC.

While the program waits for anything else (an answer of the operator, a file, a camera), the
cycle continues, so that no drive loses its master. No drive is commanded to follow set-points
when the previous SYNC is too old (`executor.safety.monitor`): that is decided when a cycle begins
and again between its set-points and its SYNC, since this process may be suspended in between. If
it was suspended between that decision and the SYNC, a quick stop follows at once.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Sequence
from contextlib import suppress
from itertools import compress
from typing import TypeVar

import numpy as np

from drivers.drive_group import CycleStatus, DriveGroup, GroupCommand, GroupState
from drivers.factory import drive_flags, drive_states, stop_alone
from executor.realtime.scheduling import Clock
from executor.safety.fault_messages import name_drives
from executor.safety.monitor import MISSING_CYCLES
from executor.safety.sync_timeout import USUAL_TIMEOUT, SyncAge
from model.errors import CdprError, Fault, HardwareMissing, Refused
from model.rig import Rig

# Detection of silent drives where no monitor runs: before and after a motion.


class ReplyTimeout:
    """Counts consecutive cycles without an answer per drive; a time-out latches."""

    def __init__(self, rig: Rig) -> None:
        """A counter for the drives of a rig, before the first cycle."""
        self._names = tuple(rig.drive_names.values())
        self._cycles = [0] * rig.cable_count

    def take(self, status: CycleStatus) -> None:
        """Counts a cycle."""
        self._cycles = [
            n + 1 if is_missing else (n if n >= MISSING_CYCLES else 0)
            for n, is_missing in zip(self._cycles, status.missing.tolist(), strict=True)
        ]

    def require_none(self, doing: str, *, where: str, why: str, next_step: str) -> None:
        """Requires that no drive is silent.

        Args:
            doing: Phase for the message, as in "while the drives settled".
            where: As for every error.
            why: As for every error.
            next_step: As for every error.

        Raises:
            HardwareMissing: Drives fell silent; with their names.
        """
        gone = [
            name for name, n in zip(self._names, self._cycles, strict=True) if n >= MISSING_CYCLES
        ]
        if gone:
            which, cause = name_drives(gone, len(self._cycles))
            what = f"{which} stopped answering {doing}{cause}"
            raise HardwareMissing(what, where=where, why=why, next_step=next_step)


#: Drives hold within this time after a stop, [s]; those without a quick stop may take longer.
HOLD_TIMEOUT = 3.0
#: A drive that has not answered SYNC for this long is not waited for at the end, [s].
GIVEN_UP_AFTER = 0.5

Message = TypeVar("Message")


class SyncMaster:
    """Sends the cycles of one drive group.

    Attributes:
        group: The drives; others read and command it, only this class sends its cycles.
        clock: Real or simulated.
        rule: Limit on the age of the last SYNC.
        status: Last report of the drives; None before the first reading.
        sent: The frames of the last `exchange` were sent, whatever was found afterwards.
    """

    def __init__(self, rig: Rig, group: DriveGroup, clock: Clock) -> None:
        self.group, self.clock = group, clock
        timeout = group.capabilities.sync_timeout
        self.rule = SyncAge(USUAL_TIMEOUT if timeout is None else timeout)
        self.status: CycleStatus | None = None
        self.sent = False
        self._rig, self._cycle = rig, rig.cycle
        self._synced: float | None = None
        self._overdue = 0.0
        self._enabled_after: float | None = None  # time of the SYNC before one that enables, [s]

    @property
    def hold_timeout(self) -> float:
        """Longest time until all drives hold after a stop, [s]."""
        drives = self.group.capabilities
        return max(HOLD_TIMEOUT, 0.0 if drives.holds_on_quick_stop else drives.released_within)

    @property
    def age(self) -> float:
        """Age of the last SYNC, in cycles; 0 before the first."""
        return 0.0 if self._synced is None else (self.clock.now - self._synced) / self._cycle

    def begin(self) -> float:
        """Waits for the next cycle; returns its lateness, in cycles."""
        return self.clock.next_cycle()

    def exchange(self, targets: Sequence[int]) -> CycleStatus:
        """Sends the frames of the current cycle and takes the replies.

        Raises:
            Fault: The bus failed.
        """
        self._overdue, self._enabled_after, self.sent = 0.0, None, False
        self.group.send_cycle(targets, self._may_send_now)
        self.sent = True
        if self._enabled_after is not None:
            age = (self.clock.now - self._enabled_after) / self._cycle
            if not self.rule.may_enable(age):
                self._overdue = age
                self.stop_now()
        self.status = self.group.receive(self.clock.time_left())
        return self.status

    @property
    def overdue(self) -> float:
        """Age of the last SYNC [cycles] that turned this cycle into a stop; 0 otherwise."""
        return self._overdue

    def _may_send_now(self, enables: bool) -> bool:
        """Whether the SYNC may be sent now; called just before each one."""
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

    def require_no_fault(self) -> None:
        """Requires drives without a fault since their set-up, as last reported.

        Raises:
            Refused: There is one; with the drive and its cause.
        """
        if self.status is not None and self.status.state is GroupState.FAULT:
            raise Refused(
                "; ".join(text for _, text in self.status.faults),
                where="arming",
                why="this happened after the drives were set up",
                next_step="remove the cause, then run `cdpr reset RIG`; nothing was enabled",
            )

    def rest(self) -> CycleStatus:
        """One cycle with unchanged targets.

        Raises:
            Fault: The bus failed.
        """
        self.begin()
        return self.exchange(self.group.targets.tolist())

    def refresh(self) -> None:
        """Sends a cycle with unchanged targets if the last SYNC is a whole cycle old.

        On a slow computer, work between two cycles may take longer than one.

        Raises:
            Fault: The bus failed.
        """
        if self.age >= 1.0:
            self.rest()

    def cycle_until(self, poll: Callable[[], Message | None]) -> Message:
        """Sends cycles with unchanged targets until a message arrives; returns it.

        Args:
            poll: Called every cycle; returns None while there is no message.

        Raises:
            HardwareMissing: A drive fell silent.
            Fault: The bus failed.
        """
        silence = ReplyTimeout(self._rig)
        while (message := poll()) is None:
            silence.take(self.rest())
            silence.require_none(
                "before the motion began",
                where="arming",
                why="it lost power or the bus",
                next_step="check power and wiring, then start again; nothing was enabled",
            )
        return message

    def leave(self, cycle: Callable[[], bool]) -> CycleStatus:
        """Ends the cycle in order; the drives hold on their own or by command.

        Their monitoring of this master is switched off while SYNC continues, heartbeat first, SYNC
        last. Then SYNC and heartbeat cease, and the state of every drive is read again; where
        monitoring could not be switched off, only after its time-out.

        Args:
            cycle: Sends one cycle; returns False to send no more.

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
        return self.read_state()

    def read_state(self) -> CycleStatus:
        """Reads the state of every drive without SYNC; see `DriveGroup.read_state`.

        Raises:
            Fault: The bus failed.
        """
        self._synced = None

        def pace() -> float:
            self.clock.next_cycle()
            return self.clock.time_left()

        self.status = self.group.read_state(pace)
        return self.status

    def leave_disabled(self) -> None:
        """Ends the cycle for drives that were never enabled; ignores bus failures."""

        def cycle() -> bool:
            self.rest()
            return True

        with suppress(CdprError):
            self.leave(cycle)


def changed_states(
    rig: Rig, before: CycleStatus, after: CycleStatus, excluded: Collection[int] = ()
) -> str:
    """Names the drives that are enabled or changed their state at the end; empty if none did.

    Args:
        before: Status before monitoring was ended.
        after: Status after the last SYNC.
        excluded: Drives, from 0, whose state is already reported: only named while still enabled.
    """
    rows = zip(
        rig.drive_names.values(),
        drive_states(rig, before.status_words.tolist()),
        drive_states(rig, after.status_words.tolist()),
        after.missing.tolist(),
        drive_flags(rig, after.status_words.tolist()),
        strict=True,
    )
    changed, still = [], []
    for drive, (name, old, new, silent, flags) in enumerate(rows):
        if flags.torque == "enabled" and not silent and (old == new or drive in excluded):
            still.append(name)
        elif (silent or old != new) and drive not in excluded:
            what = "does not answer" if silent else f"went from {old} to {new}"
            changed.append(f"{name} {what}")
    found = [f"drives still enabled: {', '.join(still)}"] if still else []
    if changed:
        found.append(f"drives left the state they held in: {', '.join(changed)}")
    return "; ".join(found)


def lost_states(
    rig: Rig, before: CycleStatus, after: CycleStatus, held: Collection[int], cause: str
) -> str:
    """Names the drives that may not hold after a stop, as their states show; empty for none.

    They are still enabled, hold no longer, or do not answer.

    Args:
        before: As for `changed_states`.
        after: As for `changed_states`.
        held: Nodes of the drives that have held their cables at some time.
        cause: Of the stop; what it states of a drive is not repeated.
    """
    words = before.status_words.tolist(), after.status_words.tolist()
    before_holds, holds = (stop_alone(rig, each) for each in words)
    was_enabled, is_enabled = (
        [flags.torque == "enabled" for flags in drive_flags(rig, each)] for each in words
    )
    states = drive_states(rig, words[1])
    excluded, released = [], []
    for drive, (node, name) in enumerate(rig.drive_names.items()):
        if after.missing[drive]:
            if node not in held or _is_silent_in(cause, name, rig):
                excluded.append(drive)
            continue
        faults = [text for at, text in after.faults if at == node]
        unknown = [text for text in faults if text not in cause]
        is_known = holds[drive] or node not in held or f"{name} went from" in cause
        if is_known or is_enabled[drive]:
            excluded.append(drive)  # one that is still enabled is named nevertheless
        elif not (before_holds[drive] or was_enabled[drive]):
            excluded.append(drive)
            released += unknown if faults else [f"{name} is in {states[drive]}"]
    changed = changed_states(rig, before, after, excluded)
    return "; ".join([*released, *([changed] if changed else [])])


def _is_silent_in(cause: str, name: str, rig: Rig) -> bool:
    """Whether a cause states that this drive did not answer, or that none did."""
    everyone, _ = name_drives(names := [*rig.drive_names.values()], len(names))
    clauses = [part.partition(" did not answer for ") for part in cause.split("; ")]
    silent = [subject for subject, verb, _ in clauses if verb]
    return f"{name} does not answer" in cause or any(
        name in subject or everyone in subject for subject in silent
    )


def hold_timeout_text(
    rig: Rig, status: CycleStatus | None, within: float, *, was_enabled: bool
) -> str:
    """States that drives did not hold within a time: which, and which replies are missing.

    Args:
        status: Of the last cycle.
        within: The time, [s].
        was_enabled: Of all drives; otherwise each that follows no set-points has stopped.
    """
    texts = [f"the drives did not hold within {within:.3g} s"]
    if status is not None:
        words, names = status.status_words.tolist(), tuple(rig.drive_names.values())
        ended = (
            stop_alone(rig, words)
            if was_enabled
            else [flags.torque != "enabled" for flags in drive_flags(rig, words)]
        )
        rows = zip(names, drive_states(rig, words), ended, strict=True)
        texts += [f"{name} is in {state}" for name, state, has_ended in rows if not has_ended]
        if silent := list(compress(names, status.missing.tolist())):
            texts.append(f"no reply from {', '.join(silent)} in the last cycle")
    return "; ".join(texts)


def late_fault(age: float) -> Fault:
    """Fault of a late cycle outside a motion along a path."""
    return Fault(
        f"a cycle began {age - 1.0:.1f} cycles late",
        where="executor",
        why="another program held the processor; the drives may have stopped on their own",
        next_step="run `cdpr doctor RIG` for real-time scheduling, then `cdpr reset RIG`",
    )
