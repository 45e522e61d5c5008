"""Whether a camera is calibrated well enough: what the pictures covered, and millimetres."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from calibration.camera import CameraCalibration
from cdpr.poses import Array

CELLS = (8, 6)
"""Columns and rows of the map of what is covered."""
GOOD_VIEWS, GOOD_COVERAGE, GOOD_TILT, GOOD_ERROR = 12, 0.6, 20.0, 1.0
"""Pictures, share of the map, degrees to either side of both axes together, pixels."""
_SIDES = (("left", 0, 0), ("right", 0, -1), ("top", 1, 0), ("bottom", 1, -1))


@dataclass(frozen=True, slots=True, eq=False)
class Verdict:
    """What a calibration is good for.

    Attributes:
        coverage: How many corners were seen in each cell of the picture, shape `CELLS`.
        tilts: Angle of each picture's board against the picture's plane, about its x and y axes,
            shape (pictures, 2), [deg].
        distance: For which the errors are stated, [m].
        error: How far off a point at that distance is seen, 95 %, RMS over the picture, [m].
        halves: How far apart two halves of the pictures would see it, RMS over the picture, [m].
        wanted: What is good enough, [m].
        reasons: Why it is not good enough; empty if it is.
        next_steps: What to do about each.
    """

    coverage: Array
    tilts: Array
    distance: float
    error: float
    halves: float
    wanted: float
    reasons: tuple[str, ...]
    next_steps: tuple[str, ...]

    @property
    def good(self) -> bool:
        """Whether it is good enough."""
        return not self.reasons

    @property
    def covered(self) -> float:
        """Share of the cells with corners."""
        return float(np.mean(self.coverage > 0))

    def __str__(self) -> str:
        """The verdict in a sentence."""
        if self.good:
            return f"good enough for {self.error * 1e3:.2g} mm at {self.distance:.2g} m"
        return f"not good enough: {'; '.join(self.reasons)}"


def judge(result: CameraCalibration, wanted: float, distance: float | None = None) -> Verdict:
    """Judges a calibration.

    Args:
        result: The calibration.
        wanted: What is good enough, [m].
        distance: At which the camera will measure, [m]; that of the boards when left out.
    """
    if distance is None:
        away = [np.linalg.norm(pose.position) for pose in result.boards.values()]
        distance = float(np.median(away))
    coverage, tilts = _coverage(result), _tilts(result)
    slopes = _slopes(result)
    scale = distance / float(np.sqrt(result.matrix[0, 0] * result.matrix[1, 1]))
    widths = np.asarray(result.uncertainty.half_widths)
    deviations = np.sqrt(np.diag(result.uncertainty.covariance))
    grown = result.uncertainty.covariance * np.outer(widths / deviations, widths / deviations)
    error = scale * float(np.sqrt(np.mean(np.einsum("pik,kl,pil->p", slopes, grown, slopes))))
    apart = slopes @ result.uncertainty.halves
    halves = scale * float(np.sqrt(np.mean(np.sum(apart**2, axis=1))))
    found = [
        *_about_pictures(result, coverage, tilts),
        *_about_errors(result, error, halves, wanted, distance),
    ]
    return Verdict(
        coverage=coverage,
        tilts=tilts,
        distance=distance,
        error=error,
        halves=halves,
        wanted=wanted,
        reasons=tuple(reason for reason, _ in found),
        next_steps=tuple(dict.fromkeys(step for _, step in found)),
    )


def _coverage(result: CameraCalibration) -> Array:
    corners = np.concatenate([seen.corners for seen in result.views.values()])
    limits = [[0.0, result.size[0]], [0.0, result.size[1]]]
    counts, _, _ = np.histogram2d(corners[:, 0], corners[:, 1], bins=CELLS, range=limits)
    return np.asarray(counts)


def _tilts(result: CameraCalibration) -> Array:
    """Of the board's normal against the camera's axis, about the picture's x and y axes, [deg]."""
    normals = np.array([pose.rotation[:, 2] for pose in result.boards.values()])
    normals *= np.where(normals[:, 2:] < 0.0, -1.0, 1.0)
    return np.asarray(np.degrees(np.arctan2(normals[:, [1, 0]], normals[:, 2:])))


def _slopes(result: CameraCalibration) -> Array:
    """Derivatives of pixels by the nine numbers, on a grid of rays, shape (rays, 2, 9)."""
    across = np.linspace(0.05, 0.95, 9)
    pixels = np.array([(x * result.size[0], y * result.size[1]) for x in across for y in across])
    flat = cv2.undistortPoints(pixels.reshape(-1, 1, 2), result.matrix, result.distortion)
    rays = np.column_stack([flat.reshape(-1, 2), np.ones(len(pixels))])
    nothing = np.zeros(3)
    _, slopes = cv2.projectPoints(rays, nothing, nothing, result.matrix, result.distortion)
    return np.asarray(slopes[:, 6:15].reshape(len(pixels), 2, 9))


def _about_pictures(
    result: CameraCalibration, coverage: Array, tilts: Array
) -> list[tuple[str, str]]:
    """What the set of pictures lacks, and what to add."""
    found = []
    if len(result.views) < GOOD_VIEWS:
        found.append(
            (
                f"{len(result.views)} pictures show the board, {GOOD_VIEWS} are needed",
                "take more pictures: 40 are good",
            )
        )
    share = float(np.mean(coverage > 0))
    if share < GOOD_COVERAGE:
        empty = [side for side, axis, at in _SIDES if not coverage.take(at, axis=axis).any()]
        place = f", none at the {' and '.join(empty)}" if empty else ""
        found.append(
            (
                f"the board covered {share:.0%} of the picture{place}, {GOOD_COVERAGE:.0%} are"
                " needed",
                "bring the board near the edges and corners of the picture",
            )
        )
    for axis, name in enumerate(("forward and backward", "left and right")):
        span = float(np.ptp(tilts[:, axis]))
        if span < 2.0 * GOOD_TILT:
            found.append(
                (
                    f"the board was tilted {name} over {span:.0f}° only, {2 * GOOD_TILT:.0f}° are"
                    " needed",
                    "tilt the board up to 40° every way",
                )
            )
    return found


def _about_errors(
    result: CameraCalibration, error: float, halves: float, wanted: float, distance: float
) -> list[tuple[str, str]]:
    """What the numbers lack, and what to do."""
    found = []
    if result.error > GOOD_ERROR:
        found.append(
            (
                f"corners are {result.error:.2f} px off",
                "take sharp pictures of a flat board, held still, and check its numbers",
            )
        )
    if not error <= wanted:
        found.append(
            (
                f"points at {distance:.2g} m are seen within {error * 1e3:.2g} mm,"
                f" {wanted * 1e3:.2g} mm are wanted",
                "take more pictures: 40 are good",
            )
        )
    if not halves <= 2.0 * wanted:
        found.append(
            (
                f"two halves of the pictures see them {halves * 1e3:.2g} mm apart",
                "take more pictures: 40 are good",
            )
        )
    return found
