"""Where the platform stands, from where its drives stand."""

from __future__ import annotations

import numpy as np

from model.errors import Fault, Refused
from model.kinematics import forward_kinematics
from model.pose import Array, Pose
from model.rig import Rig
from model.scene import Load
from model.statics.gravity import working_tensions
from model.winches import WinchMap

#: The stretch of the cables depends on the pose: rounds until the pose changes no more than this,
#: [m]; soft cables on a large robot need some twenty.
_SETTLED, _ROUNDS = 1e-8, 200


def current_pose(rig: Rig, counts: Array, load: Load) -> Pose:
    """The pose whose planned drive positions are these, ``world_from_platform``.

    Args:
        rig: The robot; its drives are referenced.
        counts: Positions of the drives, shape (m,), [counts].
        load: What the platform carries.

    Raises:
        Refused: No pose of the workspace fits them within the rig's start tolerance.
        TensionInfeasible: The cables cannot hold the platform there.
        Fault: The search for a pose ended without one.
    """
    winches = WinchMap(rig)
    unstrained = winches.unstrained_from_counts(counts)
    tensions = working_tensions(rig, rig.home, load).tensions
    found = forward_kinematics(rig, winches.strained(unstrained, tensions))
    for _ in range(_ROUNDS):
        before = found.pose
        tensions = working_tensions(rig, before, load).tensions
        found = forward_kinematics(rig, winches.strained(unstrained, tensions), before)
        if found.pose.distance_to(before) < _SETTLED:
            break
    else:
        raise Fault(
            "the platform pose could not be computed from the drive positions",
            where="drive positions",
            why="the solver did not converge",
            next_step="report this with the rig file and the positions; nothing has moved",
        )
    place = found.pose.position
    inside = np.all((rig.workspace_lower <= place) & (place <= rig.workspace_upper))
    if not (inside and found.worst <= rig.motion.start_tolerance):
        x, y, z = place * 1000.0
        raise Refused(
            f"the drive positions fit no pose in the workspace: the nearest is {x:.1f}, {y:.1f},"
            f" {z:.1f} mm, with a cable {found.worst * 1000:.1f} mm off",
            where="drive positions",
            why="the homing reference is lost, a cable slipped, or the rig file is wrong",
            next_step="home the drives at a known pose (home_counts in the rig file);"
            " nothing was moved",
        )
    return found.pose
