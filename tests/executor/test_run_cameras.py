"""Several cameras of a run: late, in disagreement, or without an answer."""

from __future__ import annotations

import math
import multiprocessing
import os
import signal
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from executor.cameras import multi_camera as run_cameras
from executor.cameras import process as camera_process
from executor.cameras.client import BLIND_IMAGES, CameraClient, wait_until_ready
from executor.cameras.multi_camera import (
    HURRY,
    PATIENCE,
    ROUND,
    MultiCameraMonitor,
    RunCameras,
)
from executor.cameras.process import (
    CameraProcess,
    CameraSample,
    FrameRequest,
    sample_without_pose,
)
from executor.cameras.sources import cycles_per_image
from executor.proposals import homing_proposal
from executor.remote.client import camera_line
from executor.state_machine import PlatformPoses
from model.clearance import ClearanceModel
from model.errors import BadInput, Fault
from model.pose import Pose, matrix_from_rotation_vector
from model.rig import load_rig
from tests.cli.plans import RIG, free_scene
from tracking.clearance import MeasuredClearance, clearance_of
from tracking.measurement import OFF_IMAGES, FrameRate, PoseMeasurement, PoseMonitor

RATE = 10.0
HERE = Pose.level([0.0, 0.0, 0.445])
_RIG = load_rig(RIG)
_SCENE = free_scene([0.0, 0.0, 445.0], [0.0, 30.0, 495.0])
MODEL = ClearanceModel(_RIG, _SCENE)


@given(
    rate=st.floats(0.5, 200.0),
    milliseconds=st.integers(1, 100),
    phase=st.floats(0.0, 1.0, exclude_max=True),
)
@example(rate=30.0, milliseconds=10, phase=0.9)  # 33.3 requests per second before
@example(rate=10.0, milliseconds=10, phase=0.0)
def test_a_camera_with_its_stated_rate_has_an_image_for_every_request(
    rate: float, milliseconds: int, phase: float
) -> None:
    """It takes images all the time; a request is answered by the next one, or one not yet used."""
    every = cycles_per_image(rate, milliseconds / 1e3)
    period = every * milliseconds / 1e3
    assert every == 1 or (every - 1) * milliseconds / 1e3 < 1.0 / rate
    used = -1
    for request in range(50):
        come = math.floor(request * period * rate - phase + 1e-6)  # the newest image
        used = max(come, used + 1)
        assert (used + phase) / rate <= (request + 1) * period + 1e-6


BLIND = 100
"""Added to a delay: the camera answers without a pose."""


def seen_at(
    trigger: FrameRequest, shift: float = 0.0, deviation: float = 1e-4, late: float = 0.0
) -> CameraSample:
    """A sample with a pose, shifted along x [m] and delayed [s]."""
    covariance = np.diag([deviation**2] * 3 + [1e-6] * 3)
    pose = Pose(HERE.position + np.array([shift, 0.0, 0.0]), HERE.rotation)
    found = PoseMeasurement(
        trigger.poses.time + late, pose, covariance, (301, 303), 0.1, "tracked", unstated=False
    )
    return CameraSample(trigger.frame, found, seconds=0.005)


class Scripted:
    """A camera that answers after a number of further frames; with -1 never, with -2 it dies."""

    def __init__(
        self, name: str, delays: Sequence[int], shift: float = 0.0, late: float = 0.0
    ) -> None:
        self.name, self.unanswered, self._off = name, None, {"shift": shift, "late": late}
        self._delays, self._left, self._blind = list(delays), 0, False
        self.waited = 0.0

    unanswered: FrameRequest | None

    def ask(self, trigger: FrameRequest) -> None:
        delay = self._delays[trigger.frame % len(self._delays)]
        self._blind, self._left = delay >= BLIND, delay % BLIND if delay >= 0 else delay
        if self._left == -2:
            raise Fault(f"the process of camera {self.name} ended without an answer")
        self.unanswered = trigger

    def answer(self) -> CameraSample | None:
        if self.unanswered is None or self._left:
            self._left -= self._left > 0
            return None
        return self.answer_within(0.0)

    def answer_within(self, patience: float) -> CameraSample | None:
        self.waited += patience
        if self.unanswered is None or self._left < 0:
            return None
        trigger, self.unanswered = self.unanswered, None
        if self._blind:
            return sample_without_pose(trigger.frame, trigger.poses.time, "no tag")
        return seen_at(trigger, **self._off)


def at_time(time: float) -> Pose:
    """The pose of a platform that moves along x at 1 m/s."""
    return Pose(HERE.position + np.array([time, 0.0, 0.0]), HERE.rotation)


class Moving(Scripted):
    """A camera that sees a platform move, in images taken some time after the request."""

    def __init__(
        self,
        name: str,
        delays: Sequence[int],
        late: float,
        truth: Callable[[float], Pose] = at_time,
    ) -> None:
        super().__init__(name, delays)
        self._late, self._truth = late, truth

    def answer_within(self, patience: float) -> CameraSample | None:
        asked = self.unanswered
        if asked is not None:
            self._off = {"late": self._late}
        sample = super().answer_within(patience)
        if sample is None:
            return None
        found = replace(sample.found, pose=self._truth(sample.found.time))  # type: ignore[arg-type]
        return replace(sample, found=found)


def never() -> bool:
    """No stop is requested."""
    return False


def run_of(moments: int, *cameras: Any) -> tuple[RunCameras, list[str]]:
    """Cameras after a number of frames, and their reports."""
    eyes = [CameraClient(camera, "here") for camera in cameras]
    run, reported = RunCameras(eyes, MODEL, _SCENE.obstacle_clearance, RATE), []
    for k in range(moments):
        run.trigger(PlatformPoses(k / RATE, 100.0 + k / RATE))
        reported += [news.text for news in run.news()]
    return run, reported


DELAYS = st.lists(st.integers(0, 5), min_size=1, max_size=6)


@given(front=DELAYS, side=DELAYS, moments=st.integers(1, 25))
def test_for_any_delay_of_cameras_every_frame_is_reported_once_and_nothing_is_lost(
    front: list[int], side: list[int], moments: int
) -> None:
    run, _ = run_of(moments, Scripted("front", front), Scripted("side", side))
    seen = run.finish(never)
    frames = [look.frame for look in seen.together]
    alone = {name: [look.frame for look in looks] for name, looks in seen.alone.items()}
    assert frames == sorted(set(alone["front"]) | set(alone["side"]))
    assert all(isinstance(look.found, PoseMeasurement) for look in seen.together)
    for camera in seen.cameras:
        assert len(alone[camera.name]) == camera.pictures == camera.poses
        assert camera.pictures + camera.dropped == moments


class Awaited(Scripted):
    """A camera whose images are taken when they are answered, as if it had none before."""

    def answer_within(self, patience: float) -> CameraSample | None:
        asked = self.unanswered
        self._off["late"] = 0.0 if asked is None else self._delays[asked.frame % 4] % BLIND / RATE
        return super().answer_within(patience)


@given(
    front=st.lists(st.sampled_from([0, BLIND]), min_size=4, max_size=4),
    side=st.lists(st.integers(0, 12), min_size=4, max_size=4),
)
@example(front=[BLIND, 0, 0, 0], side=[10, 0, 0, 0])
def test_measurements_are_in_order_of_time_whichever_camera_blocks(
    front: list[int], side: list[int]
) -> None:
    run, _ = run_of(25, Awaited("front", front), Awaited("side", side))
    times = [look.found.time for look in run.finish(never).together]
    assert times == sorted(times)


@given(late=st.integers(2, 5))
def test_a_slow_camera_does_not_keep_what_the_other_sees(late: int) -> None:
    """The fast camera measures too small a clearance: the stop must not wait for the slow one."""
    cameras: list[Any] = [Scripted("front", [0]), Scripted("side", [late])]
    limit = 10.0  # every clearance is too small
    run = RunCameras([CameraClient(camera, "here") for camera in cameras], MODEL, limit, RATE)
    for k in range(5):
        run.trigger(PlatformPoses(k / RATE, k / RATE))
    assert "the scene requires 10000 mm" in run.near


@pytest.mark.parametrize(
    ("front", "side"),
    [
        pytest.param([1], [0, -1], id="hangs in a frame in which the other was not asked"),
        pytest.param([BLIND], [3], id="is late, and the other sees nothing"),
        pytest.param([0], [-1], id="hangs from the beginning"),
        pytest.param([BLIND + 1, 1, 1], [-1], id="hangs, and the other sees nothing now and then"),
    ],
)
def test_too_small_a_clearance_is_noticed_whatever_a_camera(
    front: list[int], side: list[int]
) -> None:
    limit = 10.0  # every clearance is too small
    cameras: list[Any] = [Scripted("front", front), Scripted("side", side)]
    run = RunCameras([CameraClient(camera, "here") for camera in cameras], MODEL, limit, RATE)
    for k in range(10):
        run.trigger(PlatformPoses(k / RATE, k / RATE))
    assert "the scene requires 10000 mm" in run.near
    frames = [look.frame for look in run.finish(never).together]
    assert frames == sorted(set(frames))


@given(
    front=st.lists(st.sampled_from([0, 1, 4, BLIND, BLIND + 3]), min_size=1, max_size=6),
    side=st.lists(st.sampled_from([0, 2, 5, BLIND + 1]), min_size=1, max_size=6),
)
def test_no_pose_of_any_camera_is_lost(front: list[int], side: list[int]) -> None:
    run, _ = run_of(20, Scripted("front", front), Scripted("side", side))
    seen = run.finish(never)
    with_pose = [
        {look.frame for look in looks if isinstance(look.found, PoseMeasurement)}
        for looks in (*seen.alone.values(), seen.together)
    ]
    assert with_pose[0] | with_pose[1] == with_pose[2]


def test_images_of_both_make_a_better_pose() -> None:
    run, reported = run_of(5, Scripted("front", [0]), Scripted("side", [0]))
    seen = run.finish(never)
    for look in seen.together:
        assert isinstance(look.found, PoseMeasurement)
        assert look.found.position_deviation == pytest.approx(np.full(3, 1e-4 / np.sqrt(2)))
        assert look.clearance is not None
    assert not reported


def test_cameras_that_disagree_are_reported_once_and_clearance_is_not_measured() -> None:
    run, reported = run_of(25, Scripted("front", [0]), Scripted("side", [0], shift=0.02))
    assert reported == [
        f"cameras front and side disagree by 20.0 mm, {BLIND_IMAGES} times in a row;"
        " fused clearance is not measured, each camera monitors it alone"
    ]
    assert all(look.clearance is None for look in run.finish(never).together)


def nearest_at(shift: float) -> MeasuredClearance:
    found = seen_at(FrameRequest(0, PlatformPoses(0.0, 0.0)), shift).found
    assert isinstance(found, PoseMeasurement)
    clearance = clearance_of(MODEL, found)
    assert clearance is not None
    return clearance


@pytest.mark.parametrize("wrong", ["front", "side"])
def test_of_cameras_that_disagree_one_that_sees_too_little_clearance_is_enough(wrong: str) -> None:
    """It is unknown which one is right, so the smaller clearance counts."""
    shifts = {name: 0.02 if name == wrong else 0.0 for name in ("front", "side")}
    at_most = {name: nearest_at(shift).at_most for name, shift in shifts.items()}
    limit = sum(at_most.values()) / 2.0
    assert abs(at_most["front"] - at_most["side"]) > 0.002
    sees = min(at_most, key=lambda name: at_most[name])
    eyes = [CameraClient(Scripted(n, [0], shift), "here") for n, shift in shifts.items()]  # type: ignore[arg-type]
    run, reported = RunCameras(eyes, MODEL, limit, RATE), []
    for k in range(4):
        run.trigger(PlatformPoses(k / RATE, k / RATE))
        reported.append(run.near)
    assert not any(reported[:2])
    assert f"measured by camera {sees} alone" in run.near
    assert all(look.clearance is None for look in run.finish(never).together)


@pytest.mark.parametrize("names", [("front",), ("front", "side")])
@pytest.mark.parametrize(("shift_mm", "images"), [(20.0, 10), (20.0, 9), (2.5, 30), (-20.0, 30)])
def test_a_platform_off_its_encoder_pose_is_reported_once(
    names: tuple[str, ...], shift_mm: float, images: int
) -> None:
    """The rig's tolerances, 3 mm together, and the camera's errors are no difference."""
    eyes = [CameraClient(Scripted(name, [0], shift_mm / 1e3), "here") for name in names]  # type: ignore[arg-type]
    run, reported = RunCameras(eyes, MODEL, 0.0, RATE), []
    for k in range(images + 1):
        run.trigger(PlatformPoses(k / RATE, k / RATE, None, HERE, HERE))
        reported += [news for news in run.news() if news.code == "pose_differs"]
    if abs(shift_mm) < 3.0 or images < OFF_IMAGES:
        assert not reported
        return
    (news,) = reported
    who = "the cameras" if len(names) > 1 else "the camera"
    assert news.text.startswith(f"{who} measured the platform {abs(shift_mm):.1f} mm and 0.0 deg")


@pytest.mark.parametrize("known", [True, False])
@given(late=st.floats(0.0, 0.1))
def test_a_moving_platform_is_compared_with_the_encoders_at_the_time_of_the_image(
    known: bool, late: float
) -> None:
    """At 1 m/s, where a whole request apart it would be 100 mm off."""
    run: Any = RunCameras([CameraClient(Moving("front", [1], late), "here")], MODEL, 0.0, RATE)
    for k in range(30):
        planned = at_time(k / RATE) if known else None
        run.trigger(PlatformPoses(k / RATE, k / RATE, None, planned, planned))
        assert not run.news()


@pytest.mark.parametrize("off", ["planned", "encoder", "both"])
def test_a_platform_at_its_planned_or_its_encoder_pose_does_not_differ(off: str) -> None:
    """Drives lag behind a fast path, and wrong tensions shift the encoder pose."""
    monitor, beside = PoseMonitor(_RIG.anchors, 0.003, 0.0), at_time(0.02)
    found = seen_at(FrameRequest(0, PlatformPoses(0.0, 0.0))).found
    assert isinstance(found, PoseMeasurement)
    planned, encoder = (
        beside if off in (name, "both") else HERE for name in ("planned", "encoder")
    )
    texts = [monitor.take(found, planned, encoder) for _ in range(12)]
    assert any(texts) is (off == "both")


def test_an_image_off_by_its_unstated_error_is_no_difference() -> None:
    monitor = PoseMonitor(_RIG.anchors, 0.003, 0.0)
    found = seen_at(FrameRequest(0, PlatformPoses(0.0, 0.0)), 0.02).found
    assert isinstance(found, PoseMeasurement)
    unstated, common = replace(found, unstated=True), replace(found, shared=1e-4 * np.eye(6))
    assert not any(monitor.take(one, HERE, HERE) for one in [unstated, common] * 20)
    assert [bool(monitor.take(found, HERE, None)) for _ in range(12)] == [k == 9 for k in range(12)]


@given(share=st.floats(0.5, 1.5))
def test_the_stated_error_of_the_rig_explains_its_difference(share: float) -> None:
    """95 % along any axis is 1.43 times as much for a distance in space."""
    monitor, error = PoseMonitor(_RIG.anchors, 0.003, 0.01), 0.003 + share * 0.01 * 2.7955 / 1.96
    found = seen_at(FrameRequest(0, PlatformPoses(0.0, 0.0)), error, deviation=1e-6).found
    assert isinstance(found, PoseMeasurement)
    assert any(monitor.take(found, HERE, HERE) for _ in range(10)) == (share > 1.0 + 1e-6)


@given(axis=st.sampled_from(np.eye(3).tolist()), degrees=st.floats(0.5, 6.0))
def test_a_platform_rotated_about_its_origin_differs_where_an_anchor_is_too_far_off(
    axis: list[float], degrees: float
) -> None:
    monitor, turn = PoseMonitor(_RIG.anchors, 0.003, 0.0), np.radians(degrees) * np.array(axis)
    rotated = Pose(HERE.position, matrix_from_rotation_vector(turn))
    found = replace(
        seen_at(FrameRequest(0, PlatformPoses(0.0, 0.0)), deviation=1e-6).found,
        pose=rotated,
        covariance=1e-12 * np.eye(6),
    )
    off = np.linalg.norm(_RIG.anchors @ (rotated.rotation - np.eye(3)).T, axis=1).max()
    texts = [monitor.take(found, HERE, None) for _ in range(10)]
    if off < 0.003:
        assert not texts[-1]
    if off > 0.00301:
        assert f"0.0 mm and {degrees:.1f} deg from its planned pose" in texts[-1]


def test_poses_between_images_follow_a_curve() -> None:
    """A circle at 300 mm/s, seen twice a second: the chord between two images is 18 mm off."""

    def on_circle(time: float) -> Pose:
        angle = 2.0 * time
        offset = 0.15 * np.array([np.cos(angle), np.sin(angle), 0.0])
        return Pose(HERE.position + offset, HERE.rotation)

    reported = {}
    for between in (1, 5):
        camera = Moving("front", [0], 0.15, on_circle)
        run: Any = RunCameras([CameraClient(camera, "here")], MODEL, 0.0, RATE)
        reported[between] = []
        for k in range(20 * 5):
            time = k / 10.0
            if k % 5 == 0:
                run.trigger(PlatformPoses(time, time, None, on_circle(time), on_circle(time)))
            elif between == 1:
                run.drive(PlatformPoses(time, time, None, on_circle(time), on_circle(time)))
            reported[between] += run.news()
    assert not reported[1]
    assert [news.code for news in reported[5]] == ["pose_differs"]


@pytest.mark.parametrize("wrong", ["front", "side", "both"])
def test_each_camera_off_the_encoder_pose_is_named_where_they_disagree(wrong: str) -> None:
    shifts = {"front": 0.03, "side": -0.03}
    eyes = [
        CameraClient(Scripted(n, [0], s if wrong in (n, "both") else 0.0), "here")  # type: ignore[arg-type]
        for n, s in shifts.items()
    ]
    run, reported = RunCameras(eyes, MODEL, 0.0, RATE), []
    for k in range(15):
        run.trigger(PlatformPoses(k / RATE, k / RATE, None, HERE, HERE))
        reported += [news.text for news in run.news() if news.code == "pose_differs"]
    named = [name for name in shifts if wrong in (name, "both")]
    assert [text.split(" measured")[0] for text in reported] == [f"camera {n}" for n in named]


#: Each frame of a camera: what it measures beside the truth along x, [mm]; None without a pose.
FRAMES = st.lists(st.sampled_from([None, -3.0, 0.0, 1.0, 3.0, 20.0]), min_size=6, max_size=6)
#: Standard deviations of scatter and shared errors, and the operator's value of errors, [mm].
CAMERA = st.tuples(
    st.sampled_from([0.02, 0.2, 1.0]), st.sampled_from([0.0, 0.2, 2.0]), st.sampled_from([0.0, 5.0])
)


def stops(seen: dict[str, tuple[Sequence[float | None], Any]], limit: float) -> list[str]:
    """Why cameras stop the run, after each frame; empty while they do not."""
    monitor, reasons = MultiCameraMonitor(list(seen), MODEL, limit, RATE), []
    for k in range(len(next(iter(seen.values()))[0])):
        samples = {}
        for name, (shifts, (own, common, operator)) in seen.items():
            shift, time = shifts[k], k / RATE
            if shift is None:
                samples[name] = sample_without_pose(k, time, "no tag")
                continue
            one = seen_at(FrameRequest(k, PlatformPoses(time, time)), shift / 1e3, own / 1e3)
            shared = np.diag([max(common, operator / 1.96) ** 2 * 1e-6] * 3 + [0.0] * 3)
            found = replace(one.found, shared=shared, cable_error=operator / 1e3)
            samples[name] = replace(one, found=found)
        monitor.of(samples)
        reasons.append(monitor.near)
    return reasons


@given(
    frames=st.lists(FRAMES, min_size=2, max_size=3),
    cameras=st.lists(CAMERA, min_size=3, max_size=3),
    room=st.floats(-3.0, 6.0),
)
@example(frames=[[0.0] * 6] * 2, cameras=[(0.02, 2.0, 0.0), (0.2, 0.2, 0.0)], room=2.0)
@example(frames=[[0.0] * 6] * 2, cameras=[(0.02, 0.0, 5.0), (0.2, 0.2, 0.0)], room=2.0)
def test_another_camera_never_delays_a_stop(
    frames: list[list[float | None]], cameras: list[Any], room: float
) -> None:
    """Whatever it measures, and with whatever uncertainty."""
    limit = nearest_at(0.0).distance + room / 1e3
    seen = dict(zip("abc", zip(frames, cameras, strict=False), strict=False))
    together = stops(seen, limit)
    for name, one in seen.items():
        for alone, both in zip(stops({name: one}, limit), together, strict=True):
            assert both or not alone


@pytest.mark.parametrize("late", [0, 1, 2, 5])
@pytest.mark.parametrize("shift", [-0.02, 0.02])
def test_a_slow_camera_stops_a_run_too(late: int, shift: float) -> None:
    """Also where a fast one is fused without waiting for it."""
    limit = (nearest_at(0.0).at_most + nearest_at(shift).at_most) / 2.0
    near = nearest_at(shift).at_most < limit
    cameras: list[Any] = [Scripted("fast", [0], 0.0 if near else shift)]
    cameras.append(Scripted("slow", [late], shift if near else 0.0))
    run = RunCameras([CameraClient(camera, "here") for camera in cameras], MODEL, limit, RATE)
    for k in range(2 * late + 6):
        run.trigger(PlatformPoses(k / RATE, k / RATE))
    assert run.near.endswith("measured by camera slow alone")


def test_the_camera_that_alone_measures_too_little_clearance_is_named() -> None:
    """Its pose agrees with that of the other camera, and their mean is far enough away."""
    fine, shifts = (0.1, 0.2, 0.0), {"front": 0.0, "side": 1.0}
    fine_at = {name: nearest_at(shift / 1e3).distance for name, shift in shifts.items()}
    near = min(fine_at, key=lambda name: fine_at[name])
    seen = {name: ([shift] * 3, fine) for name, shift in shifts.items()}
    for step in np.arange(0.0, 1e-3, 2e-5):
        reasons = stops(seen, min(fine_at.values()) + step)
        if any(reasons):
            break
    assert reasons[0] == ""
    assert reasons[1].endswith(f"measured by camera {near} alone")


def test_one_that_dies_is_reported_and_after_the_last_one_none_is_left() -> None:
    one_left, reported = run_of(4, Scripted("front", [0, 0, -2]), Scripted("side", [0]))
    (text,) = reported
    assert "camera front failed (the process of camera front ended" in text
    assert text.endswith("clearance is measured by side")
    assert one_left.all_failed == ""
    none_left, reported = run_of(4, Scripted("front", [0, 0, -2]), Scripted("side", [0, -2]))
    assert len(reported) == 2
    assert "camera side failed" in reported[0]
    assert reported[1].startswith("camera front failed")
    assert reported[1].endswith("clearance is not measured")
    each = (f"{n}: the process of camera {n} ended without an answer" for n in ("front", "side"))
    assert none_left.all_failed == f"all cameras failed: {'; '.join(each)}"


def test_frames_in_which_cameras_were_not_taken_together_are_counted_and_reported() -> None:
    run, reported = run_of(10, Scripted("front", [0]), Scripted("side", [0], late=0.12))
    run.finish(never)
    reported += [news.text for news in run.news()]
    assert reported == [
        "at 10 of 10 times not all cameras were used: images were taken more than 50 ms from"
        " the others"
    ]


class Swinging(Scripted):
    """It sees the platform go to and fro along x, later than the stated time [s]."""

    def __init__(self, name: str, behind: float) -> None:
        super().__init__(name, [0])
        self._behind = behind

    def answer_within(self, patience: float) -> CameraSample | None:
        if self.unanswered is not None:
            self._off["shift"] = 0.05 * np.sin(1.5 * (self.unanswered.poses.time + self._behind))
        return super().answer_within(patience)


@pytest.mark.parametrize("behind", [0.0, 0.04])
def test_clocks_that_differ_are_reported_at_the_end(behind: float) -> None:
    run, _ = run_of(60, Swinging("front", 0.0), Swinging("side", behind))
    run.finish(never)
    news = [(one.code, one.text) for one in run.news()]
    assert len(news) == (behind > 0.0)
    for code, text in news:
        assert code == "remark"
        assert "images of side are taken 40 ±" in text


@pytest.mark.parametrize("stops", [None, 0, 100])
def test_at_the_end_all_that_hang_are_waited_for_together_and_a_stop_cuts_it_short(
    stops: int | None,
) -> None:
    """The operator stops before the end, in the hundredth round of waiting, or never."""
    hanging = [Scripted(name, [-1]) for name in ("front", "side", "back")]
    run, _ = run_of(3, *hanging, Scripted("well", [0]))
    rounds = 0

    def stopped() -> bool:
        nonlocal rounds
        rounds += 1
        return stops is not None and rounds > stops

    seen = run.finish(stopped)
    longest = {None: PATIENCE, 0: HURRY, 100: 100 * ROUND}[stops]
    assert sum(camera.waited for camera in hanging) == pytest.approx(longest, abs=2 * ROUND)
    assert [c.failed for c in seen.cameras] == ["no answer since 0.00 s"] * 3 + [""]
    assert seen.cameras[-1].poses == 3


def test_live_figures_are_those_of_the_newest_images() -> None:
    run, _ = run_of(30, Scripted("front", [0]), Scripted("side", [1]))
    front, side = run.as_dict()
    assert (front["pictures_per_second"], side["pictures_per_second"]) == (10.0, 5.0)
    assert front["measuring_ms"] == 5.0
    assert camera_line(side) == (
        "side (here), 5.0 images/s, 5.0 ms, 2 tags, 14 of 14 with a pose, 15 dropped"
    )


def test_the_pace_of_a_source_is_that_of_its_newest_images() -> None:
    pace = FrameRate()
    assert (pace.pictures_per_second, pace.measuring_ms) == (None, None)
    for k in range(30):
        pace.take(5.0 + k / 20, 1.0 if k < 20 else 0.004)
        assert (pace.pictures_per_second is None) is (k == 0)
    pace.take(6.5, float("nan"))
    assert (pace.pictures_per_second, pace.measuring_ms) == (20.0, 4.0)


class Quick:
    """A worker that finds the platform at once, or never answers."""

    def __init__(self, silent: bool) -> None:
        self._silent = silent

    def __enter__(self) -> Quick:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def measure(self, trigger: FrameRequest) -> CameraSample:
        while self._silent and trigger.frame > 2:
            signal.pause()
        return seen_at(trigger)

    def show(self) -> None:
        pass


def quick() -> Quick:
    return Quick(silent=False)


def silent() -> Quick:
    return Quick(silent=True)


def test_signals_to_all_processes_of_a_terminal_end_no_camera() -> None:
    """A closed terminal, or a service that is stopped: the supervisor stops the run first."""
    signals = (signal.SIGINT, signal.SIGHUP, signal.SIGQUIT, signal.SIGTERM)
    with closing(CameraProcess("front", quick, may_wait=False)) as process:  # type: ignore[arg-type]
        for number in signals:
            os.kill(child("front"), number)  # while it loads its libraries
        wait_until_ready([process], lambda: None)
        for number in signals:
            os.kill(child("front"), number)
        process.ask(FrameRequest(1, PlatformPoses(0.0, 0.0)))
        assert process.answer_within(60.0) is not None
    assert not [c for c in multiprocessing.active_children() if c.name.startswith("cdpr-camera")]


@pytest.mark.parametrize("how", ["stopped", "silent"])
def test_in_real_time_a_process_that_hangs_is_reported_while_the_other_measures(
    monkeypatch: pytest.MonkeyPatch, how: str
) -> None:
    """Real processes; the test sets the loop's clock, so that it need not wait 2 s."""
    monkeypatch.setattr(run_cameras, "PATIENCE", 1.0)
    monkeypatch.setattr(camera_process, "END_TIMEOUT", 0.2)
    make = {"front": quick, "side": silent if how == "silent" else quick}
    processes = [CameraProcess(name, make[name], may_wait=False) for name in make]  # type: ignore[arg-type]
    try:
        wait_until_ready(processes, lambda: None)
        eyes = [CameraClient(process, "here") for process in processes]
        run, reported, now = RunCameras(eyes, MODEL, 0.01, RATE), [], 0.0
        while not reported:
            now += 1.0 / RATE
            assert now < 60.0, "it is reported soon"
            run.trigger(PlatformPoses(now, now))
            reported += [news.text for news in run.news()]
            if how == "stopped" and len(eyes[1].samples) == 3:
                os.kill(child("side"), signal.SIGSTOP)
            front_only = len(eyes[1].samples) >= 3
            wait_for_answers(processes[:1] if front_only else processes)
        seen = run.finish(never)
    finally:
        for process in processes:
            process.close()
    assert reported == ["camera side did not answer for 2 s; clearance is measured by front"]
    front, side = seen.cameras
    assert front.poses == front.pictures > 20
    assert side.poses == side.pictures - 1 >= 3
    assert side.failed.startswith("no answer since")
    assert [n.code for n in run.news()] == ["camera"]
    assert not [c for c in multiprocessing.active_children() if c.name.startswith("cdpr-camera")]


def child(name: str) -> int:
    (process,) = (c for c in multiprocessing.active_children() if c.name == f"cdpr-camera-{name}")
    assert process.pid is not None
    return process.pid


def wait_for_answers(processes: Sequence[CameraProcess]) -> None:
    for process in processes:
        if process.unanswered is not None:
            assert process._link.poll(20.0)


def test_the_names_of_the_images_name_the_camera(tmp_path: Path) -> None:
    from executor.recording.run_folder import RunFolder

    folder = RunFolder.create(tmp_path / "run")
    image = np.zeros((8, 8), np.uint8)
    names = [folder.write_image(7, image, "side"), folder.write_image(7, image)]
    assert names == ["pictures/side/frame_000007.jpg", "pictures/frame_000007.jpg"]
    assert all(folder.image(name).startswith(b"\xff\xd8") for name in names)
    (tmp_path / "secret").touch()
    with pytest.raises(BadInput, match="cannot be read"):
        folder.image("pictures/../../secret")


def test_the_password_of_a_camera_is_neither_sent_nor_recorded_nor_shown() -> None:
    client = CameraClient(Scripted("front", [0]), "rtsp://user:s3cret@h/x")  # type: ignore[arg-type]
    assert client.as_dict(0.0)["source"] == client.record().source == "rtsp://user:***@h/x"
    facts = homing_proposal(
        _RIG,
        np.full(8, 10.0),
        50.0,
        0.05,
        0.002,
        (_RIG.cameras[0], "rtsp://user:s3cret@h/x"),
    ).facts()
    assert dict(facts)["pose"] == "measured, camera front (rtsp://user:***@h/x)"
