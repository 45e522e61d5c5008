"""The planes of every pair of a body and a piece, in the space of positions.

A translation whose ends p both have ``normal · p ≤ limit`` for one of a pair's first planes keeps
the needed distance; one with ``normal · p ≥ limit`` somewhere for all of its last ones does not.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cdpr.cables import cables_at
from cdpr.poses import Array, Pose
from cdpr.rig import Rig
from planner.exact.fields import Integers
from planner.exact.pieces import BOX, Piece
from planner.exact.shadow_cores import cable_core, platform_core
from planner.exact.shadow_planes import best_first, cable_normals, platform_normals

_LATTICE = 9
_PARALLEL = 1e-13
"""Sine of the angle at which axes count as parallel; what it moves is below the round-off that
every needed distance has on top."""


@dataclass(frozen=True, slots=True, eq=False)
class Bodies:
    """The m cables and the platform under translation.

    Attributes:
        rig: The robot.
        rotation: ``world_from_platform``, shape (3, 3).
        needed: What each body needs to any obstacle, shape (m + 1,), [m].
        eyes: Where the cables leave their outlets, world frame, shape (m, 3), [m].
        arms: From the platform's origin to the anchors, world axes, shape (m, 3), [m].
        positions: A lattice of the workspace, on which planes are chosen, shape (n, 3), [m].
    """

    rig: Rig
    rotation: Array
    needed: Array
    eyes: Array
    arms: Array
    positions: Array


def bodies_of(rig: Rig, rotation: Array, needed: Array) -> Bodies:
    """The bodies of a rig; arguments as in `Bodies`."""
    axes = [
        np.linspace(low, high, _LATTICE)
        for low, high in zip(rig.workspace_lower, rig.workspace_upper, strict=True)
    ]
    positions = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    eyes = cables_at(rig, Pose(rig.home.position, rotation)).exits
    return Bodies(rig, rotation, needed, eyes, rig.anchors @ rotation.T, positions)


def planes_of(bodies: Bodies, pieces: tuple[Piece, ...]) -> tuple[Array, Integers]:
    """`World.planes` and `World.pairs`."""
    made = []
    for number, piece in enumerate(pieces):
        for body in range(len(bodies.needed)):
            proving, left = _proving(bodies, piece, body)
            made.append((left, (number, body), proving, _core(bodies, piece, body)))
    made.sort(key=lambda pair: -pair[0])
    planes, rows, first = [np.zeros((0, 6))], [], 0
    for _, pair, proving, core in made:
        last = first + len(proving)
        rows.append([*pair, first, last, last + len(core)])
        planes += [proving, core]
        first = last + len(core)
    return np.concatenate(planes), np.array(rows, dtype=np.int64).reshape(-1, 5)


def sum_of_boxes(rig: Rig, piece: Piece, rotation: Array) -> Array:
    """Half extents of a box grown by the platform, [m]; zeros where that is no box."""
    turn = np.abs(piece.pose.rotation.T @ rotation)
    parallel = np.all(np.minimum(turn, np.abs(1.0 - turn)) <= _PARALLEL)
    if piece.kind != BOX or not parallel:
        return np.zeros(3)
    grown: Array = piece.half + np.round(turn) @ rig.half_size
    return grown


def _proving(bodies: Bodies, piece: Piece, body: int) -> tuple[Array, float]:
    """The planes kept that prove one pair, shape (l, 6), and the part of positions they leave."""
    rig, needed = bodies.rig, float(bodies.needed[body])
    if body == rig.cable_count:
        normals = platform_normals(piece, bodies.rotation)
        reach = np.abs(normals @ bodies.rotation) @ rig.half_size
        eye_reach = np.full(len(normals), -np.inf)
    else:
        normals = cable_normals(piece, bodies.eyes[body], needed, 2.0 * rig.pulley_radius)
        reach = normals @ bodies.arms[body]
        eye_reach = normals @ bodies.eyes[body]
    surface = piece.least(normals)
    limits = surface - needed - reach
    proved = normals @ bodies.positions.T <= limits[:, None]
    chosen = best_first(proved.astype(np.float64))
    left = 1.0 - float(np.mean(np.any(proved, axis=0)))
    return np.column_stack([normals, limits, surface, eye_reach])[chosen], left


def _core(bodies: Bodies, piece: Piece, body: int) -> Array:
    """Planes about what one pair forbids for certain, shape (l, 6), the last two columns unused."""
    rig, needed = bodies.rig, float(bodies.needed[body])
    if body == rig.cable_count:
        grown = sum_of_boxes(rig, piece, bodies.rotation)
        core = platform_core(piece, rig.half_size, grown, needed)
    elif rig.pulley_radius > 0.0:  # an exit that moves leaves no convex set
        core = np.zeros((0, 4))
    else:
        core = cable_core(piece, bodies.eyes[body], bodies.arms[body], needed)
    behind = np.mean(core[:, :3] @ bodies.positions.T >= core[:, 3:], axis=1)
    core = core[np.argsort(behind, kind="stable")]  # what leaves out most comes first
    return np.column_stack([core, np.zeros((len(core), 2))])
