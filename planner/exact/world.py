"""Rig and scene as plain arrays that compiled functions read.

Every pair of a body and a piece has planes in the space of positions: a translation whose ends p
both have ``normal · p ≤ limit`` for one of the planes keeps the needed distance.
"""

from __future__ import annotations

import numpy as np

from cdpr.cables import cables_at
from cdpr.errors import BadInput
from cdpr.poses import Array, Pose
from cdpr.rig import Rig
from cdpr.scene import Scene
from planner.exact.fields import Integers, World
from planner.exact.pieces import BOX, Piece, pieces_of
from planner.exact.shadow_planes import best_first, cable_normals, platform_normals

ROUND_OFF = 1e-12
"""Added to every needed distance, as part of the largest coordinate: some thousand times the
round-off of the sums that are compared with it."""

_LATTICE = 9
_PARALLEL = 1e-13
"""Sine of the angle at which axes count as parallel; what it moves is below `ROUND_OFF`."""


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
    arms = rig.anchors @ rotation.T
    return World(
        limits=np.stack([rig.workspace_lower, rig.workspace_upper]),
        platform=np.concatenate([rotation, rig.half_size[None, :]]),
        pulley=float(rig.pulley_radius),
        cables=np.concatenate([rig.outlets, rig.feed_directions, rig.anchors, arms], axis=1),
        bodies=np.column_stack([needed, radii]),
        pieces=np.concatenate(
            [np.zeros((0, 20)), *(_piece_row(rig, p, rotation) for p in pieces)], axis=0
        ),
        spans=_spans(pieces),
        points=np.concatenate([np.zeros((0, 3)), *(p.points for p in pieces)]),
        triangles=np.concatenate([np.zeros((0, 3, 3)), *(p.triangles for p in pieces)]),
        planes=planes,
        first_plane=first_plane,
    )


def _piece_row(rig: Rig, piece: Piece, rotation: Array) -> Array:
    grown = _sum_of_boxes(rig, piece, rotation)
    frame = piece.pose.rotation.T.ravel()
    sizes = np.array([piece.radius, piece.disc])
    return np.concatenate([frame, piece.pose.position, piece.half, grown, sizes])[None, :]


def _spans(pieces: tuple[Piece, ...]) -> Integers:
    points = _starts([len(p.points) for p in pieces])
    triangles = _starts([len(p.triangles) for p in pieces])
    rows = [
        [p.kind, p.owner, points[k], points[k + 1], triangles[k], triangles[k + 1]]
        for k, p in enumerate(pieces)
    ]
    return np.array(rows, dtype=np.int64).reshape(-1, 6)


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
    """Half extents of a box grown by the platform, [m]; zeros where that is no box."""
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
