"""Structure matrices for the tests of this folder, built without the package under test."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linprog

Array = NDArray[np.float64]

# The paper's rig. Source: Table 1 with the digits of the authors' code, which also has -437.082
# where the table prints -427.08; the reference values come from these.
PAPER_OUTLETS: Array = 1e-3 * np.array(
    [
        [-437.082, 524.3283, 864.7443],
        [439.7277, 525.9461, 860.8701],
        [-435.143, -521.906, 839.1691],
        [437.8987, -523.83, 859.4645],
        [-535.048, 466.8895, 79.72492],
        [531.9962, 451.4305, 80.32775],
        [-543.043, -463.811, 71.49693],
        [529.0567, -448.63, 84.36402],
    ]
)
PAPER_ANCHORS: Array = 0.065 * np.array(
    [
        [-1, 1, -1],
        [1, 1, -1],
        [-1, -1, -1],
        [1, -1, -1],
        [-1, 1, 1],
        [1, 1, 1],
        [-1, -1, 1],
        [1, -1, 1],
    ]
)
PAPER_LENGTH = 0.065 * 3**0.5
PAPER_WEIGHT: Array = np.array([0.0, 0.0, -0.4 * 9.80665, 0.0, 0.0, 0.0])
HOME = (0.0, 0.0, 0.445)


def structure_matrix(outlets: Array, anchors: Array, position: Array) -> Array:
    """Return the structure matrix of a level platform, shape (6, m)."""
    along = outlets - anchors - position
    directions = along / np.linalg.norm(along, axis=1, keepdims=True)
    return np.vstack([directions.T, np.cross(anchors, directions).T])


def paper_matrix(position: tuple[float, ...] = HOME) -> Array:
    return structure_matrix(PAPER_OUTLETS, PAPER_ANCHORS, np.array(position))


def paper_matrices_at_slice(points_a_side: int) -> Array:
    """Return the matrices over the reference slice z = 445 mm, |x|, |y| <= 200 mm."""
    side = np.linspace(-0.2, 0.2, points_a_side)
    return np.array([paper_matrix((x, y, 0.445)) for x in side for y in side])


def random_matrix(seed: int, cables: int, *, suspended: bool = False) -> Array:
    """Return the matrix of a robot with outlets around (or only above) a box-shaped platform."""
    random = np.random.default_rng(seed)
    outlets = random.uniform(-1.0, 1.0, (cables, 3))
    outlets /= np.abs(outlets).max(axis=1, keepdims=True)
    if suspended:
        outlets[:, 2] = 1.0
    anchors = random.uniform(-0.2, 0.2, (cables, 3))
    return structure_matrix(outlets, anchors, random.uniform(-0.2, 0.2, 3))


def flat_matrix(cables: int = 8) -> Array:
    """Return a matrix without full rank: every cable meets the platform in one point."""
    outlets = np.random.default_rng(7).uniform(-1.0, 1.0, (cables, 3))
    return structure_matrix(outlets, np.zeros((cables, 3)), np.zeros(3))


def largest_smallest_tension(matrix: Array) -> float:
    """Return the largest s with tensions of at most 1 and at least s that balance each other.

    It is above zero exactly where the pose has wrench closure, if the matrix has full rank.
    """
    cables = matrix.shape[1]
    answer = linprog(
        np.append(np.zeros(cables), -1.0),
        A_eq=np.column_stack([matrix, np.zeros(6)]),
        b_eq=np.zeros(6),
        A_ub=np.column_stack([-np.eye(cables), np.ones(cables)]),
        b_ub=np.zeros(cables),
        bounds=[(0.0, 1.0)] * cables + [(None, None)],
    )
    return float(-answer.fun)
