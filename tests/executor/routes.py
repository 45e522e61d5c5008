"""Random poses and routes for the tests of this folder, and distances by an independent route."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from executor.trajectory.path import Path, line
from model.pose import Pose
from model.rig import Motion

Array = NDArray[np.float64]
WEIGHT = 0.11
GACHON = Motion(
    speed=0.020,
    acceleration=0.1,
    jerk=1.0,
    blend_tolerance=0.001,
    following_error=0.002,
    start_tolerance=0.001,
    stuck_travel=0.00007,
    stuck_speed=0.002,
)
HALL = Motion(
    speed=0.1,
    acceleration=0.3,
    jerk=3.0,
    blend_tolerance=0.005,
    following_error=0.005,
    start_tolerance=0.003,
    stuck_travel=0.00007,
    stuck_speed=0.002,
)


def at_mm(x: float, y: float, z: float, turn_deg: float = 0.0) -> Pose:
    """A pose rotated about z."""
    turn = Rotation.from_euler("z", turn_deg, degrees=True).as_matrix()
    return Pose(np.array([x, y, z]) / 1000.0, turn)


def random_pose(rng: np.random.Generator, size: float, turn: float = 0.0) -> Pose:
    """A pose in a cube of half width ``size`` [m], rotated by up to ``turn`` [rad]."""
    axis = rng.normal(size=3)
    vector = axis / np.linalg.norm(axis) * turn * rng.random()
    return Pose(rng.uniform(-size, size, 3), Rotation.from_rotvec(vector).as_matrix())


def random_route(
    seed: int, rotated: bool = False, count: int | None = None, sharpest_deg: float = 130.0
) -> list[Pose]:
    """Two to seven waypoints, from some millimetres to some decimetres apart.

    Turns are uniformly distributed between 0 and ``sharpest_deg``, in any plane.
    """
    rng = np.random.default_rng(seed)
    size = 10.0 ** rng.uniform(-2.5, -0.5)
    turn = 0.5 * size if rotated else 0.0  # [rad] for [m]: part of the path length, not most of it
    poses = [random_pose(rng, size, turn)]
    heading = rng.normal(size=3)
    heading /= np.linalg.norm(heading)
    for _ in range((count or rng.integers(2, 8)) - 1):
        across = np.cross(heading, rng.normal(size=3))
        angle = np.radians(rng.uniform(0.0, sharpest_deg))
        heading = np.cos(angle) * heading + np.sin(angle) * across / np.linalg.norm(across)
        position = poses[-1].position + size * rng.uniform(0.3, 1.0) * heading
        poses.append(Pose(position, random_pose(rng, size, turn).rotation))
    return poses


def steps_between(positions: Array, rotations: Array, weight: float = WEIGHT) -> Array:
    """√(|Δp|² + (ρ Δθ)²) of neighbouring rows, shape (n − 1,), [m]."""
    moved = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    relative = np.einsum("nji,njk->nik", rotations[:-1], rotations[1:])
    rotated = Rotation.from_matrix(relative).magnitude()
    return np.hypot(moved, weight * rotated)


def always(_poses: object) -> bool:
    """No obstacle anywhere."""
    return True


def polyline(waypoints: Sequence[Pose], weight: float) -> Path:
    """The path with sharp corners."""
    return Path(tuple(line(a, b, weight) for a, b in pairwise(waypoints)))
