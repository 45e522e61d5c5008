"""Cables against each other and against the platform, proved over whole regions of poses.

A region is the hull of corner positions (two for an edge, eight for a box) at one orientation. Two
cables lie on lines, the distance of which is |N| / ‖D‖ with N and D affine in the position p; so
N - c ‖D‖ is concave, and not below zero anywhere if it is not at the corners. The room at a plane
with a fixed normal is the least of functions affine in p. A cable leaves the platform by a stub's
end that is c before a plane with normal n at the platform where s n·w - (c + h) ‖w‖ is not below
zero, w from anchor to exit being affine in p and s the stub: concave again. Exits that move on
pulleys and a platform that turns are taken off as a bound of what they move.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from planner.exact.cells import Masks
from planner.exact.compiled import kernel
from planner.exact.exits import exit_point, exit_travel
from planner.exact.fields import World, anchor, half_size
from planner.exact.segment_box import segment_box_squared
from planner.exact.segment_pair import segment_pair_between
from planner.exact.vectors import Vector, along, cross, dot, minus, norm, plus, row, turned

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

PROVED, OPEN, REFUTED = 1, 0, -1

_LINE_ROUND_OFF = 1e-14


class Robot(NamedTuple):
    """What of a robot is compared with what, and what is still open.

    Attributes:
        pairs: Cables of each compared pair, shape (q, 2).
        stubs: Length left out of both at the anchors and at the exits, shape (q, 2), [m].
        stub: Length of cable at its anchor that may be near the platform, [m].
        pair_needed: Between the lines of two cables, their radii included, [m].
        platform_needed: Between the line of a cable and the platform, radius included, [m].
        open_pairs: Pairs not proved over the whole workspace, shape (k,).
        open_cables: Cables not proved against the platform over the whole workspace, shape (l,).
        open_cells: In which cells of it which of these are open, the pairs first, shape (c, c, c,
            words); see `planner.exact.cells`.
    """

    pairs: Integers
    stubs: Array
    stub: float
    pair_needed: float
    platform_needed: float
    open_pairs: Integers
    open_cables: Integers
    open_cells: Masks


@kernel
def pair_over_region(
    world: World,
    robot: Robot,
    pair: int,
    rotation: Array,
    corners: Array,
    middle: Vector,
    angle: float,
) -> int:
    """Whether two cables keep their distance over a region: `PROVED`, `REFUTED` or `OPEN`.

    Args:
        world: Where.
        robot: What is needed.
        pair: Number of the pair.
        rotation: ``world_from_platform`` in the middle, shape (3, 3).
        corners: Positions the hull of which is the region, shape (k, 3), [m].
        middle: A position in it, [m].
        angle: By which the platform is turned from ``rotation`` at most, [rad].
    """
    i, j = robot.pairs[pair, 0], robot.pairs[pair, 1]
    at_anchor, at_exit = robot.stubs[pair, 0], robot.stubs[pair, 1]
    needed, reach = robot.pair_needed, _reach(corners, middle)
    arm_i, arm_j = turned(rotation, anchor(world, i)), turned(rotation, anchor(world, j))
    b_i, b_j = plus(middle, arm_i), plus(middle, arm_j)
    a_i, a_j = exit_point(world, i, b_i), exit_point(world, j, b_j)
    w_i, w_j = minus(a_i, b_i), minus(a_j, b_j)
    l_i, l_j = norm(w_i), norm(w_j)
    if not (math.isfinite(l_i) and math.isfinite(l_j) and l_i > 0.0 and l_j > 0.0):
        return REFUTED
    between = segment_pair_between(
        along(b_i, w_i, at_anchor / l_i),
        along(a_i, w_i, -at_exit / l_i),
        along(b_j, w_j, at_anchor / l_j),
        along(a_j, w_j, -at_exit / l_j),
    )
    distance = norm(between)
    if not distance >= needed:
        return REFUTED
    moved = _drift(world, i, b_i, reach, angle) + _drift(world, j, b_j, reach, angle)
    if not moved < np.inf:
        return OPEN
    if _by_motion(distance - moved - needed, reach + moved, at_anchor + at_exit, l_i, l_j):
        return PROVED
    if _by_lines(a_i, a_j, arm_i, arm_j, corners, needed + moved):
        return PROVED
    if at_anchor + at_exit == 0.0 and distance > 0.0:
        normal = (between[0] / distance, between[1] / distance, between[2] / distance)
        if _by_plane(normal, a_i, a_j, arm_i, arm_j, corners, needed + moved):
            return PROVED
    return OPEN


@kernel
def platform_over_region(
    world: World,
    robot: Robot,
    cable: int,
    rotation: Array,
    corners: Array,
    middle: Vector,
    angle: float,
) -> int:
    """Whether a cable keeps its distance to the platform over a region; see `pair_over_region`."""
    needed, stub, half = robot.platform_needed, robot.stub, half_size(world)
    fixed = anchor(world, cable)
    at = plus(middle, turned(rotation, fixed))
    leaving = exit_point(world, cable, at)
    far = _into(rotation, minus(leaving, middle))
    way = minus(far, fixed)
    length = norm(way)
    if not (math.isfinite(length) and length > 0.0):
        return REFUTED
    near = along(fixed, way, stub / length)
    if not segment_box_squared(near, far, half) >= needed * needed:
        return REFUTED
    reach = _reach(corners, middle)
    exit_moved = _exit_drift(world, cable, at, reach + angle * norm(fixed))
    moved = exit_moved + angle * (norm(far) + reach + exit_moved)
    away = (
        near[0] - min(max(near[0], -half[0]), half[0]),
        near[1] - min(max(near[1], -half[1]), half[1]),
        near[2] - min(max(near[2], -half[2]), half[2]),
    )
    size = norm(away)
    if size == 0.0 or not moved < np.inf:
        return OPEN
    normal = (away[0] / size, away[1] / size, away[2] / size)
    face = abs(normal[0]) * half[0] + abs(normal[1]) * half[1] + abs(normal[2]) * half[2]
    height = needed + face - dot(normal, fixed)
    for k in range(len(corners)):
        shift = _into(rotation, minus(row(corners, k), middle))
        to_exit = minus(way, shift)
        room = stub * dot(normal, to_exit) - height * norm(to_exit)
        if not room >= (stub + abs(height)) * moved:
            return OPEN
        if not dot(normal, minus(far, shift)) - face - moved >= needed:
            return OPEN
    return PROVED if height >= 0.0 else OPEN


@kernel
def _by_motion(room: float, moved: float, stubs: float, l_i: float, l_j: float) -> bool:
    """Two points of cables whose ends move by at most d move apart by at most d, stubs aside."""
    shortest = min(l_i, l_j) - moved
    if shortest <= 0.0:
        return False
    return room >= moved * (1.0 + 2.0 * stubs / shortest)


@kernel
def _by_lines(
    a_i: Vector, a_j: Vector, arm_i: Vector, arm_j: Vector, corners: Array, needed: float
) -> bool:
    gap = minus(a_j, a_i)
    sign = 0.0
    for k in range(len(corners)):
        at = row(corners, k)
        u_i, u_j = minus(plus(at, arm_i), a_i), minus(plus(at, arm_j), a_j)
        across = cross(u_i, u_j)
        value = dot(gap, across)
        if sign == 0.0:
            sign = 1.0 if value > 0.0 else -1.0
        round_off = _LINE_ROUND_OFF * norm(gap) * norm(u_i) * norm(u_j)
        # Parallel lines, for which all of this is zero, do not pass.
        if not sign * value > needed * norm(across) + round_off:
            return False
    return True


@kernel
def _by_plane(
    normal: Vector,
    a_i: Vector,
    a_j: Vector,
    arm_i: Vector,
    arm_j: Vector,
    corners: Array,
    needed: float,
) -> bool:
    exit_i, exit_j = dot(normal, a_i), dot(normal, a_j)
    for k in range(len(corners)):
        at = row(corners, k)
        anchor_i, anchor_j = dot(normal, plus(at, arm_i)), dot(normal, plus(at, arm_j))
        if not min(exit_j, anchor_j) - max(exit_i, anchor_i) >= needed:
            return False
    return True


@kernel
def _drift(world: World, cable: int, at: Vector, reach: float, angle: float) -> float:
    """How far a cable leaves the one with its exit at rest and its anchor not turned, [m]."""
    turning = angle * norm(anchor(world, cable))
    return turning + _exit_drift(world, cable, at, reach + turning)


@kernel
def _exit_drift(world: World, cable: int, at: Vector, reach: float) -> float:
    """How far an exit travels while its anchor stays within a distance of a point, [m]."""
    return exit_travel(world, cable, at, at, 2.0 * reach) / 2.0


@kernel
def _reach(corners: Array, middle: Vector) -> float:
    farthest = 0.0
    for k in range(len(corners)):
        farthest = max(farthest, norm(minus(row(corners, k), middle)))
    return farthest


@kernel
def _into(rotation: Array, a: Vector) -> Vector:
    """A vector of the world in the axes of the platform."""
    return (
        rotation[0, 0] * a[0] + rotation[1, 0] * a[1] + rotation[2, 0] * a[2],
        rotation[0, 1] * a[0] + rotation[1, 1] * a[1] + rotation[2, 1] * a[2],
        rotation[0, 2] * a[0] + rotation[1, 2] * a[1] + rotation[2, 2] * a[2],
    )
