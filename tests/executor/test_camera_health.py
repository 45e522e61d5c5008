"""A camera that loses the platform, or hangs, is reported as often as it happens."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from executor.cameras.client import BLIND_IMAGES, SILENCE, CameraHealth


def looked(seen: list[bool]) -> list[str]:
    """Reports after each image, ten per second, each answered at once."""
    sight, reported = CameraHealth(), []
    for frame, pose in enumerate(seen):
        sight.ask(frame / 10)
        sight.answer(pose)
        reported.append(sight.trouble(frame / 10))
    return reported


@given(seen=st.lists(st.booleans(), max_size=40))
def test_it_is_in_trouble_exactly_while_the_last_images_gave_no_pose(seen: list[bool]) -> None:
    for frame, reported in enumerate(looked(seen)):
        last = seen[max(0, frame + 1 - BLIND_IMAGES) : frame + 1]
        assert bool(reported) is (len(last) == BLIND_IMAGES and not any(last))


def test_a_camera_that_saw_once_and_then_loses_the_tags_is_reported() -> None:
    reported = looked([True] + [False] * BLIND_IMAGES)
    assert not any(reported[:-1])
    assert "gave no pose in 10 images in a row" in reported[-1]


@pytest.mark.parametrize("blind", [False, True])
def test_a_camera_that_hangs_is_reported_until_it_answers(blind: bool) -> None:
    sight = CameraHealth()
    for _ in range(BLIND_IMAGES):
        sight.answer(not blind)
    sight.ask(100.0)
    assert "no answer" not in sight.trouble(100.0 + SILENCE)
    assert "did not answer for 2 s" in sight.trouble(100.001 + SILENCE)
    sight.answer(not blind)
    assert "no answer" not in sight.trouble(200.0)
    assert bool(sight.trouble(200.0)) is blind
