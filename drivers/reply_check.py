"""Which replies of drives are believed: right length, one a cycle, no jump. No bus, no clock."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from cdpr.rig import Rig

BAD_CYCLES = 2
"""Cycles in a row that are one too many: one bad frame may happen, two are a defect."""

JUMP_RESERVE, JUMP_COUNTS = 4.0, 8.0
"""A position that changes this much faster than its winch may turn is no position; a few counts to
and fro are, however coarse the encoder."""


def largest_steps(rig: Rig, cycle: float) -> tuple[float, ...]:
    """How far each drive's position can change in a cycle [s], [counts]."""
    fastest = [w.max_speed * cycle * abs(w.counts_per_metre) for w in rig.winches]
    return tuple(max(JUMP_COUNTS, JUMP_RESERVE * step) for step in fastest)


class ReplyCheck:
    """Looks at every reply before it counts.

    Attributes:
        rejected: Replies that were not believed, of all drives.
    """

    def __init__(self, names: Mapping[int, str], max_steps: Sequence[float]) -> None:
        """Takes names by node id, and how far each position can change in a cycle, [counts]."""
        count = len(names)
        self.rejected = 0
        self._names, self._max_steps = tuple(names.items()), tuple(max_steps)
        self._positions: list[int | None] = [None] * count
        self._age = [1] * count
        self._heard = [0] * count
        self._reasons: list[str] = [""] * count
        self._bad_cycles = [0] * count
        self._repeats = [0] * count

    def forget_positions(self) -> None:
        """The next position of each drive is believed whatever it is."""
        self._positions = [None] * len(self._names)

    def begin_cycle(self) -> None:
        """Counts who answered the last SYNC more than once, up to now, when the next one goes."""
        self._repeats = [
            repeats + 1 if heard > 1 else 0
            for repeats, heard in zip(self._repeats, self._heard, strict=True)
        ]
        self._heard = [0] * len(self._names)
        self._reasons = [""] * len(self._names)

    def hear(self, drive: int) -> None:
        """Notes that a drive answered, in time or late."""
        self._heard[drive] += 1

    def believed(self, drive: int, position: int) -> bool:
        """Whether a position [counts] can be true; it then counts as the drive's."""
        last = self._positions[drive]
        if last is not None:
            step, allowed = abs(position - last), self._max_steps[drive] * self._age[drive]
            if step > allowed:
                text = f"its position jumped by {step} counts, at most {allowed:.0f} are possible"
                self.reject(drive, text)
                return False
        self._reasons[drive] = ""
        self._positions[drive] = position
        self._age[drive] = 0
        return True

    def reject(self, drive: int, reason: str) -> None:
        """A reply was thrown away."""
        self.rejected += 1
        self._reasons[drive] = reason

    def end_cycle(self) -> None:
        """Counts the cycles in which a drive sent nothing that could be believed."""
        self._age = [age + 1 for age in self._age]
        self._bad_cycles = [
            bad + 1 if reason else 0
            for bad, reason in zip(self._bad_cycles, self._reasons, strict=True)
        ]

    def faults(self) -> list[tuple[int, str]]:
        """Drives whose answers cannot be relied on, by node."""
        found = [
            (node, f"{name}: {reason}, {bad} cycles in a row")
            for (node, name), reason, bad in zip(
                self._names, self._reasons, self._bad_cycles, strict=True
            )
            if bad >= BAD_CYCLES
        ]
        found += [
            (node, f"{name} answers twice: two devices have this node id")
            for (node, name), repeats in zip(self._names, self._repeats, strict=True)
            if repeats >= BAD_CYCLES
        ]
        return found
