"""Drives that count from anywhere: as what rig they are set up and watched."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cdpr.errors import Refused
from cdpr.kinematics import cable_lengths
from cdpr.poses import Pose
from cdpr.rig import Rig, rig_from_document
from cdpr.winches import WinchMap
from drivers.drive_group import CycleStatus


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


def set_up_here(rig: Rig, told: CycleStatus) -> tuple[Rig, float]:
    """What drives are set up for that move nothing: their limits lie about where they stand.

    The rig file's counts are no guide: a drive that is enabled beyond its own position limits runs
    to them.

    Args:
        rig: The robot.
        told: Where its drives stand.

    Returns:
        The rig, see `counted_here`, and the largest tension, [N].
    """
    return counted_here(rig, told.positions.tolist(), rig.home), rig.max_tension


def careful(rig: Rig, *, limit: float, speed: float) -> Rig:
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


def require_below(rig: Rig, held: CycleStatus, limit: float) -> None:
    """No drive holds more than it may from now on: written to it, the limit would let it slip.

    What closed brakes hold is not known before the drives are enabled.

    Args:
        rig: The robot.
        held: What its drives tell.
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
            why="a drive whose torque is limited to less than it holds lets its cable slip",
            next_step="name a higher --limit-n, or take the load off these cables; the drives hold"
            " as before",
        )
