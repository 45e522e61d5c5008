"""What must hold before drives are enabled."""

from __future__ import annotations

import numpy as np

from cdpr.errors import Refused
from cdpr.poses import Array
from cdpr.rig import Rig
from drivers.drive_group import Capabilities, DriveGroup
from executor.course import Course
from executor.reference import ReferenceDocument, moved_since

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
        missing.append("take their set-points at one SYNC")
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
            why="a cable robot whose drives do not stop together and hold drops its platform",
            next_step=f"use drives that do, or winches with brakes{_declared(drives)};"
            " nothing was enabled",
        )


def _declared(drives: Capabilities) -> str:
    """What the rig file must say of drives that only brakes make fit."""
    return "" if drives.sync else " (winches[].brake of all, and drives.watchdog_ms)"


def require_unchanged(course: Course) -> None:
    """The set-points are still those that were checked.

    Raises:
        Refused: They are not.
    """
    if not course.unchanged:
        raise Refused(
            "the set-points are not those that were checked",
            where="arming",
            why="memory was written to after the check: a defect of the program or the computer",
            next_step="run it again, and test the computer's memory; nothing was enabled",
        )


def require_at_start(course: Course, actual: Array) -> None:
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
            f" {off[worst] * 1000:.1f} mm off, allowed {rig.motion.start_tolerance * 1000:.1f} mm",
            where="arming",
            why="the rig stands elsewhere, or its drives were not referenced at home",
            next_step="move the platform to the plan's start (plan a path from where it is"
            " with `cdpr plan --start-mm`), or reference the drives; nothing was enabled",
            values={"off_mm": float(off[worst] * 1000), "cable": float(worst + 1)},
        )


def require_still_referenced(
    rig: Rig, reference: ReferenceDocument | None, group: DriveGroup
) -> None:
    """Drives without absolute encoders still count from where they were referenced.

    Such a drive forgets its set-up and its position when its power goes, and nobody tells. So it
    must hold the set-up of before, and stand where it was left.

    Args:
        rig: The robot.
        reference: Of its drives; None where it needs none.
        group: The drives, configured.

    Raises:
        Refused: One of them was switched on since, or was moved; nothing was enabled.
    """
    if reference is None:
        return
    moved = moved_since(rig, reference, group.read_positions().positions.tolist())
    for drive, (winch, off) in enumerate(zip(rig.winches, moved, strict=True)):
        if not winch.absolute and winch.node_id in group.restarted:
            raise _lost(rig, drive, "it was switched on since it was referenced")
        if not off <= rig.motion.start_tolerance:
            raise _lost(
                rig, drive, f"it stands {off * 1000:.1f} mm of cable away from where it was left"
            )


def _lost(rig: Rig, drive: int, how: str) -> Refused:
    node = rig.winches[drive].node_id
    return Refused(
        f"the reference of {rig.drive_names[node]} is lost: {how}",
        where="arming",
        why="its encoder is not absolute: after its power was gone it counts from anywhere",
        next_step="reference the drives again with `cdpr home RIG`; nothing was enabled",
        values={"cable": drive + 1, "drive": node},
    )
