"""What a path keeps, found by another route than the planner's and the check's.

Distances are coal's, of primitive shapes (cables are threads, hulls are hulls, meshes are their
triangles), at places 40 mm apart and at every corner. A distance changes by no more than the motion
(twice as fast between cables over pulleys), so neighbours that differ by more show a wrong one, and
two neighbours bound what is between them: where the bound is too low, there is another place in the
middle, until every pair is proved or two places are 20 µm apart. Tensions are found by a quadratic
program at the first places; each solution is put into the equations again.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import combinations, product
from typing import Any

import coal
import daqp
import numpy as np

from cdpr.cables import cables_to
from cdpr.clearance import PLATFORM, cable_name
from cdpr.poses import Array, Pose
from cdpr.rig import Rig
from cdpr.scene import Scene
from cdpr.shapes import Box, Capsule, ConvexHull, Cylinder, Shape, Sphere, TriangleMesh

SPACING = 0.040
CLOSEST = 20e-6
EXACT = 2e-7
"""How far coal's distances are trusted, [m]; those of cylinders are off by up to 1e-8."""
THREAD = 1e-9
"""Radius of the capsule that stands for a cable, [m]; part of what is trusted above."""
GRAVITY = 9.80665
_BALANCED = 1e-6
"""What tensions may leave of the wrench, [N] and [N m]."""
_RELEASED = 1e-4
"""How far the program's tensions may miss their limits, [N]."""

_REQUEST = coal.DistanceRequest()
_REQUEST.gjk_tolerance, _REQUEST.gjk_max_iterations = 1e-9, 2000

Body = tuple[Any, Any]
Part = tuple[int, float, float]


@dataclass
class Opinion:
    """What was found along one path.

    Attributes:
        problems: What it does not keep, a line each.
        slack: Smallest distance over what is needed, of obstacles and of the robot itself, [m].
        distances: How many were computed.
    """

    problems: list[str] = field(default_factory=list)
    slack: float = np.inf
    distances: int = 0


def second_opinion(rig: Rig, scene: Scene, path: Array) -> Opinion:
    """Everything a path under translation must keep.

    Args:
        rig: The robot.
        scene: Obstacles, clearances, load, start and goal.
        path: Corners, shape (k, 3), [m].
    """
    found = Opinion()
    _look_at_ends(rig, scene, path, found)
    robot = _Robot(rig, scene, path)
    places = robot.first_places()
    for pair in _pairs(rig, scene):
        _prove(robot, pair, places, found)
    for place in places.tolist():
        problem = _tension_problem(rig, scene, robot.position(place))
        if problem:
            found.problems.append(f"{problem} at {place * 1e3:.1f} mm")
            break
    return found


def _look_at_ends(rig: Rig, scene: Scene, path: Array, found: Opinion) -> None:
    if not np.isfinite(path).all():
        found.problems.append("a corner is no number")
    outside = np.maximum(rig.workspace_lower - path, path - rig.workspace_upper).max()
    if not outside <= 1e-8:
        found.problems.append(f"{outside * 1e3:.6f} mm outside the workspace")
    for name, at, wanted in (("start", path[0], scene.start), ("goal", path[-1], scene.goal)):
        away = float(np.linalg.norm(at - wanted.position))
        if not away <= 1e-8:
            found.problems.append(f"{away * 1e3:.6f} mm from the {name}")


@dataclass(frozen=True)
class _Pair:
    """Two bodies, and what they need.

    A part of the robot is a cable's number and lengths left out at its anchor and at its exit, or
    the number after the last cable's for the platform. The other body is a part too,
    or fixed, and then the second part stands for nothing.
    """

    name: str
    first: Part
    second: Part
    fixed: Body | None
    needed: float
    slope: float


def _pairs(rig: Rig, scene: Scene) -> Iterator[_Pair]:
    count, thick = rig.cable_count, rig.cable_radius
    for obstacle in scene.obstacles:
        for geometry in _geometries(obstacle.shape, obstacle.pose):
            for body in range(count + 1):
                name = PLATFORM if body == count else cable_name(body)
                needed = scene.obstacle_clearance + (0.0 if body == count else thick)
                title = f"{name} – {obstacle.name}"
                yield _Pair(title, (body, 0.0, 0.0), (body, 0.0, 0.0), geometry, needed, 1.0)
    slope = 1.0 if rig.pulley_radius == 0.0 else 2.0
    stub = 0.5 * float(rig.half_size.min())  # a quarter of the shortest side
    for i, j in combinations(range(count), 2):
        ends = [
            stub if float(np.linalg.norm(points[i] - points[j])) < stub else 0.0
            for points in (rig.anchors, rig.outlets)
        ]
        needed = scene.self_clearance + 2.0 * thick
        title = f"{cable_name(i)} – {cable_name(j)}"
        yield _Pair(title, (i, ends[0], ends[1]), (j, ends[0], ends[1]), None, needed, slope)
    for i in range(count):
        needed = scene.self_clearance + thick
        title = f"{cable_name(i)} – {PLATFORM}"
        yield _Pair(title, (i, stub, 0.0), (count, 0.0, 0.0), None, needed, slope)


class Nearness:
    """Whether single positions keep what is asked for."""

    def __init__(self, rig: Rig, scene: Scene) -> None:
        """Makes the obstacles once."""
        self._rig, self._scene = rig, scene
        self._all = list(_pairs(rig, scene))

    def is_usable(self, position: Array, reserve: float) -> bool:
        """Whether all distances at a position, shape (3,), [m], are what is needed and more."""
        robot = _Robot(self._rig, self._scene, position[None, :])
        return all(_room(robot, pair, 0.0) >= reserve for pair in self._all)


class _Robot:
    """The robot's bodies along a path, made when they are asked for."""

    def __init__(self, rig: Rig, scene: Scene, path: Array) -> None:
        self.rig = rig
        self._rotation = np.array(scene.start.rotation)
        self._arms = rig.anchors @ self._rotation.T
        self._path = path
        steps = np.linalg.norm(np.diff(path, axis=0), axis=1)
        self._marks = np.append(0.0, np.cumsum(steps))
        self._box = coal.Box(*(2.0 * rig.half_size))
        self._cables: dict[float, tuple[Array, Array]] = {}
        self._made: dict[tuple[float, Part], Body] = {}

    def first_places(self) -> Array:
        """Every corner, and places between, as ways from the start, [m]."""
        places = [0.0]
        for low, high in zip(self._marks[:-1], self._marks[1:], strict=True):
            if high > low:
                count = int(np.ceil((high - low) / SPACING))
                places += np.linspace(low, high, count + 1)[1:].tolist()
        return np.array(places)

    def position(self, place: float) -> Array:
        """Of the platform, shape (3,), [m]."""
        return np.array([np.interp(place, self._marks, axis) for axis in self._path.T])

    def body(self, part: Part, place: float) -> Body:
        """A part of a cable, or the platform, with the platform at a place."""
        key = (place, part)
        if key not in self._made:
            self._made[key] = self._body(part, place)
        return self._made[key]

    def _body(self, part: Part, place: float) -> Body:
        number, at_anchor, at_exit = part
        if number == self.rig.cable_count:
            return self._box, coal.Transform3s(self._rotation, self.position(place))
        if place not in self._cables:
            cables = cables_to(self.rig, self._arms + self.position(place))
            self._cables[place] = (np.array(cables.exits), np.array(cables.anchors))
        exits, anchors = self._cables[place]
        return _thread(exits[number], anchors[number], at_exit, at_anchor)


def _prove(robot: _Robot, pair: _Pair, places: Array, found: Opinion) -> None:
    """One pair along the whole path, finer and finer where it is not proved."""

    def room(place: float) -> float:
        found.distances += 1
        return _room(robot, pair, place)

    values = [room(place) for place in places.tolist()]
    open_parts = list(zip(places[:-1], values[:-1], places[1:], values[1:], strict=True))
    least = min(values)
    while open_parts:
        low, at_low, high, at_high = open_parts.pop()
        motion = pair.slope * (high - low)
        if abs(at_high - at_low) > motion + EXACT:
            found.problems.append(f"{pair.name}: distances {motion:.3g} m apart disagree")
            break
        if (at_low + at_high - motion) / 2.0 >= 0.0:
            continue
        if least < -EXACT or high - low < CLOSEST:
            break
        middle = (low + high) / 2.0
        value = room(middle)
        least = min(least, value)
        open_parts += [(low, at_low, middle, value), (middle, value, high, at_high)]
    else:
        found.slack = min(found.slack, least)
        return
    found.slack = min(found.slack, least)
    found.problems.append(f"{pair.name}: {least * 1e3:+.5f} mm over what is needed, not proved")


def _room(robot: _Robot, pair: _Pair, place: float) -> float:
    """Distance of the surfaces of a pair over what it needs, [m]; below 0 it is too little."""
    second = pair.fixed or robot.body(pair.second, place)
    found = coal.distance(*robot.body(pair.first, place), *second, _REQUEST, coal.DistanceResult())
    return float(found) - pair.needed


def _thread(exit: Array, anchor: Array, at_exit: float, at_anchor: float) -> Body:
    """A part of a straight cable; plain numbers, as this is done a thousand times a path."""
    a, b, c = exit.tolist()
    u, v, w = anchor.tolist()
    whole = math.dist((a, b, c), (u, v, w))
    x, y, z = (u - a) / whole, (v - b) / whole, (w - c) / whole
    sign = math.copysign(1.0, z)
    p = -1.0 / (sign + z)
    q = x * y * p
    frame = np.array(
        [
            [1.0 + sign * x * x * p, q, x],
            [sign * q, sign + y * y * p, y],
            [-sign * x, -y, z],
        ]
    )
    length = whole - at_exit - at_anchor
    middle = at_exit + length / 2.0
    place = np.array([a + middle * x, b + middle * y, c + middle * z])
    return coal.Capsule(THREAD, length), coal.Transform3s(frame, place)


def _geometries(shape: Shape, pose: Pose) -> Iterator[Body]:
    place = coal.Transform3s(np.array(pose.rotation), np.array(pose.position))
    match shape:
        case Box(half_size=half):
            yield coal.Box(*(2.0 * half)), place
        case Sphere(radius=radius):
            yield coal.Sphere(radius), place
        case Cylinder(radius=radius, length=length):
            yield coal.Cylinder(radius, length), place
        case Capsule(radius=radius, length=length):
            yield coal.Capsule(radius, length), place
        case ConvexHull():
            cloud = coal.StdVec_Vec3s()
            for point in shape.vertices:
                cloud.append(np.array(point))
            yield coal.Convex.convexHull(cloud, False, ""), place
        case TriangleMesh():
            for corners in shape.vertices[shape.triangles]:
                yield _triangle(corners), place


def _triangle(corners: Array) -> Any:
    """A convex body with two sides; coal has no distances for its own triangles."""
    points, sides = coal.StdVec_Vec3s(), coal.StdVec_Triangle()
    for corner in corners:
        points.append(np.array(corner))
    sides.append(coal.Triangle(0, 1, 2))
    sides.append(coal.Triangle(0, 2, 1))
    return coal.Convex(points, sides)


def _tension_problem(rig: Rig, scene: Scene, position: Array) -> str:
    """Empty where tensions hold weight, payload and every corner of the box of disturbances."""
    rotation, load = np.array(scene.start.rotation), scene.load
    arms = rig.anchors @ rotation.T
    cables = cables_to(rig, arms + position)
    pulls = cables.exits - cables.anchors
    pulls = pulls / np.linalg.norm(pulls, axis=1)[:, None]
    matrix = np.hstack([pulls, np.cross(arms, pulls)]).T
    down = np.array([0.0, 0.0, -GRAVITY])
    weight = np.zeros(6)
    for mass, centre in (
        (rig.mass, rig.centre_of_mass),
        (load.payload_mass, load.payload_centre),
    ):
        weight += np.append(mass * down, np.cross(rotation @ centre, mass * down))
    spread = np.concatenate([load.force, load.moment])
    signs = [(-1.0, 1.0) if part > 0.0 else (0.0,) for part in spread]
    low, high = (np.full(rig.cable_count, t) for t in (rig.min_tension, rig.max_tension))
    for corner in product(*signs):
        wanted = -(weight + np.array(corner) * spread)
        if not _balanced(matrix, wanted, low, high):
            return "no tensions hold the load"
    return ""


def _balanced(matrix: Array, wanted: Array, low: Array, high: Array) -> bool:
    count = matrix.shape[1]
    sense = np.zeros(count + 6, dtype=np.int32)
    sense[count:] = 5  # equality
    tensions, _, flag, _ = daqp.solve(
        np.eye(count), -(low + high) / 2.0, np.ascontiguousarray(matrix),
        np.concatenate([high, wanted]), np.concatenate([low, wanted]), sense,
    )  # fmt: skip
    if flag != 1:
        return False
    kept = (tensions >= low - _RELEASED) & (tensions <= high + _RELEASED)
    return bool(kept.all() and np.abs(matrix @ tensions - wanted).max() <= _BALANCED)
