"""The wrench of gravity on platform and payload, and the commanded tensions."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from model.errors import BadInput
from model.kinematics import structure_matrix
from model.pose import Array, Pose
from model.statics.tension_distribution import TensionSolution, solve_tensions

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


# The commanded tensions: one rule for planner, check, executor and plant.


PRETENSION_SHARE = 0.2
"""Position of the reference tension between the tension limits: taut enough not to sag, far from
the upper limit. The solution is the nearest to it, hence continuous in the pose."""


def weight_wrench(rig: Rig, pose: Pose, load: Load | None = None) -> Array:
    """Wrench of gravity on platform and payload, about the platform's origin, world axes.

    Args:
        rig: The robot.
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
