"""What the columns of a world's arrays hold, by name.

A world is passed to every function, and compiled code counts the owners of each of its arrays
whenever it does; hence few arrays with many columns.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from planner.exact.compiled import leaf
from planner.exact.vectors import Vector, dot

Array = NDArray[np.float64]
Integers = NDArray[np.int64]


class World(NamedTuple):
    """One rig at one orientation in one scene; `planner.exact.world.build_world` makes it.

    Bodies are the m cables and then the platform. A pair is one body and one piece of an obstacle.

    Attributes:
        limits: Lower and upper corner of the workspace box, shape (2, 3), [m].
        platform: Rotation ``world_from_platform`` under translation, and half extents of the box,
            shape (4, 3).
        pulley: Radius of the pulleys, [m]; 0 for point exits.
        cables: Outlet, feed direction, anchor in the platform's frame, and the same turned into
            the world's axes, shape (m, 12), [m].
        bodies: What each body needs to any obstacle, radius included, and its radius, shape
            (m + 1, 2), [m].
        pieces: Rotation ``shape_from_world``, centre, half extents of a box, half extents of the
            box grown by the platform (zeros where that is no box), radius of the ball and of the
            disc that the piece is grown by, shape (k, 20).
        spans: Kind (`planner.exact.pieces`), number of the obstacle, first and last + 1 of its
            `points` and of its `triangles`, shape (k, 6).
        points: Of all pieces, world frame, shape (n, 3), [m].
        triangles: Of all meshes, world frame, shape (t, 3, 3), [m].
        planes: Of all pairs, shape (l, 6): unit normal n; the limit of n · position; how little
            the ungrown piece reaches along n; how far the exit does (-inf for the platform).
        pairs: All pairs, those that forbid most positions first: piece, body, the first of the
            planes before which a position is allowed, the first of those behind all of which it is
            forbidden, and the last of these + 1, shape (k (m + 1), 5).
    """

    limits: Array
    platform: Array
    pulley: float
    cables: Array
    bodies: Array
    pieces: Array
    spans: Integers
    points: Array
    triangles: Array
    planes: Array
    pairs: Integers


@leaf
def _triple(array: Array, index: int, column: int) -> Vector:
    return (array[index, column], array[index, column + 1], array[index, column + 2])


@leaf
def outlet(world: World, cable: int) -> Vector:
    """Outlet of a cable, world frame, [m]."""
    return _triple(world.cables, cable, 0)


@leaf
def feed(world: World, cable: int) -> Vector:
    """Feed direction of a cable's pulley, world frame."""
    return _triple(world.cables, cable, 3)


@leaf
def anchor(world: World, cable: int) -> Vector:
    """Anchor of a cable, platform frame, [m]."""
    return _triple(world.cables, cable, 6)


@leaf
def arm(world: World, cable: int) -> Vector:
    """From the platform's origin to a cable's anchor under translation, world axes, [m]."""
    return _triple(world.cables, cable, 9)


@leaf
def half_size(world: World) -> Vector:
    """Half extents of the platform box, [m]."""
    return _triple(world.platform, 3, 0)


@leaf
def centre(world: World, piece: int) -> Vector:
    """Origin of a piece, world frame, [m]."""
    return _triple(world.pieces, piece, 9)


@leaf
def box_half(world: World, piece: int) -> Vector:
    """Half extents of a box, [m]."""
    return _triple(world.pieces, piece, 12)


@leaf
def box_sum(world: World, piece: int) -> Vector:
    """Half extents of a box grown by the platform, [m]; zeros where that is no box."""
    return _triple(world.pieces, piece, 15)


@leaf
def disc_axis(world: World, piece: int) -> Vector:
    """Axis of the disc that a piece is grown by, world frame."""
    return _triple(world.pieces, piece, 6)


@leaf
def in_frame(world: World, piece: int, vector: Vector) -> Vector:
    """A vector of the world in the axes of a piece."""
    return (
        dot(_triple(world.pieces, piece, 0), vector),
        dot(_triple(world.pieces, piece, 3), vector),
        dot(_triple(world.pieces, piece, 6), vector),
    )


@leaf
def ball(world: World, piece: int) -> float:
    """Radius of the ball that a piece is grown by, [m]."""
    return world.pieces[piece, 18]  # type: ignore[no-any-return]


@leaf
def disc(world: World, piece: int) -> float:
    """Radius of the disc that a piece is grown by, [m]."""
    return world.pieces[piece, 19]  # type: ignore[no-any-return]
