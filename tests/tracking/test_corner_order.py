"""The frame of a tag is that of the AprilTag project's image, verified by published codes."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from tracking.detection.detector import TagDetector
from tracking.detection.tags import CORNER_SIGNS, official_modules

# First code of each family, most significant bit at the top left, row after row (AprilTag 2).
FIRST_CODES = {"tag16h5": (4, 0x231B), "tag25h9": (5, 0x155CBF1), "tag36h11": (6, 0xD5D628584)}


def published_modules(family: str) -> NDArray[np.bool_]:
    side, code = FIRST_CODES[family]
    bits = [(code >> (side * side - 1 - i)) & 1 for i in range(side * side)]
    return np.pad(np.array(bits, dtype=bool).reshape(side, side), 1)


@pytest.mark.parametrize("family", FIRST_CODES)
def test_official_modules_are_the_published_ones(family: str) -> None:
    np.testing.assert_array_equal(official_modules(family, 0), published_modules(family))


@pytest.mark.parametrize("quarter_turns", [0, 1, 2, 3])
@pytest.mark.parametrize("family", FIRST_CODES)
def test_detected_corners_follow_the_upright_picture(family: str, quarter_turns: int) -> None:
    """Projects the published image without OpenCV and recovers the corners."""
    modules = published_modules(family)
    angle = np.radians(17.0) + quarter_turns * np.pi / 2
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    half, centre = 40.0, np.array([100.0, 90.0])
    # Pixels (y down) to the tag's plane (y up), in half sides.
    rows, columns = np.mgrid[0:200, 0:200]
    in_plane = (np.stack([columns, rows], axis=-1) - centre) @ turn / half * [1, -1]
    count = len(modules)
    index = np.floor((in_plane * [1, -1] + 1) / 2 * count).astype(int)
    inside = np.all((index >= 0) & (index < count), axis=-1)
    clipped = np.clip(index, 0, count - 1)
    white = np.where(inside, modules[clipped[..., 1], clipped[..., 0]], True)
    image = np.where(white, 230, 20).astype(np.uint8)

    (found,) = TagDetector(family).detect(image)

    expected = centre + (CORNER_SIGNS * [1, -1] * half) @ turn.T
    assert found.id == 0
    assert np.abs(found.corners - expected).max() < 2.0
