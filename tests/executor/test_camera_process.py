"""The camera's process alone, and the times of its images."""

from __future__ import annotations

import multiprocessing
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from drivers.cameras.live import Frame
from executor.cameras.open import LiveImages, RenderedImages
from executor.cameras.process import FrameRequest, _serve
from model.pose import Pose


class _Camera:
    """A worker that detects nothing, and may fail."""

    def __enter__(self) -> _Camera:
        return self

    def __exit__(self, *_: object) -> None:
        pass


def _broken() -> Any:
    raise RuntimeError("no such camera")


@pytest.mark.parametrize("make", [_Camera, _broken])
@pytest.mark.parametrize("closed", ["ours", "both ends"])
def test_it_ends_without_a_word_when_its_parent_is_gone(make: Any, closed: str) -> None:
    parent, child = multiprocessing.Pipe()
    parent.close()
    if closed == "both ends":
        child.close()
    _serve(make, child)
    child.close()


class Film:
    """Records the poses that are rendered."""

    def __init__(self) -> None:
        self.shown: list[tuple[float, float]] = []

    def picture(self, time: float, pose: Pose, _frame: int) -> np.ndarray:
        self.shown.append((time, pose.position[0]))
        return np.zeros((4, 4), np.uint8)


def test_a_synthetic_image_shows_the_platform_of_its_latency_ago() -> None:
    """It moves at 1 m/s, from rest at the first image; the rig file states another latency."""
    film: Any = Film()
    source = RenderedImages(film, latency=0.05, true_latency=0.12)
    for k in range(5):
        pose = Pose.level([0.1 * k, 0.0, 0.0])
        _, delay = source.picture(FrameRequest(k, 0.1 * k, 0.0, pose, None))
        assert delay == -0.05
    expected = [(0.1 * k - 0.12, max(0.0, 0.1 * k - 0.12)) for k in range(5)]
    np.testing.assert_allclose(film.shown, expected, atol=1e-12)


def test_a_live_image_may_be_exposed_before_it_is_requested() -> None:
    camera: Any = SimpleNamespace(
        read=lambda: Frame(12.26, np.zeros((4, 4), np.uint8), "x"), close=lambda: None
    )
    _, delay = LiveImages(camera).picture(FrameRequest(0, 1.0, 12.3, None, None))
    assert delay == pytest.approx(-0.04)
