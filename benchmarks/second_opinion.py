"""Verification of a path, independent of planner and check.

Distances are coal's, between primitive shapes (cables are threads, hulls are hulls, meshes are
their triangles), at samples 40 mm apart and at every corner. A distance changes at most by the
motion (twice that between cables over pulleys): larger differences between neighbours reveal an
error, and two neighbours bound the distance between them. Where the bound is too low, the interval
is bisected until every pair is proved or samples are 20 µm apart. Tensions are found by a quadratic
program at the first samples; each solution is verified in the equations.
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
    """Result for one path.

    Attributes:
        problems: Violations, one line each.
        slack: Smallest distance beyond the required one, to obstacles and between bodies, [m].
        distances: Number of distances computed.
    """

    problems: list[str] = field(default_factory=list)
    slack: float = np.inf
    distances: int = 0


def second_opinion(rig: Rig, scene: Scene, path: Array) -> Opinion:
    """Verifies all requirements of a path under pure translation.

    Args:
        rig: The robot.
        scene: Obstacles, clearances, load, start and goal.
        path: Corners, shape (k, 3), [m].
    """
    found = Opinion()
    _check_ends(rig, scene, path, found)
    robot = _Robot(rig, scene, path)
    samples = robot.first_samples()
    for pair in _pairs(rig, scene):
        _prove(robot, pair, samples, found)
    for s in samples.tolist():
        problem = tension_problem(rig, scene, robot.position(s))
        if problem:
            found.problems.append(f"{problem} at {s * 1e3:.1f} mm")
            break
    return found


def _check_ends(rig: Rig, scene: Scene, path: Array, found: Opinion) -> None:
    if not np.isfinite(path).all():
        found.problems.append("a corner is not finite")
    outside = np.maximum(rig.workspace_lower - path, path - rig.workspace_upper).max()
    if not outside <= 1e-8:
        found.problems.append(f"{outside * 1e3:.6f} mm outside the workspace")
    for name, at, wanted in (("start", path[0], scene.start), ("goal", path[-1], scene.goal)):
        away = float(np.linalg.norm(at - wanted.position))
        if not away <= 1e-8:
            found.problems.append(f"{away * 1e3:.6f} mm from the {name}")


@dataclass(frozen=True)
class _Pair:
    """Two bodies and their required distance.

    A part of the robot is a cable's number with the lengths left out at its anchor and at its exit,
    or the number after the last cable's for the platform. The other body is a part too, or fixed;
    then the second part is unused.
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
    """Whether single positions meet the required distances."""

    def __init__(self, rig: Rig, scene: Scene) -> None:
        """Builds the obstacles once."""
        self._rig, self._scene = rig, scene
        self._all = list(_pairs(rig, scene))

    def is_usable(self, position: Array, reserve: float) -> bool:
        """Whether all distances at a position, (3,), [m], exceed the required ones by a reserve."""
        robot = _Robot(self._rig, self._scene, position[None, :])
        return all(_room(robot, pair, 0.0) >= reserve for pair in self._all)


class _Robot:
    """The robot's bodies along a path, built on demand."""

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

    def first_samples(self) -> Array:
        """Every corner and samples between them, as path lengths from the start, [m]."""
        samples = [0.0]
        for low, high in zip(self._marks[:-1], self._marks[1:], strict=True):
            if high > low:
                count = int(np.ceil((high - low) / SPACING))
                samples += np.linspace(low, high, count + 1)[1:].tolist()
        return np.array(samples)

    def position(self, s: float) -> Array:
        """Position of the platform at path length ``s``, shape (3,), [m]."""
        return np.array([np.interp(s, self._marks, axis) for axis in self._path.T])

    def body(self, part: Part, s: float) -> Body:
        """A part of a cable, or the platform, at path length ``s``."""
        key = (s, part)
        if key not in self._made:
            self._made[key] = self._body(part, s)
        return self._made[key]

    def _body(self, part: Part, s: float) -> Body:
        number, at_anchor, at_exit = part
        if number == self.rig.cable_count:
            return self._box, coal.Transform3s(self._rotation, self.position(s))
        if s not in self._cables:
            cables = cables_to(self.rig, self._arms + self.position(s))
            self._cables[s] = (np.array(cables.exits), np.array(cables.anchors))
        exits, anchors = self._cables[s]
        return thread(exits[number], anchors[number], at_exit, at_anchor)


def _prove(robot: _Robot, pair: _Pair, samples: Array, found: Opinion) -> None:
    """Proves one pair along the whole path, bisecting intervals that are not proved."""

    def room(s: float) -> float:
        found.distances += 1
        return _room(robot, pair, s)

    values = [room(s) for s in samples.tolist()]
    open_parts = list(zip(samples[:-1], values[:-1], samples[1:], values[1:], strict=True))
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
    found.problems.append(f"{pair.name}: {least * 1e3:+.5f} mm beyond the required, not proved")


def _room(robot: _Robot, pair: _Pair, s: float) -> float:
    """Distance of a pair's surfaces minus the required one, [m]."""
    second = pair.fixed or robot.body(pair.second, s)
    return distance(robot.body(pair.first, s), second) - pair.needed
