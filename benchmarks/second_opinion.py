"""What a path keeps, found by another route than the planner's and the check's.

Distances are coal's, of primitive shapes (cables are threads, hulls are hulls, meshes are their
triangles), at places 40 mm apart and at every corner. A distance changes by no more than the motion
(twice as fast between cables over pulleys), so neighbours that differ by more show a wrong one, and
two neighbours bound what is between them: where the bound is too low, there is another place in the
middle, until every pair is proved or two places are 20 µm apart. Tensions are found by a quadratic
program at the first places; each solution is put into the equations again.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import combinations

import coal
import numpy as np

from benchmarks.coal_bodies import EXACT, Body, distance, geometries, thread
from benchmarks.tension_opinion import tension_problem
from model.clearance import PLATFORM, cable_name
from model.kinematics import cables_to
from model.pose import Array
from model.rig import Rig
from model.scene import Scene

SPACING = 0.040
CLOSEST = 20e-6

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
        problem = tension_problem(rig, scene, robot.position(place))
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
        for geometry in geometries(obstacle.shape, obstacle.pose):
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
        return thread(exits[number], anchors[number], at_exit, at_anchor)


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
    return distance(robot.body(pair.first, place), second) - pair.needed
