"""Wrenches of gravity and inertia on platform and payload, and the commanded tensions."""

from __future__ import annotations

from math import hypot, sqrt
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from model.errors import BadInput
from model.kinematics import structure_matrix
from model.pose import Array, Pose
from model.statics.tension_distribution import TensionSolution, solve_tensions
from model.statics.wrench_sets import rms_anchor_radius

if TYPE_CHECKING:
    from model.rig import Rig
    from model.scene import Load

STANDARD_GRAVITY = 9.80665
"""[m/s²]. Source: 3rd General Conference on Weights and Measures, 1901."""


def gravity_wrench(
    mass: float,
    centre_of_mass_offset: ArrayLike,
    *,
    payload_mass: float = 0.0,
    payload_offset: ArrayLike = (0.0, 0.0, 0.0),
) -> NDArray[np.float64]:
    """Return the wrench of the weight of platform and payload about the platform origin.

    Args:
        mass: Mass of the platform [kg].
        centre_of_mass_offset: From the platform origin to the platform's centre of mass, shape
            (..., 3), [m], world frame: the rotation of the platform is already applied.
        payload_mass: Mass of the payload [kg].
        payload_offset: From the platform origin to the payload's centre of mass, shape
            (..., 3), [m], world frame.

    Returns:
        External wrench, shape (..., 6), [N, N·m], world frame.

    Raises:
        BadInput: A mass is negative, a value is not finite, or a shape is wrong.
    """
    platform = _weight(mass, centre_of_mass_offset, "platform")
    return platform + _weight(payload_mass, payload_offset, "payload")


def _weight(mass: float, offset: ArrayLike, name: str) -> NDArray[np.float64]:
    arm = np.asarray(offset, dtype=np.float64)
    if arm.ndim < 1 or arm.shape[-1] != 3:
        raise BadInput(f"the offset of the {name} has shape {arm.shape}, not (..., 3)")
    if not (0.0 <= mass < np.inf and np.isfinite(arm).all()):
        raise BadInput(f"mass {mass} kg or offset of the {name} is not a usable number")
    weight = mass * STANDARD_GRAVITY
    wrench = np.zeros((*arm.shape[:-1], 6))
    wrench[..., 2] = -weight
    # offset × (0, 0, -weight), written out.
    wrench[..., 3] = -arm[..., 1] * weight
    wrench[..., 4] = arm[..., 0] * weight
    return wrench


# Inertia. Planned tensions are those at rest; the cables must have this wrench left.


RATE_CHANGES = 2.0
"""A feed hold slows down by the path's acceleration, on top of the deceleration of the path."""
_BENDING = 1.5
"""Largest share of ω² in the acceleration of a point per metre: centripetal, and half of it in the
angular acceleration, as rotation vectors are not added like rotations."""


def largest_lever(rig: Rig, load: Load | None = None) -> float:
    """Distance from the platform's origin within which all mass is, [m].

    A payload counts as a point, or as inside the platform's reach.
    """
    centres = [rig.centre_of_mass, *([] if load is None else [load.payload_centre])]
    return max(rig.reach, *(float(np.linalg.norm(centre)) for centre in centres))


def inertial_wrench(rig: Rig, load: Load | None = None, *, turns: bool) -> float:
    """Largest wrench that accelerates platform and payload along a path, [N].

    Along the path and across it in corners the acceleration keeps to the motion's limit, and its
    jerk lets it rise to at most √(2 j v), as no rounded corner turns by more than 2 rad.

    Args:
        rig: The robot, whose motion has the path's limits.
        load: Payload; none when left out.
        turns: Whether the platform rotates along the path.

    Returns:
        Norm of force and moment about the platform's origin, with moments divided by the RMS
        distance ρ of the anchors: comparable with a capacity margin.
    """
    motion, radius = rig.motion, rms_anchor_radius(rig.anchors)
    carried = 0.0 if load is None else load.payload_mass
    mass = rig.mass + carried
    most = RATE_CHANGES * min(motion.acceleration, sqrt(2.0 * motion.jerk * motion.speed))
    if turns:
        lever = largest_lever(rig, load)
        per_length = hypot(1.0, lever / radius)
        most = most * per_length + _BENDING * lever * (motion.speed / radius) ** 2
        return mass * most * per_length
    moment = rig.mass * rig.centre_of_mass
    if load is not None:
        moment = moment + carried * load.payload_centre
    return most * hypot(mass, float(np.linalg.norm(moment)) / radius)


# The commanded tensions: one rule for planner, check, executor and plant.


PRETENSION_SHARE = 0.2
"""Position of the reference tension between the tension limits: taut enough not to sag, far from
the upper limit. The solution is the nearest to it, hence continuous in the pose."""


def weight_wrench(rig: Rig, pose: Pose, load: Load | None = None) -> Array:
    """Wrench of gravity on platform and payload, about the platform's origin, world axes.

    Args:
        pose: ``world_from_platform``.
        load: The scene's load; the wrench includes its payload, not its wrench box.

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
        load: Payload; none when left out.

    Raises:
        TensionInfeasible: The cables cannot hold the weight at this pose within their limits.
    """
    wanted = rig.min_tension + PRETENSION_SHARE * (rig.max_tension - rig.min_tension)
    return solve_tensions(
        structure_matrix(rig, pose),
        weight_wrench(rig, pose, load),
        rig.min_tension,
        rig.max_tension,
        reference=wanted,
    )
