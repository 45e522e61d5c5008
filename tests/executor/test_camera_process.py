"""The camera's process alone, and the times of its images."""

from __future__ import annotations

import multiprocessing
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.cameras.live import Frame
from executor.cameras.open import LiveImages, RenderedImages
from executor.cameras.process import KEPT_IMAGES, CameraWorker, FrameRequest, _serve
from executor.state_machine import PlatformPoses
from model.pose import Pose
from model.rig import load_rig
from tests.cli.plans import RIG
from tracking.measurement import NoPose

_RIG = load_rig(RIG)


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


class Dark:
    """A camera without light, which also delivered images that were not used."""

    unused = 2, 5

    def image(self, _trigger: FrameRequest) -> tuple[np.ndarray, float]:
        return np.zeros((4, 4), np.uint8), 0.0


@given(frames=st.integers(1, 40_000), planned=st.integers(1, 400))
def test_a_run_on_hold_for_hours_keeps_few_images_over_all_of_it(frames: int, planned: int) -> None:
    """Each doubling of the run adds as many as its first half has."""
    kept: list[int] = []
    folder: Any = SimpleNamespace(write_image=lambda n, *_: kept.append(n) or "x")
    tracker: Any = SimpleNamespace(observe=lambda *_: NoPose(0.0, "dark"))
    every = max(1, planned // KEPT_IMAGES)
    worker = CameraWorker(_RIG, _RIG.cameras[0], Dark(), folder, every, named=False)
    worker._tracker = tracker
    names = [
        worker.measure(FrameRequest(n, PlatformPoses(0.1 * n, 0.0))).picture for n in range(frames)
    ]
    assert [n for n, name in enumerate(names) if name] == kept
    assert kept[0] == 0
    doublings = max(0.0, np.log2(frames / (every * KEPT_IMAGES)))
    assert len(kept) <= KEPT_IMAGES * (doublings + 2)
    gaps = np.diff([*kept, frames])
    assert gaps.max() <= every + frames / KEPT_IMAGES


class Film:
    """Records the poses that are rendered."""

    def __init__(self) -> None:
        self.shown: list[tuple[float, float]] = []

    def image(self, time: float, pose: Pose, _frame: int) -> np.ndarray:
        self.shown.append((time, pose.position[0]))
        return np.zeros((4, 4), np.uint8)


def test_a_synthetic_image_shows_the_platform_of_its_latency_ago() -> None:
    """It moves at 1 m/s, from rest at the first image; the rig file states another latency."""
    film: Any = Film()
    source = RenderedImages(film, latency=0.05, true_latency=0.12)
    for k in range(5):
        pose = Pose.level([0.1 * k, 0.0, 0.0])
        _, delay = source.image(FrameRequest(k, PlatformPoses(0.1 * k, 0.0, pose)))
        assert delay == -0.05
    expected = [(0.1 * k - 0.12, max(0.0, 0.1 * k - 0.12)) for k in range(5)]
    np.testing.assert_allclose(film.shown, expected, atol=1e-12)


def test_a_synthetic_image_of_a_rare_camera_shows_the_curve_between_two_requests() -> None:
    """Once a second, of a platform on a circle; poses come ten times a second."""
    film: Any = Film()
    source = RenderedImages(film, latency=0.25, true_latency=0.25)
    poses = [(0.1 * k, Pose.level([np.cos(0.1 * k), 0.0, 0.0])) for k in range(51)]
    for k in range(6):
        recent = tuple(poses[max(0, 10 * k - 20) : 10 * k + 1])
        source.image(FrameRequest(k, PlatformPoses(1.0 * k, 0.0, recent[-1][1]), recent))
    np.testing.assert_allclose(
        film.shown[1:], [(k - 0.25, np.cos(k - 0.25)) for k in range(1, 6)], atol=2e-3
    )


def test_a_live_image_may_be_exposed_before_it_is_requested() -> None:
    camera: Any = SimpleNamespace(
        read=lambda: Frame(12.26, np.zeros((4, 4), np.uint8), "x"), late=3, truncated=1
    )
    source = LiveImages(camera)
    _, delay = source.image(FrameRequest(0, PlatformPoses(1.0, 12.3)))
    assert delay == pytest.approx(-0.04)
    assert source.unused == (3, 1)


def test_a_sample_states_how_many_images_were_not_used() -> None:
    tracker: Any = SimpleNamespace(observe=lambda *_: NoPose(0.0, "dark"))
    worker = CameraWorker(_RIG, _RIG.cameras[0], Dark(), None, 1, named=False)
    worker._tracker = tracker
    sample = worker.measure(FrameRequest(0, PlatformPoses(0.0, 0.0)))
    assert (sample.late, sample.truncated) == Dark.unused
