"""Stopped in the middle, replanned from there, run to the end; refused where unsafe."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import yaml

import cdpr
from executor.recording.resume import remaining_scene, run_end
from executor.recording.run_folder import RunFolder
from executor.state_machine import State
from executor.trajectory.setpoints import PreparedRun, prepare
from model.errors import BadInput
from model.files.scene_file import Payload
from model.kinematics import cable_lengths
from model.plan import load_plan, plan_from_document
from model.pose import Pose
from model.rig import load_rig
from model.scene import Scene, load_scene
from planner.check import verify
from planner.planning import make_plan
from planner.settings import OptimalSettings
from tests.cli.plans import RIG
from tests.cli.program import call, nothing_written, one_message
from tests.scenarios.stage import Stage, concluded, staged

SCENE = {
    "schema_version": 1,
    "name": "short path",
    "start": {"position_mm": [0, 0, 445]},
    "goal": {"position_mm": [0, 0, 445]},
    "stops": [
        {
            "name": "take",
            "kind": "pick",
            "position_mm": [0, 12, 450],
            "dwell_s": 0.4,
            "mass_kg": 1.5,
            "mass_centre_mm": [0, 0, -60],
        },
        {"name": "by", "position_mm": [12, 12, 455]},
        {
            "name": "leave",
            "kind": "place",
            "position_mm": [12, 0, 450],
            "dwell_s": 0.4,
            "mass_kg": 1.5,
        },
    ],
    "obstacles": [
        {"name": "block", "box": {"size_mm": [80, 80, 100]}, "position_mm": [-150, 0, 50]}
    ],
}
CARRIED = Payload(1.5, (0.0, 0.0, -60.0))


@dataclass(frozen=True)
class Ended:
    """A finished run: its folder, and the true pose of the simulated platform."""

    folder: RunFolder
    state: State
    pose: Pose


def ended(
    prepared: PreparedRun, path: Path, stop: Callable[[Stage], bool], start: Pose | None = None
) -> Ended:
    """Runs until the operator requests a stop; ``stop`` checks the cycles."""

    def script(stage: Stage) -> None:
        if stop(stage):
            stage.board.ask_stop()

    with staged(prepared, path, script, start) as stage:
        outcome = stage.run()
        concluded(stage, outcome)
        return Ended(stage.folder, outcome.state, stage.rehearsal.pose)


def after_row(prepared: PreparedRun, row: int) -> Callable[[Stage], bool]:
    """Some cycles are sent before the first row."""
    return lambda stage: stage.cycle >= row + 16


@pytest.fixture(scope="module")
def scene_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("scene") / "scene.yaml"
    path.write_text(yaml.safe_dump(SCENE), encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def scene(scene_file: Path) -> Scene:
    return load_scene(scene_file)


def planned(scene: Scene, **more: object) -> PreparedRun:
    rig = load_rig(RIG)
    document = make_plan(rig, scene, OptimalSettings(rounds=3), **more)
    return prepare(verify(plan_from_document(document)), rig)


@pytest.fixture(scope="module")
def first(scene: Scene) -> PreparedRun:
    return planned(scene)


@pytest.fixture(scope="module")
def stopped(first: PreparedRun, tmp_path_factory: pytest.TempPathFactory) -> Ended:
    """On the second leg, halfway from the pick to the via pose."""
    take, by, _ = first.checked.table.dwells
    path = tmp_path_factory.mktemp("stopped") / "run"
    return ended(first, path, after_row(first, (take.last + by.first) // 2))


def test_the_end_of_a_run_is_where_the_platform_is_with_what_it_carries(
    stopped: Ended, scene: Scene
) -> None:
    assert stopped.state is State.STOPPED
    end = run_end(stopped.folder)
    assert end.pose.distance_to(stopped.pose) < 5e-5
    assert end.payload == CARRIED
    assert [stop.name for stop in end.done] == ["take"]
    assert (end.waiting_at, end.finished) == ("", False)
    times = {times_at["name"]: times_at for times_at in stopped.folder.summary()["stops"]}
    assert times["take"]["left_s"] - times["take"]["reached_s"] == pytest.approx(0.4, abs=0.011)
    assert times["by"] == {"name": "by", "kind": "pass", "reached_s": None, "left_s": None}


def test_a_plan_from_a_stopped_run_runs_to_the_goal_through_the_stops_left(
    stopped: Ended, scene_file: Path, tmp_path: Path
) -> None:
    """From the command line; the simulated rig is where the first run truly left it."""
    plan = tmp_path / "rest.json"
    folder = stopped.folder.path
    answer = call("plan", RIG, scene_file, "-o", plan, "--from-run", folder, "--rounds", "3")
    assert answer.code == 0, answer
    assert "with 1.5 kg; 1 stops done, 2 left" in answer.said
    rest = load_plan(plan)
    assert [stop.name for stop in rest.scene.stops] == ["by", "leave"]
    assert [stop.name for stop in rest.document.done] == ["take"]
    assert rest.scene.load.payload_mass == 1.5
    prepared = prepare(verify(rest), load_rig(RIG))
    second = ended(prepared, tmp_path / "run", lambda _stage: False, stopped.pose)
    assert second.state is State.FINISHED
    assert second.folder.summary()["verdict"] == "PASSED"
    assert second.pose.distance_to(rest.scene.goal) < 1e-4
    end = run_end(second.folder)
    assert (end.payload.mass_kg, end.finished) == (0.0, True)
    assert [stop.name for stop in end.done] == ["take", "by", "leave"]
    with nothing_written(tmp_path):
        nothing = call(
            "plan", RIG, scene_file, "-o", plan, "--force", "--from-run", tmp_path / "run"
        )
    one_message(nothing, 2, "nothing remains to be done", "--goal-mm")


def test_a_dwell_cut_short_is_done_again_with_the_load_before_it(
    first: PreparedRun, scene: Scene, tmp_path: Path
) -> None:
    take = first.checked.table.dwells[0]
    cut = ended(first, tmp_path / "run", after_row(first, take.first + 5))
    end = run_end(cut.folder)
    assert end.waiting_at == "take"
    assert end.payload.mass_kg == 0.0
    rest, done = remaining_scene(scene, end)
    assert done == ()
    assert [stop.name for stop in rest.stops] == ["take", "by", "leave"]
    again = planned(rest, done=done)
    assert ended(again, tmp_path / "again", lambda _stage: False, cut.pose).state is State.FINISHED


def test_another_task_begins_where_the_run_ended_with_all_its_stops(
    stopped: Ended, scene: Scene
) -> None:
    renamed = [s.model_copy(update={"name": s.name + " 2"}) for s in scene.document.stops[1:]]
    other, done = remaining_scene(
        scene.changed(stops=[], payload=CARRIED).changed(stops=renamed), run_end(stopped.folder)
    )
    assert done == ()
    assert len(other.stops) == 2
    assert other.load.payload_mass == 1.5


def test_a_stop_that_was_changed_since_is_refused(stopped: Ended, tmp_path: Path) -> None:
    changed = json.loads(json.dumps(SCENE))
    changed["stops"][0]["dwell_s"] = 0.5
    path = tmp_path / "scene.yaml"
    path.write_text(yaml.safe_dump(changed), encoding="utf-8")
    out = tmp_path / "plan.json"
    answer = call("plan", RIG, path, "-o", out, "--from-run", stopped.folder.path)
    one_message(answer, 2, "visited 'take' as stops that differ from the scene's")


def test_a_clearance_that_is_not_there_is_reported_with_the_one_that_is(
    stopped: Ended, scene_file: Path, tmp_path: Path
) -> None:
    arguments = ("plan", RIG, scene_file, "-o", tmp_path / "plan.json", "--rounds", "3")
    arguments += ("--from-run", stopped.folder.path, "--clearance-mm")
    answer = call(*arguments, "300")
    one_message(answer, 2, "the platform stopped with", "block")
    possible = answer.said.split("pass --clearance-mm ")[1].split(",")[0]
    with pytest.raises(BadInput) as refused:
        cdpr.plan(
            load_rig(RIG), load_scene(scene_file), clearance=0.3, from_run=stopped.folder.path
        )
    assert f"pass `clearance={float(possible) / 1000:g}`" in (refused.value.next_step or "")
    above = call(*arguments, str(float(possible) + 0.02))
    assert above.code == 2
    # With that clearance the plan may begin; the rest of the path is as close to the block.
    assert "the platform stopped" not in call(*arguments, possible).said


def copied(folder: RunFolder, path: Path) -> RunFolder:
    """A copy without checksums, whose files the tests replace."""
    path.mkdir()
    for file in folder.path.iterdir():
        if file.is_file() and file.name != "SHA256SUMS":
            (path / file.name).write_bytes(file.read_bytes())
    return RunFolder(path)


@pytest.mark.parametrize(
    ("cable", "off_mm", "words"),
    [(None, 3.0, "mm from the commanded pose"), (4, 2.2, "longer or shorter than")],
)
def test_drives_that_contradict_the_plan_or_each_other_are_refused(
    stopped: Ended, scene_file: Path, tmp_path: Path, cable: int | None, off_mm: float, words: str
) -> None:
    """All cables as for a pose 3 mm higher; or one cable alone that is 2.2 mm off."""
    folder = copied(stopped.folder, tmp_path / "run")
    cycles, rig = folder.cycles(), folder.rig()
    per_metre = np.array([w.counts_per_metre for w in rig.winches])
    change = np.zeros(rig.cable_count)
    if cable is None:
        higher = Pose(
            stopped.pose.position + np.array([0.0, 0.0, off_mm / 1e3]), stopped.pose.rotation
        )
        change = cable_lengths(rig, higher) - cable_lengths(rig, stopped.pose)
    else:
        change[cable] = off_mm / 1e3
    counts = cycles.actual_counts.copy()
    counts[-1] += np.rint(change * per_metre).astype(np.int64)
    folder.write_table("cycles.csv", replace(cycles, actual_counts=counts))
    out = tmp_path / "plan.json"
    answer = call("plan", RIG, scene_file, "-o", out, "--from-run", folder.path)
    one_message(answer, 3, "the platform pose is unknown", words, "--start-mm")
    assert not out.exists()


def test_a_folder_without_its_cycles_or_with_silent_drives_is_refused(
    stopped: Ended, scene_file: Path, tmp_path: Path
) -> None:
    folder = copied(stopped.folder, tmp_path / "run")
    arguments = ("plan", RIG, scene_file, "-o", tmp_path / "plan.json", "--from-run", folder.path)
    cycles = folder.cycles()
    missing = cycles.missing.copy()
    missing[-1] = 2
    folder.write_table("cycles.csv", replace(cycles, missing=missing))
    one_message(call(*arguments), 3, "2 drives did not answer in the last cycle")
    (folder.path / "cycles.csv").unlink()
    one_message(call(*arguments), 2, "incomplete run folder", "cycles.csv missing")
    both = call(*arguments, "--start-mm", "0", "0", "445")
    one_message(both, 2, "--from-run and --start-mm contradict each other")


def test_via_poses_of_the_command_line_are_met_before_the_scenes_stops(
    scene_file: Path, tmp_path: Path
) -> None:
    plan = tmp_path / "plan.json"
    arguments = ("plan", RIG, scene_file, "-o", plan, "--rounds", "3")
    answer = call(*arguments, "--via-mm", "5", "-5", "450", "--via-mm", "0", "0", "460")
    assert answer.code == 0, answer
    made = load_plan(plan)
    assert [stop.name for stop in made.scene.stops] == ["via 1", "via 2", "take", "by", "leave"]
    np.testing.assert_allclose(made.waypoints[made.stops[0]].position, [0.005, -0.005, 0.45])
    for wrong in ("1 2", "1 2 x", "1 2 nan"):
        times_at = call(*arguments, "--force", "--via-mm", *wrong.split())
        one_message(times_at, 2, f"--via-mm {wrong}:", "numbers are required")
