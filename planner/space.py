"""The search space: coordinates and bounds of a pose, and a lattice with costs over it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from model.pose import Array, Pose
from model.rig import Rig


class Space(Protocol):
    """A bounded box of n coordinates, each point of which is a pose.

    Tree, samplers and post-processing access poses only through this interface.

    Attributes:
        lower: Smallest coordinates, shape (n,).
        upper: Largest coordinates, shape (n,).
    """

    lower: Array
    upper: Array

    def pose(self, coordinates: Array) -> Pose:
        """The pose at coordinates, shape (n,)."""

    def coordinates(self, pose: Pose) -> Array:
        """The coordinates of a pose, shape (n,)."""


class PoseSpace:
    """Positions [m] and unit quaternions (w, x, y, z); n = 7.

    The quaternion's bounds are those of its components; the scene's rotation limits are narrower.
    """

    def __init__(self, rig: Rig) -> None:
        """The workspace of ``rig`` with the platform in any orientation."""
        self.lower = np.append(rig.workspace_lower, np.full(4, -1.0))
        self.upper = np.append(rig.workspace_upper, np.full(4, 1.0))

    def pose(self, coordinates: Array) -> Pose:
        """The pose of a position and a quaternion, shape (7,)."""
        return Pose.from_quaternion(coordinates[:3], coordinates[3:])

    def coordinates(self, pose: Pose) -> Array:
        """Position and quaternion of a pose, shape (7,)."""
        return np.append(pose.position, pose.quaternion)


class TranslationSpace:
    """Positions of the platform's origin in the workspace box at one orientation; n = 3, [m]."""

    def __init__(self, rig: Rig, rotation: Array) -> None:
        """The workspace of ``rig`` with the platform at orientation ``rotation``, shape (3, 3)."""
        self.lower = rig.workspace_lower
        self.upper = rig.workspace_upper
        self.rotation = rotation

    def pose(self, coordinates: Array) -> Pose:
        """The pose with the platform's origin at ``coordinates``, shape (3,), [m]."""
        return Pose(coordinates, self.rotation)

    def coordinates(self, pose: Pose) -> Array:
        """The position of a pose, shape (3,), [m]."""
        return pose.position


# A regular lattice of points over a box, and trilinear interpolation between them.


_CELLS = 20
"""Cells along the longest side. Source: measured on the first two rigs of `configs/`, where the
kinematic cost between lattice points is then within 1 % of the exact one."""


@dataclass(frozen=True, slots=True, eq=False)
class Lattice:
    """Points ``lower + spacing * (i, j, k)``, numbered with k fastest.

    Attributes:
        lower: The first point, shape (3,), [m].
        spacing: Between points along each axis, shape (3,), [m].
        shape: Number of points along each axis.
    """

    lower: Array
    spacing: Array
    shape: tuple[int, int, int]

    @classmethod
    def over(cls, lower: Array, upper: Array) -> Lattice:
        """A lattice over a box, both ends included, with nearly cubic cells."""
        size = upper - lower
        cells = np.maximum(1, np.ceil(_CELLS * size / size.max() - 1e-9)).astype(int)
        x, y, z = (int(c) + 1 for c in cells)
        return cls(lower, size / cells, (x, y, z))

    @property
    def count(self) -> int:
        """Number of points."""
        return int(np.prod(self.shape))

    def points(self, numbers: NDArray[np.int64]) -> Array:
        """The points of given indices, shape (k,) → (k, 3), [m]."""
        index = np.stack(np.unravel_index(numbers, self.shape), axis=-1)
        points: Array = self.lower + index * self.spacing
        return points


def corners_and_weights(lattice: Lattice, points: Array) -> tuple[NDArray[np.int64], Array]:
    """Indices of the eight lattice points around each point, and their trilinear weights.

    Args:
        points: Shape (k, 3), [m]; outside the box the nearest cell is used.

    Returns:
        Shape (k, 8) each.
    """
    last = np.array(lattice.shape) - 2
    scaled = (points - lattice.lower) / lattice.spacing
    cell = np.clip(np.floor(scaled).astype(np.int64), 0, last)
    part = np.clip(scaled - cell, 0.0, 1.0)
    strides = np.array([lattice.shape[1] * lattice.shape[2], lattice.shape[2], 1])
    first = cell @ strides
    offsets = _CORNERS @ strides
    factors = np.where(_CORNERS, part[:, None, :], 1.0 - part[:, None, :])
    return first[:, None] + offsets, factors[..., 0] * factors[..., 1] * factors[..., 2]


_CORNERS = np.array([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)])


# An index over the workspace as a cost.


def finite_range(values: Array) -> tuple[float, float]:
    """The smallest and the largest finite value; 0 without any."""
    finite = values[np.isfinite(values)]
    return (float(finite.min()), float(finite.max())) if len(finite) else (0.0, 0.0)


def scaled(values: Array, low: float, high: float) -> Array:
    """An index as a cost: 0 at its best within the workspace or better, 1 at a singular pose.

    An orientation other than the one of the extremes may be better than their best.
    """
    rising = np.maximum((values - low) / (high - low if high > low else 1.0), 0.0)
    return np.where(np.isfinite(values), rising, 1.0)
