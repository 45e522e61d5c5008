"""Camera matrix and lens distortion from images of a board, with their uncertainty.

With r the errors of an image's corners and A, B their derivatives by the camera's parameters and by
the board's pose, the image's information is H = AᵀPA with score s = AᵀPr, where P projects the pose
out. From these follow the covariance from the scatter of the corners, the fit without any one
image, and the fits of two halves of the images, each to first order.

Scatter alone is too optimistic: corner errors within an image are correlated (a bent board, blur,
the lens model). The jackknife over images covers that; the larger of both is stated.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace

import cv2
import numpy as np

from calibration.intrinsics.lens import AUTO, LENSES, LensFit, LensModel, choose_lens, fit_lens
from calibration.results import data_hash
from calibration.statistics import (
    EvenSample,
    Interval,
    covariance_of,
    duplicate_views,
    jackknife,
    rms_bound,
    student_factor,
    widened,
)
from calibration.targets.boards import Board, DetectedBoard, is_mirrored
from model.cameras import Z_95, generic_camera
from model.errors import BadInput
from model.pose import Array, Pose, matrix_from_rotation_vector, read_only
from tracking.camera_model import Image, rms


@dataclass(frozen=True, slots=True, eq=False)
class Uncertainty:
    """Uncertainty of a camera's n parameters, in the order of its lens model.

    Attributes:
        covariance: From the scatter of the corners only, shape (n, n).
        half_widths: Of the 95 % intervals, shape (n,).
        without: Changes of the parameters when each image is left out, shape (images, n).
        halves: Difference between the fits to even and odd images, shape (n,).
    """

    covariance: Array
    half_widths: Array
    without: Array
    halves: Array

    @property
    def stated_covariance(self) -> Array:
        """Covariance for 95 % intervals of quantities that depend on the parameters, (n, n).

        That of the scatter, scaled up by `widened`.
        """
        return widened(self.covariance, self.without) * (_quantile(len(self.without)) / Z_95) ** 2

    def error_of(self, slopes: Array) -> float:
        """95 % error of quantities that depend on the parameters, RMS.

        The larger of scatter and jackknife, each with all its correlations: parameter by
        parameter, errors that cancel would not.

        Args:
            slopes: Their derivatives by the parameters, shape (..., n).
        """
        flat = slopes.reshape(-1, slopes.shape[-1])
        larger = max(rms_bound(one, flat) for one in (self.covariance, jackknife(self.without)))
        return _quantile(len(self.without)) / Z_95 * larger


def uncertainty_of(
    views: Sequence[DetectedBoard],
    turns: Sequence[Array],
    translations: Sequence[Array],
    matrix: Array,
    distortion: Array,
    lens: LensModel,
) -> Uncertainty:
    """The uncertainty of a fit.

    Args:
        views: The board in each image.
        turns: Rotation vectors of the board in the camera's frame, shape (3,) each, [rad].
        translations: Origins of the board there, shape (3,) each, [m].
        matrix: Camera matrix, shape (3, 3), [px].
        distortion: The lens's coefficients, shape (k,).

    Raises:
        BadInput: The images do not determine all parameters.
    """
    parts, scores, squares, residuals = [], [], 0.0, 0
    for seen, turn, translation in zip(views, turns, translations, strict=True):
        there, of_pose, of_camera = lens.slopes(seen.points, turn, translation, matrix, distortion)
        errors = (seen.corners - there).ravel()
        base = np.linalg.qr(of_pose)[0]
        left = of_camera - base @ (base.T @ of_camera)
        parts.append(left.T @ left)
        scores.append(left.T @ errors)
        squares += float(errors @ errors)
        residuals += len(errors) - 6
    information, count = np.sum(parts, axis=0), len(parts)
    inverse = covariance_of(information)
    if inverse is None:
        raise _undetermined("other parameters would explain them as well")
    by_scatter = inverse * squares / max(residuals - len(information), 1)
    without = np.array([_without(information, h, s) for h, s in zip(parts, scores, strict=True)])
    larger = np.maximum(np.diag(by_scatter), np.diag(jackknife(without)))
    return Uncertainty(
        covariance=read_only(by_scatter),
        half_widths=read_only(_quantile(count) * np.sqrt(larger)),
        without=read_only(without),
        halves=read_only(_half(parts, scores, 1) - _half(parts, scores, 0)),
    )


def _without(information: Array, part: Array, score: Array) -> Array:
    """Change of the parameters when one image is left out."""
    return np.asarray(-np.linalg.pinv(information - part, hermitian=True) @ score)


def _half(parts: Sequence[Array], scores: Sequence[Array], which: int) -> Array:
    """Change of the parameters when only the even or only the odd images are used."""
    information, score = (np.sum(one[which::2], axis=0) for one in (parts, scores))
    return np.asarray(np.linalg.pinv(information, hermitian=True) @ score)


def _quantile(count: int) -> float:
    """Two-sided quantile of Student's t for a number of images."""
    return student_factor(max(count - 1, 1))


# The fit.


LEAST_VIEWS = 4
"""Minimum number of images; forty or more, tilted up to 40°, are good."""
_FAR_OFF, _OFF = 4.0, 0.5
"""A view is rejected if its error exceeds this many times the median and this many pixels."""
_EXAMINED = 5
"""Number of images without the board that are examined for what they show instead."""
_PREVIEW = 800
"""Width of the reduced copies of images, [px]."""
NOT_FOUND = "no board was found in it"
"""Why most unused images are not used."""
_MIRRORED = "it mirrored, so the images or the board's print are mirrored"


@dataclass(frozen=True, slots=True, eq=False)
class CameraCalibration:
    """A camera's matrix and distortion, with the data behind them.

    Attributes:
        size: Width and height of the images, [px].
        matrix: Camera matrix, shape (3, 3), [px].
        distortion: The lens's coefficients, shape (k,).
        lens: The lens model.
        uncertainty: Of the parameters.
        views: Detected board in each image used, by name.
        boards: ``camera_from_board``, by image name.
        view_errors: RMS corner error of each image used, by name, [px].
        unused: Why each of the other images is not used, by name.
        data_hash: Of the corners used.
        previews: Reduced copies of the images used, by name; empty when fitted to corners.
        board: The board in the images; None when fitted to corners.
    """

    size: tuple[int, int]
    matrix: Array
    distortion: Array
    lens: LensModel
    uncertainty: Uncertainty
    views: Mapping[str, DetectedBoard]
    boards: Mapping[str, Pose]
    view_errors: Mapping[str, float]
    unused: Mapping[str, str]
    data_hash: str
    previews: Mapping[str, Image] = field(default_factory=dict)
    board: Board | None = None

    @property
    def error(self) -> float:
        """RMS error over all corners, [px]; small even when coverage is poor."""
        counts = [len(view.corners) for view in self.views.values()]
        squares = np.square(list(self.view_errors.values()))
        return float(np.sqrt(np.average(squares, weights=counts)))

    @property
    def intervals(self) -> dict[str, Interval]:
        """The camera's parameters with 95 % intervals, by the names of its lens model."""
        m, widths = self.matrix, self.uncertainty.half_widths
        numbers = [m[0, 0], m[1, 1], m[0, 2], m[1, 2], *self.distortion]
        return {
            name: Interval(float(number), float(width))
            for name, number, width in zip(self.lens.names, numbers, widths, strict=True)
        }


def fit_camera(
    pictures: Iterable[tuple[str, Image]],
    board: Board,
    unused: Mapping[str, str] | None = None,
    lens: str = AUTO,
) -> CameraCalibration:
    """Fits a camera and its lens.

    Args:
        pictures: Names and grey images of one size.
        board: The board in the images.
        unused: Images already left out, with the reasons.
        lens: One of `calibration.intrinsics.lens.LENSES`, or `AUTO`.

    Raises:
        BadInput: Image sizes differ, or too few images show the board.
    """
    views: dict[str, DetectedBoard] = {}
    previews: dict[str, Image] = {}
    left_out = dict(unused or {})
    size: tuple[int, int] | None = None
    without = EvenSample[tuple[str, Image]](_EXAMINED)
    for name, image in pictures:
        own = (image.shape[1], image.shape[0])
        size = size or own
        if own != size:
            raise BadInput(
                f"the image has {own[0]} x {own[1]} px, others {size[0]} x {size[1]} px",
                where=name,
                next_step="use images of one camera at one size",
            )
        seen = board.find(image)
        if seen is None:
            left_out[name] = NOT_FOUND
            without.add((name, image))
        else:
            views[name] = seen
            previews[name] = _reduced(image)
    shown = len(views)
    views, left_out = _without_duplicates(views, left_out)
    if size is None or len(views) < LEAST_VIEWS:
        raise _too_few(len(views), shown, left_out, board, without.chosen())
    found = calibrate_from_views(views, size, left_out, lens)
    return replace(found, previews=previews, board=board)


def refit_camera(
    first: CameraCalibration,
    pictures: Iterable[tuple[str, Image]],
    board: Board,
    lens: str = AUTO,
) -> CameraCalibration:
    """Fits a camera again, to corners detected with the lens of the first fit.

    Args:
        pictures: Its images, read again.
        board: As in the first fit.
        lens: As in `fit_camera`.

    Raises:
        BadInput: An image cannot be read again, or too few images show the board.
    """
    camera = replace(
        generic_camera(first.size),
        matrix=first.matrix,
        distortion=first.distortion,
        lens=first.lens.kind,
    )
    again = {name: board.find(image, camera) for name, image in pictures if name in first.views}
    if missing := [name for name in first.views if name not in again]:
        raise BadInput(
            "the image cannot be read again",
            where=missing[0],
            why=f"the corners of {board} depend on the lens: they are detected twice",
            next_step="pass images that can be read twice, such as a folder or a list",
        )
    views = {name: seen for name, seen in again.items() if seen is not None}
    left_out = {name: NOT_FOUND for name in again if name not in views}
    found = calibrate_from_views(views, first.size, {**first.unused, **left_out}, lens)
    previews = {name: first.previews[name] for name in found.views}
    return replace(found, previews=previews, board=board)


def _reduced(image: Image) -> Image:
    times = min(1.0, _PREVIEW / image.shape[1])
    size = (round(image.shape[1] * times), max(1, round(image.shape[0] * times)))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)


def _without_duplicates(
    views: Mapping[str, DetectedBoard], unused: Mapping[str, str]
) -> tuple[dict[str, DetectedBoard], dict[str, str]]:
    """The views without duplicates, and why others are not used."""
    corners = {
        name: dict(zip(map(tuple, seen.points.tolist()), seen.corners, strict=True))
        for name, seen in views.items()
    }
    reasons = duplicate_views(corners)
    return {k: seen for k, seen in views.items() if k not in reasons}, {**unused, **reasons}


def fit_corners(
    views: Mapping[str, DetectedBoard],
    unused: Mapping[str, str],
    size: tuple[int, int],
    lens: str,
    where: str,
) -> CameraCalibration:
    """Fits a camera to corners detected by another program.

    Args:
        unused: Images already left out, with the reasons.
        size: Width and height of the images, [px].
        lens: As in `fit_camera`.
        where: Names the source in messages.

    Raises:
        BadInput: Too few images, or corners outside them.
    """
    every = np.concatenate([seen.corners for seen in views.values()])
    low, high = every.min(axis=0), every.max(axis=0)
    views, left_out = _without_duplicates(views, unused)
    if (low < -0.5).any() or (high > np.array(size) - 0.5).any() or len(views) < LEAST_VIEWS:
        raise BadInput(
            f"{len(views)} images have corners from ({low[0]:.0f}, {low[1]:.0f}) to"
            f" ({high[0]:.0f}, {high[1]:.0f}) px; {LEAST_VIEWS} are required, within {size[0]} x"
            f" {size[1]} px",
            where=where,
            why="; ".join(f"{name} {reason}" for name, reason in list(left_out.items())[:5]),
            next_step="check the columns and the size of the images",
        )
    return calibrate_from_views(views, size, left_out, lens)


def calibrate_from_views(
    views: Mapping[str, DetectedBoard],
    size: tuple[int, int],
    unused: Mapping[str, str] | None = None,
    lens: str = AUTO,
) -> CameraCalibration:
    """Fits the camera to the board's corners in each image.

    Outlier images, such as of a moving or misdetected board, are rejected.

    Raises:
        BadInput: Too few images remain, or they do not determine the camera.
    """
    left_out, used = dict(unused or {}), dict(views)
    fit = _fit(used, size, lens)
    errors = _errors(fit, used)
    limit = max(_FAR_OFF * float(np.median(list(errors.values()))), _OFF)
    bad = {name: error for name, error in errors.items() if error > limit}
    if bad and len(used) - len(bad) >= LEAST_VIEWS:
        for name, error in bad.items():
            left_out[name] = f"has a corner error of {error:.2f} px, far more than the others"
            del used[name]
        fit = _fit(used, size, lens)
        errors = _errors(fit, used)
    return CameraCalibration(
        size=size,
        matrix=read_only(fit.matrix),
        distortion=read_only(fit.distortion),
        lens=fit.lens,
        uncertainty=uncertainty_of(
            list(used.values()),
            list(fit.turns.values()),
            list(fit.translations.values()),
            fit.matrix,
            fit.distortion,
            fit.lens,
        ),
        views=used,
        boards={
            name: Pose(fit.translations[name], matrix_from_rotation_vector(fit.turns[name]))
            for name in used
        },
        view_errors=errors,
        unused=left_out,
        data_hash=data_hash(
            name.encode() + np.round(seen.corners, 6).tobytes() for name, seen in used.items()
        ),
    )


def _fit(views: Mapping[str, DetectedBoard], size: tuple[int, int], lens: str) -> LensFit:
    with suppress(cv2.error, np.linalg.LinAlgError):
        fit = choose_lens(views, size) if lens == AUTO else fit_lens(LENSES[lens], views, size)
        if fit.finite:
            return fit
    raise _undetermined("the fit has no finite solution, as with one tilt in all images")


def _errors(fit: LensFit, views: Mapping[str, DetectedBoard]) -> dict[str, float]:
    """RMS corner error of each image, [px]."""
    return {name: float(rms(fit.residuals(name, seen))) for name, seen in views.items()}


def _undetermined(why: str) -> BadInput:
    return BadInput(
        "these images do not determine a camera",
        why=why,
        next_step="take more images, with the board tilted up to 40° in every direction",
    )


def _instead(board: Board, without: Sequence[tuple[str, Image]]) -> str:
    """What most images without the board show instead, if known."""
    shown: dict[str, list[str]] = {}
    for name, image in without:
        flipped = is_mirrored(board, image)
        if what := _MIRRORED if flipped else board.describe_other(image):
            shown.setdefault(what, []).append(name)
    if not shown:
        return ""
    what, names = max(shown.items(), key=lambda item: len(item[1]))
    verb = "shows"
    if len(names) > 1:
        verb = f"and {len(names) - 1} of {len(without) - 1} others that were examined show"
    return f"; {names[0]} {verb} {what}"


def _too_few(
    different: int,
    shown: int,
    unused: Mapping[str, str],
    board: Board,
    without: Sequence[tuple[str, Image]],
) -> BadInput:
    reasons = [f"{name} {reason}" for name, reason in unused.items()]
    more = f" and {len(reasons) - 4} more" if len(reasons) > 5 else ""
    listed = [f"expected {board}{_instead(board, without)}", *reasons[: 4 if more else 5]]
    only = f", only {different} of them different" if different < shown else ""
    check = "check the board's kind and dimensions, or " if shown < LEAST_VIEWS else ""
    return BadInput(
        f"the board was found in {shown} of {different + len(unused)} images{only};"
        f" at least {LEAST_VIEWS} are required",
        why="; ".join(listed) + more,
        next_step=f"{check}take more images of it, tilted up to 40°; 40 are recommended",
    )
