"""How well images determine a camera: the fit linearised, image by image.

With r the errors of a picture's corners and A, B their derivatives by the camera's numbers and by
the board's pose, what the picture says of those numbers is H = AᵀPA and s = AᵀPr, P projecting the
pose out. From these follow the covariance by the scatter of the corners, the fit without any one
image, and the fits of two halves of the images, each to first order.

The scatter alone promises too much: corners of one image err together (a bent board, blur, the
lens model). The spread of the fits without one image (the jackknife over images) feels that,
and the larger of both is stated.

Source: Efron & Tibshirani, "An Introduction to the Bootstrap", 1993, ch. 11.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import t as student

from calibration.intrinsics.lens import LensModel
from calibration.statistics import CONFIDENCE, jackknife, kept_share, rms_bound, widened
from calibration.targets.board import Seen
from model.cameras import SURE
from model.errors import BadInput
from model.pose import Array, read_only


@dataclass(frozen=True, slots=True, eq=False)
class Uncertainty:
    """What is known about the errors of a camera's n numbers, in the order of its lens model.

    Attributes:
        covariance: By the scatter of the corners alone, shape (n, n).
        half_widths: Of the 95 % intervals, shape (n,).
        without: How the numbers change when a picture is left out, shape (pictures, n).
        halves: How the even pictures' numbers differ from the odd ones', shape (n,).
    """

    covariance: Array
    half_widths: Array
    without: Array
    halves: Array

    @property
    def stated_covariance(self) -> Array:
        """The covariance that 95 % intervals of whatever depends on the numbers follow from.

        That of the scatter, as much wider as `widened` finds it; shape (n, n).
        """
        quantile = _quantile(len(self.without)) / SURE
        return widened(self.covariance, self.without) * quantile**2

    def error_of(self, slopes: Array) -> float:
        """How far off things are that depend on all numbers, 95 %, RMS.

        Taken as a whole by the scatter and by the jackknife, the larger counts: taken number by
        number, errors that cancel in the whole would not.

        Args:
            slopes: Their derivatives by the numbers, shape (..., n).
        """
        flat = slopes.reshape(-1, slopes.shape[-1])
        by_pictures = jackknife(self.without) * kept_share(*self.without.shape)
        larger = max(rms_bound(one, flat) for one in (self.covariance, by_pictures))
        return _quantile(len(self.without)) / SURE * larger


def uncertainty_of(
    views: Sequence[Seen],
    turns: Sequence[Array],
    places: Sequence[Array],
    matrix: Array,
    distortion: Array,
    lens: LensModel,
) -> Uncertainty:
    """The uncertainty of a fit.

    Args:
        views: The board in each image.
        turns: Rotation vectors of the board in the camera's frame, shape (3,) each, [rad].
        places: Its origin there, shape (3,) each, [m].
        matrix: Camera matrix, shape (3, 3), [px].
        distortion: The lens's coefficients, shape (k,).
        lens: The lens model.

    Raises:
        BadInput: The pictures leave some of the numbers open.
    """
    parts, scores, squares, residuals = [], [], 0.0, 0
    for seen, turn, place in zip(views, turns, places, strict=True):
        there, of_pose, of_camera = lens.slopes(seen.points, turn, place, matrix, distortion)
        errors = (seen.corners - there).ravel()
        base = np.linalg.qr(of_pose)[0]
        left = of_camera - base @ (base.T @ of_camera)
        parts.append(left.T @ left)
        scores.append(left.T @ errors)
        squares += float(errors @ errors)
        residuals += len(errors) - 6
    information, count = np.sum(parts, axis=0), len(parts)
    scale = np.sqrt(np.diag(information))
    if not (scale > 0.0).all() or np.linalg.cond(information / np.outer(scale, scale)) > 1e13:
        raise BadInput(
            "these images do not determine a camera",
            why="other parameters would explain them as well",
            next_step="take more images, with the board tilted up to 40° in every direction",
        )
    by_scatter = np.linalg.inv(information) * squares / max(residuals - len(information), 1)
    without = np.array([_without(information, h, s) for h, s in zip(parts, scores, strict=True)])
    by_pictures = jackknife(without)
    larger = np.maximum(np.diag(by_scatter), np.diag(by_pictures) * kept_share(*without.shape))
    return Uncertainty(
        covariance=read_only(by_scatter),
        half_widths=read_only(_quantile(count) * np.sqrt(larger)),
        without=read_only(without),
        halves=read_only(_half(parts, scores, 1) - _half(parts, scores, 0)),
    )


def _without(information: Array, part: Array, score: Array) -> Array:
    """The change of the numbers when one image is left out."""
    return np.asarray(-np.linalg.pinv(information - part, hermitian=True) @ score)


def _half(parts: Sequence[Array], scores: Sequence[Array], which: int) -> Array:
    """The change of the numbers when every other image is used, from the first or the second."""
    information = np.sum(parts[which::2], axis=0)
    return np.asarray(
        np.linalg.pinv(information, hermitian=True) @ np.sum(scores[which::2], axis=0)
    )


def _quantile(count: int) -> float:
    """Of Student's distribution, for a number of images."""
    return float(student.ppf(0.5 + CONFIDENCE / 2.0, max(count - 1, 1)))
