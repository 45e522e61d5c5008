"""Monitors the drives' reports and decides when, and how, the rig must stop."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from executor.safety import fault_messages
from executor.safety.fault_messages import Alarm
from executor.safety.sync_timeout import LATE_AGE, SyncAge

#: Consecutive missing replies that are a fault.
MISSING_CYCLES = 2
#: Missing replies of one drive, and the number of its last ones among which they are a fault. CAN
#: repeats disturbed frames: a sound bus loses hardly any reply. Of 2 % lost at random, 10 of 50 are
#: missing less than once in ten million cycles. More of them are a defect, as a loose connector or
#: a busy computer, and limits on errors and tensions are then checked too seldom.
LOST_REPLIES, REPLY_WINDOW = 10, 50


@dataclass(frozen=True, slots=True)
class MonitorLimits:
    """Limits of the monitor.

    Attributes:
        following_error: Cable length, [m].
        min_tension: Slack below this, [N].
        max_tension: Over-tension above this, [N].
        no_tension: Below this a cable is broken or slack, [N].
        slack_cycles: Consecutive cycles of slack or over-tension that cause an alarm.
        loose_cycles: Consecutive cycles without tension that cause an alarm.
        missing_cycles: Consecutive missing replies that cause a quick stop.
        lost_replies: Missing replies of a drive among its last `REPLY_WINDOW` that cause a path
            stop.
        late_periods: Lateness, in cycles, that causes a path stop.
        may_disarm: Whether drives disarm before they report it, so that cables lose their tension.
        gone_periods: Lateness, in cycles, after which drives may have stopped on their own for
            lack of SYNC: no set-point may follow. See `SyncAge`.
    """

    following_error: float
    min_tension: float
    max_tension: float
    no_tension: float
    slack_cycles: int = 5
    loose_cycles: int = 3
    missing_cycles: int = MISSING_CYCLES
    lost_replies: int = LOST_REPLIES
    late_periods: float = LATE_AGE - 1.0
    gone_periods: float = SyncAge().limit - 1.0
    may_disarm: bool = False


@dataclass(frozen=True, slots=True)
class Observation:
    """The replies of one cycle; one entry per drive.

    Attributes:
        following: Whether the drives follow their set-points; otherwise following errors and
            tensions are not judged.
        following_errors: Signed, in cable length, [m].
        tensions: From the drives' torque, [N].
        missing: True where a drive did not answer.
        faults: Reported faults: number of the drive, from 1, or 0 for the bus, and the text.
        lateness: How late the cycle began, in cycles.
        warnings: Reported by drives that stay enabled: number of the drive, from 1, and the text.
    """

    following: bool
    following_errors: Sequence[float]
    tensions: Sequence[float]
    missing: Sequence[bool]
    faults: Sequence[tuple[int, str]]
    lateness: float
    warnings: Sequence[tuple[int, str]] = ()


@dataclass(frozen=True, slots=True)
class ReplyCounts:
    """Missing replies of one motion; one entry per drive.

    Attributes:
        cycles: Number of cycles, each with one expected reply of every drive.
        lost: Missing replies in all of them.
        recent: The last `REPLY_WINDOW` cycles, one bit each, the newest lowest; 1 for missing.
    """

    cycles: int
    lost: tuple[int, ...]
    recent: tuple[int, ...]

    def seen(self, missing: Sequence[bool]) -> ReplyCounts:
        """The counts after one more cycle."""
        window = (1 << REPLY_WINDOW) - 1
        return ReplyCounts(
            self.cycles + 1,
            tuple(count + bool(now) for count, now in zip(self.lost, missing, strict=True)),
            tuple(
                (bits << 1 | bool(now)) & window
                for bits, now in zip(self.recent, missing, strict=True)
            ),
        )

    @property
    def lost_lately(self) -> tuple[int, ...]:
        """Missing replies in the last `REPLY_WINDOW` cycles."""
        return tuple(bits.bit_count() for bits in self.recent)

    def largest_share(self, names: Sequence[str]) -> str:
        """Text of the event on the drives with the most missing replies; empty if none is."""
        most = max(self.lost)
        if not most:
            return ""
        losing = [name for name, count in zip(names, self.lost, strict=True) if count == most]
        which, _ = fault_messages.name_drives(losing, len(names))
        each = " each" if len(losing) > 1 else ""
        return f"{fault_messages.LARGEST_SHARE}{which}, {most} of {self.cycles}{each}"


@dataclass(frozen=True, slots=True)
class Monitor:
    """Counts of cycles per drive, consecutive ones but for `replies`.

    `update` returns the next state and alarms.
    """

    limits: MonitorLimits
    names: tuple[str, ...]
    replies: ReplyCounts
    missing: tuple[int, ...]
    slack: tuple[int, ...]
    loose: tuple[int, ...]
    over: tuple[int, ...]

    @classmethod
    def fresh(cls, limits: MonitorLimits, names: Sequence[str]) -> Monitor:
        """The initial state, for drives of these names."""
        zeros = (0,) * len(names)
        replies = ReplyCounts(0, zeros, zeros)
        return cls(limits, tuple(names), replies, zeros, zeros, zeros, zeros)

    def update(self, seen: Observation) -> tuple[Monitor, tuple[Alarm, ...]]:
        """Evaluates one cycle.

        Raises:
            ValueError: Not one entry per drive: a missing one would hide a fault.
        """
        limits = self.limits
        counts = {len(seen.following_errors), len(seen.tensions), len(seen.missing)}
        if counts != {len(self.missing)}:
            raise ValueError(
                f"the monitor was given {counts} entries for {len(self.missing)} drives"
            )
        # "not ... >=" and "not ... <=", so that NaN counts as wrong.
        slack = [seen.following and not t >= limits.min_tension for t in seen.tensions]
        loose = [seen.following and not t >= limits.no_tension for t in seen.tensions]
        over = [seen.following and not t <= limits.max_tension for t in seen.tensions]
        # The tension of a drive that did not answer is unknown.
        watch = Monitor(
            limits,
            self.names,
            self.replies.seen(seen.missing),
            _counted(self.missing, seen.missing, [False] * len(seen.missing)),
            _counted(self.slack, slack, seen.missing),
            _counted(self.loose, loose, seen.missing),
            _counted(self.over, over, seen.missing),
        )
        return watch, (
            *watch._replies(seen),
            *watch._following(seen),
            *watch._tensions(seen),
            *watch.lateness(seen.lateness),
        )

    def _replies(self, seen: Observation) -> list[Alarm]:
        found = [fault_messages.drive_fault(number, text) for number, text in seen.faults]
        found += [fault_messages.drive_warning(number, text) for number, text in seen.warnings]
        limits, window = self.limits, min(self.replies.cycles, REPLY_WINDOW)
        rows = zip(self.names, self.missing, self.replies.lost_lately, strict=True)
        for drive, (name, count, lost) in enumerate(rows, start=1):
            fault = count >= limits.missing_cycles
            if not fault and lost >= limits.lost_replies:
                found.append(fault_messages.replies_missing(drive, name, lost, window))
            elif count:
                found.append(fault_messages.reply_missing(drive, name, count, fault=fault))
        return found

    def _following(self, seen: Observation) -> list[Alarm]:
        found = []
        for drive, error in enumerate(seen.following_errors, start=1):
            if not seen.following or seen.missing[drive - 1]:
                continue
            # "not ... <=", so that NaN counts as too large.
            if not abs(error) <= self.limits.following_error:
                limit = self.limits.following_error
                found.append(fault_messages.following_error(drive, error, limit))
        return found

    def _tensions(self, seen: Observation) -> list[Alarm]:
        limits, found = self.limits, []
        loose = [count >= limits.loose_cycles for count in self.loose]
        if limits.may_disarm and any(loose) and all(self.loose):  # not all in the same cycle
            return [fault_messages.all_loose(len(loose))]
        for drive, tension in enumerate(seen.tensions):
            cable = drive + 1
            if loose[drive]:
                found.append(fault_messages.cable_loose(cable, tension, limits.may_disarm))
            elif self.slack[drive] >= limits.slack_cycles:
                found.append(fault_messages.slack(cable, tension, limits.min_tension))
            if self.over[drive] >= limits.slack_cycles:
                found.append(fault_messages.over_tension(cable, tension, limits.max_tension))
        return found

    def lateness(self, cycles: float) -> list[Alarm]:
        """Alarms of a cycle that begins this late, before anything is sent in it."""
        if not cycles < self.limits.gone_periods:  # also for NaN
            return [fault_messages.late(cycles, too_late=True)]
        if cycles >= self.limits.late_periods:
            return [fault_messages.late(cycles, too_late=False)]
        return []


def _counted(
    before: Sequence[int], now: Sequence[bool], unknown: Sequence[bool]
) -> tuple[int, ...]:
    """Counts of consecutive hits; unchanged where the state is unknown."""
    return tuple(
        count if hidden else (count + 1 if hit else 0)
        for count, hit, hidden in zip(before, now, unknown, strict=True)
    )
