"""Lens models that a camera can be calibrated with, and how well each fits pictures held out.

Three are OpenCV's pinhole with more and more coefficients, the fourth is its fisheye model. All
share one fit, by damped least squares from OpenCV's answer or, for the fisheye, from several focal
lengths.

Source: Brown, "Close-range camera calibration", 1971 (five coefficients); Claus & Fitzgibbon, "A
rational function lens distortion model", CVPR 2005; Weng et al., IEEE TPAMI 14(10), 1992 (thin
prism); Kannala & Brandt, IEEE TPAMI 28(8), 2006 (fisheye).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np

from calibration.targets.boards import DetectedBoard
from model.files.camera_file import LensName
from model.pose import Array
from tracking.camera_model import rays_of

_MATRIX = ("fx_px", "fy_px", "cx_px", "cy_px")
_FIVE = ("k1", "k2", "p1", "p2", "k3")
_EIGHT = (*_FIVE, "k4", "k5", "k6")


@dataclass(frozen=True, slots=True)
class LensModel:
    """How a lens bends rays.

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
        """The camera's numbers, matrix first, in the order of every array about them."""
        return (*_MATRIX, *self.coefficients)

    @property
    def kind(self) -> LensName:
        """The key `lens` of the rig file."""
        return "fisheye" if self.fisheye else "pinhole"

    def slopes(
        self, points: Array, turn: Array, place: Array, matrix: Array, distortion: Array
    ) -> tuple[Array, Array, Array]:
        """Where points are seen, and how that depends on pose and camera.

        Args:
            points: Shape (n, 3), [m].
            turn: Rotation vector into the camera's frame, shape (3,), [rad].
            place: Translation into it, shape (3,), [m].
            matrix: Camera matrix, shape (3, 3), [px].
            distortion: Coefficients, shape (k,).

        Returns:
            Pixels, shape (n, 2); derivatives by the pose's six numbers, shape (2n, 6), and by the
            camera's, shape (2n, 4 + k).
        """
        if self.fisheye:
            seen, by = cv2.fisheye.projectPoints(
                np.ascontiguousarray(points).reshape(-1, 1, 3), turn, place, matrix, distortion
            )
            pose, camera = slice(8, 14), slice(0, 8)
        else:
            seen, by = cv2.projectPoints(points, turn, place, matrix, distortion)
            pose, camera = slice(0, 6), slice(6, 10 + len(self.coefficients))
        derivatives = np.asarray(by, dtype=np.float64)
        pixels = np.asarray(seen, dtype=np.float64).reshape(-1, 2)
        return pixels, derivatives[:, pose], derivatives[:, camera]


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
"""By name; the first one is tried first."""
LensChoice = Literal["auto", "five", "rational", "thin-prism", "fisheye"]
AUTO = "auto"
"""In place of a name: the model that fits held-out pictures best."""
FOLDS = 4
"""Parts of the pictures that are held out in turn."""
GAIN = 0.03
"""Share of the held-out error by which another model must be better than five coefficients."""
RADIAL = 0.02
"""Share of the squared errors in the radial pattern from which other models are tried."""
_RINGS = 12


@dataclass(frozen=True, slots=True, eq=False)
class LensFit:
    """A camera, and where the board was.

    Attributes:
        lens: The model.
        matrix: Camera matrix, shape (3, 3), [px].
        distortion: Coefficients, shape (k,).
        turns: Rotation vectors of the board by picture, shape (3,) each, [rad].
        places: Its origins, shape (3,) each, [m].
    """

    lens: LensModel
    matrix: Array
    distortion: Array
    turns: dict[str, Array]
    places: dict[str, Array]

    def residuals(self, name: str, seen: DetectedBoard) -> Array:
        """Corners less where they are expected, shape (n, 2), [px]."""
        turn, place = self.turns[name], self.places[name]
        there = self.lens.slopes(seen.points, turn, place, self.matrix, self.distortion)[0]
        return np.asarray(seen.corners - there)

    @property
    def finite(self) -> bool:
        """Whether it is an answer."""
        known = np.isfinite(self.matrix).all() and np.isfinite(self.distortion).all()
        return bool(known and self.matrix[0, 0] > 0.0 and self.matrix[1, 1] > 0.0)


def fit_lens(lens: LensModel, views: Mapping[str, DetectedBoard], size: tuple[int, int]) -> LensFit:
    """The camera that explains views best, by least squares.

    Raises:
        cv2.error: OpenCV finds no answer.
        np.linalg.LinAlgError: There is none.
    """
    if not lens.fisheye:
        return _fit_pinhole(lens, views, size)
    fits = []
    for share in (0.3, 0.5, 0.8):  # focal length in widths: views of 180°, 110° and 64°
        focal = share * size[0]
        matrix = np.array([[focal, 0.0, size[0] / 2], [0.0, focal, size[1] / 2], [0.0, 0.0, 1.0]])
        try:
            fits.append(_polished(lens, views, matrix, np.zeros(4)))
        except (cv2.error, np.linalg.LinAlgError):
            continue
    if not fits:
        raise np.linalg.LinAlgError("no focal length leads to an answer")
    return min(fits, key=lambda fit: _squares(fit, views))


def _fit_pinhole(
    lens: LensModel, views: Mapping[str, DetectedBoard], size: tuple[int, int]
) -> LensFit:
    points = [seen.points.astype(np.float32).reshape(-1, 1, 3) for seen in views.values()]
    corners = [seen.corners.astype(np.float32).reshape(-1, 1, 2) for seen in views.values()]
    _, matrix, distortion, turns, places = cv2.calibrateCamera(
        points, corners, size, np.eye(3), np.zeros(0), flags=lens.flags
    )
    return LensFit(
        lens,
        np.asarray(matrix, dtype=np.float64),
        np.ravel(distortion)[: len(lens.coefficients)].astype(np.float64),
        {name: np.ravel(turn) for name, turn in zip(views, turns, strict=True)},
        {name: np.ravel(place) for name, place in zip(views, places, strict=True)},
    )


def _polished(
    lens: LensModel, views: Mapping[str, DetectedBoard], matrix: Array, distortion: Array
) -> LensFit:
    """Damped least squares over camera and poses, the poses eliminated picture by picture."""
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
            seen.points, fit.turns[name], fit.places[name], fit.matrix, fit.distortion
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
        {name: fit.places[name] + move[3:] for name, move in moves.items()},
    )


def _squares(fit: LensFit, views: Mapping[str, DetectedBoard]) -> float:
    total = sum(float(np.sum(fit.residuals(name, seen) ** 2)) for name, seen in views.items())
    return total if np.isfinite(total) else np.inf


def _first_pose(lens: LensModel, seen: DetectedBoard, matrix: Array, distortion: Array) -> Array:
    """Rotation vector and place of a board, from rays; shape (6,)."""
    rays = rays_of(lens.kind, matrix, distortion, seen.corners)
    _, turn, place = cv2.solvePnP(seen.points, rays, np.eye(3), np.zeros(0))
    return np.concatenate([np.ravel(turn), np.ravel(place)]).astype(np.float64)


def held_out_errors(
    lens: LensModel, views: Mapping[str, DetectedBoard], size: tuple[int, int]
) -> dict[str, float]:
    """Mean squared error of each picture by fits that have not seen it, [px²].

    The board's pose in it is fitted, the camera is not. Infinite where there is no fit.
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
    """Mean squared error of a picture that a fit has not seen, its pose fitted, [px²]."""
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
    """The fit of the lens model that suits pictures best.

    Five coefficients, unless their errors show a radial pattern (`RADIAL`) and another model has a
    held-out error (RMS) lower by `GAIN`, and in most pictures: the mean of the logarithms of their
    errors' ratios is beyond two of its standard errors. Of several such models that with the fewest
    numbers whose error is within `GAIN` of the best.

    Raises:
        cv2.error: OpenCV finds no answer.
    """
    plain = LENSES["five"]
    first = fit_lens(plain, views, size)
    rest = [first.residuals(name, seen) for name, seen in views.items()]
    shown = np.concatenate([seen.corners for seen in views.values()])
    pattern = radial_share(shown, np.concatenate(rest), first.matrix)
    if first.finite and (pattern < RADIAL or len(views) < 2 * FOLDS):
        return first
    errors = {name: _listed(held_out_errors(lens, views, size)) for name, lens in LENSES.items()}
    rms = {name: float(np.sqrt(np.mean(each))) for name, each in errors.items()}
    better = [
        name for name in LENSES if name != "five" and _is_better(errors[name], errors["five"])
    ]
    least = min((rms[name] for name in better), default=0.0)
    near = [LENSES[name] for name in better if rms[name] <= least * (1.0 + GAIN)]
    lens = min(near, key=lambda one: len(one.names), default=plain)
    return first if lens is plain else fit_lens(lens, views, size)


def _listed(errors: Mapping[str, float]) -> Array:
    return np.array(list(errors.values()))


def _is_better(mine: Array, plain: Array) -> bool:
    if not np.isfinite(mine).all():
        return False
    if not np.isfinite(plain).all():
        return True
    gains = np.log(np.maximum(plain, 1e-12) / np.maximum(mine, 1e-12))
    doubt = 2.0 * float(np.std(gains, ddof=1)) / np.sqrt(len(gains))
    by_share = float(np.mean(mine)) < float(np.mean(plain)) * (1.0 - GAIN) ** 2
    return by_share and float(np.mean(gains)) > doubt


def radial_share(corners: Array, errors: Array, matrix: Array) -> float:
    """Share of squared errors that is a function of the distance from the principal point.

    The mean radial error of each of twelve rings with as many corners is such a function; what
    chance adds to it is taken off.

    Args:
        corners: Shape (n, 2), [px].
        errors: Of them, shape (n, 2), [px].
        matrix: Camera matrix, shape (3, 3), [px].
    """
    away = corners - matrix[:2, 2]
    distance = np.linalg.norm(away, axis=1)
    radial = np.sum(errors * away, axis=1) / np.maximum(distance, 1e-9)
    rings: Sequence[Array] = np.array_split(radial[np.argsort(distance)], _RINGS)
    if min(len(ring) for ring in rings) < 2:
        return 0.0
    by_chance = sum(float(np.var(ring, ddof=1)) for ring in rings)
    found = sum(len(ring) * float(np.mean(ring)) ** 2 for ring in rings)
    return max(0.0, found - by_chance) / max(float(np.sum(errors**2)), 1e-300)
