"""Rig and scene as plain arrays for compiled functions, with the proofs of self clearance.

Pairs of a body and a piece have planes in position space: `planner.collision.separating_planes`.
"""

from __future__ import annotations

import numpy as np

from model.clearance import SelfModel
from model.errors import BadInput
from model.pose import Array
from model.rig import Rig
from model.scene import Scene
from planner.collision.rotating_edges import rotated_by
from planner.collision.self_collision_regions import (
    CELLS,
    PROVED,
    REFUTED,
    WORD,
    Masks,
    Robot,
    box_proved,
    compared,
    mark_open_cells,
    open_along,
    words_for,
)
from planner.collision.separating_planes import bodies_of, planes_of, sum_of_boxes
from planner.kernels.jit import inlined, kernel
from planner.kernels.primitives import Vector, along, minus
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


# Self clearance of a rig: precomputed proofs where possible, the rest checked by edge.

_MOST_PIECES = 4096
_DEEPEST = 64
_FINEST = 1e-9


def build_robot(rig: Rig, world: World, clearance: float) -> Robot:
    """The comparisons on a rig, proved over its workspace as far as possible.

    Args:
        world: Built from it for one orientation; its obstacles are not used.
        clearance: Smallest allowed distance between cables and of cables to the platform, [m].

    Raises:
        BadInput: The clearance is negative or not finite.
    """
    robot = unproved_robot(rig, world, clearance)
    count = len(robot.pairs)
    open_pairs = [k for k in range(count) if not box_proved(world, robot, k)]
    cables = range(rig.cable_count)
    open_cables = [k for k in cables if not box_proved(world, robot, count + k)]
    left = [*open_pairs, *(count + k for k in open_cables)]
    return robot._replace(
        open_pairs=np.array(open_pairs, dtype=np.int64),
        open_cables=np.array(open_cables, dtype=np.int64),
        open_cells=_open_cells(world, robot, left),
    )


def unproved_robot(rig: Rig, world: World, clearance: float) -> Robot:
    """As `build_robot`, with nothing proved; only for edges with rotation.

    Args:
        world: Built from it for one orientation; its obstacles are not used.
        clearance: Smallest allowed distance between cables and of cables to the platform, [m].

    Raises:
        BadInput: The clearance is negative or not finite.
    """
    if not 0.0 <= clearance < np.inf:
        raise BadInput(
            f"the self clearance must be 0 mm or more (it is {clearance * 1000.0:g} mm)",
            where="exact edge checks",
        )
    model = SelfModel(rig)
    guard = ROUND_OFF * float(max(np.abs(rig.outlets).max(), np.abs(world.limits).max()))
    return Robot(
        pairs=np.array(model.pairs),
        stubs=np.array(model.stubs),
        stub=float(model.stub),
        pair_needed=clearance + 2.0 * rig.cable_radius + guard,
        platform_needed=clearance + rig.cable_radius + guard,
        open_pairs=np.arange(len(model.pairs)),
        open_cables=np.arange(rig.cable_count),
        open_cells=np.zeros((CELLS, CELLS, CELLS, 0), dtype=np.uint64),
    )


def _open_cells(world: World, robot: Robot, left: list[int]) -> Masks:
    """Bit masks of the comparisons that are open in each cell of the workspace."""
    masks = np.zeros((CELLS, CELLS, CELLS, words_for(len(left))), dtype=np.uint64)
    for number, which in enumerate(left):
        word, bit = number // WORD, np.uint64(1 << (number % WORD))
        mark_open_cells(world, robot, which, masks, word, bit)
    return masks


@kernel
def self_edge_free(world: World, robot: Robot, start: Array, end: Array) -> bool:
    """Whether the cables keep the self clearance under a translation.

    Comparisons proved over the cells that the edge passes are skipped, so both ends must lie in the
    workspace.

    Args:
        start: World frame, shape (3,), [m].
        end: World frame, shape (3,), [m].
    """
    pairs, rotation, still = len(robot.pairs), world.platform[:3], np.zeros(3)
    before, after = (start[0], start[1], start[2]), (end[0], end[1], end[2])
    # Most comparisons are decided over the whole edge.
    ends, middle = np.empty((2, 3)), along(before, minus(after, before), 0.5)
    ends[0], ends[1] = before, after
    count = len(robot.open_pairs)
    for word in range(robot.open_cells.shape[3]):
        mask, k = open_along(robot.open_cells, world.limits, before, after, word), word * WORD
        while mask != np.uint64(0):
            if mask & np.uint64(1):
                which = robot.open_pairs[k] if k < count else pairs + robot.open_cables[k - count]
                found = compared(world, robot, which, rotation, ends, middle, 0.0)
                if found == REFUTED:
                    return False
                if found != PROVED and not _clear(
                    world, robot, which, before, after, rotation, still
                ):
                    return False
            mask, k = mask >> np.uint64(1), k + 1
    return True


@inlined
def is_open(world: World, robot: Robot, start: Vector, end: Vector) -> bool:
    """Whether any comparison is open along a translation within the workspace."""
    for word in range(robot.open_cells.shape[3]):
        if open_along(robot.open_cells, world.limits, start, end, word) != np.uint64(0):
            return True
    return False


@kernel
def self_rotating_edge_free(
    world: World, robot: Robot, start: Array, end: Array, rotation: Array, turn: Array
) -> bool:
    """Whether the cables keep the self clearance while the platform is moved and rotated.

    Args:
        world: Rig and obstacles; its own orientation is not used.
        start: World frame, shape (3,), [m].
        end: World frame, shape (3,), [m].
        rotation: ``world_from_platform`` at the start, shape (3, 3).
        turn: Rotation vector from start to end, platform frame, shape (3,), [rad].
    """
    before, after = (start[0], start[1], start[2]), (end[0], end[1], end[2])
    angle = np.sqrt(turn[0] ** 2 + turn[1] ** 2 + turn[2] ** 2)
    # Most comparisons are decided over the whole edge, whose middle is then computed only once.
    ends, there = np.empty((2, 3)), rotated_by(rotation, turn, 0.5)
    ends[0], ends[1] = before, after
    middle = along(before, minus(after, before), 0.5)
    for which in range(len(robot.pairs) + len(world.cables)):
        found = compared(world, robot, which, there, ends, middle, angle / 2.0)
        if found == REFUTED:
            return False
        if found != PROVED and not _clear(world, robot, which, before, after, rotation, turn):
            return False
    return True


@kernel
def _clear(
    world: World,
    robot: Robot,
    which: int,
    before: Vector,
    after: Vector,
    rotation: Array,
    turn: Array,
) -> bool:
    """One comparison along an edge, bisected until decided; ``which`` as in `compared`."""
    delta = minus(after, before)
    angle = np.sqrt(turn[0] ** 2 + turn[1] ** 2 + turn[2] ** 2)
    size = np.sqrt(delta[0] ** 2 + delta[1] ** 2 + delta[2] ** 2) + angle
    lows, highs, ends = np.empty(_DEEPEST), np.empty(_DEEPEST), np.empty((2, 3))
    lows[0], highs[0] = 0.0, 1.0
    waiting, tried = 1, 0
    while waiting > 0:
        waiting -= 1
        low, high, tried = lows[waiting], highs[waiting], tried + 1
        middle = (low + high) / 2.0
        ends[0], ends[1] = along(before, delta, low), along(before, delta, high)
        at, there = along(before, delta, middle), rotated_by(rotation, turn, middle)
        off = angle * (high - low) / 2.0
        found = compared(world, robot, which, there, ends, at, off)
        if found == PROVED:
            continue
        if found == REFUTED or tried >= _MOST_PIECES or waiting + 2 > _DEEPEST:
            return False
        if size * (high - low) < _FINEST:
            return False
        lows[waiting], highs[waiting] = middle, high
        lows[waiting + 1], highs[waiting + 1] = low, middle
        waiting += 2
    return True
