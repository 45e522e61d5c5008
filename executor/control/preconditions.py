"""What must hold before drives are enabled."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from drivers.drive_group import Capabilities, DriveSnapshot
from executor.interlock.reference import HomingReference, moved_since
from executor.trajectory.setpoints import CheckedSetpoints
from model.errors import Refused
from model.kinematics import cable_lengths
from model.pose import Array, Pose
from model.rig import Rig, rig_from_document
from model.winches import WinchMap

WATCHDOG_CYCLES = 3
"""Cycles that a drive's watchdog must last at least: one late cycle is no reason to disarm."""


def require_capabilities(drives: Capabilities, cycle: float) -> None:
    """Drives must start, stop and hold together without the master, or have brakes.

    Drives that no SYNC holds together get their set-points back to back, and when these stay away
    each is stopped by its own watchdog, which frees its cable: then every winch needs a brake.

    Raises:
        Refused: They do not, or the cycle is faster than they were tested with.
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
    """What the rig file must say of drives that only brakes make fit."""
    return "" if drives.sync else " (winches[].brake of all, and drives.watchdog_ms)"


def require_unchanged(course: CheckedSetpoints) -> None:
    """The set-points are still those that were checked.

    Raises:
        Refused: They are not.
    """
    if not course.unchanged:
        raise Refused(
            "the set-points differ from those that were checked",
            where="arming",
            why="memory changed after the check: a defect of the program or the computer",
            next_step="run it again, and test the computer's memory; nothing was enabled",
        )


def require_at_start(course: CheckedSetpoints, actual: Array) -> None:
    """The drives stand where the set-points begin.

    Args:
        course: The set-points.
        actual: Positions of the drives, shape (m,), [counts].

    Raises:
        Refused: One is farther from its first set-point than the rig's start tolerance.
    """
    rig = course.rig
    per_metre = np.array([w.counts_per_metre for w in rig.winches])
    off = np.abs((actual - course.setpoints[0]) / per_metre)
    worst = int(off.argmax())
    if not off[worst] <= rig.motion.start_tolerance:
        raise Refused(
            f"the platform is not at the start of the plan: cable {worst + 1} is"
            f" {off[worst] * 1000:.1f} mm off, limit {rig.motion.start_tolerance * 1000:.1f} mm",
            where="arming",
            why="the platform was moved, or the drives were not homed",
            next_step="move the platform to the plan's start (plan a path from its pose"
            " with `cdpr plan --start-mm`), or home the drives; nothing was enabled",
            values={"off_mm": float(off[worst] * 1000), "cable": float(worst + 1)},
        )


def require_still_referenced(
    rig: Rig,
    reference: HomingReference | None,
    restarted: Sequence[int],
    positions: Sequence[int],
) -> None:
    """Drives without absolute encoders still count from where they were referenced.

    Such a drive silently loses its configuration and position with its power. So it
    must hold the set-up of before, and stand where it was left.

    Args:
        rig: The robot.
        reference: Of its drives; None where it needs none.
        restarted: Nodes that were found without this program's set-up.
        positions: Where the drives are, [counts].

    Raises:
        Refused: One of them was switched on since, or was moved; nothing was enabled.
    """
    if reference is None:
        return
    moved = moved_since(rig, reference, positions)
    for drive, (winch, off) in enumerate(zip(rig.winches, moved, strict=True)):
        if not winch.absolute and winch.node_id in restarted:
            raise _lost(rig, drive, "it was power-cycled after homing")
        if not off <= rig.motion.start_tolerance:
            raise _lost(
                rig, drive, f"it is {off * 1000:.1f} mm of cable from its last known position"
            )


def _lost(rig: Rig, drive: int, how: str) -> Refused:
    node = rig.winches[drive].node_id
    return Refused(
        f"the homing reference of {rig.drive_names[node]} is lost: {how}",
        where="arming",
        why="its encoder is not absolute: its position is arbitrary after power-up",
        next_step="home the drives again with `cdpr home RIG`; nothing was enabled",
        values={"cable": drive + 1, "drive": node},
    )


# Drives that count from anywhere: as what rig they are set up and watched.


def counted_here(rig: Rig, counts: Sequence[int], pose: Pose) -> Rig:
    """The rig as drives that were never referenced are set up for: a guess of what they count.

    Args:
        rig: The robot.
        counts: Where its drives stand, [counts].
        pose: Where its platform is about, ``world_from_platform``.

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


def set_up_here(rig: Rig, snapshot: DriveSnapshot) -> tuple[Rig, float]:
    """What drives are set up for that move nothing: their limits lie about where they stand.

    The rig file's counts are no guide: a drive that is enabled beyond its own position limits runs
    to them.

    Args:
        rig: The robot.
        snapshot: Positions of its drives.

    Returns:
        The rig, see `counted_here`, and the largest tension, [N].
    """
    return counted_here(rig, snapshot.positions.tolist(), rig.home), rig.max_tension


def with_reduced_limits(rig: Rig, *, limit: float, speed: float) -> Rig:
    """The rig as gate and watch see it while winches move by a law; drives are not set up by it.

    With the platform on a jig or not on its cables at all, no tensions need balance it.

    Args:
        rig: The robot.
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
    """No drive holds more than it may from now on: written to it, the limit would let it slip.

    What closed brakes hold is not known before the drives are enabled.

    Args:
        rig: The robot.
        held: State of its drives.
        limit: Largest tension, [N].

    Raises:
        Refused: One does; with its cable.
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
