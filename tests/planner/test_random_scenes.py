"""A slice of `benchmarks/random_scenes.py`, and whether its second opinion detects violations."""

from __future__ import annotations

import json

import numpy as np
import pytest

from benchmarks.random_robots import random_robot, random_scene
from benchmarks.random_scenes import PLANNED, main, repeated
from benchmarks.second_opinion import second_opinion
from model.clearance import ClearanceModel
from model.pose import Pose
from model.scene import scene_from_document

UP = np.array([0.0, 0.0, 1.0])


def test_a_path_through_an_obstacle_is_reported_with_the_pair(gachon, ready_scene) -> None:
    scene = ready_scene("environment_1")
    ends = np.array([scene.start.position, scene.goal.position])
    opinion = second_opinion(gachon, scene, ends)
    assert opinion.slack < 0.0
    assert any("not proved" in problem for problem in opinion.problems)


def test_a_path_that_barely_keeps_its_clearance_passes_and_one_that_misses_it_does_not(
    gachon, ready_scene
) -> None:
    """Beside the obstacle for a while, with the clearance taken from the path itself."""
    scene = ready_scene("environment_1")
    path = np.array([scene.start.position, scene.start.position + 0.2 * UP])
    scene = scene.changed(goal=Pose(path[-1], scene.goal.rotation))
    model = ClearanceModel(gachon, scene)
    poses = [Pose.level(path[0] + k / 400.0 * (path[1] - path[0])) for k in range(401)]
    smallest = min(near.distance for p in poses if (near := model.smallest(p)) is not None)
    assert second_opinion(gachon, scene.changed(clearance=smallest - 1e-4), path).problems == []
    refused = second_opinion(gachon, scene.changed(clearance=smallest + 1e-4), path)
    assert refused.problems


def test_wrong_ends_and_loads_that_nothing_holds_are_reported(gachon, ready_scene) -> None:
    scene = ready_scene("environment_1")
    path = np.array([scene.start.position, scene.start.position + 0.01 * UP])
    problems = second_opinion(gachon, scene, path).problems
    assert len(problems) == 1
    assert "from the goal" in problems[0]
    load = scene.document.load.model_copy(update={"payload_kg": 60.0})
    heavy = scene_from_document(scene.document.model_copy(update={"load": load}))
    problems = second_opinion(gachon, heavy, path).problems
    assert any("no tensions hold the load" in problem for problem in problems)


def test_a_scene_that_failed_is_repeated_from_its_file(gachon, ready_scene, tmp_path) -> None:
    again = {
        "rig": gachon.document.model_dump(mode="json"),
        "scene": ready_scene("environment_1").document.model_dump(mode="json"),
        "objective": "length",
        "seed": 3,
        "rounds": 12,
    }
    file = tmp_path / "failure_3.json"
    file.write_text(json.dumps(again))
    result = repeated(file)
    assert (result.outcome, result.problems, result.checked) == (PLANNED, [], True)
    assert result.slack_mm is not None
    assert 0.0 <= result.slack_mm < 1.0


def test_the_same_number_gives_the_same_robot_and_scene() -> None:
    first, second = random_robot(3, 2), random_robot(3, 2)
    assert first.rig.hash == second.rig.hash
    assert first.rig.cable_count == 8
    scenes = [random_scene(robot, 3, 7) for robot in (first, second)]
    assert scenes[0] is not None
    assert scenes[0].hash == scenes[1].hash


@pytest.mark.slow
def test_no_path_in_random_scenes_violates_anything(tmp_path, capsys) -> None:
    """One robot of every number of cables would take a minute; two do here."""
    arguments = ["--scenes", "12", "--seed", "5", "-o", str(tmp_path)]
    assert main(arguments) == 0
    lines = (tmp_path / "random_scenes_5.jsonl").read_text().splitlines()
    results = [json.loads(line) for line in lines]
    assert sum(result["outcome"] == PLANNED for result in results) >= 6
    assert all(result["problems"] == [] for result in results)
    capsys.readouterr()
    assert main(arguments) == 0  # nothing remains to be done
    assert len((tmp_path / "random_scenes_5.jsonl").read_text().splitlines()) == 12
