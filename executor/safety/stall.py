"""Detects a stalled drive: at rest while its set-points advance, or its replies stale.

The following error detects the same, but only after millimetres are lost.

A drive is judged over the shortest window of its last replies, two cycles at least, in which its
set-points advanced by `travel`. The travel of its position, as a share of that of its set-points,
is 1 for a drive that follows and 0 for one that has stalled; position noise of at most ±n changes
that share by 2 n / travel. So with the shares below

    n <= 3/8 travel    a drive that follows is never reported
    n <  1/8 travel    a stalled drive is reported as soon as its set-points have advanced by
                       `travel` (and two cycles) without it

Only motion in one direction is judged, above a speed that friction may absorb (`least`), and only
of a drive that has followed since: at the start of a motion a servo lags. A drive that is ahead of
its set-points, as a servo may be after they slowed down, waits for them and has not stalled.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from executor.safety.fault_messages import Alarm, stuck

#: A drive that moves by less than this share of its set-points' travel is stalled.
STALLED_SHARE = 0.25
#: A drive that moves by at least this share of it is following.
FOLLOWING_SHARE = 0.5
#: Stalled cycles that are a fault; a single one is the effect of a lost set-point.
STUCK_CYCLES = 2


@dataclass(frozen=True, slots=True)
class StuckLimits:
    """Stall limits of one drive.

    Attributes:
        least: Slower set-points are not judged, [counts per cycle].
        travel: Travel of the set-points over which a drive is judged, [counts].
        period: Cycles from reply to reply, at least.
    """

    least: float
    travel: int
    period: int = 1

    @property
    def replies(self) -> int:
        """Replies of a stalled drive that are a fault."""
        return math.ceil(STUCK_CYCLES / self.period)


@dataclass(frozen=True, slots=True)
class Drive:
    """Stall detection of one drive.

    Attributes:
        limits: Its limits.
        replies: Position and demand of each reply in the window, [counts]; the oldest first.
        followed: It has followed; a drive that has not yet begun to move is not judged.
        stalled: Replies since it stalled; 0 for a drive that moves.
        silent: Cycles since its last reply.
    """

    limits: StuckLimits
    replies: tuple[tuple[int, int], ...] = ()
    followed: bool = False
    stalled: int = 0
    silent: int = 0

    def unseen(self) -> Drive:
        """The state after a cycle without a reply."""
        return replace(self, silent=self.silent + 1)

    def seen(self, position: int, demand: int) -> Drive:
        """The state after one more reply."""
        if not self.replies or not self._advances(demand - self.replies[-1][1]):
            return Drive(self.limits, ((position, demand),))
        replies = self._window((*self.replies, (position, demand)))
        share = self._share(replies)
        if share is None:  # `followed` is False here: once set, the window is never too short again
            return Drive(self.limits, replies)
        is_behind = (demand - position) * (demand - replies[0][1]) > 0
        if self.followed and is_behind and share < STALLED_SHARE:
            return Drive(self.limits, replies, True, len(replies) - 1)
        followed = self.followed or share >= FOLLOWING_SHARE
        misses_step = followed and is_behind and self._misses_step(replies)
        return Drive(self.limits, replies, followed, int(misses_step))

    @property
    def is_stuck(self) -> bool:
        """Whether it stalled for so long that this is a fault."""
        return self.stalled >= self.limits.replies

    def _advances(self, step: int) -> bool:
        """Whether the set-points move far enough, in the same direction as before."""
        before = self.replies[-1][1] - self.replies[0][1]
        return abs(step) >= self.limits.least * (self.silent + 1) and step * before >= 0

    def _window(self, replies: tuple[tuple[int, int], ...]) -> tuple[tuple[int, int], ...]:
        """The window: replies without the oldest that are not needed."""
        demand = replies[-1][1]
        while (
            len(replies) > self.limits.replies + 1
            and abs(demand - replies[1][1]) >= self.limits.travel
        ):
            replies = replies[1:]
        return replies

    def _share(self, replies: tuple[tuple[int, int], ...]) -> float | None:
        """Share of the set-points' travel that the drive made; None while it is too short."""
        (first, begin), (last, end) = replies[0], replies[-1]
        if len(replies) <= self.limits.replies or abs(end - begin) < self.limits.travel:
            return None
        return (last - first) / (end - begin)

    def _misses_step(self, replies: tuple[tuple[int, int], ...]) -> bool:
        """Whether it stalled in the last cycle, whose step alone exceeds the noise."""
        (first, begin), (last, end) = replies[-2:]
        if abs(end - begin) < self.limits.travel:
            return False
        return (last - first) / (end - begin) < STALLED_SHARE

    def forgotten(self) -> Drive:
        """The state while the drive follows no set-points."""
        return Drive(self.limits)


@dataclass(frozen=True, slots=True)
class StuckWatch:
    """Stall detection of all drives; `update` returns the next state and alarms."""

    drives: tuple[Drive, ...]
    names: tuple[str, ...]
    may_disarm: bool

    @classmethod
    def fresh(
        cls, limits: Sequence[StuckLimits], names: Sequence[str], *, may_disarm: bool = False
    ) -> StuckWatch:
        """The initial state.

        Args:
            limits: One per drive.
            may_disarm: As in `MonitorLimits`.
        """
        return cls(tuple(Drive(each) for each in limits), tuple(names), may_disarm)

    def update(
        self,
        following: bool,
        positions: Sequence[int],
        demands: Sequence[int],
        missing: Sequence[bool],
    ) -> tuple[StuckWatch, tuple[Alarm, ...]]:
        """Evaluates one cycle; one entry per drive.

        Args:
            following: Whether the drives follow set-points; otherwise nothing is judged.
            positions: Actual positions, [counts].
            demands: Set-points of those reports, all of the same age, [counts].
            missing: True where a drive sent no new position.

        Raises:
            ValueError: Not one entry per drive.
        """
        if not following:
            return replace(self, drives=tuple(drive.forgotten() for drive in self.drives)), ()
        rows = zip(self.drives, positions, demands, missing, strict=True)
        drives = tuple(
            drive.unseen() if silent else drive.seen(position, demand)
            for drive, position, demand, silent in rows
        )
        each = zip(self.names, drives, missing, strict=True)
        found = [
            stuck(
                number,
                name,
                drive.stalled * drive.limits.period,
                fault=drive.is_stuck,
                may_disarm=self.may_disarm,
            )
            for number, (name, drive, silent) in enumerate(each, start=1)
            if drive.stalled and not silent
        ]
        return replace(self, drives=drives), tuple(found)
