"""Cables, forces and stiffness of a suspended platform, compiled; see `simulation.plant`.

The same formulas, one cable at a time, into arrays of the caller. Tests compare both.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from model.jit import compiled
from model.pose import Array


class Hanging(NamedTuple):
    """Constants of the equilibrium search.

    Attributes:
        outlets: World frame, shape (m, 3), [m].
        feeds: Direction of each cable where it enters its pulley, world frame, shape (m, 3).
        radius: Of the pulleys, 0 without, [m].
        anchors: Platform frame, shape (m, 3), [m].
        axial: EA of each cable, shape (m,), [N].
        behind: From drum to outlet, shape (m,), [m].
        weight: Of platform and payload, [N].
        centre: Their centre of mass, platform frame, shape (3,), [m].
    """

    outlets: Array
    feeds: Array
    radius: float
    anchors: Array
    axial: Array
    behind: Array
    weight: float
    centre: Array


class Strained(NamedTuple):
    """The cables at a pose; kernels fill it.

    Attributes:
        arms: From the platform's origin to each anchor, world axes, shape (m, 3), [m].
        columns: Of the structure matrix, one per row, shape (m, 6).
        straight: From exit to anchor, shape (m,), [m].
        strains: Strain of each cable, negative if slack, shape (m,).
    """

    arms: Array
    columns: Array
    straight: Array
    strains: Array


@compiled
def rotate(rotation: Array, vector: Array) -> tuple[float, float, float]:
    """The product of a matrix, shape (3, 3), and a vector."""
    x, y, z = vector[0], vector[1], vector[2]
    return (
        rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2] * z,
        rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2] * z,
        rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2] * z,
    )


@compiled
def run_cable(
    outlet: Array, feed: Array, radius: float, anchor: tuple[float, float, float]
) -> tuple[float, float, float, float, float]:
    """The cable to an anchor, as `model.kinematics.cables_to`.

    Returns:
        Unit vector from anchor to exit, straight part [m], length [m]; straight part 0 if no
        cable path exists.
    """
    x, y, z = anchor[0] - outlet[0], anchor[1] - outlet[1], anchor[2] - outlet[2]
    if radius == 0.0:
        length = math.sqrt(x * x + y * y + z * z)
        return -x / length, -y / length, -z / length, length, length
    along = x * feed[0] + y * feed[1] + z * feed[2]
    x, y, z = x - along * feed[0], y - along * feed[1], z - along * feed[2]
    reach = math.sqrt(x * x + y * y + z * z)
    outward = reach - radius
    distance = math.hypot(outward, along)
    if not (reach > 0.0 and distance > radius):
        return 0.0, 0.0, 0.0, 0.0, 0.0
    straight = math.sqrt(distance * distance - radius * radius)
    angle = math.atan2(along, outward) + math.acos(radius / distance)
    # The exit, seen from the anchor: outward along the swivel direction, and along the feed.
    out = (radius + radius * math.cos(angle) - reach) / straight
    up = (radius * math.sin(angle) - along) / straight
    share = out / reach
    length = radius * ((math.pi - angle) % (2.0 * math.pi)) + straight
    return (
        share * x + up * feed[0],
        share * y + up * feed[1],
        share * z + up * feed[2],
        straight,
        length,
    )


@compiled
def strain(
    hanging: Hanging, unstrained: Array, position: Array, rotation: Array, seen: Strained
) -> bool:
    """Fills ``seen`` for a pose; False if a cable has no path."""
    for k in range(len(unstrained)):
        a, b, c = rotate(rotation, hanging.anchors[k])
        anchor = (a + position[0], b + position[1], c + position[2])
        cable = run_cable(hanging.outlets[k], hanging.feeds[k], hanging.radius, anchor)
        x, y, z, straight, length = cable
        if not straight > 0.0:
            return False
        seen.arms[k, 0], seen.arms[k, 1], seen.arms[k, 2] = a, b, c
        column = seen.columns[k]
        column[0], column[1], column[2] = x, y, z
        column[3], column[4], column[5] = b * z - c * y, c * x - a * z, a * y - b * x
        seen.straight[k] = straight
        seen.strains[k] = (length + hanging.behind[k]) / unstrained[k] - 1.0
    return True


@compiled
def slope(
    hanging: Hanging, rotation: Array, seen: Strained, tensions: Array, gradient: Array
) -> None:
    """Fills the energy's derivative by a twist: minus the wrench, shape (6,), [N, N·m]."""
    gradient[:] = 0.0
    for k in range(len(tensions)):
        for i in range(6):
            gradient[i] -= tensions[k] * seen.columns[k, i]
    x, y, _ = rotate(rotation, hanging.centre)
    gradient[2] += hanging.weight
    gradient[3] += y * hanging.weight
    gradient[4] -= x * hanging.weight


@compiled
def bend(
    hanging: Hanging,
    rotation: Array,
    seen: Strained,
    rates: Array,
    tensions: Array,
    stiffness: Array,
) -> None:
    """Fills the energy's second derivative by the twist, shape (6, 6); `Suspension.stiffness`."""
    stiffness[:, :] = 0.0
    x, y, z = rotate(rotation, hanging.centre)
    moment = stiffness[3:, 3:]  # first the sum of force times arm, and the arms' second moment
    moment[2, 0] -= hanging.weight * x
    moment[2, 1] -= hanging.weight * y
    moment[2, 2] -= hanging.weight * z
    swing, first, second, third = 0.0, 0.0, 0.0, 0.0
    for k in range(len(tensions)):
        sway = tensions[k] / seen.straight[k]
        arm, column = seen.arms[k], seen.columns[k]
        swing += sway
        first, second, third = first + sway * arm[0], second + sway * arm[1], third + sway * arm[2]
        for i in range(3):
            for j in range(3):
                moment[i, j] += (tensions[k] * column[i] + sway * arm[i]) * arm[j]
    trace = moment[0, 0] + moment[1, 1] + moment[2, 2]
    for i in range(3):
        for j in range(i):
            both = -(moment[i, j] + moment[j, i]) / 2.0
            moment[i, j], moment[j, i] = both, both
        moment[i, i] = trace - moment[i, i]
        stiffness[i, i] = swing
    _set_skew(stiffness, first, second, third)
    for k in range(len(tensions)):
        rate = rates[k] - tensions[k] / seen.straight[k]
        column = seen.columns[k]
        for i in range(6):
            for j in range(6):
                stiffness[i, j] += rate * column[i] * column[j]


@compiled
def _set_skew(stiffness: Array, x: float, y: float, z: float) -> None:
    """Off the diagonal: minus the matrix of the cross product above, plus it below."""
    stiffness[0, 4], stiffness[0, 5], stiffness[1, 5] = z, -y, x
    stiffness[1, 3], stiffness[2, 3], stiffness[2, 4] = -z, y, -x
    for i in range(3):
        for j in range(3):
            stiffness[3 + j, i] = stiffness[i, 3 + j]
