"""Unusable plan files, for `cdpr check` and `cdpr run`."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from model.plan import save_plan
from model.rig import load_rig
from model.scene import load_scene, scene_from_document
from tests.cli.plans import (
    CONFIGS,
    GOAL_MM,
    HALL,
    RIG,
    START_MM,
    free_scene,
    rig_with_long_cycles,
    straight_plan,
)
from tests.cli.program import Answer, call, nothing_written, one_message


def use(verb: str, plan: Path, folder: Path, rig: Path = RIG) -> Answer:
    """`cdpr check` or `cdpr run` of a plan, which must leave the folder unchanged."""
    rest = ["-o", folder / "run", "--fast", "--no-camera"] if verb == "run" else []
    with nothing_written(folder):
        return call(verb, plan, "--rig", rig, *rest)


@pytest.fixture(params=["check", "run"])
def verb(request: pytest.FixtureRequest) -> str:
    return str(request.param)


def test_a_plan_with_nan_is_not_read(short_plan: Path, tmp_path: Path, verb: str) -> None:
    plan = tmp_path / "plan.json"
    plan.write_text(short_plan.read_text().replace("445.0", "NaN", 1))
    one_message(use(verb, plan, tmp_path), 2, f"{plan}: the file holds NaN", "cdpr plan")


def test_an_edited_plan_is_not_used(short_plan: Path, tmp_path: Path, verb: str) -> None:
    data = json.loads(short_plan.read_text())
    data["waypoints"][1]["position_mm"][2] += 1.0
    plan = tmp_path / "plan.json"
    plan.write_text(json.dumps(data))
    one_message(use(verb, plan, tmp_path), 2, str(plan), "hash does not match", "edited")


@pytest.mark.parametrize(
    ("name", "text", "part"),
    [
        ("missing", None, "no such file"),
        ("empty", "", "the file is empty"),
        ("cut off", '{"kind": "cdpr-plan", "waypoi', "truncated or edited"),
        ("something else", '{"kind": "shopping list"}', "this is not a plan file"),
        ("a list", "[]", "this is not a plan file"),
        ("a later version", '{"kind": "cdpr-plan", "schema_version": 7}', "schema version 7"),
        ("incomplete", '{"kind": "cdpr-plan", "schema_version": 1}', "waypoints"),
    ],
)
def test_a_file_that_is_not_a_plan_is_reported_as_such(
    tmp_path: Path, verb: str, name: str, text: str | None, part: str
) -> None:
    plan = tmp_path / f"{name}.json"
    if text is not None:
        plan.write_text(text)
    one_message(use(verb, plan, tmp_path), 2, str(plan), part)


def test_a_plan_of_another_rig_names_what_differs(
    short_plan: Path, tmp_path: Path, verb: str
) -> None:
    answer = use(verb, short_plan, tmp_path, HALL)
    one_message(answer, 2, str(short_plan), "made for the rig 'gachon_8_6'", "outlets_mm")


def test_a_plan_of_another_rig_is_named_before_the_cameras_that_rig_lacks(
    short_plan: Path, tmp_path: Path
) -> None:
    """Passing --no-camera, as the cameras would ask for, would not help."""
    rig = CONFIGS / "open_frame_8_6.yaml"
    answer = call("run", short_plan, "--rig", rig, "--fast", "-o", tmp_path / "run")
    one_message(answer, 2, "made for the rig 'gachon_8_6'")


def test_a_plan_of_the_rig_before_it_was_changed_names_the_part(
    short_plan: Path, tmp_path: Path, verb: str
) -> None:
    rig = tmp_path / "rig.yaml"
    rig.write_text(RIG.read_text().replace("mass_kg: 0.4", "mass_kg: 0.5"))
    answer = use(verb, short_plan, tmp_path, rig)
    one_message(answer, 2, "as it is now", "differ: platform")


def colliding_plan(path: Path) -> Path:
    """A valid plan file, straight through the obstacle of environment 1."""
    scene = load_scene(CONFIGS / "environment_1.yaml")
    corners = [(180.0, 180.0, 300.0), (-180.0, -180.0, 400.0)]
    save_plan(straight_plan(load_rig(RIG), scene, corners), path)
    return path


def test_a_whole_plan_that_collides_is_refused_before_anything_moves(tmp_path: Path) -> None:
    plan = colliding_plan(tmp_path / "plan.json")
    answer = use("run", plan, tmp_path)
    one_message(answer, 3, "the plan fails its check", "obstacle_1", "limit 10 mm")


def test_check_reports_every_violation_with_its_position_and_exits_3(tmp_path: Path) -> None:
    plan = colliding_plan(tmp_path / "plan.json")
    answer = use("check", plan, tmp_path)
    assert answer.code == 3
    assert "violated" in answer.out
    assert "obstacle_1" in answer.out
    assert "not passed" in answer.out
    checked = call("check", plan, "--json")
    assert checked.code == 3
    assert json.loads(checked.out)["passed"] is False
    assert json.loads(checked.out)["violations"]


@pytest.mark.parametrize(("speed_mm_s", "refused"), [(20, False), (90, True)])
def test_check_remarks_on_a_path_that_a_run_refuses_as_it_cannot_stop_before_obstacles(
    tmp_path: Path, speed_mm_s: int, refused: bool
) -> None:
    rig = rig_with_long_cycles(tmp_path)
    rig.write_text(rig.read_text().replace("  speed_mm_s: 20", f"  speed_mm_s: {speed_mm_s}"))
    plan = tmp_path / "plan.json"
    ends = [(-20.0, 0.0, 150.0), (-20.0, 20.0, 160.0)]
    save_plan(straight_plan(load_rig(rig), free_scene(*ends), ends), plan)
    checked = call("check", plan)
    assert checked.code == 0
    assert ("may be refused: the path comes within" in checked.err) is refused
    ran = call("run", plan, "--fast", "--no-camera", "-o", tmp_path / "run")
    assert (ran.code == 3 and "without its master" in ran.err) is refused


@pytest.mark.parametrize("profile", [None, "drives: {}\n"], ids=["missing", "invalid"])
@pytest.mark.parametrize("with_obstacles", [True, False])
def test_check_does_not_depend_on_the_file_of_the_drive_profile(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, profile: str | None, with_obstacles: bool
) -> None:
    """The plan contains rig and scene; the profile's path is relative to the current folder."""
    rig = tmp_path / "rig.yaml"
    rig.write_text(f"{RIG.read_text()}\ndrives: {{type: cia402, profile: mine.yaml}}\n")
    scene = free_scene(START_MM, GOAL_MM)
    if not with_obstacles:
        document = scene.document.model_copy(update={"obstacles": []})
        scene = scene_from_document(document)
    plan = tmp_path / "plan.json"
    save_plan(straight_plan(load_rig(rig), scene, [START_MM, GOAL_MM]), plan)
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    monkeypatch.chdir(elsewhere)
    if profile is not None:
        Path("mine.yaml").write_text(profile)
    checked = call("check", plan)
    assert checked.code == 0, checked
    assert "passed" in checked.out
    remark = "whether a run can stop before obstacles is not checked: "
    assert (remark in checked.err) is ("mine.yaml:" in checked.err) is with_obstacles
