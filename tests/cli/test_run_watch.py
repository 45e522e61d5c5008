"""Reports of the cameras during a run, and what stops the run."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from executor.cameras.client import CameraClient
from executor.cameras.multi_camera import CameraWatch, RunCameras
from executor.supervision import LocalRequests, StopReason
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
        watch.trigger(k / RATE, k / RATE, None, None)
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
