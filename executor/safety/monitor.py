"""Monitors the drives' reports and decides when, and how, the rig must stop."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

# Limit on the age of the last SYNC when drives are commanded to follow a set-point.
#
# A drive that misses SYNC stops on its own, and "enable operation" (0Fh) takes it out of that stop
# again: CiA 402 transition 16 is level-triggered. So the sender of 0Fh must know that no drive has
# stopped meanwhile. A drive stops `timeout` periods after the SYNC that it received last; the age
# of that SYNC is measured here from just before it was sent, so it is never less than the drive's.
#
# The arithmetic, in periods, for a cycle that begins L periods late:
#
#     age = 1 + L                         the last SYNC belongs to the cycle before
#     limit = timeout - margin            0Fh is not sent from this age on
#     margin = min(1/2, (timeout - 1)/2)
#
# The margin covers what is not measured: the new SYNC waits for the set-points before it and for
# one foreign frame, at most 0.7 periods at the largest bus load that arming allows minus the same
# wait of the previous SYNC; and the drives' clocks. A drive that tolerates 1.5 periods leaves only
# half a period in all; half of it is the margin.
#
# Source: CiA 301 (communication cycle period, 1006h), CiA 402-2 (transition 16). Pure.


#: Periods without SYNC after which drives stop on their own unless their profile says otherwise.
USUAL_TIMEOUT = 3.0
#: Shortest time-out of a drive that can be kept enabled, in periods.
LEAST_TIMEOUT = 1.1
#: The largest margin, in periods.
MARGIN = 0.5
#: Age from which a late cycle is reported and causes a path stop, in periods.
LATE_AGE = 2.0


@dataclass(frozen=True, slots=True)
class SyncAge:
    """Limit on the age of SYNC for drives with a common time-out.

    Attributes:
        timeout: Periods without SYNC after which a drive stops on its own, at least 1.1.
    """

    timeout: float = USUAL_TIMEOUT

    def __post_init__(self) -> None:
        """Refuses a time-out that no cycle could meet.

        Raises:
            ValueError: It is not longer than one period by enough.
        """
        if not self.timeout >= LEAST_TIMEOUT:
            raise ValueError(
                f"drives that stop after {self.timeout} periods cannot be kept enabled"
            )

    @property
    def margin(self) -> float:
        """Margin before the time-out, in periods."""
        return min(MARGIN, (self.timeout - 1.0) / 2.0)

    @property
    def limit(self) -> float:
        """Age of the last SYNC from which no drive is commanded to follow, in periods."""
        return self.timeout - self.margin

    def may_enable(self, age: float) -> bool:
        """Whether 0Fh may be sent with the next SYNC; False for NaN."""
        return age < self.limit


#: Consecutive missing replies that are a fault.
MISSING_CYCLES = 2


class StopReaction(IntEnum):
    """Reaction that an alarm requires; the largest one wins."""

    NOTE = 0
    PATH_STOP = 1
    QUICK_STOP = 2


@dataclass(frozen=True, slots=True)
class Alarm:
    """A condition found by a monitor.

    Attributes:
        reaction: Required reaction.
        code: Stable code.
        text: Condition, measured value and limit.
        drive: Number of the cable and drive, from 1 as in the rig file; 0 for all.
    """

    reaction: StopReaction
    code: str
    text: str
    drive: int = 0


@dataclass(frozen=True, slots=True)
class WatchLimits:
    """Limits of the monitor.

    Attributes:
        following_error: Cable length, [m].
        min_tension: Slack below this, [N].
        max_tension: Over-tension above this, [N].
        no_tension: Below this a cable is broken or slack, [N].
        slack_cycles: Consecutive cycles of slack or over-tension that cause an alarm.
        loose_cycles: Consecutive cycles without tension that cause an alarm.
        missing_cycles: Consecutive missing replies that cause a quick stop.
        late_periods: Lateness, in cycles, that causes a path stop.
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
    late_periods: float = LATE_AGE - 1.0
    gone_periods: float = SyncAge().limit - 1.0


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
        warnings: Reported by drives that stay enabled: number of the drive, from 1, the text, and
            whether it requires a path stop.
    """

    following: bool
    following_errors: Sequence[float]
    tensions: Sequence[float]
    missing: Sequence[bool]
    faults: Sequence[tuple[int, str]]
    lateness: float
    warnings: Sequence[tuple[int, str, bool]] = ()


@dataclass(frozen=True, slots=True)
class Monitor:
    """Counts of consecutive cycles per drive; `update` returns the next state and alarms."""

    limits: WatchLimits
    names: tuple[str, ...]
    missing: tuple[int, ...]
    slack: tuple[int, ...]
    loose: tuple[int, ...]
    over: tuple[int, ...]

    @classmethod
    def fresh(cls, limits: WatchLimits, names: Sequence[str]) -> Monitor:
        """The initial state, for drives of these names."""
        zeros = (0,) * len(names)
        return cls(limits, tuple(names), zeros, zeros, zeros, zeros)

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
        found = [
            Alarm(StopReaction.QUICK_STOP, "drive_fault", text, number)
            for number, text in seen.faults
        ]
        for number, text, stops in seen.warnings:
            reaction = StopReaction.PATH_STOP if stops else StopReaction.NOTE
            found.append(Alarm(reaction, "drive_warning", text, number))
        for drive, count in enumerate(self.missing, start=1):
            name = self.names[drive - 1]
            text = f"{name} did not answer for {count} cycle{'s' if count > 1 else ''}"
            if count >= self.limits.missing_cycles:
                found.append(Alarm(StopReaction.QUICK_STOP, "drive_silent", text, drive))
            elif count:
                found.append(Alarm(StopReaction.NOTE, "reply_lost", text, drive))
        return found

    def _following(self, seen: Observation) -> list[Alarm]:
        found = []
        for drive, error in enumerate(seen.following_errors, start=1):
            if not seen.following or seen.missing[drive - 1]:
                continue
            # "not ... <=", so that NaN counts as too large.
            if not abs(error) <= self.limits.following_error:
                text = (
                    f"cable {drive} is {error * 1000:.2f} mm from its set-point,"
                    f" limit {self.limits.following_error * 1000:.2f} mm"
                )
                found.append(Alarm(StopReaction.QUICK_STOP, "following_error", text, drive))
        return found

    def _tensions(self, seen: Observation) -> list[Alarm]:
        found = []
        for drive, tension in enumerate(seen.tensions):
            text = f"cable {drive + 1} carries {tension:.1f} N,"
            if self.loose[drive] >= self.limits.loose_cycles:
                loose = f"{text} no tension: it is broken or slack"
                found.append(Alarm(StopReaction.QUICK_STOP, "cable_loose", loose, drive + 1))
            elif self.slack[drive] >= self.limits.slack_cycles:
                slack = f"{text} less than {self.limits.min_tension:.1f} N: it may be slack"
                found.append(Alarm(StopReaction.PATH_STOP, "slack", slack, drive + 1))
            if self.over[drive] >= self.limits.slack_cycles:
                over = f"{text} more than {self.limits.max_tension:.1f} N"
                found.append(Alarm(StopReaction.PATH_STOP, "over_tension", over, drive + 1))
        return found

    def lateness(self, cycles: float) -> list[Alarm]:
        """Alarms of a cycle that begins this late, before anything is sent in it."""
        text = f"a cycle began {cycles:.1f} cycles late"
        if not cycles < self.limits.gone_periods:  # also for NaN
            return [Alarm(StopReaction.QUICK_STOP, "late", text)]
        if cycles >= self.limits.late_periods:
            return [Alarm(StopReaction.PATH_STOP, "late", text)]
        return []


def _counted(
    before: Sequence[int], now: Sequence[bool], unknown: Sequence[bool]
) -> tuple[int, ...]:
    """Counts of consecutive hits; unchanged where the state is unknown."""
    return tuple(
        count if hidden else (count + 1 if hit else 0)
        for count, hit, hidden in zip(before, now, unknown, strict=True)
    )
