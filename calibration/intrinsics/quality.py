"""Whether a camera is calibrated well enough: what the images covered, and millimetres."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from calibration.intrinsics.calibrate import CameraCalibration
from calibration.verdict import CalibrationVerdict, Issue
from model.pose import Array

CELLS = (8, 6)
"""Columns and rows of the map of what is covered."""
GOOD_VIEWS, GOOD_COVERAGE, GOOD_TILT, GOOD_ERROR = 12, 0.6, 20.0, 1.0
"""Images, share of the map, degrees to either side of both axes together, pixels."""
GOOD_PIXELS = 1.0
"""Of points all over the image, 95 %, [px]: unlike millimetres, no wrong size of squares changes
them."""
FULL_COVERAGE = 0.9
"""Share of the map beyond which nothing is gained by more of it."""
EDGES = "bring the board near the edges and corners of the image"
MORE = "take more images: 40 are recommended"
_SIDES = (("left", 0, 0), ("right", 0, -1), ("top", 1, 0), ("bottom", 1, -1))


@dataclass(frozen=True, slots=True, eq=False)
class CameraQuality:
    """What a camera calibration is good for.

    Attributes:
        verdict: The verdict.
        coverage: How many corners were seen in each cell of the image, shape `CELLS`.
        tilts: Angle of each image's board against the image's plane, about its x and y axes,
            shape (pictures, 2), [deg].
        distance: For which the errors are stated, [m].
        nearest: Least distance of a board, [m]; it grows with the stated size of the squares.
        farthest: Greatest distance of a board, [m].
        halves: How far apart two halves of the images would see a point there, RMS over the
            image, [m].
    """

    verdict: CalibrationVerdict
    coverage: Array
    tilts: Array
    distance: float
    nearest: float
    farthest: float
    halves: float

    @property
    def covered(self) -> float:
        """Share of the cells with corners."""
        return float(np.mean(self.coverage > 0))


def judge_camera(
    result: CameraCalibration, wanted: float, distance: float | None = None
) -> CameraQuality:
    """Judges a calibration.

    Args:
        result: The calibration.
        wanted: What is good enough, [m].
        distance: At which the camera will measure, [m]; that of the boards when left out, which
            is true only if the stated size of the squares is: pixels are judged as well then.
    """
    away = [float(np.linalg.norm(pose.position)) for pose in result.boards.values()]
    told = distance is not None
    distance = float(np.median(away)) if distance is None else distance
    coverage, tilts = _coverage(result), _tilts(result)
    slopes = _slopes(result)
    scale = distance / float(np.sqrt(result.matrix[0, 0] * result.matrix[1, 1]))
    widths = np.asarray(result.uncertainty.half_widths)
    deviations = np.sqrt(np.diag(result.uncertainty.covariance))
    grown = result.uncertainty.covariance * np.outer(widths / deviations, widths / deviations)
    error = scale * float(np.sqrt(np.mean(np.einsum("pik,kl,pil->p", slopes, grown, slopes))))
    apart = slopes @ result.uncertainty.halves
    halves = scale * float(np.sqrt(np.mean(np.sum(apart**2, axis=1))))
    lacks = [
        *_about_pictures(result, coverage, tilts),
        *_about_errors(result, coverage, error, halves, wanted, distance),
    ]
    where = f"at {distance:.2g} m"
    if not told:
        where += f", if the boards were {min(away):.2g} to {max(away):.2g} m away"
        if not error / scale <= GOOD_PIXELS:
            what = f"points are within {error / scale:.2g} px; {GOOD_PIXELS:.0f} px is required"
            lacks.append(Issue(what, "take more images, or pass --distance-m"))
    verdict = CalibrationVerdict.of(error, wanted, where, lacks)
    return CameraQuality(verdict, coverage, tilts, distance, min(away), max(away), halves)


def _coverage(result: CameraCalibration) -> Array:
    corners = np.concatenate([seen.corners for seen in result.views.values()])
    limits = [[0.0, result.size[0]], [0.0, result.size[1]]]
    counts, _, _ = np.histogram2d(corners[:, 0], corners[:, 1], bins=CELLS, range=limits)
    return np.asarray(counts)


def _tilts(result: CameraCalibration) -> Array:
    """Of the board's normal against the camera's axis, about the image's x and y axes, [deg]."""
    normals = np.array([pose.rotation[:, 2] for pose in result.boards.values()])
    normals *= np.where(normals[:, 2:] < 0.0, -1.0, 1.0)
    return np.asarray(np.degrees(np.arctan2(normals[:, [1, 0]], normals[:, 2:])))


def picture_grid(size: tuple[int, int]) -> Array:
    """Pixels all over an image, shape (81, 2)."""
    across = np.linspace(0.05, 0.95, 9)
    return np.array([(x * size[0], y * size[1]) for x in across for y in across])


def _slopes(result: CameraCalibration) -> Array:
    """Derivatives of pixels by the nine numbers, on a grid of rays, shape (rays, 2, 9)."""
    pixels = picture_grid(result.size)
    flat = cv2.undistortPoints(pixels.reshape(-1, 1, 2), result.matrix, result.distortion)
    rays = np.column_stack([flat.reshape(-1, 2), np.ones(len(pixels))])
    nothing = np.zeros(3)
    _, slopes = cv2.projectPoints(rays, nothing, nothing, result.matrix, result.distortion)
    return np.asarray(slopes[:, 6:15].reshape(len(pixels), 2, 9))


def _about_pictures(result: CameraCalibration, coverage: Array, tilts: Array) -> list[Issue]:
    """What the set of images lacks, and what to add."""
    lacks = []
    if len(result.views) < GOOD_VIEWS:
        what = f"{len(result.views)} images show the board; {GOOD_VIEWS} are required"
        lacks.append(Issue(what, MORE))
    share = float(np.mean(coverage > 0))
    if share < GOOD_COVERAGE:
        empty = [side for side, axis, at in _SIDES if not coverage.take(at, axis=axis).any()]
        place = f", none at the {' and '.join(empty)}" if empty else ""
        what = f"the board covered {share:.0%} of the image{place}; {GOOD_COVERAGE:.0%} is required"
        lacks.append(Issue(what, EDGES))
    for axis, name in enumerate(("forward and backward", "left and right")):
        span = float(np.ptp(tilts[:, axis]))
        if span < 2.0 * GOOD_TILT:
            needed = f"{2 * GOOD_TILT:.0f}° is required"
            what = f"the board was tilted {name} over only {span:.0f}°; {needed}"
            lacks.append(Issue(what, "tilt the board up to 40° in every direction"))
    return lacks


def _about_errors(
    result: CameraCalibration,
    coverage: Array,
    error: float,
    halves: float,
    wanted: float,
    distance: float,
) -> list[Issue]:
    """What the numbers lack, and what to do."""
    lacks = []
    if result.error > GOOD_ERROR:
        what = f"the reprojection error is {result.error:.2f} px"
        step = "take sharp images of a flat board, held still, and check its dimensions"
        lacks.append(Issue(what, step))
    if not error <= wanted:
        what = (
            f"points at {distance:.2g} m are measured within {error * 1e3:.2g} mm;"
            f" {wanted * 1e3:.2g} mm are required"
        )
        lacks.append(Issue(what, MORE))
        share = float(np.mean(coverage > 0))
        if GOOD_COVERAGE <= share < FULL_COVERAGE:
            what = f"the board covered {share:.0%} of the image; {FULL_COVERAGE:.0%} is recommended"
            lacks.append(Issue(what, EDGES))
    if not halves <= 2.0 * wanted:
        what = f"two halves of the images differ by {halves * 1e3:.2g} mm"
        lacks.append(Issue(what, MORE))
    return lacks
