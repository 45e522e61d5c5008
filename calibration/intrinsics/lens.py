"""Lens models for camera calibration, their fit and their selection by cross-validation.

Three are OpenCV's pinhole model with increasing numbers of coefficients, the fourth is its fisheye
model. Pinhole models are fitted by OpenCV, the fisheye by damped least squares from several focal
lengths.

Source: Brown, "Close-range camera calibration", 1971 (five coefficients); Claus & Fitzgibbon, "A
rational function lens distortion model", CVPR 2005; Weng et al., IEEE TPAMI 14(10), 1992 (thin
prism); Kannala & Brandt, IEEE TPAMI 28(8), 2006 (fisheye).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from calibration.targets.boards import DetectedBoard
from model.files.camera_file import LensName
from model.pose import Array
from tracking.camera_model import rays_of

_MATRIX = ("fx_px", "fy_px", "cx_px", "cy_px")
_FIVE = ("k1", "k2", "p1", "p2", "k3")
_EIGHT = (*_FIVE, "k4", "k5", "k6")


@dataclass(frozen=True, slots=True)
class LensModel:
    """A lens distortion model.

    Attributes:
        name: For options and messages.
        fisheye: Whether it is the fisheye model; else a pinhole.
        flags: Of OpenCV's fit.
        coefficients: Names, in OpenCV's order.
    """

    name: str
    fisheye: bool
    flags: int
    coefficients: tuple[str, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the camera's parameters, matrix first, in the order of all arrays."""
        return (*_MATRIX, *self.coefficients)

    @property
    def kind(self) -> LensName:
        """Value of the key `lens` in the rig file."""
        return "fisheye" if self.fisheye else "pinhole"

    def slopes(
        self, points: Array, turn: Array, translation: Array, matrix: Array, distortion: Array
    ) -> tuple[Array, Array, Array]:
        """Projections of points, with derivatives by pose and camera.

        Args:
            points: Shape (n, 3), [m].
            turn: Rotation vector into the camera's frame, shape (3,), [rad].
            translation: Into the camera's frame, shape (3,), [m].
            matrix: Camera matrix, shape (3, 3), [px].
            distortion: Coefficients, shape (k,).

        Returns:
            Pixels, shape (n, 2); derivatives by the pose's parameters, shape (2n, 6), and by the
            camera's, shape (2n, 4 + k).
        """
        if self.fisheye:
            depths = points @ cv2.Rodrigues(turn)[0][2] + translation[2]
            if depths.min() <= 0.0:
                return _wide_slopes(points, turn, translation, matrix, distortion)
            flat = np.ascontiguousarray(points).reshape(-1, 1, 3)
            seen, by = cv2.fisheye.projectPoints(flat, turn, translation, matrix, distortion)
            pose, camera = slice(8, 14), slice(0, 8)
        else:
            seen, by = cv2.projectPoints(points, turn, translation, matrix, distortion)
            pose, camera = slice(0, 6), slice(6, 10 + len(self.coefficients))
        derivatives = np.asarray(by, dtype=np.float64)
        pixels = np.asarray(seen, dtype=np.float64).reshape(-1, 2)
        return pixels, derivatives[:, pose], derivatives[:, camera]


_ODD = np.arange(1, 10, 2)
"""Powers of the angle in the fisheye's radius."""


def _wide_slopes(
    points: Array, turn: Array, translation: Array, matrix: Array, distortion: Array
) -> tuple[Array, Array, Array]:
    """As `LensModel.slopes` of a fisheye, for rays up to 180° off the axis.

    OpenCV divides by the depth: beyond 90° it projects to the opposite side of the image.
    """
    rotation, by_vector = cv2.Rodrigues(np.asarray(turn, dtype=np.float64))
    x, y, depth = (points @ rotation.T + translation).T
    across = np.hypot(x, y)
    off_axis = across > 1e-12 * np.abs(depth)
    outward = np.column_stack([x, y]) / np.where(off_axis, across, np.inf)[:, None]
    angle, squared = np.arctan2(across, depth), across**2 + depth**2
    powers = angle[:, None] ** _ODD
    coefficients = np.array([1.0, *distortion])
    radius, slope = powers @ coefficients, angle[:, None] ** (_ODD - 1) @ (_ODD * coefficients)
    share = np.where(off_axis, radius / np.where(off_axis, across, 1.0), 1.0 / depth)
    along = outward[:, :, None] * outward[:, None, :]
    by_point = np.empty((len(points), 2, 3))
    by_point[..., :2] = share[:, None, None] * (np.eye(2) - along)
    by_point[..., :2] += (slope * depth / squared)[:, None, None] * along
    by_point[..., 2] = -(slope * across / squared)[:, None] * outward
    focal = np.array([matrix[0, 0], matrix[1, 1]])
    by_point *= focal[:, None]
    by_turn = by_point @ (points @ by_vector.reshape(3, 3, 3).transpose(0, 2, 1)).transpose(1, 2, 0)
    image = radius[:, None] * outward
    by_camera = np.zeros((len(points), 2, 8))
    by_camera[:, [0, 1], [0, 1]], by_camera[:, [0, 1], [2, 3]] = image, 1.0
    by_camera[..., 4:] = (focal * outward)[..., None] * powers[:, None, 1:]
    by_pose = np.concatenate([by_turn, by_point], axis=2).reshape(-1, 6)
    return image * focal + matrix[:2, 2], by_pose, by_camera.reshape(-1, 8)


LENSES = {
    lens.name: lens
    for lens in (
        LensModel("five", False, 0, _FIVE),
        LensModel("rational", False, cv2.CALIB_RATIONAL_MODEL, _EIGHT),
        LensModel(
            "thin-prism",
            False,
            cv2.CALIB_RATIONAL_MODEL | cv2.CALIB_THIN_PRISM_MODEL,
            (*_EIGHT, "s1", "s2", "s3", "s4"),
        ),
        LensModel("fisheye", True, 0, ("k1", "k2", "k3", "k4")),
    )
}
"""Lens models by name; the first is tried first."""
LensChoice = Literal["auto", "five", "rational", "thin-prism", "fisheye"]
AUTO = "auto"
"""Instead of a name: the model that fits held-out images best."""
FOLDS = 4
"""Number of folds of the cross-validation."""
GAIN = 0.03
"""Relative improvement of the held-out error that another model needs over ``five``."""
NO_WORSE = 0.02
"""Relative excess over the lowest held-out error up to which fewer parameters are preferred."""
RADIAL = 0.02
"""Share of radial errors from which other models are tried; see `radial_share`."""
_POOR = 0.5
"""Median corner error of ``five`` from which other models are tried as well, [px]."""
_LEAST_DEPTH = 0.05
"""Of a corner's direction in a camera rotated towards the board: about 87° off its axis."""
_RINGS = 12
_CLIP = 3.0


@dataclass(frozen=True, slots=True, eq=False)
class LensFit:
    """A fitted camera and the board's poses.

    Attributes:
        lens: The model.
        matrix: Camera matrix, shape (3, 3), [px].
        distortion: Coefficients, shape (k,).
        turns: Rotation vectors of the board by image, shape (3,) each, [rad].
        translations: Origins of the board by image, shape (3,) each, [m].
    """

    lens: LensModel
    matrix: Array
    distortion: Array
    turns: dict[str, Array]
    translations: dict[str, Array]

    def residuals(self, name: str, seen: DetectedBoard) -> Array:
        """Detected minus projected corners, shape (n, 2), [px]."""
        turn, translation = self.turns[name], self.translations[name]
        there = self.lens.slopes(seen.points, turn, translation, self.matrix, self.distortion)[0]
        return np.asarray(seen.corners - there)

    @property
    def finite(self) -> bool:
        """Whether the parameters are finite and the focal lengths positive."""
        known = np.isfinite(self.matrix).all() and np.isfinite(self.distortion).all()
        return bool(known and self.matrix[0, 0] > 0.0 and self.matrix[1, 1] > 0.0)


def fit_lens(lens: LensModel, views: Mapping[str, DetectedBoard], size: tuple[int, int]) -> LensFit:
    """The least-squares fit of a camera to views.

    Raises:
        cv2.error: OpenCV finds no solution.
        np.linalg.LinAlgError: There is no solution.
    """
    if not lens.fisheye:
        return _fit_pinhole(lens, views, size)
    fits = []
    for share in (0.3, 0.5, 0.8):  # focal length in widths: views of 180°, 110° and 64°
        focal = share * size[0]
        matrix = np.array([[focal, 0.0, size[0] / 2], [0.0, focal, size[1] / 2], [0.0, 0.0, 1.0]])
        try:
            fits.append(_fit_from(lens, views, matrix, np.zeros(4)))
        except (cv2.error, np.linalg.LinAlgError):
            continue
    if not fits:
        raise np.linalg.LinAlgError("no initial focal length leads to a solution")
    return min(fits, key=lambda fit: _squares(fit, views))


def _fit_pinhole(
    lens: LensModel, views: Mapping[str, DetectedBoard], size: tuple[int, int]
) -> LensFit:
    points = [seen.points.astype(np.float32).reshape(-1, 1, 3) for seen in views.values()]
    corners = [seen.corners.astype(np.float32).reshape(-1, 1, 2) for seen in views.values()]
    _, matrix, distortion, turns, translations = cv2.calibrateCamera(
        points, corners, size, np.eye(3), np.zeros(0), flags=lens.flags
    )
    return LensFit(
        lens,
        np.asarray(matrix, dtype=np.float64),
        np.ravel(distortion)[: len(lens.coefficients)].astype(np.float64),
        {name: np.ravel(turn) for name, turn in zip(views, turns, strict=True)},
        {name: np.ravel(shift) for name, shift in zip(views, translations, strict=True)},
    )


def _fit_from(
    lens: LensModel, views: Mapping[str, DetectedBoard], matrix: Array, distortion: Array
) -> LensFit:
    """Damped least squares over camera and poses, with the poses eliminated."""
    poses = {name: _first_pose(lens, seen, matrix, distortion) for name, seen in views.items()}
    fit = LensFit(
        lens,
        matrix,
        distortion,
        {name: pose[:3] for name, pose in poses.items()},
        {name: pose[3:] for name, pose in poses.items()},
    )
    best, damping = _squares(fit, views), 1e-3
    for _ in range(100):
        moved = _stepped(fit, views, damping)
        squares = _squares(moved, views) if moved.finite else np.inf
        if squares < best:
            done = best - squares < 1e-10 * best
            fit, best, damping = moved, squares, damping / 5.0
            if done:
                break
        else:
            damping *= 8.0
            if damping > 1e10:
                break
    return fit


def _stepped(fit: LensFit, views: Mapping[str, DetectedBoard], damping: float) -> LensFit:
    lens, count = fit.lens, 4 + len(fit.distortion)
    normal, score, parts = np.zeros((count, count)), np.zeros(count), {}
    for name, seen in views.items():
        there, of_pose, of_camera = lens.slopes(
            seen.points, fit.turns[name], fit.translations[name], fit.matrix, fit.distortion
        )
        errors = (seen.corners - there).ravel()
        own = of_pose.T @ of_pose
        own[np.diag_indices(6)] *= 1.0 + damping
        cross, alone = of_pose.T @ of_camera, of_pose.T @ errors
        parts[name] = (own, cross, alone)
        solved = np.linalg.solve(own, np.column_stack([cross, alone]))
        normal += of_camera.T @ of_camera - cross.T @ solved[:, :-1]
        score += of_camera.T @ errors - cross.T @ solved[:, -1]
    normal[np.diag_indices(count)] *= 1.0 + damping
    step = np.linalg.solve(normal, score)
    matrix = fit.matrix.copy()
    matrix[[0, 1, 0, 1], [0, 1, 2, 2]] += step[:4]
    moves = {n: np.linalg.solve(o, a - c @ step) for n, (o, c, a) in parts.items()}
    return LensFit(
        lens,
        matrix,
        fit.distortion + step[4:],
        {name: fit.turns[name] + move[:3] for name, move in moves.items()},
        {name: fit.translations[name] + move[3:] for name, move in moves.items()},
    )


def _squares(fit: LensFit, views: Mapping[str, DetectedBoard]) -> float:
    total = sum(float(np.sum(fit.residuals(name, seen) ** 2)) for name, seen in views.items())
    return total if np.isfinite(total) else np.inf


def _first_pose(lens: LensModel, seen: DetectedBoard, matrix: Array, distortion: Array) -> Array:
    """Initial rotation vector and translation of a board, from rays; shape (6,).

    It is found in a camera rotated towards the board: near 90° off the axis, rays meet the image
    plane so far away that a few corners would decide.
    """
    rays = np.insert(rays_of(lens.kind, matrix, distortion, seen.corners), 2, 1.0, axis=1)
    if not np.isfinite(rays).all():
        raise np.linalg.LinAlgError("the lens has no rays through the corners")
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    middle = rays.mean(axis=0)
    towards = Rotation.align_vectors([[0.0, 0.0, 1.0]], [middle])[0]
    facing = towards.apply(rays)
    plane = facing[:, :2] / np.maximum(facing[:, 2:], _LEAST_DEPTH)
    _, turn, translation = cv2.solvePnP(seen.points, plane, np.eye(3), np.zeros(0))
    back = towards.inv()
    turns = (back * Rotation.from_rotvec(np.ravel(turn))).as_rotvec()
    return np.concatenate([turns, back.apply(np.ravel(translation))])


def held_out_errors(
    lens: LensModel, views: Mapping[str, DetectedBoard], size: tuple[int, int]
) -> dict[str, float]:
    """Mean squared error of each held-out image, [px²].

    The board's pose is fitted to it, the camera is not. Infinite where there is no fit.
    """
    names = list(views)
    errors: dict[str, float] = {}
    for fold in range(FOLDS):
        rest = {name: views[name] for k, name in enumerate(names) if k % FOLDS != fold}
        fit = None
        with suppress(cv2.error, np.linalg.LinAlgError):
            fit = fit_lens(lens, rest, size)
        for name in names[fold::FOLDS]:
            errors[name] = np.inf if fit is None else error_of(fit, views[name])
    return {name: errors[name] for name in names}


def error_of(fit: LensFit, seen: DetectedBoard) -> float:
    """Mean squared error of a held-out image, with its pose fitted, [px²]."""
    try:
        pose = _first_pose(fit.lens, seen, fit.matrix, fit.distortion)
        for _ in range(5):
            there, of_pose, _ = fit.lens.slopes(
                seen.points, pose[:3], pose[3:], fit.matrix, fit.distortion
            )
            errors = (seen.corners - there).ravel()
            pose = pose + np.linalg.lstsq(of_pose, errors, rcond=None)[0]
    except (cv2.error, np.linalg.LinAlgError):
        return np.inf
    mean = 2.0 * float(np.mean(errors**2))
    return mean if np.isfinite(mean) else np.inf


def choose_lens(views: Mapping[str, DetectedBoard], size: tuple[int, int]) -> LensFit:
    """The fit of the lens model selected by cross-validation.

    Five coefficients, unless their errors show a radial pattern (`RADIAL`) or are large, such as
    those of a lens wider than 180°, and another model has held-out errors lower by `GAIN` and by
    two standard errors, in the geometric mean over the images, so that a few bad images, equally
    bad for every model, do not hide the others. Of several such models, the one with the fewest
    parameters whose error is within `NO_WORSE` of the best.

    Raises:
        cv2.error: OpenCV finds no solution.
    """
    plain = LENSES["five"]
    first = fit_lens(plain, views, size)
    rest = np.concatenate([first.residuals(name, seen) for name, seen in views.items()])
    shown = np.concatenate([seen.corners for seen in views.values()])
    poor = float(np.median(np.linalg.norm(rest, axis=1))) > _POOR
    explained = radial_share(shown, rest, first.matrix) < RADIAL and not poor
    if first.finite and (explained or len(views) < 2 * FOLDS):
        return first
    errors = {
        name: _log_errors(held_out_errors(lens, views, size)) for name, lens in LENSES.items()
    }
    mean = {name: float(np.mean(each)) for name, each in errors.items()}
    better = [
        name for name in LENSES if name != "five" and _is_better(errors[name], errors["five"])
    ]
    least = min((mean[name] for name in better), default=0.0)
    near = [LENSES[name] for name in better if mean[name] <= least + np.log1p(NO_WORSE)]
    lens = min(near, key=lambda one: len(one.names), default=plain)
    return first if lens is plain else fit_lens(lens, views, size)


def _log_errors(squared: Mapping[str, float]) -> Array:
    return np.log(np.maximum(list(squared.values()), 1e-24)) / 2.0


def _is_better(mine: Array, plain: Array) -> bool:
    if not np.isfinite(mine).all():
        return False
    if not np.isfinite(plain).all():
        return True
    gains = plain - mine
    margin = 2.0 * float(np.std(gains, ddof=1)) / math.sqrt(len(gains))
    least = -math.log1p(-GAIN)
    return float(np.mean(gains)) > max(margin, least)


def radial_share(corners: Array, errors: Array, matrix: Array) -> float:
    """Share of squared errors that is a function of the distance from the principal point.

    It is estimated from the mean radial error in twelve rings of equal numbers of corners, less the
    part expected by chance. Errors above `_CLIP` medians are shortened to that: a few bad images
    must not hide the pattern of the others.

    Args:
        corners: Shape (n, 2), [px].
        errors: Of them, shape (n, 2), [px].
        matrix: Camera matrix, shape (3, 3), [px].
    """
    away = corners - matrix[:2, 2]
    sizes = np.linalg.norm(errors, axis=1)
    most = _CLIP * float(np.median(sizes))
    errors = errors * np.minimum(1.0, most / np.maximum(sizes, 1e-300))[:, None]
    distance = np.linalg.norm(away, axis=1)
    radial = np.sum(errors * away, axis=1) / np.maximum(distance, 1e-9)
    rings: Sequence[Array] = np.array_split(radial[np.argsort(distance)], _RINGS)
    if min(len(ring) for ring in rings) < 2:
        return 0.0
    by_chance = sum(float(np.var(ring, ddof=1)) for ring in rings)
    found = sum(len(ring) * float(np.mean(ring)) ** 2 for ring in rings)
    return max(0.0, found - by_chance) / max(float(np.sum(errors**2)), 1e-300)
