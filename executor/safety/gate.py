"""The safety gate for every set-point before it is sent; denies by default."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum


class Purpose(Enum):
    """Purpose of a set-point."""

    HOLD = "hold"
    """Keep still: the previous targets, or the drives' own positions."""
    MOVE = "move"
    """Follow the checked table."""


@dataclass(frozen=True, slots=True)
class Limits:
    """Limits of set-points, one entry per drive, [counts].

    Attributes:
        lowest: Smallest position.
        highest: Largest position.
        largest_step: Largest change from one cycle to the next.
        largest_lag: Largest distance of a target from the drive's actual position.
    """

    lowest: tuple[int, ...]
    highest: tuple[int, ...]
    largest_step: tuple[int, ...]
    largest_lag: tuple[int, ...]

    def __post_init__(self) -> None:
        """Refuses inconsistent limits: a missing limit would deny nothing.

        Raises:
            ValueError: Not one whole number per drive in each, or an empty range.
        """
        rows = (self.lowest, self.highest, self.largest_step, self.largest_lag)
        if not self.lowest or len({len(row) for row in rows}) > 1:
            raise ValueError("the safety gate needs one limit of each kind per drive")
        if not all(_whole(row) for row in rows):
            raise ValueError("the safety gate's limits must be whole numbers of counts")
        ranges = zip(self.lowest, self.highest, strict=True)
        if (
            any(low > high for low, high in ranges)
            or min(*self.largest_step, *self.largest_lag) < 0
        ):
            raise ValueError("the safety gate's limits allow nothing")


@dataclass(frozen=True, slots=True)
class Request:
    """One cycle's set-points, and the state in which they would be sent.

    Attributes:
        purpose: Their purpose.
        targets: One position per drive, [counts].
        previous: Targets of the previous cycle; None before the first.
        actual: Last reported drive positions, [counts].
        armed: The checked table's hash was confirmed and the operator confirmed the motion.
        enabled: All drives report that they follow.
        latched: A fault is latched.
    """

    purpose: Purpose
    targets: Sequence[int]
    previous: Sequence[int] | None
    actual: Sequence[int]
    armed: bool
    enabled: bool
    latched: bool


@dataclass(frozen=True, slots=True)
class GateDecision:
    """Whether set-points may be sent, and why not."""

    allowed: bool
    reason: str = ""


ALLOWED = GateDecision(True)


def examine(limits: Limits, request: Request) -> GateDecision:
    """Allows or denies one cycle's set-points."""
    count = len(limits.lowest)
    known = {"targets": request.targets, "actual positions": request.actual}
    if request.previous is not None:
        known["previous targets"] = request.previous
    for name, positions in known.items():
        if len(positions) != count:
            return GateDecision(False, f"{len(positions)} {name} for {count} drives")
        if not _whole(positions):
            return GateDecision(False, f"{name} are not all whole numbers")
    if request.purpose is Purpose.HOLD:
        return _hold(limits, request)
    if request.purpose is Purpose.MOVE:
        return _move(limits, request)
    return GateDecision(False, "unknown purpose")


def _hold(limits: Limits, request: Request) -> GateDecision:
    if request.previous is not None and tuple(request.targets) == tuple(request.previous):
        return ALLOWED
    if request.enabled is not False:
        return GateDecision(
            False, "a hold would change the targets of drives that follow set-points"
        )
    return _near_actual(limits, request)


def _move(limits: Limits, request: Request) -> GateDecision:
    if request.latched is not False:
        return GateDecision(False, "a fault is latched")
    if request.armed is not True:
        return GateDecision(False, "not armed")
    if request.enabled is not True:
        return GateDecision(False, "not all drives are enabled")
    if request.previous is None:
        return GateDecision(False, "no previous targets")
    for drive, target in enumerate(request.targets):
        if not limits.lowest[drive] <= target <= limits.highest[drive]:
            return GateDecision(
                False,
                f"cable {drive + 1}: target {target} outside"
                f" [{limits.lowest[drive]}, {limits.highest[drive]}] counts",
            )
        step = abs(target - request.previous[drive])
        if step > limits.largest_step[drive]:
            return GateDecision(
                False,
                f"cable {drive + 1}: step of {step} counts, limit {limits.largest_step[drive]}",
            )
    return _near_actual(limits, request)


def _whole(values: Sequence[int]) -> bool:
    """Whether all are ints; NaN, which passes every comparison, is not."""
    return all(type(value) is int for value in values)


def _near_actual(limits: Limits, request: Request) -> GateDecision:
    for drive, target in enumerate(request.targets):
        lag = abs(target - request.actual[drive])
        if lag > limits.largest_lag[drive]:
            return GateDecision(
                False,
                f"cable {drive + 1}: target {lag} counts from the actual position,"
                f" limit {limits.largest_lag[drive]}",
            )
    return ALLOWED
