"""Notices a drive that stood still while its set-points went on: jammed, deaf, or its reply old.

The following error tells the same, but only when millimetres are lost.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from executor.safety.watch import Finding, Reaction

#: A drive that moves by less than this share of what its set-points move stands still.
STANDING_SHARE = 0.25
#: A drive that moved by at least this share of it was following.
FOLLOWING_SHARE = 0.5
#: Cycles of standing still that are one too many; one alone is what a lost set-point leaves.
STUCK_CYCLES = 2


@dataclass(frozen=True, slots=True)
class Drive:
    """What is known of one drive.

    Attributes:
        least: Steps of set-points below this say nothing, [counts].
        position: As last told, [counts]; None before, and while nothing is judged.
        demand: Where it was to be then, [counts].
        followed: It was seen to follow; a drive that has not yet begun to move is not judged.
        standing: Cycles in a row in which it stood still.
    """

    least: int
    position: int | None = None
    demand: int = 0
    followed: bool = False
    standing: int = 0

    def seen(self, position: int, demand: int) -> Drive:
        """After one more reply."""
        now = replace(self, position=position, demand=demand)
        if self.position is None:
            return now
        told, moved = demand - self.demand, position - self.position
        if abs(told) < self.least:
            return replace(now, followed=False, standing=0)
        if self.followed and abs(moved) < STANDING_SHARE * abs(told):
            return replace(now, standing=self.standing + 1)
        return replace(now, followed=moved / told >= FOLLOWING_SHARE, standing=0)

    def forgotten(self) -> Drive:
        """While the drive follows nothing."""
        return Drive(self.least)


@dataclass(frozen=True, slots=True)
class StuckWatch:
    """All drives; `look` returns the next watch and what was found."""

    drives: tuple[Drive, ...]
    names: tuple[str, ...]

    @classmethod
    def fresh(cls, least: Sequence[int], names: Sequence[str]) -> StuckWatch:
        """A watch that has seen nothing.

        Args:
            least: The smallest step that says something, one a drive, [counts].
            names: What the drives are called.
        """
        return cls(tuple(Drive(counts) for counts in least), tuple(names))

    def look(
        self,
        following: bool,
        positions: Sequence[int],
        demands: Sequence[int],
        missing: Sequence[bool],
    ) -> tuple[StuckWatch, tuple[Finding, ...]]:
        """Takes in one cycle; one entry a drive.

        Args:
            following: The drives follow set-points; otherwise nothing is judged.
            positions: Actual positions, [counts].
            demands: Where the drives were to be when they told them, [counts].
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


def _finding(number: int, name: str, cycles: int) -> Finding:
    text = f"{name} stood still for {cycles} cycle{'s' if cycles > 1 else ''}"
    text += " while its set-points went on"
    if cycles < STUCK_CYCLES:
        return Finding(Reaction.NOTE, "set_point_missed", text, number)
    return Finding(Reaction.QUICK_STOP, "drive_stuck", text, number)
