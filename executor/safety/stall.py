"""Notices a drive that stands still while its set-points go on: jammed, deaf, or its reply old.

The following error reports the same, but only when millimetres are lost.

A drive is judged over the shortest stretch of its last replies, two cycles at least, in which its
set-points went on by `travel`. What its position did meanwhile, as a share of what its set-points
did, is 1 for a drive that follows and 0 for one that stands still; noise of the position of at most
+-n changes that share by 2 n / travel. So with the shares below

    n <= 3/8 travel    a drive that follows is never found
    n <  1/8 travel    a drive that stands still is found as soon as its set-points went on by
                       `travel` (and by two cycles) without it

Only motion one way is judged, at a speed that friction does not eat up (`least`), and only of a
drive that was seen to follow since: at the begin of a motion a servo lags.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from executor.safety.monitor import Alarm, StopReaction

#: A drive that moves by less than this share of what its set-points move stands still.
STANDING_SHARE = 0.25
#: A drive that moved by at least this share of it was following.
FOLLOWING_SHARE = 0.5
#: Cycles of standing still that are one too many; one alone is what a lost set-point leaves.
STUCK_CYCLES = 2


@dataclass(frozen=True, slots=True)
class StuckLimits:
    """What is judged of one drive.

    Attributes:
        least: Steps of set-points from cycle to cycle below this say nothing, [counts].
        travel: Set-points must go on by this before anything is judged, [counts].
    """

    least: int
    travel: int


@dataclass(frozen=True, slots=True)
class Drive:
    """What is known of one drive.

    Attributes:
        limits: What is judged.
        replies: Position and demand of each reply of the stretch, [counts]; the oldest first.
        followed: It was seen to follow; a drive that has not yet begun to move is not judged.
        standing: Cycles in which it stood still, until the last reply; 0 for a drive that moves.
    """

    limits: StuckLimits
    replies: tuple[tuple[int, int], ...] = ()
    followed: bool = False
    standing: int = 0

    def seen(self, position: int, demand: int) -> Drive:
        """After one more reply."""
        if not self.replies or not self._goes_on(demand - self.replies[-1][1]):
            return Drive(self.limits, ((position, demand),))
        replies = self._stretch((*self.replies, (position, demand)))
        share = self._share(replies)
        if share is None:  # and none that followed: its stretch is never too short again
            return Drive(self.limits, replies)
        if self.followed and share < STANDING_SHARE:
            return Drive(self.limits, replies, True, len(replies) - 1)
        followed = self.followed or share >= FOLLOWING_SHARE
        return Drive(self.limits, replies, followed, int(followed and self._misses_step(replies)))

    def _goes_on(self, step: int) -> bool:
        """The set-points move far enough, and the way they moved before."""
        before = self.replies[-1][1] - self.replies[0][1]
        return abs(step) >= self.limits.least and step * before >= 0

    def _stretch(self, replies: tuple[tuple[int, int], ...]) -> tuple[tuple[int, int], ...]:
        """Without the oldest ones that are not needed."""
        demand = replies[-1][1]
        while len(replies) > STUCK_CYCLES + 1 and abs(demand - replies[1][1]) >= self.limits.travel:
            replies = replies[1:]
        return replies

    def _share(self, replies: tuple[tuple[int, int], ...]) -> float | None:
        """Of the set-points' travel that the drive made; None while it is too short."""
        (first, begin), (last, end) = replies[0], replies[-1]
        if len(replies) <= STUCK_CYCLES or abs(end - begin) < self.limits.travel:
            return None
        return (last - first) / (end - begin)

    def _misses_step(self, replies: tuple[tuple[int, int], ...]) -> bool:
        """It stood still in the last cycle, whose step alone is larger than noise."""
        (first, begin), (last, end) = replies[-2:]
        if abs(end - begin) < self.limits.travel:
            return False
        return (last - first) / (end - begin) < STANDING_SHARE

    def forgotten(self) -> Drive:
        """While the drive follows nothing."""
        return Drive(self.limits)


@dataclass(frozen=True, slots=True)
class StuckWatch:
    """All drives; `look` returns the next watch and what was found."""

    drives: tuple[Drive, ...]
    names: tuple[str, ...]

    @classmethod
    def fresh(cls, limits: Sequence[StuckLimits], names: Sequence[str]) -> StuckWatch:
        """A watch that has seen nothing.

        Args:
            limits: What is judged, one a drive.
            names: What the drives are called.
        """
        return cls(tuple(Drive(each) for each in limits), tuple(names))

    def look(
        self,
        following: bool,
        positions: Sequence[int],
        demands: Sequence[int],
        missing: Sequence[bool],
    ) -> tuple[StuckWatch, tuple[Alarm, ...]]:
        """Takes in one cycle; one entry a drive.

        Args:
            following: The drives follow set-points; otherwise nothing is judged.
            positions: Actual positions, [counts].
            demands: Where the drives were to be when they reported them, [counts].
            missing: True where a drive did not answer; it says nothing new.

        Raises:
            ValueError: Not one entry for every drive.
        """
        if not following:
            return replace(self, drives=tuple(drive.forgotten() for drive in self.drives)), ()
        rows = zip(self.drives, positions, demands, missing, strict=True)
        drives = tuple(
            drive if silent else drive.seen(position, demand)
            for drive, position, demand, silent in rows
        )
        found = [
            _finding(number, self.names[number - 1], drive.standing)
            for number, (drive, silent) in enumerate(zip(drives, missing, strict=True), start=1)
            if drive.standing and not silent
        ]
        return replace(self, drives=drives), tuple(found)


def _finding(number: int, name: str, cycles: int) -> Alarm:
    text = f"{name} did not move for {cycles} cycle{'s' if cycles > 1 else ''}"
    text += " while its set-points advanced"
    if cycles < STUCK_CYCLES:
        return Alarm(StopReaction.NOTE, "set_point_missed", text, number)
    return Alarm(StopReaction.QUICK_STOP, "drive_stuck", text, number)
