"""The tensions that the rig is run with: one rule for planner, check, executor and plant."""

from __future__ import annotations

from cdpr.kinematics import structure_matrix
from cdpr.poses import Array, Pose
from cdpr.rig import Rig
from cdpr.scene import Load
from cdpr.statics.gravity import gravity_wrench
from cdpr.statics.tension import solve_tensions
from cdpr.statics.tension_solution import TensionSolution

PRETENSION_SHARE = 0.2
"""Where the wanted tension lies between the smallest and the largest allowed one: taut enough not
to sag, far from the limit. The solution is the one nearest to it, hence continuous in the pose."""


def weight_wrench(rig: Rig, pose: Pose, load: Load | None = None) -> Array:
    """Wrench of gravity on platform and payload, about the platform's origin, world axes.

    Args:
        rig: The robot.
        pose: ``world_from_platform``.
        load: The scene's load; its payload is carried, its wrench box is not in this wrench.

    Returns:
        Shape (6,), [N, N·m].
    """
    carried = load.payload_mass if load else 0.0
    centre = pose.rotation @ load.payload_centre if load else (0.0, 0.0, 0.0)
    return gravity_wrench(
        rig.mass, pose.rotation @ rig.centre_of_mass, payload_mass=carried, payload_offset=centre
    )


def working_tensions(rig: Rig, pose: Pose, load: Load | None = None) -> TensionSolution:
    """The tensions commanded at a pose: nearest to the pretension, within the rig's limits.

    Args:
        rig: The robot.
        pose: ``world_from_platform``.
        load: What it carries; nothing when left out.

    Raises:
        TensionInfeasible: The cables cannot hold the weight at this pose within their limits.
    """
    wanted = rig.min_tension + PRETENSION_SHARE * (rig.max_tension - rig.min_tension)
    return solve_tensions(
        structure_matrix(rig, pose),
        weight_wrench(rig, pose, load),
        rig.min_tension,
        rig.max_tension,
        method="least_norm",
        reference=wanted,
    )
