"""Corners to hundredths of a pixel in images with known corners."""

from __future__ import annotations

import numpy as np
import pytest

from model.pose import Array
from tests.tracking.tag_images import FAMILY, SIZE, TagPrinter, facing, small_camera
from tracking.detection.detector import TagDetector
from tracking.detection.tags import modules_across
from tracking.edges.refine import RefinedTag, refine

MODULES = modules_across(FAMILY)


@pytest.fixture(scope="module")
def printer() -> TagPrinter:
    return TagPrinter(small_camera())


def refined_errors(printer: TagPrinter, side_px: float, count: int) -> tuple[Array, Array]:
    """Corner errors, shape (n, 4, 2), [px], and whitened errors, shape (n, 8)."""
    rng, detector = np.random.default_rng(11), TagDetector(FAMILY)
    errors, whitened = [], []
    for _ in range(count):
        pose = facing(rng, 400.0 * SIZE / side_px, tilt=0.7)
        picture = printer.image(pose, rng, noise=1.0)
        (found,) = detector.detect(picture.image)
        (square,) = refine(picture.image, printer.camera, found.corners[None], MODULES)
        assert square is not None
        assert square.whole
        errors.append(square.corners - picture.corners)
        whitened.append(square.whitening @ picture.corners.ravel() - square.target)
    return np.array(errors), np.array(whitened)


@pytest.mark.parametrize(("side_px", "limit_px"), [(60.0, 0.02), (24.0, 0.05)])
def test_corners_are_found_to_hundredths_of_a_pixel(
    printer: TagPrinter, side_px: float, limit_px: float
) -> None:
    errors, whitened = refined_errors(printer, side_px, count=40)
    assert np.sqrt(np.mean(np.sum(errors**2, axis=-1))) < limit_px
    assert np.all(np.abs(errors.mean(axis=(0, 1))) < limit_px / 2)  # no bias
    assert np.mean(whitened**2) < 1.5  # the stated uncertainty is no less than the errors


def test_covariance_of_a_whole_tag_is_the_inverse_of_its_whitening(printer: TagPrinter) -> None:
    rng = np.random.default_rng(3)
    picture = printer.image(facing(rng, 0.7, 0.5), rng)
    square = only(printer, picture.image, picture.corners)
    np.testing.assert_allclose(
        square.whitening @ square.covariance @ square.whitening.T, np.eye(8), atol=1e-9
    )


def only(printer: TagPrinter, image: np.ndarray, rough: Array) -> RefinedTag:
    (square,) = refine(image, printer.camera, rough[None], MODULES)
    assert square is not None
    return square


@pytest.mark.parametrize("shift", [-2.0, -1.0, 1.0, 2.0])
def test_the_result_does_not_depend_on_the_approximate_corners(
    printer: TagPrinter, shift: float
) -> None:
    rng = np.random.default_rng(5)
    picture = printer.image(facing(rng, 0.64, 0.4), rng)
    straight = only(printer, picture.image, picture.corners)
    shifted = only(printer, picture.image, picture.corners + shift)
    assert np.abs(straight.corners - shifted.corners).max() < 0.03


def test_a_cable_across_an_edge_does_not_move_it(printer: TagPrinter) -> None:
    rng = np.random.default_rng(8)
    picture = printer.image(facing(rng, 0.64, 0.3), rng)
    start, end = picture.corners[0], picture.corners[1]
    middle = np.round((start + end) / 2).astype(int)
    image = picture.image.copy()
    image[:, middle[0] - 1 : middle[0] + 2] = 40  # a dark line of 3 px down the image
    square = only(printer, image, picture.corners)
    whitened = square.whitening @ picture.corners.ravel() - square.target
    assert np.abs(whitened).max() < 5.0
    assert square.edges.sum() >= 3


def test_a_hidden_edge_is_left_out_and_says_nothing(printer: TagPrinter) -> None:
    rng = np.random.default_rng(9)
    picture = printer.image(facing(rng, 0.64, 0.1), rng)
    start, end = picture.corners[0], picture.corners[1]
    image = picture.image.astype(float)
    rows, columns = np.mgrid[0 : image.shape[0], 0 : image.shape[1]]
    along = (end - start) / np.linalg.norm(end - start)
    inward = np.array([-along[1], along[0]])
    depth = (columns - start[0]) * inward[0] + (rows - start[1]) * inward[1]
    image[depth < 9.0] = 90.0  # the first edge and its surroundings are covered
    square = only(printer, image.astype(np.uint8), picture.corners)
    assert not square.edges[0]
    assert not square.whitening[:2].any()
    assert not square.whole


def test_a_tag_that_leaves_the_picture_is_refused(printer: TagPrinter) -> None:
    rng = np.random.default_rng(1)
    picture = printer.image(facing(rng, 0.7, 0.1), rng)
    outside = picture.corners + np.array([250.0, 0.0])
    assert refine(picture.image, printer.camera, outside[None], MODULES) == [None]


def test_a_grey_wall_has_no_edges(printer: TagPrinter) -> None:
    rng = np.random.default_rng(2)
    wall = np.clip(120 + rng.standard_normal((240, 320)), 0, 255).astype(np.uint8)
    square = np.array([[100.0, 80.0], [160.0, 80.0], [160.0, 140.0], [100.0, 140.0]])
    assert refine(wall, printer.camera, square[None], MODULES) == [None]


def test_nothing_to_refine_gives_nothing(printer: TagPrinter) -> None:
    wall = np.zeros((240, 320), dtype=np.uint8)
    assert refine(wall, printer.camera, np.empty((0, 4, 2)), MODULES) == []
