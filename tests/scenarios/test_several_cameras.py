"""Runs with two cameras: fused and single poses, and a camera that detects nothing or hangs."""

from __future__ import annotations

import multiprocessing
import os
import re
import signal
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from mcap.reader import make_reader

from calibration.run_data import poses_of_run
from executor import evaluation as run_module
from executor.cameras import client as camera_sight
from executor.cameras import multi_camera as run_cameras
from executor.cameras import process as camera_process
from executor.cameras.sources import choose_cameras, parse_camera_sources, resolve_cameras
from executor.homing import home
from executor.realtime.scheduling import SimulatedClock
from executor.recording.run_folder import RunFolder
from model.errors import BadInput
from model.plan import save_plan
from model.pose import Pose, matrix_from_rotation_vector
from model.rig import load_rig
from tests.cli.plans import GOAL_MM, RIG, START_MM, free_scene, straight_plan
from tests.cli.program import Answer, call, nothing_written, one_message

#: A cycle in which the platform moves.
MOVING = 60


def with_two_cameras(path: Path, looks_away: bool = False) -> Path:
    """The ready rig with a second camera, a quarter turn round the frame, or looking up."""
    data = yaml.safe_load(RIG.read_text())
    (front,) = load_rig(RIG).cameras
    quarter = matrix_from_rotation_vector(np.array([0.0, 0.0, np.pi / 2]))
    pose = front.world_from_camera
    side = Pose(quarter @ pose.position, quarter @ pose.rotation)
    where = {
        "position_mm": (side.position * 1e3).tolist(),
        "rotation_wxyz": [1.0, 0.0, 0.0, 0.0] if looks_away else side.quaternion.tolist(),
    }
    data["cameras"].append({**data["cameras"][0], "name": "side", "world_from_camera": where})
    # Most of the time goes into images; those without the platform are searched all over.
    data["cameras"] = [camera | {"rate_hz": 5} for camera in data["cameras"]]
    path.write_text(yaml.safe_dump(data))
    return path


@pytest.fixture(scope="module")
def rig_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return with_two_cameras(tmp_path_factory.mktemp("rig") / "rig.yaml")


@pytest.fixture(scope="module")
def plan(rig_file: Path) -> Path:
    path = rig_file.parent / "plan.json"
    scene = free_scene(START_MM, GOAL_MM)
    save_plan(straight_plan(load_rig(rig_file), scene, [START_MM, GOAL_MM]), path)
    return path


@pytest.fixture(scope="module")
def answer_and_folder(
    rig_file: Path, plan: Path, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Answer, RunFolder]:
    path = tmp_path_factory.mktemp("two") / "run"
    answer = call("run", plan, "--rig", rig_file, "-o", path, "--fast")
    return answer, RunFolder.open(path)


def test_all_cameras_of_the_rig_file_look_and_each_is_on_record(
    answer_and_folder: tuple[Answer, RunFolder],
) -> None:
    answer, folder = answer_and_folder
    assert answer.code == 0, answer
    assert "front (synthetic), side (synthetic)" in answer.out
    assert "PASSED" in answer.out
    together, alone = folder.poses(), folder.poses_by_camera()
    assert list(alone) == ["front", "side"]
    assert together.ok.all()
    for name, poses in alone.items():
        assert poses.frame.tolist() == together.frame.tolist()
        assert poses.ok.all()
        scatter = [np.linalg.norm(p.std[:, :3], axis=1) for p in (together, poses)]
        assert (scatter[0] < scatter[1]).all()
        assert {p.split("/")[1] for p in poses.picture if p} == {name}
    numbers = [
        {*a.split(), *b.split()} for a, b in zip(*(p.tags for p in alone.values()), strict=True)
    ]
    assert [set(tags.split()) for tags in together.tags] == numbers
    summary = folder.summary()
    reported = [(c["name"], c["pictures"], c["poses"], c["failed"]) for c in summary["cameras"]]
    assert reported == [(name, len(together), len(together), "") for name in ("front", "side")]
    assert all(c["measuring_ms"] > 0.0 for c in summary["cameras"])
    page = folder.report.read_text()
    assert "side alone" in page
    assert "cameras together" in page


def test_each_camera_has_its_own_channels(answer_and_folder: tuple[Answer, RunFolder]) -> None:
    _, folder = answer_and_folder
    counts: dict[str, int] = {}
    with folder.mcap.open("rb") as file:
        for _schema, channel, _message in make_reader(file).iter_messages():
            counts[channel.topic] = counts.get(channel.topic, 0) + 1
    rows = len(folder.poses())
    for channel in ("/tag_pose", "/tag_status"):
        assert [counts[channel + name] for name in ("", "/front", "/side")] == [rows] * 3
    clearance = folder.clearance()
    assert counts["/clearance/front"] == len(clearance.of("tag:front")) == rows
    assert counts["/clearance/side"] == len(clearance.of("tag:side")) == rows
    assert counts["/clearance"] == len(clearance.of("tag")) + len(clearance.of("encoder"))
    kept = {name: sum(map(bool, p.picture)) for name, p in folder.poses_by_camera().items()}
    assert counts["/pictures/front"] == kept["front"] > 0
    assert counts["/pictures/side"] == kept["side"] > 0


def test_the_kept_images_of_each_camera_have_the_drives_poses(
    answer_and_folder: tuple[Answer, RunFolder],
) -> None:
    """With these `cdpr calibrate extrinsics --camera side --poses RUNDIR` finds its pose."""
    _, folder = answer_and_folder
    kept = [Path(name).name for name in folder.poses_by_camera()["side"].picture if name]
    poses = poses_of_run(folder.path, "side")
    assert set(kept[1:-1]) <= poses.keys() <= set(kept)
    with pytest.raises(BadInput, match="camera 'back' took no images") as reported:
        poses_of_run(folder.path, "back")
    assert "front, side" in reported.value.next_step


def test_an_image_at_a_time_without_a_pose_of_the_drives_is_left_out(
    answer_and_folder: tuple[Answer, RunFolder], monkeypatch: pytest.MonkeyPatch
) -> None:
    _, folder = answer_and_folder
    poses, cycles = poses_of_run(folder.path, "side"), folder.cycles()
    name, *others = sorted(poses)
    samples = folder.poses_by_camera()["side"]
    at = next(t for t, p in zip(samples.time, samples.picture, strict=True) if p.endswith(name))
    encoder = cycles.encoder.copy()
    encoder[np.searchsorted(cycles.time, at)] = np.nan
    monkeypatch.setattr(RunFolder, "cycles", lambda _folder: replace(cycles, encoder=encoder))
    assert sorted(poses_of_run(folder.path, "side")) == others


@pytest.mark.parametrize(
    ("wanted", "chosen"),
    [
        ([], {"front": "synthetic", "side": "synthetic"}),
        (["synthetic"], {"front": "synthetic", "side": "synthetic"}),
        (["0"], {"front": "0"}),
        (["side=synthetic"], {"side": "synthetic"}),
        (["side=1", "front=rtsp://x/?a=b"], {"side": "1", "front": "rtsp://x/?a=b"}),
    ],
)
def test_cameras_are_chosen_as_they_are_named(
    rig_file: Path, wanted: list[str], chosen: dict[str, str]
) -> None:
    eyes = choose_cameras(load_rig(rig_file), wanted, without=False, in_process=True)
    assert {camera.name: source for camera, source in eyes.items()} == chosen


@pytest.mark.parametrize("several", [lambda s: s, lambda s: [s], lambda s: {"front": s}])
def test_a_device_is_named_by_its_path_or_by_a_text(rig_file: Path, several: Any) -> None:
    device, rig = Path("/dev/video9"), load_rig(rig_file)
    by_text = resolve_cameras(rig, several(str(device)), in_process=False)
    assert resolve_cameras(rig, several(device), in_process=False) == by_text
    with pytest.raises(BadInput, match="state the platform pose by exactly one"):
        home(rig, at_home=True, camera=device)


@pytest.mark.parametrize("wanted", [1, np.int64(1), [np.int64(1)], {"front": np.int64(1)}])
def test_a_camera_is_named_by_an_integer_of_any_type(rig_file: Path, wanted: Any) -> None:
    eyes = resolve_cameras(load_rig(rig_file), wanted, in_process=True)
    assert {camera.name: source for camera, source in eyes.items()} == {"front": "1"}
    with pytest.raises(BadInput, match="camera"):
        home(load_rig(rig_file), at_home=True, camera=np.int64(1))


@pytest.mark.parametrize(
    ("cameras", "parts"),
    [
        (["front=0", "back=1"], ["unknown camera 'back'", "front, side"]),
        (["0", "side=1"], ["'0' does not name its camera"]),
        (["side=0", "side=1"], ["'side' has two sources"]),
        (["side=0", "front=0"], ["cameras 'side' and 'front' have the same source '0'"]),
        (["side=0", "front=/dev/video0"], ["have the same source"]),
        (["side=0", "front"], ["camera 'front' has no source", "write front=0"]),
        (["side=0", "http://x/?a=b"], ["'http://x/?a=b' does not name its camera"]),
        (["front=0", "--no-camera"], ["--camera and --no-camera contradict"]),
    ],
)
def test_cameras_that_are_not_named_clearly_are_refused(
    rig_file: Path, plan: Path, tmp_path: Path, cameras: list[str], parts: list[str]
) -> None:
    wanted = [w for c in cameras for w in ((c,) if c.startswith("--") else ("--camera", c))]
    with nothing_written(tmp_path):
        answer = call("run", plan, "--rig", rig_file, "-o", tmp_path / "run", *wanted)
    one_message(answer, 2, *parts)


@pytest.mark.parametrize(
    ("one", "other"),
    [
        ("0", "00"),
        ("/dev/video0", "000"),
        ("dir", "dir/"),
        ("dir", "./dir"),
        ("dir", "../{here}/dir"),
        ("dir", "{root}/dir"),
        ("dir", "link"),
        ("{root}/link", "dir/../dir"),
        ("7", "{root}/7"),  # a folder
        ("http://camera.lan/video", "HTTP://Camera.LAN/video"),
        ("rtsp://Me:Pass@host", "rtsp://Me:Pass@HOST/"),
    ],
)
def test_the_same_source_in_other_words_is_refused(
    rig_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, one: str, other: str
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "dir").mkdir()
    (tmp_path / "7").mkdir()
    (tmp_path / "link").symlink_to("dir")
    names = {"root": tmp_path, "here": tmp_path.name}
    sources = [f"side={one.format(**names)}", f"front={other.format(**names)}"]
    with pytest.raises(BadInput, match="have the same source"):
        parse_camera_sources(load_rig(rig_file), sources, None)


@pytest.mark.parametrize(
    ("one", "other"),
    [
        ("0", "10"),
        ("0", "dir"),
        ("dir", "dir2"),
        ("http://host/Video", "http://host/video"),
        ("rtsp://me:A@host/", "rtsp://me:a@host/"),
        ("null\0byte", "0" * 5000),
        ("loop", "0"),
    ],
)
def test_different_sources_are_accepted(
    rig_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, one: str, other: str
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "loop").symlink_to("loop")
    sources = [f"side={one}", f"front={other}"]
    assert len(parse_camera_sources(load_rig(rig_file), sources, None)) == 2


@pytest.fixture
def no_report(monkeypatch: pytest.MonkeyPatch) -> None:
    """It takes longer than the run, and is read in one test only."""
    monkeypatch.setattr(run_module, "build_report", lambda folder: folder.report)


@pytest.mark.slow
@pytest.mark.usefixtures("no_report")
def test_a_camera_that_faces_away_is_reported_and_the_other_measures(
    plan: Path, tmp_path: Path
) -> None:
    rig = with_two_cameras(tmp_path / "rig.yaml", looks_away=True)
    run = tmp_path / "run"
    answer = call("run", plan, "--rig", rig, "-o", run, "--fast")
    assert answer.code == 0, answer
    folder = RunFolder.open(run)
    assert folder.poses().ok.all()
    events = [e["text"] for e in folder.summary()["events"] if e["code"] == "camera_sees_nothing"]
    (text,) = events
    assert "camera side gave no pose in 10 images in a row" in text
    assert text.endswith("clearance is measured by front")
    assert "camera side gave no pose" in " ".join(answer.err.split())
    assert re.search(r"side 0 of \d+", answer.out)


def camera_of(name: str) -> int:
    """The process of a camera of the run in this process."""
    (child,) = (c for c in multiprocessing.active_children() if c.name == f"cdpr-camera-{name}")
    assert child.pid is not None
    return child.pid


@pytest.fixture
def stop_in_motion(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], None]:
    """Stops (SIGSTOP) a camera's process once the platform moves."""
    monkeypatch.setattr(camera_process, "PATIENCE", 3.0)
    monkeypatch.setattr(run_cameras, "PATIENCE", 3.0)
    monkeypatch.setattr(camera_process, "END_TIMEOUT", 0.2)

    def stop(name: str) -> None:
        cycles, real = 0, SimulatedClock.next_cycle

        def next_cycle(clock: SimulatedClock) -> float:
            nonlocal cycles
            cycles += 1
            if cycles == MOVING:
                os.kill(camera_of(name), signal.SIGSTOP)
            return real(clock)

        monkeypatch.setattr(SimulatedClock, "next_cycle", next_cycle)

    return stop


def events_of(folder: RunFolder, code: str) -> list[dict[str, Any]]:
    return [event for event in folder.summary()["events"] if event["code"] == code]


@pytest.mark.usefixtures("no_report")
def test_a_camera_that_hangs_is_reported_and_the_run_continues_with_the_other(
    rig_file: Path, plan: Path, tmp_path: Path, stop_in_motion: Callable[[str], None]
) -> None:
    stop_in_motion("side")
    run = tmp_path / "run"
    answer = call("run", plan, "--rig", rig_file, "-o", run, "--fast")
    assert answer.code == 0, answer
    folder = RunFolder.open(run)
    hangs, end = events_of(folder, "camera_sees_nothing"), events_of(folder, "camera")
    assert [e["text"] for e in hangs] == [
        "camera side did not answer for 2 s; clearance is measured by front"
    ]
    assert "camera side failed (no answer since 0." in end[0]["text"]
    moved = [e["time_s"] for e in folder.summary()["events"] if e["code"] == "held"]
    assert hangs[0]["time_s"] < moved[0], "reported during motion"
    assert folder.poses().ok.all()
    alone = folder.poses_by_camera()
    assert len(alone["front"]) == len(folder.poses()) > len(alone["side"]) > 1
    assert alone["side"].status[-1].startswith("no answer since 0.")
    (front, side) = folder.summary()["cameras"]
    assert side["dropped"] > 10
    assert side["failed"]
    assert not front["failed"]
    assert "(no answer since" in answer.out, "reported at the end"


@pytest.mark.usefixtures("no_report")
def test_a_run_whose_only_camera_hangs_comes_to_its_end_and_does_not_pass(
    plan: Path, tmp_path: Path, stop_in_motion: Callable[[str], None]
) -> None:
    stop_in_motion("front")
    run = tmp_path / "run"
    answer = call("run", plan, "--rig", RIG, "-o", run, "--fast")
    assert answer.code == 1, answer
    folder = RunFolder.open(run)
    summary = folder.summary()
    assert summary["final_state"] == "finished"
    (hangs,) = events_of(folder, "camera_sees_nothing")
    assert hangs["text"] == "camera front did not answer for 2 s; clearance is not measured"
    assert any("Camera front failed: no answer" in reason for reason in summary["reasons"])
    assert folder.poses().ok[:-1].all(), "what was measured before is on record"
    assert not folder.poses().ok[-1]


@pytest.mark.slow
@pytest.mark.usefixtures("no_report")
def test_a_camera_that_dies_leaves_the_run_to_the_other(
    rig_file: Path, plan: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cycles, real = 0, SimulatedClock.next_cycle

    def next_cycle(clock: SimulatedClock) -> float:
        nonlocal cycles
        cycles += 1
        if cycles == MOVING:
            os.kill(camera_of("front"), signal.SIGKILL)
        return real(clock)

    monkeypatch.setattr(SimulatedClock, "next_cycle", next_cycle)
    run = tmp_path / "run"
    answer = call("run", plan, "--rig", rig_file, "-o", run, "--fast")
    assert answer.code == 0, answer
    folder = RunFolder.open(run)
    (event,) = events_of(folder, "camera")
    assert "the process of camera front ended" in event["text"]
    assert event["text"].endswith("clearance is measured by side")
    assert folder.poses().ok.all()
    assert len(folder.poses_by_camera()["side"]) == len(folder.poses())


def test_silence_is_reported_after_the_time_that_the_docs_say() -> None:
    page = (Path(__file__).parents[2] / "docs" / "faults" / "camera_sees_nothing.md").read_text()
    assert f"did not answer for {camera_sight.SILENCE:g} s" in page
