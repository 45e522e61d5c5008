"""`cdpr track` with several cameras: one pose, and each camera's alone."""

from __future__ import annotations

import csv
import json
from collections import Counter
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from mcap.reader import make_reader

from model.plan import load_plan, save_plan
from model.pose import Pose, matrix_from_rotation_vector
from model.rig import load_rig
from simulation.camera.camera import SyntheticCamera
from tests.cli.plans import GOAL_MM, RIG, START_MM, free_scene, straight_plan
from tests.cli.program import call, nothing_written, one_message
from tracking.shared_errors import CameraMoved
from tracking.tracker import Tracker


@pytest.fixture(scope="module")
def rig_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The ready rig with a second camera, a quarter turn round the frame."""
    data = yaml.safe_load(RIG.read_text())
    (front,) = load_rig(RIG).cameras
    quarter = matrix_from_rotation_vector(np.array([0.0, 0.0, np.pi / 2]))
    front_pose = front.world_from_camera
    side = Pose(quarter @ front_pose.position, quarter @ front_pose.rotation)
    where = {
        "position_mm": (side.position * 1e3).tolist(),
        "rotation_wxyz": side.quaternion.tolist(),
    }
    data["cameras"].append({**data["cameras"][0], "name": "side", "world_from_camera": where})
    path = tmp_path_factory.mktemp("rig") / "rig.yaml"
    path.write_text(yaml.safe_dump(data))
    return path


@pytest.fixture(scope="module")
def plan(rig_file: Path) -> Path:
    path = rig_file.parent / "plan.json"
    scene = free_scene(START_MM, GOAL_MM)
    save_plan(straight_plan(load_rig(rig_file), scene, [START_MM, GOAL_MM]), path)
    assert load_plan(path).scene.obstacles
    return path


def rows_of(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as stream:
        return list(csv.DictReader(stream))


def test_what_was_measured_before_a_fault_is_kept(
    plan: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Such as a camera that is bumped, or unplugged, after an hour."""
    log, observe = tmp_path / "poses.csv", Tracker.observe
    images: list[float] = []

    def bumped(self: Tracker, picture: np.ndarray, time: float, *rest: object) -> object:
        images.append(time)
        if len(images) == 5:
            raise CameraMoved("the camera has moved", where="camera front")
        return observe(self, picture, time, *rest)

    monkeypatch.setattr(Tracker, "observe", bumped)
    answer = call("track", RIG, "synthetic", "--plan", plan, "--pictures", "9", "-o", log)
    assert answer.code == 1
    assert "the camera has moved" in answer.err
    assert f"4 images before the error are in {log}" in " ".join(answer.err.split())
    assert len(rows_of(log)) == 4


def test_two_cameras_are_logged_together_and_alone(
    rig_file: Path, plan: Path, tmp_path: Path
) -> None:
    log = tmp_path / "poses.csv"
    sources = ("front=synthetic", "side=synthetic", "--plan", plan, "--pictures", "3")
    mcap = tmp_path / "poses.mcap"
    outputs = ("-o", log, "--overlay", tmp_path / "drawn", "--mcap", mcap, "--json")
    answer = call("track", rig_file, *sources, *outputs)
    assert answer.code == 0, answer
    assert json.loads(answer.out)["poses"] == 3
    both = rows_of(log)
    front, side = (rows_of(tmp_path / f"poses-{name}.csv") for name in ("front", "side"))
    for fused, *alone in zip(both, front, side, strict=True):
        scatter, *each = (
            sum(float(one[f"std_{axis}_mm"]) ** 2 for axis in "xyz") for one in (fused, *alone)
        )
        assert scatter < min(each)
        numbers = {n for one in alone for n in one["tags"].split()}
        assert set(fused["tags"].split()) == numbers
    assert len(list((tmp_path / "drawn" / "side").iterdir())) == 3
    with mcap.open("rb") as stream:
        counted = Counter(channel.topic for _, channel, _ in make_reader(stream).iter_messages())
    for channel in ("/tag_pose", "/tag_status", "/clearance"):
        assert [counted[channel + name] for name in ("", "/front", "/side")] == [3, 3, 3]


def test_cameras_of_different_rates_are_paired_by_name_to_the_end_of_the_longest(
    rig_file: Path, plan: Path, tmp_path: Path
) -> None:
    data = yaml.safe_load(rig_file.read_text())
    data["cameras"][0]["rate_hz"], data["cameras"][1]["rate_hz"] = 10.0, 5.0
    uneven = tmp_path / "rig.yaml"
    uneven.write_text(yaml.safe_dump(data))
    rig, scene = load_rig(uneven), load_plan(plan).scene
    for camera, numbers in zip(rig.cameras, (range(5), (0, 2)), strict=True):
        synthetic = SyntheticCamera(rig, scene, camera, seed=1)
        (tmp_path / camera.name).mkdir()
        for number in numbers:
            picture = synthetic.render(scene.start, number)
            cv2.imwrite(str(tmp_path / camera.name / f"{number}.png"), picture)
    log, drawn = tmp_path / "poses.csv", tmp_path / "drawn.avi"
    sources = [f"{name}={tmp_path / name}" for name in ("front", "side")]
    answer = call("track", uneven, *sources, "-o", log, "--overlay", drawn, "--json")
    assert answer.code == 0, answer
    facts = json.loads(answer.out)
    assert (facts["pictures"], facts["poses"], facts["pictures_without_partner"]) == (5, 5, 3)
    assert (facts["moments_apart"], facts["moments_without_speed"]) == (0, 0)
    rows = {name: rows_of(tmp_path / f"poses{name}.csv") for name in ("", "-front", "-side")}
    assert [len(rows[name]) for name in rows] == [5, 5, 2]
    assert [float(row["time_s"]) for row in rows[""]] == pytest.approx([0.0, 0.1, 0.2, 0.3, 0.4])
    better = [
        float(both["std_x_mm"]) < float(front["std_x_mm"])
        for both, front in zip(rows[""], rows["-front"], strict=True)
    ]
    assert better == [True, False, True, False, False]
    assert not drawn.exists()
    assert all((tmp_path / f"drawn-{name}.avi").is_file() for name in ("front", "side"))


def test_a_plan_is_for_those_cameras_that_are_synthetic(
    rig_file: Path, plan: Path, tmp_path: Path
) -> None:
    blank = tmp_path / "blank"
    blank.mkdir()
    camera = load_rig(rig_file).cameras[1]
    cv2.imwrite(str(blank / "0.png"), np.full((camera.height, camera.width), 99, dtype=np.uint8))
    options = ("--plan", plan, "--pictures", "1", "-o", tmp_path / "poses.csv", "--json")
    with nothing_written(tmp_path):
        answer = call("track", rig_file, f"side={blank}", *options)
    one_message(answer, 2, "--plan is for the synthetic camera", str(blank))
    with nothing_written(tmp_path):
        answer = call("track", rig_file, "front=synthetic", f"side={blank}", *options)
    one_message(answer, 2, "of different kinds", "front=synthetic", f"{blank} (a folder)")


@pytest.mark.parametrize(
    ("sources", "parts"),
    [
        (["front=synthetic", "back=synthetic"], ["unknown camera 'back'", "front, side"]),
        (["front=synthetic", "synthetic"], ["'synthetic' does not name its camera"]),
        (["frnt=synthetic"], ["unknown camera 'frnt'", "front, side"]),
        (["side="], ["camera 'side' has no source", "write side=0"]),
        (["front=somewhere", "side=somewhere"], ["'front' and 'side' have the same source"]),
        (["front=synthetic", "front=synthetic"], ["'front' has two sources"]),
        (["front=synthetic", "side=synthetic", "--camera", "side"], ["--camera is for a single"]),
    ],
)
def test_sources_that_do_not_say_whose_they_are_are_refused(
    rig_file: Path, plan: Path, tmp_path: Path, sources: list[str], parts: list[str]
) -> None:
    with nothing_written(tmp_path):
        answer = call("track", rig_file, *sources, "--plan", plan, "-o", tmp_path / "poses.csv")
    one_message(answer, 2, *parts)
