"""Planes about what is forbidden for certain: the cores of shadows.

Within a piece that is grown by the needed distance lies a box. The anchors to which a cable would
pass through that box are a convex set: what is behind those of its faces that the outlet is before,
and behind the planes through the outlet and the outline of the box. An edge that enters this set is
refused, after some ten products and without a distance; where it does not, closed forms decide. So
cores, too, decide how long an answer takes, never what it is.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations, product

import numpy as np

from cdpr.poses import Array, Pose
from planner.exact.pieces import BOX, ROUND, Piece

_INSIDE = 1e-9
"""How far behind all planes a position must be, [m]: far beyond round-off."""
_OUTLINE = 1e-12
"""How far before a plane of the outline a corner may seem, [m]."""
_SIGNS = np.array(list(product((-1.0, 1.0), repeat=3)))
_EDGES = np.array(
    [(i, j) for i, j in combinations(range(8), 2) if np.sum(_SIGNS[i] != _SIGNS[j]) == 1]
)
_IN_A_BALL = 1.0 / np.sqrt(3.0)
"""Half extent of the cube in a ball of radius 1."""
_IN_A_DISC = 1.0 / np.sqrt(2.0)


@dataclass(frozen=True, slots=True, eq=False)
class Core:
    """A box that lies within a grown piece.

    Attributes:
        pose: ``world_from_core``.
        half: Half extents, shape (3,), [m].
    """

    pose: Pose
    half: Array


def core_of(piece: Piece, grown: float) -> Core | None:
    """A box in a piece that is grown by a ball of some radius, [m]; None for hulls and meshes."""
    middle = (piece.points.min(axis=0) + piece.points.max(axis=0)) / 2.0
    pose = Pose(middle, piece.pose.rotation)
    ball = (grown + piece.radius) * _IN_A_BALL
    along = np.linalg.norm(np.ptp(piece.points, axis=0)) / 2.0
    if piece.kind == BOX:
        return Core(pose, piece.half + ball)
    if piece.kind == ROUND or piece.disc > 0.0:
        across = piece.disc * _IN_A_DISC
        return Core(pose, np.array([across, across, along]) + ball)
    return None


def cable_core(piece: Piece, eye: Array, arm: Array, needed: float) -> Array:
    """Planes behind which the platform is when a cable is too near to a piece.

    Args:
        piece: The obstacle.
        eye: Where the cable leaves its outlet, world frame, shape (3,), [m].
        arm: From the platform's origin to the anchor, world axes, shape (3,), [m].
        needed: Smallest distance allowed, [m].

    Returns:
        Unit normals n and limits l, shape (k, 4): a position p with n · p ≥ l for all of them is
        forbidden. None where no such set is known.
    """
    core = core_of(piece, needed)
    if core is None:
        return np.zeros((0, 4))
    normals, limits = _faces(core)
    before = normals @ eye < limits
    outline = _outline(core, eye)
    if not before.any():  # the outlet is inside
        return np.zeros((0, 4))
    normals = np.concatenate([normals[before], outline])
    limits = np.concatenate([limits[before], outline @ eye]) - normals @ arm
    return np.column_stack([normals, limits + _INSIDE])


def platform_core(piece: Piece, half_size: Array, sum_of_boxes: Array, needed: float) -> Array:
    """As `cable_core`, for the platform.

    Args:
        piece: The obstacle.
        half_size: Half extents of the platform, shape (3,), [m].
        sum_of_boxes: Half extents of the piece grown by the platform where that is a box, shape
            (3,), [m]; else zeros.
        needed: Smallest distance allowed, [m].
    """
    if sum_of_boxes.any():
        core: Core | None = Core(piece.pose, sum_of_boxes + needed * _IN_A_BALL)
    else:
        core = core_of(piece, needed + float(half_size.min()))
    if core is None:
        return np.zeros((0, 4))
    normals, limits = _faces(core)
    return np.column_stack([normals, limits + _INSIDE])


def _faces(core: Core) -> tuple[Array, Array]:
    """Inward normals of the faces, shape (6, 3), and their limits: n · x ≥ l inside, shape (6,)."""
    axes = core.pose.rotation.T
    normals = np.concatenate([axes, -axes])
    return normals, normals @ core.pose.position - np.concatenate([core.half, core.half])


def _outline(core: Core, eye: Array) -> Array:
    """Normals of planes through a point along edges that have all of the core behind them."""
    corners = core.pose.apply(_SIGNS * core.half) - eye
    normals = np.cross(corners[_EDGES[:, 0]], corners[_EDGES[:, 1]])
    lengths = np.linalg.norm(normals, axis=1)
    normals = normals[lengths > 0.0] / lengths[lengths > 0.0, None]
    heights = normals @ corners.T
    return np.concatenate(
        [
            normals[np.all(heights >= -_OUTLINE, axis=1)],
            -normals[np.all(heights <= _OUTLINE, axis=1)],
        ]
    )
