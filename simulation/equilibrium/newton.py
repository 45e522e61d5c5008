"""Newton's method for the equilibrium of a suspended platform, compiled."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from model.jit import compiled
from model.pose import Array
from simulation.equilibrium.hanging import Hanging, Strained, bend, slope, strain


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
        hanging: Rig and weight.
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
    seen = Strained(np.empty((count, 3)), np.empty((count, 6)), np.empty(count), np.empty(count))
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
