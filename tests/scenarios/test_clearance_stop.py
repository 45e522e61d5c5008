"""A platform closer to an obstacle than its encoder pose: the camera detects it, the run stops."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from executor.cameras.process import CameraWorker, FrameRequest
from executor.recording.run_folder import RunFolder
from executor.state_machine import PlatformPoses, State
from executor.supervision import StopReason
from executor.trajectory.setpoints import PreparedRun
from model.clearance import ClearanceModel
from model.files.scene_file import SceneDocument
from model.kinematics import cable_lengths
from model.plan import load_plan, save_plan
from model.pose import Pose
from model.rig import load_rig
from model.scene import scene_from_document
from simulation.camera.camera import SyntheticCamera
from tests.cli.plans import GOAL_MM, RIG, START_MM, straight_plan
from tests.cli.program import call
from tests.scenarios.stage import at, staged
from tracking.clearance import ClearanceMonitor, clearance_of
from tracking.measurement import PoseMeasurement

#: True offset of the platform towards the block, [m].
OFF = np.array([-0.005, 0.0, 0.0])
#: Possible measurements of a camera.
NEAR = "less clearance than the scene requires: platform to block: 6.0 ± 1.0 mm"


@pytest.fixture(scope="module")
def rig_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The ready rig, simulated with drives whose reference is off by `OFF` at home."""
    rig, data = load_rig(RIG), yaml.safe_load(RIG.read_text())
    home = rig.home
    beyond = Pose(home.position - OFF, home.rotation)
    wrong = cable_lengths(rig, beyond) - cable_lengths(rig, home)
    counts = [w.counts_per_metre * x for w, x in zip(rig.winches, wrong, strict=True)]
    data["simulation"] = {
        "as_built": {
            "outlets_mm": data["outlets_mm"],
            "anchors_mm": data["anchors_mm"],
            "drums_mm_per_rev": [w["drum_mm_per_rev"] for w in data["winches"]],
            "home_counts": [float(c) for c in counts],
        }
    }
    path = tmp_path_factory.mktemp("off") / "rig.yaml"
    path.write_text(yaml.safe_dump(data))
    return path


@pytest.fixture(scope="module")
def narrow_plan(rig_file: Path) -> Path:
    """Along a small block, 12 mm from it, where the scene requires 10 mm."""
    document = {
        "schema_version": 1,
        "name": "narrow",
        "clearance": {"obstacle_mm": 10, "self_mm": 5},
        "start": {"position_mm": list(START_MM)},
        "goal": {"position_mm": list(GOAL_MM)},
        "obstacles": [
            {
                "name": "block [/left]",  # no markup
                "box": {"size_mm": [40.0, 40.0, 40.0]},
                "position_mm": [-97.0, 15.0, 480.0],
            }
        ],
    }
    scene = scene_from_document(SceneDocument.model_validate(document))
    path = rig_file.parent / "plan.json"
    save_plan(straight_plan(load_rig(rig_file), scene, [START_MM, GOAL_MM]), path)
    return path


def events_of(run: Path) -> Iterator[str]:
    return (event["code"] for event in RunFolder.open(run).summary()["events"])


def test_a_run_stops_along_the_path_when_the_camera_sees_too_little_clearance(
    rig_file: Path, narrow_plan: Path, tmp_path: Path
) -> None:
    run = tmp_path / "run"
    answer = call("run", narrow_plan, "--rig", rig_file, "-o", run, "--fast")
    assert answer.code == 1, answer
    assert "below 10 mm, measured by the cameras" in answer.out
    assert "front (synthetic)" in answer.out
    assert "clearance too small" in answer.said
    assert "the scene requires 10 mm" in answer.said
    summary: dict[str, Any] = RunFolder.open(run).summary()
    assert summary["final_state"] == "stopped"
    assert summary["verdict"] == "FAILED"
    codes = list(events_of(run))
    assert codes.count("clearance_low") == 1
    assert codes.index("clearance_low") < codes.index("held")
    (low,) = (event["text"] for event in summary["events"] if event["code"] == "clearance_low")
    wanted = r"to block \[/left\]: \d+\.\d ± \d\.\d mm \(95 % interval\); the scene requires 10 mm"
    assert re.search(wanted, low)
    assert "to block [/left]: " in answer.said
    assert "details: cdpr explain clearance_low" in answer.said


def test_the_stop_can_be_left_out_and_the_run_still_does_not_pass(
    rig_file: Path, narrow_plan: Path, tmp_path: Path
) -> None:
    run = tmp_path / "run"
    arguments = ("--rig", rig_file, "-o", run, "--fast", "--no-clearance-stop")
    answer = call("run", narrow_plan, *arguments)
    assert answer.code == 1, answer
    summary = RunFolder.open(run).summary()
    assert "off (--no-clearance-stop, in Python clearance_stop=False)" in answer.out
    assert summary["final_state"] != "stopped"
    assert "clearance_low" not in list(events_of(run))
    failed = {c["name"]: c["text"] for c in summary["checks"] if not c["passed"]}
    assert "clearance_tag" in failed
    (differs,) = (e["text"] for e in summary["events"] if e["code"] == "pose_differs")
    assert re.search(
        r"the platform 5\.\d mm and 0\.\d deg from its planned pose, in 10 images in a row", differs
    )
    assert failed["camera_pose"].lower() == f"{differs}.".lower()


def test_to_leave_out_a_stop_that_no_camera_could_make_is_refused(
    rig_file: Path, narrow_plan: Path, tmp_path: Path
) -> None:
    run = tmp_path / "run"
    arguments = ("--rig", rig_file, "-o", run, "--fast", "--no-camera", "--no-clearance-stop")
    answer = call("run", narrow_plan, *arguments)
    assert answer.code == 2, answer
    assert "no effect here: --no-clearance-stop" in answer.err
    assert not run.exists()


@pytest.mark.parametrize("code", ["clearance_low", "camera"])
def test_the_loop_tells_what_the_stop_was_for(
    prepared: PreparedRun, tmp_path: Path, code: str
) -> None:
    reason = StopReason(code, NEAR)
    script = at(150, lambda s: s.board.ask_stop(reason))
    with staged(prepared, tmp_path / "run", script) as stage:
        outcome = stage.run()
    assert outcome.state is State.STOPPED
    assert outcome.cause.startswith(f"{NEAR}; slowing down")
    events = {event.code: event.text for event in stage.events()}
    assert events[code] == outcome.cause
    assert "stop" not in events


class Rendered:
    """Images of the platform at the pose of the request."""

    unused = 0, 0

    def __init__(self, camera: SyntheticCamera) -> None:
        self._camera = camera

    def image(self, trigger: FrameRequest) -> tuple[np.ndarray, float]:
        assert trigger.poses.true is not None
        return self._camera.render(trigger.poses.true, trigger.frame), 0.0

    def close(self) -> None:
        pass


def test_one_image_alone_does_not_stop_a_run(narrow_plan: Path, tmp_path: Path) -> None:
    rig, scene = load_rig(RIG), load_plan(narrow_plan).scene
    eye = SyntheticCamera(rig, scene, rig.cameras[0])
    near, far = Pose.level([-0.008, 0.02, 0.48]), Pose.level([0.05, 0.02, 0.48])
    assert min(n.distance for n in ClearanceModel(rig, scene).obstacles(near)) < 0.005
    folder = RunFolder.create(tmp_path / "run")
    watch, model = ClearanceMonitor(scene.obstacle_clearance), ClearanceModel(rig, scene)
    with CameraWorker(rig, rig.cameras[0], Rendered(eye), folder, 1000, named=False) as observer:
        reported = []
        for frame, pose in enumerate([near, far, near, near, far]):
            found = observer.measure(
                FrameRequest(frame, PlatformPoses(frame * 0.1, 0.0, pose))
            ).found
            assert isinstance(found, PoseMeasurement)
            reported.append(bool(watch.take(clearance_of(model, found))))
    assert reported == [False, False, False, True, False]
