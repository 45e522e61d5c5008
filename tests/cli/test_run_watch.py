"""Reports of the cameras during a run, and what stops the run."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import pytest

from executor.cameras.client import CameraClient
from executor.cameras.multi_camera import CameraRecords, CameraWatch, RunCameras
from executor.cameras.process import CameraSample
from executor.state_machine import PlatformPoses
from executor.supervision import Callbacks, GuardedListener, LocalRequests, StopReason
from model.progress import Listener
from tests.executor.test_run_cameras import MODEL, RATE, Scripted


def watched(
    moments: int, limit: float, *cameras: Any, clearance_stop: bool = True
) -> tuple[LocalRequests, list[tuple[str, str]]]:
    """The board after a number of frames, and the reports."""
    board, reported = LocalRequests(), list[tuple[str, str]]()
    status: Any = SimpleNamespace(
        take_cameras=lambda _cameras: None, take_measured=lambda *_measured: None
    )
    watch = CameraWatch(
        RunCameras([CameraClient(camera, "here") for camera in cameras], MODEL, limit, RATE),
        status,
        board,
        lambda code, text, _at: reported.append((code, text)),
        clearance_stop=clearance_stop,
    )
    for k in range(moments):
        watch.trigger(PlatformPoses(k / RATE, k / RATE))
    return board, reported


def test_failure_of_the_last_camera_is_reported_and_stops_the_run() -> None:
    board, reported = watched(5, 0.0, Scripted("front", [0, -2]))
    why = "the process of camera front ended without an answer"
    assert reported == [("camera", f"camera front failed ({why}); clearance is not measured")]
    assert board.read().for_what == StopReason("camera", f"all cameras failed: front: {why}")


def test_while_one_camera_is_left_nothing_is_stopped() -> None:
    board, reported = watched(5, 0.0, Scripted("front", [0, -2]), Scripted("side", [0]))
    assert [code for code, _ in reported] == ["camera"]
    assert not board.read().stop


@pytest.mark.parametrize(("names", "who"), [(["a"], "the camera"), (["a", "b"], "the cameras")])
def test_too_little_clearance_stops_the_run(names: list[str], who: str) -> None:
    board, _ = watched(4, 10.0, *(Scripted(name, [0]) for name in names))
    reason = board.read().for_what
    assert reason is not None
    assert reason.code == "clearance_low"
    assert reason.text.startswith(f"{who} measured less clearance than the scene requires: ")
    board, _ = watched(4, 10.0, *(Scripted(name, [0]) for name in names), clearance_stop=False)
    assert not board.read().stop


class Unreliable(Scripted):
    """A camera that also delivers late and truncated images."""

    late, truncated = 0, 0

    def answer_within(self, patience: float) -> CameraSample | None:
        sample = super().answer_within(patience)
        if sample is None:
            return None
        return replace(sample, late=self.late, truncated=self.truncated)


@pytest.mark.parametrize(
    ("late", "truncated", "words"),
    [
        (0, 0, ""),
        (0, 38, "; images delivered but not used: 38 truncated"),
        (2, 1, "; images delivered but not used: 1 truncated, 2 late"),
    ],
)
def test_skipped_images_are_reported_with_those_that_were_not_used(
    late: int, truncated: int, words: str
) -> None:
    camera, reported = Unreliable("front", [1]), list[tuple[str, str]]()
    camera.late, camera.truncated = late, truncated
    status: Any = SimpleNamespace(
        take_cameras=lambda _cameras: None, take_measured=lambda *_measured: None
    )
    cameras = RunCameras([CameraClient(camera, "here")], MODEL, 0.0, RATE)
    watch = CameraWatch(
        cameras,
        status,
        LocalRequests(),
        lambda code, text, _at: reported.append((code, text)),
        clearance_stop=False,
    )
    for k in range(6):
        watch.trigger(PlatformPoses(k / RATE, k / RATE))
    watch.finish(1.0)
    assert reported == [
        (
            "pictures_dropped",
            "camera front: 3 of 6 images skipped; the previous one had not arrived yet, or was"
            f" still being measured{words}",
        )
    ]


@pytest.mark.parametrize(
    ("stop", "waits"), [("listener", True), ("operator", False), ("clearance_low", False)]
)
def test_the_wait_for_the_last_images_is_cut_short_by_stops_alone(stop: str, waits: bool) -> None:
    """A listener that raises ends no wait: the images of real time would be missing."""
    board, asked = LocalRequests(), list[bool]()

    class Raising(Listener):
        def waiting(self, text: str) -> AbstractContextManager[None]:
            raise RuntimeError(f"the display is gone: {text}")

    def finish(stopped: Callable[[], bool]) -> CameraRecords:
        if stop != "listener":
            board.ask_stop(None if stop == "operator" else StopReason(stop, "near"))
        asked.append(stopped())
        return CameraRecords()

    cameras: Any = SimpleNamespace(finish=finish, news=list)
    listener = Raising() if stop == "listener" else Listener()
    guarded, status = GuardedListener(listener, Callbacks(board.ask_stop)), cast(Any, None)
    CameraWatch(
        cameras, status, board, lambda *_: None, clearance_stop=True, listener=guarded
    ).finish(1.0)
    assert board.read().stop
    assert asked == [not waits]
