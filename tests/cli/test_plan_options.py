"""Options of `cdpr plan`: each planner accepts its own and refuses others."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
import yaml

from cdpr.cli.plan import _least_rounds
from model.files.plan_file import (
    OptimalPlannerDocument,
    PlanDocument,
    StatisticsDocument,
    WeightsDocument,
)
from tests.cli.plans import CONFIGS, RIG
from tests.cli.program import call, nothing_written, one_message

SCENE = CONFIGS / "environment_1.yaml"


@pytest.mark.parametrize(
    ("options", "parts"),
    [
        (["--mode", "paper"], ["optimal", "--mode"]),
        (["--max-iterations", "9"], ["optimal", "--max-iterations"]),
        (
            ["--mode", "paper", "--max-iterations", "9"],
            ["optimal", "--max-iterations, --mode"],
        ),
        (["--planner", "adaptive", "--rounds", "5"], ["adaptive", "--rounds"]),
        (["--planner", "goal-bias", "--budget-ms", "5"], ["goal-bias", "--budget-ms"]),
        (["--planner", "adaptive", "--weight", "length=1"], ["adaptive", "--weight"]),
        (["--planner", "adaptive", "--longest-mm", "700"], ["adaptive", "--longest-mm"]),
        (["--planner", "adaptive", "--cost", "clearance"], ["adaptive", "clearance"]),
        (["--budget-ms", "5", "--rounds", "5"], ["--budget-ms", "--rounds", "leave out one"]),
        (["--cost", "length", "--weight", "length=1"], ["--cost", "--weight", "leave out one"]),
        (["--weight", "speed=1"], ["speed", "not an objective", "kinematic"]),
        (["--weight", "length=1", "--weight", "length=2"], ["length", "appears twice"]),
        (["--weight", "length=much"], ["much", "not a number"]),
        (["--weight", "length"], ["not a number"]),
        (["--weight", "length=-1"], ["length", "0 or more"]),
        (["--weight", "length=nan"], ["length", "0 or more"]),
        (["--weight", "clearance=1"], ["path length is unbounded", "length"]),
        (
            ["--via-mm", "0", "0", "450", "--longest-mm", "3000"],
            ["stops (--via-mm or", "out --lon"],
        ),
    ],
)
def test_options_that_cannot_be_heeded_are_one_clear_message(
    tmp_path: Path, options: list[str], parts: list[str]
) -> None:
    with nothing_written(tmp_path):
        answer = call("plan", RIG, SCENE, "-o", tmp_path / "plan.json", *options)
    one_message(answer, 2, *parts)


def test_weights_seed_rounds_and_limit_are_in_the_plan(tmp_path: Path) -> None:
    plan = tmp_path / "plan.json"
    options = ["--weight", "length=1", "--weight", "kinematic=0.5", "--seed", "3"]
    options += ["--rounds", "90", "--longest-mm", "700", "--json"]
    answer = call("plan", RIG, SCENE, "-o", plan, *options)
    assert answer.code == 0, answer
    planner = json.loads(answer.out)["planner"]
    assert planner == json.loads(plan.read_text())["planner"]
    assert planner == {
        "name": "optimal",
        "weights": {"length": 1.0, "kinematic": 0.5, "clearance": 0.0, "capacity": 0.0},
        "seed": 3,
        "rounds": [90],
        "budget_ms": None,
        "longest_mm": 700.0,
    }


def test_a_limit_that_no_path_keeps_is_one_message_and_no_file(tmp_path: Path) -> None:
    with nothing_written(tmp_path):
        limit = ("--longest-mm", "600", "--rounds", "10")
        answer = call("plan", RIG, SCENE, "-o", tmp_path / "plan.json", *limit)
    one_message(answer, 1, "600.0 mm", "--cost length")


def test_a_budget_that_only_the_least_rounds_exceed_is_reported(tmp_path: Path) -> None:
    scarce = call("plan", RIG, SCENE, "-o", tmp_path / "a.json", "--budget-ms", "0.01")
    wanted = re.search(r"only the minimum; --budget-ms (\d+) ", scarce.said)
    assert wanted is not None, scarce
    for longer in (["--budget-ms", "1000"], ["--rounds", "12"]):
        answer = call("plan", RIG, SCENE, "-o", tmp_path / f"{longer[0]}.json", *longer)
        assert answer.code == 0, answer
        assert "only the minimum" not in answer.said
    assert json.loads((tmp_path / "a.json").read_text())["planner"]["rounds"] == [12]


@pytest.mark.parametrize(
    ("rounds", "spent_ms", "wanted_ms"),
    [
        ([12], 90.0, 900),
        ([3], 90.0, 900),  # every edge needs a proof
        ([12], 49.0, None),
        ([1], 0.1, None),
        ([1, 12, 1], 90.1, 1000),  # between straight legs
        ([12, 400], 140.0, 900),
        ([12, 400, 12], 230.0, 900),
        ([1, 400], 50.1, None),
        ([300, 400], 100.2, None),
    ],
)
def test_the_least_rounds_are_reported_by_leg(
    rounds: list[int], spent_ms: float, wanted_ms: int | None
) -> None:
    weights = WeightsDocument(length=1.0, kinematic=0.0, clearance=0.0, capacity=0.0)
    planner = OptimalPlannerDocument(
        name="optimal", weights=weights, seed=0, rounds=rounds, budget_ms=50.0, longest_mm=None
    )
    effort = StatisticsDocument(
        nodes=1, iterations=1, edge_checks=1, planning_time_s=1.0, search_time_s=spent_ms / 1e3
    )
    said = _least_rounds(PlanDocument.model_construct(planner=planner, statistics=effort))
    assert bool(said) == (wanted_ms is not None)
    if said:
        assert f"--budget-ms {wanted_ms} " in said[0][1]


def test_positions_of_options_keep_the_orientations_of_the_scene(tmp_path: Path) -> None:
    """With the platform frame, and so the home, rotated by 90° about the vertical."""
    half = 0.5**0.5
    rotated = {"rotation_wxyz": [half, 0.0, 0.0, half]}
    data = yaml.safe_load(RIG.read_text())
    data["platform"]["home"] |= rotated
    data["anchors_mm"] = [[y, -x, z] for x, y, z in data["anchors_mm"]]
    rig, scene, plan = (tmp_path / name for name in ("rig.yaml", "scene.yaml", "plan.json"))
    rig.write_text(yaml.safe_dump(data))
    ends = {"start": [180, 180, 300], "goal": [-180, -180, 400]}
    poses = {name: {"position_mm": at, **rotated} for name, at in ends.items()}
    scene.write_text(yaml.safe_dump({"schema_version": 1, "name": "rotated", **poses}))
    positions = ["--start-mm", 0, 0, 445, "--via-mm", 50, 0, 420, "--goal-mm", 100, 0, 400]
    answer = call("plan", rig, scene, "-o", plan, "--rounds", 1, *positions)
    assert answer.code == 0, answer
    waypoints = json.loads(plan.read_text())["waypoints"]
    passed = [point["position_mm"] for point in waypoints]
    assert passed == [positions[1:4], positions[5:8], positions[9:12]]
    assert all(point["rotation_wxyz"] == pytest.approx([half, 0, 0, half]) for point in waypoints)
