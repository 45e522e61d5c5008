"""Problems for the compiled search: the example scenes, walls, posts and random obstacles."""

from __future__ import annotations

from typing import Any

import numpy as np

from model.errors import BadInput
from model.pose import Array, Pose
from model.rig import Rig
from model.scene import Scene
from planner.anytime.local_search import Polyline
from planner.anytime.path import advance, handle_of
from planner.anytime.problem import PathProblem, problem_of
from planner.anytime.state import BEST, AnytimeSearch, new_search
from planner.costs import KinematicCost
from planner.endpoints import require_usable_ends
from planner.settings import Weights
from tests.planner.collision.sampled_oracle import random_scene

KINDS = ("box", "rotated box", "sphere", "capsule", "cylinder", "hull")
LENGTH = Weights(length=1.0)


def problem(rig: Rig, scene: Scene, weights: Weights = LENGTH) -> PathProblem:
    """A problem with the cost of the scene's orientation."""
    return problem_of(rig, scene, weights, KinematicCost(rig, scene.start.rotation))


def ends_of(scene: Scene) -> Array:
    """Start and goal, shape (2, 3), [m]."""
    return np.array([scene.start.position, scene.goal.position])


def searched(asked: PathProblem, scene: Scene, rounds: int, seed: int = 0) -> AnytimeSearch:
    """A search after ``rounds`` rounds."""
    search = new_search(*ends_of(scene), seed)
    advance(handle_of(asked, search), rounds)
    return search


def best_points(search: AnytimeSearch) -> Array:
    """The best path, shape (k, 3), [m]; k is 0 without one."""
    return search.points[BEST, : search.counts[BEST, 0]].copy()


def polyline(points: Array) -> Polyline:
    """A polyline with room for a few more vertices."""
    room = len(points) + 20
    line = Polyline(np.zeros((room, 3)), np.zeros((room, 3)), np.array([len(points), 0]))
    line.points[: len(points)] = points
    return line


def post(x: float, y: float, low: float, high: float, width: float = 40.0) -> dict[str, Any]:
    """An upright square post as a scene file names it, [mm]."""
    return {
        "name": f"post at {x:g} {y:g}",
        "box": {"size_mm": [width, width, high - low]},
        "position_mm": [x, y, (low + high) / 2.0],
    }


def random_question(rig: Rig, seed: int) -> Scene | None:
    """A random scene with two usable ends; None where some draws gave none."""
    rng = np.random.default_rng(seed)
    scene = random_scene(rng, rig, int(rng.integers(1, 4)), KINDS)
    ends: list[Pose] = []
    for _ in range(40):
        pose = Pose.level(rng.uniform(rig.workspace_lower, rig.workspace_upper))
        try:
            require_usable_ends(rig, scene.changed(start=pose, goal=pose))
        except BadInput:
            continue
        ends.append(pose)
        if len(ends) == 2:
            return scene.changed(start=ends[0], goal=ends[1])
    return None
