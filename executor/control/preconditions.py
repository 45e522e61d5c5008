"""Preconditions of enabling the drives."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from drivers.drive_group import Capabilities, CycleStatus, DriveSnapshot
from drivers.factory import without_torque
from drivers.plausibility import HOME
from executor.interlock.reference import (
    RESTARTED,
    HomingReference,
    moved_since,
    released_since,
    turns_lost,
    why_turns_lost,
)
from executor.trajectory.setpoints import CheckedSetpoints
from model.errors import Refused
from model.kinematics import cable_lengths
from model.pose import Array, Pose
from model.rig import Rig, rig_from_document
from model.winches import WinchMap

WATCHDOG_CYCLES = 3
"""Shortest watchdog of a drive, in cycles: one late cycle must not disarm it."""


def require_capabilities(drives: Capabilities, cycle: float) -> None:
    """Requires drives that start, stop and hold together without the master, or have brakes.

    Drives without a common SYNC get their set-points back to back, and when these cease,
    each is stopped by its own watchdog, which releases its cable: then every winch needs a brake.

    Raises:
        Refused: A capability is missing, or the cycle is faster than tested with these drives.
    """
    watchdog = (drives.watchdog_ms or 0.0) / 1000.0
    braked = drives.has_brake and watchdog > 0.0
    missing = []
    if not (drives.sync or braked):
        missing.append("apply set-points at a common SYNC")
    if not (drives.holds_on_comm_loss or braked):
        missing.append("hold when the master is lost")
    if not (drives.holds_on_quick_stop or drives.has_brake):
        missing.append("hold after a quick stop")
    if drives.watchdog_ms is not None and not watchdog >= WATCHDOG_CYCLES * cycle - 1e-9:
        missing.append(f"stay armed for {WATCHDOG_CYCLES} cycles without a set-point")
    if not cycle * drives.max_hz >= 1.0 - 1e-9:
        missing.append(f"keep up with a cycle of {cycle * 1000:g} ms")
    if missing:
        raise Refused(
            f"these drives do not {', nor '.join(missing)}",
            where="arming",
            why="if the drives do not stop together and hold, the platform drops",
            next_step=f"use drives that do, or winches with brakes{_declared(drives)};"
            " nothing was enabled",
        )


def _declared(drives: Capabilities) -> str:
    """Keys of the rig file for drives that rely on brakes."""
    return "" if drives.sync else " (winches[].brake of all, and drives.watchdog_ms)"


def require_checked(checked: CheckedSetpoints) -> None:
    """Requires the set-points to be those that were checked.

    Raises:
        Refused: They differ.
    """
    if not checked.unchanged:
        raise Refused(
            "the set-points differ from those that were checked",
            where="arming",
            why="memory changed after the check: a defect of the program or the computer",
            next_step="run it again, and test the computer's memory; nothing was enabled",
        )


def require_at_start(checked: CheckedSetpoints, actual: Array) -> None:
    """Requires the drives to be at the first set-points.

    Args:
        actual: Positions of the drives, shape (m,), [counts].

    Raises:
        Refused: One is farther from its first set-point than the rig's start tolerance.
    """
    rig = checked.rig
    per_metre = np.array([w.counts_per_metre for w in rig.winches])
    off = np.abs((actual - checked.setpoints[0]) / per_metre)
    worst = int(off.argmax())
    if not off[worst] <= rig.motion.start_tolerance:
        raise Refused(
            f"the platform is not at the start of the plan: cable {worst + 1} is"
            f" {off[worst] * 1000:.1f} mm off, limit {rig.motion.start_tolerance * 1000:.1f} mm",
            where="arming",
            why="the platform was moved, or the drives were not homed",
            next_step="move the platform to the plan's start (plan a path from its pose with"
            " `cdpr plan --start-mm`, in Python cdpr.plan(start=)), or home the drives; nothing was"
            " enabled",
            values={"off_mm": float(off[worst] * 1000), "cable": float(worst + 1)},
        )


def require_still_referenced(
    rig: Rig,
    reference: HomingReference | None,
    restarted: Sequence[int],
    seen: CycleStatus | DriveSnapshot,
) -> None:
    """Requires the drives to have kept their reference.

    A drive without an absolute encoder silently loses its configuration and position with its
    power. So it must still have its configuration, and be at its last known position. Absolute
    ones with brakes must not have lost turns. Any drive that was left holding its cable must still
    hold it.

    Args:
        reference: Homing reference of its drives; None where it needs none.
        restarted: Nodes found without this program's configuration.
        seen: State of the drives before any is enabled.

    Raises:
        Refused: A drive was power-cycled or moved, or lost its torque, since; nothing was enabled.
    """
    if reference is None:
        return
    positions = seen.positions.tolist()
    if lost := why_turns_lost(rig, reference, positions):
        raise turns_lost(lost, "arming")
    moved = moved_since(rig, reference, positions)
    for drive, (winch, off) in enumerate(zip(rig.winches, moved, strict=True)):
        if not winch.absolute and winch.node_id in restarted:
            raise _lost(rig, drive, f"it was {RESTARTED}")
        if not off <= rig.motion.start_tolerance:
            raise _lost(
                rig, drive, f"it is {off * 1000:.1f} mm of cable from its last known position"
            )
    released = without_torque(rig, seen.status_words.tolist())
    if dropped := released_since(rig, reference, restarted, released):
        raise Refused(
            f"the homing reference is lost: {dropped}",
            where="arming",
            why="their cables were released under tension, and may have slipped or come off a"
            " pulley",
            next_step=f"check cables and platform, then home the drives again: {HOME};"
            " nothing was enabled",
        )


def _lost(rig: Rig, drive: int, how: str) -> Refused:
    node = rig.winches[drive].node_id
    return Refused(
        f"the homing reference of {rig.drive_names[node]} is lost: {how}",
        where="arming",
        why="its encoder is not absolute: its position is arbitrary after power-up",
        next_step=f"home the drives again: {HOME}; nothing was enabled",
        values={"cable": drive + 1, "drive": node},
    )


# Unreferenced drives: the rig they are configured and monitored as.


def with_counts_at(rig: Rig, counts: Sequence[int], pose: Pose) -> Rig:
    """The rig that unreferenced drives are configured for, with counts from a guessed pose.

    Args:
        counts: Positions of its drives, [counts].
        pose: Approximate pose of its platform, ``world_from_platform``.

    Raises:
        TensionInfeasible: The rig cannot hold its platform at home.
    """
    winches = WinchMap(rig)
    there = winches.unstrained(cable_lengths(rig, pose), np.zeros(rig.cable_count))
    home = winches.home_counts + np.asarray(counts) - winches.counts(there)
    winches_here = [
        winch.model_copy(update={"home_counts": round(float(count))})
        for winch, count in zip(rig.document.winches, home, strict=True)
    ]
    return rig_from_document(rig.document.model_copy(update={"winches": winches_here}))


def configuration_at_rest(rig: Rig, snapshot: DriveSnapshot) -> tuple[Rig, float]:
    """Configuration of drives that will not move: limits centred on their positions.

    The rig file's counts do not apply: a drive enabled beyond its position limits runs to them.

    Args:
        snapshot: Positions of its drives.

    Returns:
        The rig, see `with_counts_at`, and the largest tension, [N].
    """
    return with_counts_at(rig, snapshot.positions.tolist(), rig.home), rig.max_tension


def with_reduced_limits(rig: Rig, *, limit: float, speed: float) -> Rig:
    """The rig for gate and monitors while winches move by a law; not for drive configuration.

    With the platform on a jig or detached, no tensions need balance it.

    Args:
        limit: Largest tension, [N].
        speed: Fastest winch, [m/s].
    """
    document = rig.document
    slow = [
        winch.model_copy(update={"max_speed_mm_s": min(winch.max_speed_mm_s, speed * 1000.0)})
        for winch in document.winches
    ]
    cables = document.cables.model_copy(update={"max_tension_n": limit})
    return rig_from_document(document.model_copy(update={"winches": slow, "cables": cables}))


def require_below(rig: Rig, held: DriveSnapshot, limit: float) -> None:
    """Requires every drive's torque to be below its new limit, which would let it slip.

    The load on closed brakes is unknown until the drives are enabled.

    Args:
        held: State of its drives.
        limit: Largest tension, [N].

    Raises:
        Refused: A tension exceeds the limit; with its drive.
    """
    tensions = rig.tensions_by(held.torques)
    over = [
        f"{name} carries {tension:.1f} N"
        for name, tension in zip(rig.drive_names.values(), tensions.tolist(), strict=True)
        if not tension <= limit
    ]
    if over:
        raise Refused(
            f"{', '.join(over)}, more than the limit of {limit:g} N",
            where="setting the drives' torque limit",
            why="a drive with a torque limit below its holding torque lets its cable slip",
            next_step="set a higher limit, or unload these cables; the drives hold as before",
        )
