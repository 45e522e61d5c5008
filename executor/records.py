"""What the loop tells while it runs: a record a cycle, and events."""

from __future__ import annotations

from dataclasses import dataclass

from executor.machine import State


@dataclass(frozen=True, slots=True)
class CycleRecord:
    """One cycle as it was.

    Attributes:
        cycle: Counted from the first one sent.
        at: When it began, on the loop's clock, [s].
        state: Where the run was.
        index: Place in the table; of winches that move without a path how much is done, [%].
        rate: Rows a cycle that the feed went.
        targets: What was sent, [counts].
        actual: What the drives answered, [counts].
        torques: What they answered, [‰ of rated torque].
        words: Their status words.
        missing: How many did not answer.
        rejected: Frames thrown away since the drives were set up, as they could not be true.
        error_frames: Error frames of the bus since then.
        following_error: Largest over the cables, [m]; NaN while the drives do not follow.
        lateness: In cycles.
    """

    cycle: int
    at: float
    state: State
    index: float
    rate: float
    targets: tuple[int, ...]
    actual: tuple[int, ...]
    torques: tuple[int, ...]
    words: tuple[int, ...]
    missing: int
    rejected: int
    error_frames: int
    following_error: float
    lateness: float


@dataclass(frozen=True, slots=True)
class LoopEvent:
    """Something worth telling.

    Attributes:
        cycle: In which cycle.
        at: When, on the loop's clock, [s].
        code: Stable name.
        text: One sentence.
    """

    cycle: int
    at: float
    code: str
    text: str
