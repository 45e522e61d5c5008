"""Rig and scene as plain arrays for compiled functions.

Pairs of a body and a piece have planes in position space: `planner.collision.separating_planes`.
"""

from __future__ import annotations

import numpy as np

from model.errors import BadInput
from model.pose import Array
from model.rig import Rig
from model.scene import Scene
from planner.collision.separating_planes import bodies_of, planes_of, sum_of_boxes
from planner.kernels.scene_arrays import ConvexPiece, Integers, World, pieces_of

ROUND_OFF = 1e-12
"""Added to every required distance, as part of the largest coordinate: about a thousand times the
round-off of the sums compared with it."""


def build_world(rig: Rig, scene: Scene, rotation: Array, clearance: float) -> World:
    """The world of a rig in a scene.

    Args:
        rig: The robot, with any number of cables.
        scene: Any number of obstacles of any shape.
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
    planes, pairs = planes_of(bodies_of(rig, rotation, needed), pieces)
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
        pairs=pairs,
    )


def _piece_row(rig: Rig, piece: ConvexPiece, rotation: Array) -> Array:
    grown = sum_of_boxes(rig, piece, rotation)
    frame = piece.pose.rotation.T.ravel()
    sizes = np.array([piece.radius, piece.disc])
    return np.concatenate([frame, piece.pose.position, piece.half, grown, sizes])[None, :]


def _spans(pieces: tuple[ConvexPiece, ...]) -> Integers:
    points = _starts([len(p.points) for p in pieces])
    triangles = _starts([len(p.triangles) for p in pieces])
    rows = [
        [p.kind, p.owner, points[k], points[k + 1], triangles[k], triangles[k + 1]]
        for k, p in enumerate(pieces)
    ]
    return np.array(rows, dtype=np.int64).reshape(-1, 6)


def _extent(rig: Rig, pieces: tuple[ConvexPiece, ...]) -> float:
    """The largest coordinate of rig and obstacles, [m]."""
    robot = [rig.outlets, rig.workspace_lower, rig.workspace_upper, 2.0 * rig.half_size]
    sizes = [float(np.abs(array).max()) for array in robot]
    sizes += [float(np.abs(p.points).max()) + p.radius + p.disc for p in pieces]
    return max(sizes)


def _starts(counts: list[int]) -> Integers:
    return np.concatenate([[0], np.cumsum(np.array(counts, dtype=np.int64))]).astype(np.int64)
