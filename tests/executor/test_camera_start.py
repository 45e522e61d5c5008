"""Cameras open at the same time, and a stop is handled meanwhile."""

from __future__ import annotations

from dataclasses import replace
from typing import cast

import numpy as np
import pytest
from hypothesis import assume, example, given
from hypothesis import strategies as st

from executor.cameras import client as camera_start
from executor.cameras.client import HEARING, wait_until_ready
from executor.cameras.open import report_unmeasured_rotation
from executor.cameras.process import CameraProcess
from model.errors import Fault, HardwareMissing, StoppedByOperator
from model.pose import Pose, matrix_from_rotation_vector
from model.progress import Listener
from model.rig import load_rig
from tests.cli.plans import RIG


class Opening:
    """A camera that is open, or fails, after a number of calls."""

    def __init__(self, name: str, after: float, fails: bool = False) -> None:
        self.name, self.asked = name, 0
        self._after, self._fails = after, fails

    def is_ready(self, within: float) -> bool:
        assert within <= HEARING
        self.asked += 1
        if self.asked < self._after:
            return False
        if self._fails:
            raise HardwareMissing("the camera cannot be opened", where=f"camera {self.name}")
        return True


def wait(*cameras: Opening, stop_after: float = float("inf")) -> None:
    looks = 0

    def check_stop() -> None:
        nonlocal looks
        looks += 1
        if looks > stop_after:
            raise StoppedByOperator("stopped before anything moved")

    wait_until_ready([cast(CameraProcess, camera) for camera in cameras], check_stop)


def test_each_is_asked_until_it_is_open() -> None:
    slow, fast = Opening("slow", 5), Opening("fast", 2)
    wait(slow, fast)
    assert (slow.asked, fast.asked) == (5, 2)


def test_one_that_fails_is_reported_though_another_one_hangs() -> None:
    hung, broken = Opening("hung", float("inf")), Opening("broken", 3, fails=True)
    with pytest.raises(HardwareMissing, match="cannot be opened"):
        wait(hung, broken)
    assert hung.asked == 3


def test_a_stop_is_handled_while_a_camera_hangs() -> None:
    hung = Opening("hung", float("inf"))
    with pytest.raises(StoppedByOperator):
        wait(hung, stop_after=4)
    assert hung.asked == 4


def test_all_cameras_together_have_one_time_to_open(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(camera_start, "START_TIMEOUT", -1.0)
    cameras = [Opening("front", float("inf")), Opening("open", 1), Opening("side", float("inf"))]
    with pytest.raises(Fault, match="camera front, side did not open"):
        wait(*cameras)
    assert [camera.asked for camera in cameras] == [1, 1, 1]


@given(
    home=st.lists(st.floats(-1.0, 1.0), min_size=3, max_size=3),
    axis=st.sampled_from(list(np.eye(3))),
    farthest=st.floats(-180.0, 180.0),
)
@example(home=[0.0] * 3, axis=np.eye(3)[2], farthest=180.0)
@example(home=[0.0] * 3, axis=np.eye(3)[2], farthest=0.0)
def test_a_plan_that_rotates_beyond_what_cameras_measure_is_remarked_on(
    home: list[float], axis: np.ndarray, farthest: float
) -> None:
    assume(abs(abs(farthest) - 80.0) > 1e-3)
    start = Pose(np.zeros(3), matrix_from_rotation_vector(np.array(home)))
    rig, remarks = replace(load_rig(RIG), home=start), []
    listener = Listener()
    listener.remark = remarks.append  # type: ignore[method-assign]
    angles = np.radians(np.linspace(0.0, farthest, 5))
    rotations = np.array([matrix_from_rotation_vector(a * axis) @ start.rotation for a in angles])
    report_unmeasured_rotation(rig, rotations, listener)
    assert len(remarks) == (abs(farthest) > 80.0)
    assert all(f"up to {abs(farthest):.4g}° from its home pose" in text for text in remarks)
