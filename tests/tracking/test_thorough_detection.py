"""Tags that are small, blurred or faint, and squares that are not tags."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from tests.tracking.hard_images import Condition, HardPrinter
from tests.tracking.tag_images import FAMILY
from tracking.camera_model import Image
from tracking.detection.detector import Detection, TagDetector, is_blank
from tracking.detection.tags import CORNER_SIGNS, TagDecoder, carries_tag, official_modules

HARD = {
    "small": Condition(side_px=12.5),
    "in motion": Condition(side_px=60, motion_px=10.0),
    "out of focus": Condition(side_px=48, blur_px=2.8),
    "faint": Condition(side_px=40, contrast=12.0),
}


@pytest.fixture(scope="module")
def printer() -> HardPrinter:
    return HardPrinter(FAMILY, 587)


@pytest.fixture(scope="module")
def detector() -> TagDetector:
    return TagDetector(FAMILY)


def exhaustively(detector: TagDetector, image: Image) -> list[Detection]:
    return detector.detect_exhaustively(image, detector.detect_all(image))


@pytest.mark.parametrize("name", HARD)
def test_exhaustive_detection_finds_what_standard_detection_misses(
    printer: HardPrinter, detector: TagDetector, name: str
) -> None:
    rng, plain, exhaustive = np.random.default_rng(4), 0, 0
    for _ in range(6):
        picture = printer.image(HARD[name], rng)
        plain += len(detector.detect(picture.image))
        found = exhaustively(detector, picture.image)
        assert [d.id for d in found] in ([], [picture.number])
        for d in found:
            exhaustive += 1
            assert np.abs(d.corners - picture.corners).max() < 3.0
    assert exhaustive == 6
    assert plain < 6


def test_a_tag_found_by_both_searches_is_listed_once(
    printer: HardPrinter, detector: TagDetector
) -> None:
    picture = printer.image(Condition(side_px=60), np.random.default_rng(1))
    assert len(exhaustively(detector, picture.image)) == 1


def test_no_tag_that_can_be_read_is_in_a_blank_picture(
    printer: HardPrinter, detector: TagDetector, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A blank image is not searched: no detectable tag may count as blank."""
    rng, blank = np.random.default_rng(6), 0
    for _ in range(60):
        condition = Condition(
            side_px=rng.uniform(11.0, 60.0),
            tilt=rng.uniform(0.0, 1.2),
            motion_px=rng.uniform(0.0, 8.0),
            blur_px=rng.uniform(0.0, 3.0),
            contrast=np.exp(rng.uniform(np.log(4.0), np.log(200.0))),
            noise=rng.uniform(0.0, 12.0),
        )
        picture = printer.image(condition, rng)
        if is_blank(picture.image):
            blank += 1
            with monkeypatch.context() as context:
                context.setattr("tracking.detection.detector.is_blank", lambda _image: False)
                assert exhaustively(detector, picture.image) == [], condition
    assert blank > 10


@pytest.mark.parametrize("noise", [0.0, 1.5, 16.0])
@pytest.mark.parametrize("slope", [0.0, 0.2])
def test_a_wall_is_blank_whatever_its_light(noise: float, slope: float) -> None:
    grey = 60.0 + slope * np.arange(640) + np.random.default_rng(3).normal(0.0, noise, (480, 640))
    assert is_blank(np.clip(np.rint(grey), 0, 255).astype(np.uint8))


def square_picture(modules: np.ndarray) -> np.ndarray:
    """A square of modules of 10 px, with its border, on white."""
    small = np.where(np.pad(modules, 2, constant_values=True), 230, 30).astype(np.uint8)
    return np.asarray(cv2.resize(small, None, fx=10, fy=10, interpolation=cv2.INTER_NEAREST))


def test_squares_with_any_other_pattern_are_no_tags(detector: TagDetector) -> None:
    rng = np.random.default_rng(2)
    for _ in range(30):
        pattern = np.pad(rng.random((6, 6)) < 0.5, 1)
        assert exhaustively(detector, square_picture(pattern)) == []


@pytest.mark.parametrize("turns", range(4))
def test_a_decoder_says_which_corner_is_which(turns: int) -> None:
    image = square_picture(official_modules(FAMILY, 301))
    corners = (CORNER_SIGNS * [1, -1] + 1) * 40.0 + 19.5
    reading = TagDecoder(FAMILY).read(image, np.roll(corners, turns, axis=0))
    assert reading is not None
    assert reading.id == 301
    np.testing.assert_array_equal(reading.corners, corners)


def test_a_tag_without_white_around_it_or_without_contrast_is_not_read() -> None:
    decoder, corners = TagDecoder(FAMILY), (CORNER_SIGNS * [1, -1] + 1) * 40.0 + 19.5
    image = square_picture(official_modules(FAMILY, 301))
    image[:20] = image[-20:] = 30
    image[:, :20] = image[:, -20:] = 30
    assert decoder.read(image, corners) is None
    assert decoder.read(np.full_like(image, 128), corners) is None


def test_the_pattern_of_a_given_tag_is_distinguished_from_all_others() -> None:
    image = square_picture(official_modules(FAMILY, 301))
    corners = (CORNER_SIGNS * [1, -1] + 1) * 40.0 + 19.5
    assert carries_tag(image, corners, FAMILY, 301)
    assert [n for n in range(587) if n != 301 and carries_tag(image, corners, FAMILY, n)] == []
    assert not carries_tag(image, np.roll(corners, 1, axis=0), FAMILY, 301)
