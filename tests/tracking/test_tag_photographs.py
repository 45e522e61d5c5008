"""Tags in real photographs, compared with the AprilTag library's detections."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from model.pose import Array
from tests.tracking.reference_tags import nearest_gap, tags_found_by_apriltag
from tracking.detection.detector import TagDetector

PHOTOGRAPHS = sorted((Path(__file__).parent / "photographs").glob("*.jpg"))
FAMILY = "tag36h11"


def _found(photograph: Path) -> list[Array]:
    image = cv2.imread(str(photograph), cv2.IMREAD_GRAYSCALE)
    assert image is not None
    detector = TagDetector(FAMILY)
    found = detector.detect_exhaustively(image, detector.detect_all(image))
    assert {d.id for d in found} == {0}, "a tag that is not on the cubes"
    return [d.corners for d in found]


@pytest.mark.parametrize("photograph", PHOTOGRAPHS, ids=lambda path: path.stem)
def test_an_exhaustive_detection_finds_what_the_apriltag_library_finds(photograph: Path) -> None:
    found = _found(photograph)
    reference = tags_found_by_apriltag(photograph.with_suffix(".txt"))
    missed = [corners for corners in reference if nearest_gap(corners, found) > 2.0]
    assert len(missed) <= 1  # of 12, 25 and 10
    assert len(found) > len(reference)


@pytest.mark.parametrize("photograph", PHOTOGRAPHS, ids=lambda path: path.stem)
def test_no_cube_is_seen_twice(photograph: Path) -> None:
    middles = np.array([corners.mean(axis=0) for corners in _found(photograph)])
    gaps = np.linalg.norm(middles[:, None] - middles[None], axis=2) + 1e3 * np.eye(len(middles))
    assert gaps.min() > 8.0
