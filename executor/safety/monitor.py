"""Watches what the drives report and says when, and how, the rig must stop."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

# How old the last SYNC may be when drives are commanded to follow a set-point.
#
# A drive that misses SYNC stops by itself, and "enable operation" (0Fh) takes it out of that stop
# again: CiA 402 transition 16 acts by level. So the sender of 0Fh must know that no drive has
# stopped meanwhile. A drive stops `timeout` periods after the SYNC that it received last; the age
# of that SYNC is measured here from just before it was sent, which is never less than what the
# drive counts.
#
# The arithmetic, in periods, for a cycle that begins L periods late:
#
#     age = 1 + L                         the last SYNC belongs to the cycle before
#     limit = timeout - margin            from this age on 0Fh is not sent
#     margin = min(1/2, (timeout - 1)/2)
#
# The margin covers what the measurement cannot see: the new SYNC waits for the set-points before
# it and for one foreign frame, at most 0.7 periods at the largest bus load that arming allows
# minus the same wait of the SYNC before, and the drives' own clocks. A drive that tolerates 1.5
# periods leaves only half a period in all; half of it is kept.
#
# Source: CiA 301 (communication cycle period, 1006h), CiA 402-2 (transition 16). Pure.


#: Periods without SYNC after which drives stop by themselves unless their profile says otherwise.
USUAL_TIMEOUT = 3.0
#: A drive less patient than this could not be kept going, in periods.
LEAST_TIMEOUT = 1.1
#: The largest margin, in periods.
MARGIN = 0.5
#: Age from which the operator hears of a late cycle and the motion stops along the path, periods.
LATE_AGE = 2.0


@dataclass(frozen=True, slots=True)
class SyncAge:
    """The rule for drives with one time-out.

    Attributes:
        timeout: Periods without SYNC after which a drive stops by itself, at least 1.1.
    """

    timeout: float = USUAL_TIMEOUT

    def __post_init__(self) -> None:
        """Refuses a time-out that no cycle could keep.

        Raises:
            ValueError: It leaves no room beside one period.
        """
        if not self.timeout >= LEAST_TIMEOUT:
            raise ValueError(
                f"drives that stop after {self.timeout} periods cannot be kept enabled"
            )

    @property
    def margin(self) -> float:
        """Kept before the time-out, in periods."""
        return min(MARGIN, (self.timeout - 1.0) / 2.0)

    @property
    def limit(self) -> float:
        """From this age of the last SYNC on no drive is commanded to follow, in periods."""
        return self.timeout - self.margin

    def may_enable(self, age: float) -> bool:
        """Whether 0Fh may be sent with the next SYNC; not when the age is no number."""
        return age < self.limit


#: Missing replies in a row that are one too many.
MISSING_CYCLES = 2


class StopReaction(IntEnum):
    """What a finding asks for; of several the larger one is done."""

    NOTE = 0
    PATH_STOP = 1
    QUICK_STOP = 2


@dataclass(frozen=True, slots=True)
class Alarm:
    """Something that the watch saw.

    Attributes:
        reaction: What must happen.
        code: Stable name.
        text: What, where, measured value and limit.
        drive: Which cable and drive it is about, counted from 1 as in the rig file; 0 for all.
    """

    reaction: StopReaction
    code: str
    text: str
    drive: int = 0


@dataclass(frozen=True, slots=True)
class WatchLimits:
    """When the watch speaks up.

    Attributes:
        following_error: Cable length, [m].
        min_tension: Slack below this, [N].
        max_tension: Over-tension above this, [N].
        no_tension: Below this a cable is broken or slack, [N].
        slack_cycles: Cycles of slack or over-tension that are one too many.
        loose_cycles: Cycles without tension that are one too many.
        missing_cycles: Missing replies in a row that are one too many.
        late_periods: Lateness, in cycles, from which on the path stops.
        gone_periods: Lateness, in cycles, from which on drives may have stopped by themselves, as
            SYNC stayed away: no set-point may follow. See `executor.safety.monitor`.
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
    """One cycle as it came back; one entry a drive.

    Attributes:
        following: True when the drives follow their set-points; otherwise following errors and
            tensions say nothing and are not judged.
        following_errors: Signed, in cable length, [m].
        tensions: From the drives' torque, [N].
        missing: True where a drive did not answer.
        faults: What drives reported as wrong: which drive, counted from 1, or 0 for the bus, and
            the text.
        lateness: How late the cycle began, in cycles.
        warnings: What drives that stay enabled reported: which drive, counted from 1, the text, and
            whether the path must stop for it.
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
    """Counts in a row, per drive; `look` returns the next watch and what was found."""

    limits: WatchLimits
    names: tuple[str, ...]
    missing: tuple[int, ...]
    slack: tuple[int, ...]
    loose: tuple[int, ...]
    over: tuple[int, ...]

    @classmethod
    def fresh(cls, limits: WatchLimits, names: Sequence[str]) -> Monitor:
        """A watch that has seen nothing, of drives that are called so."""
        zeros = (0,) * len(names)
        return cls(limits, tuple(names), zeros, zeros, zeros, zeros)

    def look(self, seen: Observation) -> tuple[Monitor, tuple[Alarm, ...]]:
        """Takes in one cycle.

        Raises:
            ValueError: Not one entry for every drive; one that is missing would hide a fault.
        """
        limits = self.limits
        counts = {len(seen.following_errors), len(seen.tensions), len(seen.missing)}
        if counts != {len(self.missing)}:
            raise ValueError(
                f"the monitor was given {counts} entries for {len(self.missing)} drives"
            )
        # "Not at least" and "not at most", so that a tension that is no number counts as wrong.
        slack = [seen.following and not t >= limits.min_tension for t in seen.tensions]
        loose = [seen.following and not t >= limits.no_tension for t in seen.tensions]
        over = [seen.following and not t <= limits.max_tension for t in seen.tensions]
        # A drive that did not answer says nothing new about its tension.
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
            # "Not at most", so that an error that is no number counts as too large.
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
        """What a cycle that begins so late asks for, before anything is sent in it."""
        text = f"a cycle began {cycles:.1f} cycles late"
        if not cycles < self.limits.gone_periods:  # also when it is no number
            return [Alarm(StopReaction.QUICK_STOP, "late", text)]
        if cycles >= self.limits.late_periods:
            return [Alarm(StopReaction.PATH_STOP, "late", text)]
        return []


def _counted(
    before: Sequence[int], now: Sequence[bool], unknown: Sequence[bool]
) -> tuple[int, ...]:
    """Counts in a row; where nothing is known the count stays."""
    return tuple(
        count if hidden else (count + 1 if hit else 0)
        for count, hit, hidden in zip(before, now, unknown, strict=True)
    )
