"""Equilibrium of a platform on elastic cables, compiled: forces, stiffness, Newton's method.

The same formulas, one cable at a time, into arrays of the caller. Tests compare both.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

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


class StrainedCables(NamedTuple):
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
    hanging: Hanging, unstrained: Array, position: Array, rotation: Array, seen: StrainedCables
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
    hanging: Hanging, rotation: Array, seen: StrainedCables, tensions: Array, gradient: Array
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
    seen: StrainedCables,
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


# Newton's method.


@compiled
def hang_still(
    hanging: Hanging,
    unstrained: Array,
    position: Array,
    rotation: Array,
    tensions: Array,
    reach: float,
    tolerance: float,
    steps: int,
) -> bool:
    """Finds the equilibrium, starting from the present set of taut cables.

    During the search taut cables may also push, as a step of the drums may compress some, and slack
    ones have no force. If it converges with a pushing cable or a stretched slack one, it continues
    with the set of cables that are stretched there.

    Args:
        unstrained: Lengths of the whole cables, shape (m,), [m].
        position: Of the platform, shape (3,), [m]; overwritten by the result.
        rotation: Matrix, shape (3, 3); overwritten by the result.
        tensions: Shape (m,), [N]; 0 for a slack cable; overwritten by the result.
        reach: Of the platform, [m].
        tolerance: Largest residual force [N], and moment over the reach [N].
        steps: Largest number of steps.

    Returns:
        False if it does not converge, or converges to an unstable equilibrium.
    """
    count = len(unstrained)
    pulls = tensions > 0.0
    seen = StrainedCables(
        np.empty((count, 3)), np.empty((count, 6)), np.empty(count), np.empty(count)
    )
    gradient, stiffness, rates = np.empty(6), np.empty((6, 6)), np.empty(count)
    for _ in range(steps):
        if not strain(hanging, unstrained, position, rotation, seen):
            return False
        for k in range(count):
            tensions[k] = hanging.axial[k] * seen.strains[k] if pulls[k] else 0.0
            rates[k] = hanging.axial[k] / unstrained[k] if pulls[k] else 0.0
        slope(hanging, rotation, seen, tensions, gradient)
        if is_small(gradient, reach, tolerance):
            if not renew(pulls, seen.strains):
                bend(hanging, rotation, seen, rates, tensions, stiffness)
                return is_positive(stiffness)
            continue
        for k in range(count):  # a cable that pushes does not stiffen
            tensions[k] = max(tensions[k], 0.0)
        bend(hanging, rotation, seen, rates, tensions, stiffness)
        if not solve(stiffness, gradient):
            return False
        for i in range(3):
            position[i] -= gradient[i]
        turn(rotation, -gradient[3], -gradient[4], -gradient[5])
    return False


@compiled
def is_small(gradient: Array, reach: float, tolerance: float) -> bool:
    """Whether forces and moments are balanced; False for NaN."""
    for i in range(3):
        force, moment = abs(gradient[i]), abs(gradient[3 + i]) / reach
        if not (force < tolerance and moment < tolerance):
            return False
    return True


@compiled
def renew(pulls: NDArray[np.bool_], strains: Array) -> bool:
    """Updates the set of stretched cables in place; returns whether it changed."""
    changed = False
    for k in range(len(pulls)):
        stretched = strains[k] > 0.0
        changed = changed or stretched != pulls[k]
        pulls[k] = stretched
    return changed


@compiled
def turn(rotation: Array, x: float, y: float, z: float) -> None:
    """Rotates in place by a rotation vector in the world, [rad]; `matrix_from_rotation_vector`."""
    angle = math.sqrt(x * x + y * y + z * z)
    first, second = 1.0, 0.5
    if angle >= 1e-6:
        first, second = math.sin(angle) / angle, (1.0 - math.cos(angle)) / (angle * angle)
    for j in range(3):
        a, b, c = rotation[0, j], rotation[1, j], rotation[2, j]
        u, v, w = y * c - z * b, z * a - x * c, x * b - y * a
        rotation[0, j] = a + first * u + second * (y * w - z * v)
        rotation[1, j] = b + first * v + second * (z * u - x * w)
        rotation[2, j] = c + first * w + second * (x * v - y * u)


@compiled
def solve(matrix: Array, vector: Array) -> bool:
    """Solves matrix · x = vector in place of both (Gauss, partial pivots); False if singular."""
    size = len(vector)
    for i in range(size):
        pivot = i
        for k in range(i + 1, size):
            if abs(matrix[k, i]) > abs(matrix[pivot, i]):
                pivot = k
        if not abs(matrix[pivot, i]) > 0.0:
            return False
        if pivot != i:
            for j in range(i, size):
                matrix[i, j], matrix[pivot, j] = matrix[pivot, j], matrix[i, j]
            vector[i], vector[pivot] = vector[pivot], vector[i]
        for k in range(i + 1, size):
            share = matrix[k, i] / matrix[i, i]
            for j in range(i + 1, size):
                matrix[k, j] -= share * matrix[i, j]
            vector[k] -= share * vector[i]
    for i in range(size - 1, -1, -1):
        for j in range(i + 1, size):
            vector[i] -= matrix[i, j] * vector[j]
        vector[i] /= matrix[i, i]
    return True


@compiled
def is_positive(matrix: Array) -> bool:
    """Whether a symmetric matrix is positive definite (Cholesky, in place)."""
    for i in range(len(matrix)):
        for j in range(i + 1):
            rest = matrix[i, j]
            for k in range(j):
                rest -= matrix[i, k] * matrix[j, k]
            if i > j:
                matrix[i, j] = rest / matrix[j, j]
            elif rest > 0.0:
                matrix[i, i] = math.sqrt(rest)
            else:
                return False
    return True
