"""Rig and scene as plain arrays that compiled functions read.

Bodies are the m cables and then the platform; pair ``piece * (m + 1) + body`` is one body with one
piece of an obstacle. For translation every pair has planes in the space of positions: an edge whose
ends p both have ``normal · p ≤ limit`` for one of the planes keeps the needed distance.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cdpr.cables import cables_at
from cdpr.errors import BadInput
from cdpr.poses import Array, Pose
from cdpr.rig import Rig
from cdpr.scene import Scene
from planner.exact.pieces import BOX, Piece, pieces_of
from planner.exact.shadow_planes import best_first, cable_normals, platform_normals

ROUND_OFF = 1e-12
"""Added to every needed distance, as part of the largest coordinate: some thousand times the
round-off of the sums that are compared with it."""

_LATTICE = 9
_PARALLEL = 1e-13
"""Sine of the angle at which axes count as parallel; what it moves is below `ROUND_OFF`."""

Integers = NDArray[np.int64]


class World(NamedTuple):
    """One rig at one orientation in one scene.

    Attributes:
        lower: Of the workspace box, shape (3,), [m].
        upper: Likewise.
        outlets: Shape (m, 3), [m].
        feeds: Feed directions of the pulleys, shape (m, 3).
        pulley: Radius of the pulleys, [m]; 0 for point exits.
        anchors: Platform frame, shape (m, 3), [m].
        arms: The same turned into the world's axes, shape (m, 3), [m].
        rotation: ``world_from_platform`` for translation, shape (3, 3).
        half: Of the platform box, shape (3,), [m].
        radii: Radius of each body, shape (m + 1,), [m]; 0 for the platform.
        needed: What each body needs to any obstacle, its radius included, shape (m + 1,), [m].
        kinds: Kind of each piece, shape (k,); see `planner.exact.pieces`.
        owners: Number of each piece's obstacle in the scene, shape (k,).
        frames: ``shape_from_world`` rotation of each piece, shape (k, 3, 3).
        centres: Origin of each piece, shape (k, 3), [m].
        halves: Half extents of each box, shape (k, 3), [m].
        sums: Half extents of each box grown by the platform, shape (k, 3), [m], where the axes of
            the two are parallel; else and for other kinds zeros.
        balls: Radius by which each piece is grown, shape (k,), [m].
        discs: Radius of the disc of each piece, shape (k,), [m].
        points: Points of all pieces, world frame, shape (n, 3), [m].
        first_point: Where each piece's points begin, shape (k + 1,).
        triangles: Triangles of all meshes, world frame, shape (t, 3, 3), [m].
        first_triangle: Where each piece's triangles begin, shape (k + 1,).
        planes: Of all pairs, shape (l, 6): unit normal, limit, reach of the ungrown piece along
            the normal, reach of the exit (minus infinity for the platform).
        first_plane: Where each pair's planes begin, shape (k (m + 1) + 1,).
    """

    lower: Array
    upper: Array
    outlets: Array
    feeds: Array
    pulley: float
    anchors: Array
    arms: Array
    rotation: Array
    half: Array
    radii: Array
    needed: Array
    kinds: Integers
    owners: Integers
    frames: Array
    centres: Array
    halves: Array
    sums: Array
    balls: Array
    discs: Array
    points: Array
    first_point: Integers
    triangles: Array
    first_triangle: Integers
    planes: Array
    first_plane: Integers


def build_world(rig: Rig, scene: Scene, rotation: Array, clearance: float) -> World:
    """The world of a rig in a scene.

    Args:
        rig: The robot, any number of cables.
        scene: Its obstacles, any number of any shape.
        rotation: Orientation under translation, ``world_from_platform``, shape (3, 3).
        clearance: Smallest allowed distance to obstacles, [m].

    Raises:
        BadInput: The clearance is negative or not finite.
    """
    if not 0.0 <= clearance < np.inf:
        raise BadInput(
            f"the clearance must be 0 mm or more (it is {clearance * 1000.0:g} mm)",
            where="exact edge checks",
        )
    pieces = pieces_of(scene)
    radii = np.append(np.full(rig.cable_count, rig.cable_radius), 0.0)
    needed = radii + clearance + ROUND_OFF * _extent(rig, pieces)
    planes, first_plane = _planes(rig, pieces, rotation, needed)
    return World(
        lower=np.array(rig.workspace_lower),
        upper=np.array(rig.workspace_upper),
        outlets=np.array(rig.outlets),
        feeds=np.array(rig.feed_directions),
        pulley=float(rig.pulley_radius),
        anchors=np.array(rig.anchors),
        arms=np.ascontiguousarray(rig.anchors @ rotation.T),
        rotation=np.array(rotation, dtype=np.float64),
        half=np.array(rig.half_size),
        radii=radii,
        needed=needed,
        kinds=np.array([p.kind for p in pieces], dtype=np.int64),
        owners=np.array([p.owner for p in pieces], dtype=np.int64),
        frames=_stacked([p.pose.rotation.T for p in pieces], (3, 3)),
        centres=_stacked([p.pose.position for p in pieces], (3,)),
        halves=_stacked([p.half for p in pieces], (3,)),
        sums=_stacked([_sum_of_boxes(rig, p, rotation) for p in pieces], (3,)),
        balls=np.array([p.radius for p in pieces], dtype=np.float64),
        discs=np.array([p.disc for p in pieces], dtype=np.float64),
        points=np.concatenate([np.zeros((0, 3)), *(p.points for p in pieces)]),
        first_point=_starts([len(p.points) for p in pieces]),
        triangles=np.concatenate([np.zeros((0, 3, 3)), *(p.triangles for p in pieces)]),
        first_triangle=_starts([len(p.triangles) for p in pieces]),
        planes=planes,
        first_plane=first_plane,
    )


def _planes(
    rig: Rig, pieces: tuple[Piece, ...], rotation: Array, needed: Array
) -> tuple[Array, Integers]:
    axes = [
        np.linspace(low, high, _LATTICE)
        for low, high in zip(rig.workspace_lower, rig.workspace_upper, strict=True)
    ]
    positions = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    eyes = cables_at(rig, Pose(rig.home.position, rotation)).exits
    arms = rig.anchors @ rotation.T
    made = [
        _pair_planes(rig, piece, body, rotation, needed, eyes, arms, positions)
        for piece in pieces
        for body in range(rig.cable_count + 1)
    ]
    return np.concatenate([np.zeros((0, 6)), *made]), _starts([len(m) for m in made])


def _pair_planes(
    rig: Rig,
    piece: Piece,
    body: int,
    rotation: Array,
    needed: Array,
    eyes: Array,
    arms: Array,
    positions: Array,
) -> Array:
    """The planes kept for one pair, shape (l, 6); see `World.planes`."""
    if body == rig.cable_count:
        normals = platform_normals(piece, rotation)
        reach = np.abs(normals @ rotation) @ rig.half_size
        eye_reach = np.full(len(normals), -np.inf)
    else:
        slack = 2.0 * rig.pulley_radius
        normals = cable_normals(piece, eyes[body], float(needed[body]), slack)
        reach = normals @ arms[body]
        eye_reach = normals @ eyes[body]
    surface = piece.least(normals)
    limits = surface - needed[body] - reach
    proved = (normals @ positions.T <= limits[:, None]).astype(np.float64)
    chosen = best_first(proved)
    return np.column_stack([normals, limits, surface, eye_reach])[chosen]


def _sum_of_boxes(rig: Rig, piece: Piece, rotation: Array) -> Array:
    """Half extents of the box grown by the platform, shape (3,), [m]; zeros where that is no box."""
    turn = np.abs(piece.pose.rotation.T @ rotation)
    parallel = np.all(np.minimum(turn, np.abs(1.0 - turn)) <= _PARALLEL)
    if piece.kind != BOX or not parallel:
        return np.zeros(3)
    grown: Array = piece.half + np.round(turn) @ rig.half_size
    return grown


def _extent(rig: Rig, pieces: tuple[Piece, ...]) -> float:
    """The largest coordinate of all that takes part, [m]."""
    robot = [rig.outlets, rig.workspace_lower, rig.workspace_upper, 2.0 * rig.half_size]
    sizes = [float(np.abs(array).max()) for array in robot]
    sizes += [float(np.abs(p.points).max()) + p.radius + p.disc for p in pieces]
    return max(sizes)


def _starts(counts: list[int]) -> Integers:
    return np.concatenate([[0], np.cumsum(np.array(counts, dtype=np.int64))]).astype(np.int64)


def _stacked(arrays: list[Array], shape: tuple[int, ...]) -> Array:
    return np.ascontiguousarray(np.array(arrays, dtype=np.float64).reshape(-1, *shape))
