"""Random turning moves, a part of them grazing, in scenes of all shapes: none allowed wrongly."""

from __future__ import annotations

import numpy as np
import pytest

from model.files.scene_file import RotationLimitsDocument
from model.pose import Array, Pose, interpolate
from model.rig import Rig
from model.scene import Scene, scene_from_document
from planner.anytime_6d.problem import RotatingProblem, move_allowed, put_between
from tests.configs import GACHON, HALL
from tests.effort import cases
from tests.planner.anytime_6d.rotating_scenes import Judge, problem_of, random_pose, row
from tests.planner.collision.sampled_oracle import random_scene

SCENES, MOVES, SAMPLES = cases(14, 0.3), 30, 9


def pose_of(found: Array) -> Pose:
    return Pose.from_quaternion(found[:3], found[3:])


def with_limits(scene: Scene) -> Scene:
    limits = RotationLimitsDocument(tilt_deg=25.0, turn_deg=4.0)
    update = {
        "rotation_limits": limits,
        "clearance": scene.document.clearance.model_copy(update={"self_mm": 1.0}),
    }
    return scene_from_document(scene.document.model_copy(update=update))


def grazing(problem: RotatingProblem, start: Array, end: Array, tallies: Array) -> Array:
    """The start of a refused move, as far as it is allowed."""
    low, high, reached = 0.0, 1.0, start.copy()
    for _ in range(25):
        middle, at = (low + high) / 2.0, np.empty(7)
        put_between(start, end, middle, at)
        if move_allowed(problem, start, at, tallies):
            low, reached = middle, at
        else:
            high = middle
    return reached


@pytest.mark.slow
@pytest.mark.parametrize("rig", [GACHON, HALL])
def test_no_allowed_move_violates_anything_anywhere(rig: Rig) -> None:
    rng = np.random.default_rng(2027)
    tallies = np.zeros(6, dtype=np.int64)
    looked_at, touching = 0, 0
    for _ in range(SCENES):
        scene = with_limits(random_scene(rng, rig, int(rng.integers(1, 3))))
        problem, judge = problem_of(rig, scene), Judge(rig, scene)
        for _ in range(MOVES):
            start, end = row(random_pose(rng, rig, scene)), row(random_pose(rng, rig, scene))
            if not move_allowed(problem, start, start, tallies):
                continue
            if not move_allowed(problem, start, end, tallies):
                end, touching = grazing(problem, start, end, tallies), touching + 1
            first, last = pose_of(start), pose_of(end)
            poses = [interpolate(first, last, float(s)) for s in np.linspace(0.0, 1.0, SAMPLES)]
            looked_at += 1
            assert min(judge.room(pose) for pose in poses) >= 0.0
            assert min(judge.margin(pose) for pose in poses) >= 0.0
    assert looked_at > 2.5 * SCENES
    assert touching > 1.6 * SCENES
