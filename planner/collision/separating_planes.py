"""Planes that bound an obstacle's shadow: where an anchor may not be, seen from its outlet.

A cable from the outlet A is too near to a convex obstacle exactly when its anchor is in the shadow
of the obstacle grown by the required distance, a convex set. A plane with the grown obstacle behind
it and A before it (or on it) has the whole shadow behind it: an edge with both anchors before such
a plane is free. Candidates are planes through A that touch the grown obstacle, and its front faces;
a few are kept, best first, that together prove most of a lattice of positions. The platform's own
forbidden set, the obstacle grown by the platform, gets planes too. The choice of planes decides how
often the closed forms are needed, never the answer.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations, product

import numpy as np

from model.kinematics import cables_at
from model.pose import Array, Pose
from model.rig import Rig
from planner.kernels.scene_arrays import BOX, ROUND, ConvexPiece, Integers

_TURNS = 16
_HALVINGS = 20
"""Bisections of a right angle: a plane misses touching by a millionth of it at most."""
_MOST_PLANES = 12
_MOST_EDGES = 60
_EYE_ROUND_OFF = 1e-13
"""Tolerance of ``eye`` on a plane through it, as part of its largest coordinate; a tenth of the
round-off added to every required distance."""
_LEAST_GAIN = 0.002
"""Part of the lattice that an additional plane must prove."""


def cable_normals(piece: ConvexPiece, eye: Array, needed: float, slack: float) -> Array:
    """Candidate unit normals, toward the piece, of planes with ``eye`` before them; shape (k, 3).

    Args:
        eye: Where the cable leaves its outlet, world frame, shape (3,), [m].
        needed: Distance by which the piece is grown, [m].
        slack: Room between ``eye`` and the planes, for exits that move on pulleys, [m].
    """
    tried = [_touching_all_round(piece, eye, needed + slack), piece.faces * -1.0]
    if len(piece.edges) <= _MOST_EDGES:
        tried.append(_touching_edges(piece.edges, eye, needed + slack))
    toward = piece.points - eye
    tried.append(toward / np.linalg.norm(toward, axis=1, keepdims=True))
    normals = np.concatenate(tried)
    normals = normals[np.all(np.isfinite(normals), axis=1)]
    room = piece.least(normals) - needed - normals @ eye
    kept: Array = normals[room >= -_EYE_ROUND_OFF * float(np.abs(eye).max())]
    return kept


def platform_normals(piece: ConvexPiece, rotation: Array) -> Array:
    """Candidate unit normals, toward the piece, for the platform; shape (k, 3).

    Args:
        rotation: ``world_from_platform``, shape (3, 3).
    """
    signs = np.array([s for s in product((-1.0, 0.0, 1.0), repeat=3) if any(s)])
    compass = signs / np.linalg.norm(signs, axis=1, keepdims=True)
    tried = [compass @ rotation.T, compass @ piece.pose.rotation.T, -piece.faces]
    directions = piece.edges[:, 1] - piece.edges[:, 0]
    if 0 < len(directions) <= _MOST_EDGES:
        crossed = np.cross(directions[:, None, :], rotation.T[None, :, :]).reshape(-1, 3)
        lengths = np.linalg.norm(crossed, axis=1)
        crossed = crossed[lengths > 1e-9] / lengths[lengths > 1e-9][:, None]
        tried += [crossed, -crossed]
    return np.concatenate(tried)


def best_first(proved: Array) -> list[int]:
    """Indices of the planes to keep, the most useful first (greedy cover).

    Args:
        proved: Whether a plane proves a position, shape (planes, positions), 0 or 1.
    """
    left = np.ones(proved.shape[1])
    chosen: list[int] = []
    while len(chosen) < _MOST_PLANES and len(proved):
        gains = proved @ left
        best = int(np.argmax(gains))
        if gains[best] <= _LEAST_GAIN * len(left):
            break
        chosen.append(best)
        left = left * (1.0 - proved[best])
    return chosen


def _touching_edges(edges: Array, eye: Array, needed: float) -> Array:
    """Normals of the planes through ``eye`` along each edge, ``needed`` before it."""
    along = edges[:, 1] - edges[:, 0]
    lengths = np.linalg.norm(along, axis=1, keepdims=True)
    along = along / np.where(lengths > 0.0, lengths, np.nan)
    away = edges[:, 0] - eye
    across = away - np.sum(away * along, axis=1, keepdims=True) * along
    return _two_tangents(across, np.cross(along, across), needed)


def _two_tangents(across: Array, side: Array, needed: float) -> Array:
    """Unit vectors n in the plane of two perpendicular, equally long vectors: n·across = needed."""
    squared = np.sum(across**2, axis=1, keepdims=True)
    with np.errstate(invalid="ignore", divide="ignore"):
        height = np.sqrt(squared - needed**2)
        normals = [(needed * across + sign * height * side) / squared for sign in (-1.0, 1.0)]
    return np.concatenate(normals)


def _touching_all_round(piece: ConvexPiece, eye: Array, needed: float) -> Array:
    """Normals of planes through ``eye`` that touch the grown piece, evenly spread around it.

    For each direction around the line of sight, the normal is rotated from "forward" to "sideways"
    as far as the grown piece stays behind the plane.
    """
    sight = piece.points.mean(axis=0) - eye
    distance = float(np.linalg.norm(sight))
    if distance == 0.0:
        return np.zeros((0, 3))
    sight = sight / distance
    helper = np.eye(3)[int(np.argmin(np.abs(sight)))]
    right = np.cross(sight, helper)
    right /= np.linalg.norm(right)
    up = np.cross(sight, right)
    turns = 2.0 * np.pi * np.arange(_TURNS) / _TURNS
    sideways = np.cos(turns)[:, None] * right + np.sin(turns)[:, None] * up
    low, high = np.zeros(_TURNS), np.full(_TURNS, np.pi / 2.0)
    for _ in range(_HALVINGS):  # the room falls to zero where the plane touches
        middle = (low + high) / 2.0
        normals = np.cos(middle)[:, None] * sight + np.sin(middle)[:, None] * sideways
        behind = piece.least(normals) - needed - normals @ eye >= 0.0
        low, high = np.where(behind, middle, low), np.where(behind, high, middle)
    touching: Array = np.cos(low)[:, None] * sight + np.sin(low)[:, None] * sideways
    return touching


# Planes around what is certainly forbidden: the cores of shadows.
#
# A piece grown by the required distance contains a box. The anchors whose cables pass through that
# box form a convex set: behind those of its faces that the outlet is before, and behind the planes
# through the outlet and the outline of the box. An edge that enters this set is refused after some
# ten products, without computing a distance; otherwise closed forms decide. So cores, too, decide
# how long an answer takes, never the answer.


_INSIDE = 1e-9
"""How far behind all planes a position must be, [m]: far beyond round-off."""
_OUTLINE = 1e-12
"""Tolerance of a corner before a plane of the outline, [m]."""
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


def core_of(piece: ConvexPiece, grown: float) -> Core | None:
    """A box inside a piece grown by a ball of radius ``grown``, [m]; None for hulls and meshes."""
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


def cable_core(piece: ConvexPiece, eye: Array, arm: Array, needed: float) -> Array:
    """Planes behind which the platform's position puts a cable too near to a piece.

    Args:
        eye: Where the cable leaves its outlet, world frame, shape (3,), [m].
        arm: From the platform's origin to the anchor, world axes, shape (3,), [m].
        needed: Smallest distance allowed, [m].

    Returns:
        Unit normals n and limits l, shape (k, 4): a position p with n · p ≥ l for all of them is
        forbidden. Empty where no such set is known.
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


def platform_core(
    piece: ConvexPiece, half_size: Array, sum_of_boxes: Array, needed: float
) -> Array:
    """As `cable_core`, for the platform.

    Args:
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


# The planes of every pair of a body and a piece, in the space of positions.
#
# A translation whose ends p both have ``normal · p ≤ limit`` for one of a pair's proving planes
# keeps the distance; one with ``normal · p ≥ limit`` somewhere for all its core planes does not.


_LATTICE = 9
_PARALLEL = 1e-13
"""Sine of the angle at which axes count as parallel; its effect is below the round-off added to
every required distance."""


@dataclass(frozen=True, slots=True, eq=False)
class Bodies:
    """The m cables and the platform under translation.

    Attributes:
        rig: The robot.
        rotation: ``world_from_platform``, shape (3, 3).
        needed: Required distance of each body to any obstacle, shape (m + 1,), [m].
        eyes: Where the cables leave their outlets, world frame, shape (m, 3), [m].
        arms: From the platform's origin to the anchors, world axes, shape (m, 3), [m].
        positions: A lattice of the workspace, for choosing planes, shape (n, 3), [m].
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


def planes_of(bodies: Bodies, pieces: tuple[ConvexPiece, ...]) -> tuple[Array, Integers]:
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


def sum_of_boxes(rig: Rig, piece: ConvexPiece, rotation: Array) -> Array:
    """Half extents of a box grown by the platform, [m]; zeros where that is not a box."""
    turn = np.abs(piece.pose.rotation.T @ rotation)
    parallel = np.all(np.minimum(turn, np.abs(1.0 - turn)) <= _PARALLEL)
    if piece.kind != BOX or not parallel:
        return np.zeros(3)
    grown: Array = piece.half + np.round(turn) @ rig.half_size
    return grown


def _proving(bodies: Bodies, piece: ConvexPiece, body: int) -> tuple[Array, float]:
    """The planes that prove one pair, shape (l, 6), and the part of positions not proved."""
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


def _core(bodies: Bodies, piece: ConvexPiece, body: int) -> Array:
    """Planes of one pair's core, shape (l, 6); the last two columns are unused."""
    rig, needed = bodies.rig, float(bodies.needed[body])
    if body == rig.cable_count:
        grown = sum_of_boxes(rig, piece, bodies.rotation)
        core = platform_core(piece, rig.half_size, grown, needed)
    elif rig.pulley_radius > 0.0:  # with a moving exit point the set is not convex
        core = np.zeros((0, 4))
    else:
        core = cable_core(piece, bodies.eyes[body], bodies.arms[body], needed)
    behind = np.mean(core[:, :3] @ bodies.positions.T >= core[:, 3:], axis=1)
    core = core[np.argsort(behind, kind="stable")]  # most selective first
    return np.column_stack([core, np.zeros((len(core), 2))])
