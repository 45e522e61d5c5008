"""Plausibility of drives' replies: length, one per cycle, no jump. No bus, no clock."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from model.errors import BadInput, Refused
from model.rig import Rig
from model.winches import WinchMap

BAD_CYCLES = 2
"""Consecutive bad cycles that are a fault: one bad frame may happen, two are a defect."""

HOMING_OPTIONS = "--at-home, --pose-mm X Y Z or --camera SOURCE"
"""One of them states or measures the pose for `cdpr home`."""

HOMING_POSE = f"{HOMING_OPTIONS}, in Python cdpr.home() with at_home=True, pose= or camera="
"""The same for every caller."""

HOME = f"`cdpr home RIG` with {HOMING_POSE}"
"""The next step for drives without a valid reference."""

JUMP_RESERVE, JUMP_COUNTS = 4.0, 8.0
"""Largest plausible change of a position in a cycle: a multiple of the winch's motion at top speed,
and at least some counts of noise."""


def largest_steps(rig: Rig, cycle: float) -> tuple[float, ...]:
    """Largest change of each drive's position in a cycle [s], [counts]."""
    fastest = [w.max_speed * cycle * abs(w.counts_per_metre) for w in rig.winches]
    return tuple(max(JUMP_COUNTS, JUMP_RESERVE * step) for step in fastest)


@dataclass(frozen=True, slots=True)
class WrongScale:
    """A drive states other position counts per motor turn than the rig file.

    Attributes:
        drive: Index of the drive.
        source: What states it.
        stated: Stated counts per motor turn.
        counts: ``counts_per_rev`` of the winch.
        certain: What it states is the scale of its positions.
    """

    drive: int
    source: str
    stated: float
    counts: int
    certain: bool

    def __str__(self) -> str:
        """The contradiction, without the drive."""
        stated = f"{self.stated:.10g} position counts per motor turn by {self.source}"
        return f"{stated}, and {self.counts} by the rig file"


def wrong_scales(
    counts: Sequence[int], stated: Sequence[Mapping[str, float]], *, known: bool
) -> list[WrongScale]:
    """Drives whose stated scale contradicts the rig file.

    A scale of 1 is not set: the next one of the drive counts. Where no drive agrees with the rig
    file, these objects may mean something else in drives of this make.

    Args:
        counts: ``counts_per_rev`` of each winch.
        stated: Counts per motor turn that each drive states, by source, the first one first.
        known: The drives of this make state the scale of their positions.
    """
    found, certain = [], known
    for drive, (own, scales) in enumerate(zip(counts, stated, strict=True)):
        for source, scale in scales.items():
            if scale == 1.0:
                continue
            if math.isclose(scale, own, rel_tol=1e-9):
                certain = True
            else:
                found.append((drive, source, scale, own))
            break
    return [WrongScale(*each, certain) for each in found]


class ReplyCheck:
    """Checks every reply before it is used.

    Attributes:
        rejected: Number of rejected replies of all drives.
    """

    def __init__(self, names: Mapping[int, str], max_steps: Sequence[float]) -> None:
        """Takes names by node id, and the largest change of each position per cycle, [counts]."""
        count = len(names)
        self.rejected = 0
        self._names, self._max_steps = tuple(names.items()), tuple(max_steps)
        # Before this cycle and in it: replies of one cycle must not add up to a jump.
        self._positions: list[int | None] = [None] * count
        self._newest: list[int | None] = [None] * count
        self._age = [1] * count
        self._replies = [0] * count
        self._reasons: list[str] = [""] * count
        self._bad_cycles = [0] * count
        self._texts = [""] * count  # of the faults, each as it was when it began
        self._repeats = [0] * count

    def forget_positions(self) -> None:
        """Accepts any next position of each drive."""
        self._positions = [None] * len(self._names)
        self._newest = [None] * len(self._names)

    def begin_cycle(self) -> None:
        """Starts a cycle; counts drives that answered the last SYNC more than once."""
        self._repeats = [
            repeats + 1 if replies > 1 else 0
            for repeats, replies in zip(self._repeats, self._replies, strict=True)
        ]
        self._replies = [0] * len(self._names)
        self._reasons = [""] * len(self._names)

    def count_reply(self, drive: int) -> None:
        """Counts a reply of a drive, in time or late."""
        self._replies[drive] += 1

    def accept(self, drive: int, position: int) -> bool:
        """Whether a position [counts] is plausible; drives may report several in a cycle."""
        before = self._positions[drive]
        if before is None:
            before, self._age[drive] = position, 1
            self._positions[drive] = position
        step, allowed = abs(position - before), self._max_steps[drive] * self._age[drive]
        if step > allowed:
            text = f"its position jumped by {step} counts, the limit is {allowed:.0f}"
            self.reject(drive, text)
            return False
        self._reasons[drive] = ""
        self._newest[drive] = position
        return True

    def reject(self, drive: int, reason: str) -> None:
        """Records a rejected reply."""
        self.rejected += 1
        self._reasons[drive] = reason

    def end_cycle(self) -> None:
        """Ends a cycle; counts consecutive cycles without a plausible reply."""
        for drive, newest in enumerate(self._newest):
            if newest is None:
                self._age[drive] += 1
            else:
                self._positions[drive], self._age[drive] = newest, 1
        self._newest = [None] * len(self._names)
        self._bad_cycles = [
            bad + 1 if reason else 0
            for bad, reason in zip(self._bad_cycles, self._reasons, strict=True)
        ]
        self._texts = [
            (text or f"{reason}, {bad} cycles in a row") if bad >= BAD_CYCLES else ""
            for text, reason, bad in zip(self._texts, self._reasons, self._bad_cycles, strict=True)
        ]

    def faults(self) -> list[tuple[int, str]]:
        """Drives whose replies are unreliable, by node."""
        found = [
            (node, f"{name}: {text}")
            for (node, name), text in zip(self._names, self._texts, strict=True)
            if text
        ]
        found += [
            (node, f"{name} answered twice: two devices have this node id")
            for (node, name), repeats in zip(self._names, self._repeats, strict=True)
            if repeats >= BAD_CYCLES
        ]
        return found


# Range of a winch's drive.


def position_limits(rig: Rig, drive: int, winch_map: WinchMap) -> tuple[int, int]:
    """Software limits: positions for any pose of the platform in its workspace.

    Raises:
        BadInput: They do not fit the 32-bit position of the drive.
    """
    outlet, reach = rig.outlets[drive], float(np.linalg.norm(rig.anchors[drive]))
    wrapped = 2.0 * math.pi * rig.pulley_radius
    nearest = np.clip(outlet, rig.workspace_lower, rig.workspace_upper)
    middle = (rig.workspace_lower + rig.workspace_upper) / 2.0
    farthest = np.where(outlet > middle, rig.workspace_lower, rig.workspace_upper)
    shortest = max(0.0, float(np.linalg.norm(outlet - nearest)) - reach)
    longest = float(np.linalg.norm(outlet - farthest)) + reach + wrapped
    lengths = np.zeros((2, rig.cable_count))
    lengths[:, drive] = shortest, longest
    tensions = np.array([[rig.max_tension], [0.0]])
    ends = winch_map.counts(winch_map.unstrained(lengths, tensions))[:, drive]
    low, high = math.floor(min(ends)), math.ceil(max(ends))
    if low < -(2**31) or high >= 2**31:
        raise BadInput(
            f"positions from {low} to {high} counts exceed the drive's 32-bit range",
            where=f"rig {rig.name}: winches[{drive}]",
            next_step="choose home_counts closer to 0, or fewer counts per metre of cable; after"
            " `cdpr home`, set the drive's position near 0 with its manufacturer's tool",
        )
    return low, high


def require_within_limits(rig: Rig, positions: Mapping[int, int], left: str) -> None:
    """Refuses a drive beyond its position limits: it would move to them, or take it as a fault.

    Args:
        positions: By index of the drive, [counts].
        left: The state that the drives are left in.

    Raises:
        Refused: A drive is beyond its limits (607Dh).
    """
    winch_map, names = WinchMap(rig), rig.drive_names
    for drive, position in positions.items():
        low, high = position_limits(rig, drive, winch_map)
        if not low <= position <= high:
            node = rig.winches[drive].node_id
            raise Refused(
                f"{names[node]} is at {position} counts, outside its position limits {low} to"
                f" {high}",
                where="drive group",
                why="under torque it would move to its limit (607Dh), or stop with a fault (8612h)",
                next_step=f"configure limits that include this position, or run {HOME}; {left}",
                values={"node": node},
            )


# Sign of a motor's torque when winding in.
def winding_signs(rig: Rig) -> NDArray[np.int64]:
    """Sign of counts, speed and torque of a drive when winding in, shape (m,).

    The torque that holds a taut cable has this sign: −1 if positive counts pay out.
    """
    return np.array([-1 if w.counts_per_metre > 0 else 1 for w in rig.winches], dtype=np.int64)
