"""Quality of a camera calibration: coverage, errors in millimetres, verdict."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from calibration.intrinsics.calibrate import CameraCalibration
from calibration.intrinsics.lens import LENSES, RADIAL, radial_share
from calibration.results import CalibrationVerdict, Issue, beyond
from calibration.targets.boards import Charuco
from calibration.targets.grids import TagGrid
from model.errors import BadInput
from model.pose import Array, rotation_vector_from_matrix
from tracking.camera_model import rays_of, rms

CELLS = (8, 6)
"""Columns and rows of the coverage map."""
GOOD_VIEWS, GOOD_COVERAGE, GOOD_TILT, GOOD_ERROR = 12, 0.6, 20.0, 1.0
"""Required images, share of the map, tilt to either side [deg], reprojection error [px]."""
GOOD_PIXELS = 1.0
"""Required error of points over the whole image, 95 %, [px]; unlike millimetres, it does not depend
on the stated size of the squares."""
FULL_COVERAGE = 0.9
"""Share of the map beyond which more coverage gains nothing."""
EDGES = "bring the board near the edges and corners of the image"
ENOUGH_VIEWS = 40
MORE = f"take more images: {ENOUGH_VIEWS} are recommended"
NEARER = "take them again with the board filling more of the image, sharp and held still"
"""Used when there are enough images, as more like them gain little."""
_EXPLAINED = 0.2
"""Share of the squared errors from which another shape of the board is reported."""
_OTHER_MARKER = 0.1
"""Relative difference from which another size of the markers is reported."""
_SEEN = 0.3
"""RMS corner error below which the lens model is not questioned, [px]."""
_SIDES = (("left", 0, 0), ("right", 0, -1), ("top", 1, 0), ("bottom", 1, -1))


@dataclass(frozen=True, slots=True, eq=False)
class CameraQuality:
    """Quality of a camera calibration.

    Attributes:
        verdict: The verdict.
        coverage: Number of corners in each cell of the image, shape `CELLS`.
        tilts: Angle of the board to the image plane in each image, about the x and y axes, shape
            (images, 2), [deg].
        distance: Distance for which the errors are stated, [m].
        nearest: Smallest distance of a board, [m]; proportional to the stated size of the squares.
        farthest: Largest distance of a board, [m].
        halves: RMS distance over the image between points at that distance by the fits to two
            halves of the images, [m].
        bow: Deviation of the board from flat, highest to lowest, [m].
        bent: Share of the squared errors of the corners that this bow explains.
        radial: Share of them that is a function of the distance from the principal point.
    """

    verdict: CalibrationVerdict
    coverage: Array
    tilts: Array
    distance: float
    nearest: float
    farthest: float
    halves: float
    bow: float
    bent: float
    radial: float

    @property
    def covered(self) -> float:
        """Share of the cells with corners."""
        return float(np.mean(self.coverage > 0))

    def facts(self, found: CameraCalibration) -> list[tuple[str, str]]:
        """Human-readable details beside the estimates."""
        return [
            ("lens", f"model {found.lens.name}, {len(found.distortion)} coefficients"),
            ("reprojection", f"{found.error:.3f} px RMS in {len(found.views)} images"),
            (
                "board distance",
                f"{self.nearest:.3g} to {self.farthest:.3g} m; if not, the sizes are wrong",
            ),
            ("covered", f"{self.covered:.0%} of the image; {FULL_COVERAGE:.0%} or more is good"),
            (
                "precision",
                f"{self.verdict.error * 1e3:.2g} mm at {self.distance:.2f} m (95 %); two halves"
                f" of the images differ by {self.halves * 1e3:.2g} mm",
            ),
        ]


def judge_camera(
    result: CameraCalibration, wanted: float, distance: float | None = None
) -> CameraQuality:
    """Assesses a calibration.

    Args:
        wanted: Required error, [m].
        distance: Working distance of the camera, [m]; that of the boards when left out. As that
        depends on the stated size of the squares, pixels are assessed as well then.

    Raises:
        BadInput: The fitted lens has no ray through a part of the image.
    """
    away = [float(np.linalg.norm(pose.position)) for pose in result.boards.values()]
    distance_given = distance is not None
    distance = float(np.median(away)) if distance is None else distance
    coverage, tilts = _coverage(result), _tilts(result)
    slopes = _without_rotation(*_grid_slopes(result))
    scale = distance / float(np.sqrt(result.matrix[0, 0] * result.matrix[1, 1]))
    error = scale * np.sqrt(2.0) * result.uncertainty.error_of(slopes)  # of both axes
    halves = scale * float(rms(slopes @ result.uncertainty.halves))
    if not np.isfinite([error, halves]).all():
        raise _unreached(result)
    bow, bent = bow_of(result)
    radial = radial_share(*corner_errors(result), result.matrix)
    issues = [
        *_size_issues(result),
        *_image_issues(result, coverage, tilts),
        *_bow_issues(bow, bent),
        *_lens_issues(result, radial),
        *_error_issues(result, coverage, error, halves, wanted, distance),
    ]
    where = f"at {distance:.2g} m"
    if not distance_given:
        where += f", if the boards were {min(away):.2g} to {max(away):.2g} m away"
        if not error / scale <= GOOD_PIXELS:
            what = (
                f"points are seen within {error / scale:.2g} px; {GOOD_PIXELS:.0f} px is required"
            )
            step = f"{_more(result)}, or pass --distance-m, in Python distance="
            issues.append(Issue(what, step))
    verdict = CalibrationVerdict.of(error, wanted, where, issues)
    nearest, farthest = min(away), max(away)
    return CameraQuality(
        verdict, coverage, tilts, distance, nearest, farthest, halves, bow, bent, radial
    )


def _unreached(result: CameraCalibration) -> BadInput:
    other = "" if result.lens.name == "five" else ", or fit fewer coefficients with `lens='five'`"
    return BadInput(
        f"the fitted lens ({result.lens.name}) has no ray through a part of the image",
        why="the corners do not determine it there, as with the board always in the middle",
        next_step=f"{EDGES}{other}",
    )


def _coverage(result: CameraCalibration) -> Array:
    corners = np.concatenate([seen.corners for seen in result.views.values()])
    limits = [[0.0, result.size[0]], [0.0, result.size[1]]]
    counts, _, _ = np.histogram2d(corners[:, 0], corners[:, 1], bins=CELLS, range=limits)
    return np.asarray(counts)


def _tilts(result: CameraCalibration) -> Array:
    """Tilt of the board's normal to the optical axis, about the image's axes, [deg]."""
    normals = np.array([pose.rotation[:, 2] for pose in result.boards.values()])
    normals *= np.where(normals[:, 2:] < 0.0, -1.0, 1.0)
    return np.asarray(np.degrees(np.arctan2(normals[:, [1, 0]], normals[:, 2:])))


def image_grid(size: tuple[int, int]) -> Array:
    """Pixels all over an image, shape (81, 2)."""
    across = np.linspace(0.05, 0.95, 9)
    return np.array([(x * size[0], y * size[1]) for x in across for y in across])


def pixel_uncertainty(result: CameraCalibration, pixels: Array) -> Array:
    """Half widths of the 95 % intervals of points at given pixels, [px].

    The rotation that fits best over the whole image is removed.

    Args:
        pixels: Shape (n, 2), [px].

    Returns:
        Shape (n,).
    """
    over, turns = (part.reshape(-1, part.shape[-1]) for part in _grid_slopes(result))
    as_turns = np.linalg.lstsq(turns, over, rcond=None)[0]
    own, own_turns = _slopes(result, pixels)
    slopes = own - own_turns @ as_turns
    each = [result.uncertainty.error_of(slope) for slope in slopes]
    return np.asarray(np.sqrt(2.0) * np.array(each))  # of both axes


def _grid_slopes(result: CameraCalibration) -> tuple[Array, Array]:
    return _slopes(result, image_grid(result.size))


def _slopes(result: CameraCalibration, pixels: Array) -> tuple[Array, Array]:
    """Derivatives of pixels by the camera's parameters and rotation.

    Args:
        pixels: Shape (rays, 2), [px].

    Returns:
        By the n parameters, shape (rays, 2, n), and by the rotation, shape (rays, 2, 3).
    """
    lens = result.lens
    flat = rays_of(lens.kind, result.matrix, result.distortion, pixels)
    rays, nothing = np.column_stack([flat, np.ones(len(pixels))]), np.zeros(3)
    _, pose, camera = lens.slopes(rays, nothing, nothing, result.matrix, result.distortion)
    return camera.reshape(len(pixels), 2, -1), pose[:, :3].reshape(len(pixels), 2, 3)


def _without_rotation(slopes: Array, turns: Array) -> Array:
    """Derivatives with the equivalent camera rotation projected out, shape as ``slopes``.

    The extrinsics are estimated with the same parameters later, and their rotation compensates for
    that part: cx and p2, for example, trade against a rotation about y. The rotation is the best
    fit over the image.

    Source: mrcal, "Projection uncertainty and the implied transformation" (documentation), Kogan.
    """
    base = np.linalg.qr(turns.reshape(-1, 3))[0]
    flat = slopes.reshape(-1, slopes.shape[-1])
    return np.asarray((flat - base @ (base.T @ flat)).reshape(slopes.shape))


def bow_of(result: CameraCalibration) -> tuple[float, float]:
    """Bow of the board, and the share of the corners' errors that it explains.

    The board's height is a quadratic form of its coordinates, the same in all images.

    Returns:
        Highest to lowest, [m], and a share of the squared errors.
    """
    points = np.concatenate([seen.points[:, :2] for seen in result.views.values()])
    middle, half = points.mean(axis=0), np.ptp(points, axis=0) / 2.0

    def bows(own: Array) -> Array:
        heights = _bow_shapes((own[:, :2] - middle) / half)
        return np.asarray(heights[:, None, :] * np.array([0.0, 0.0, 1.0])[:, None])

    change, share = _board_change(result, bows)
    heights = _bow_shapes((points - middle) / half) @ change
    plane = np.column_stack([np.ones(len(points)), points - middle])
    heights = heights - plane @ np.linalg.lstsq(plane, heights, rcond=None)[0]
    return float(np.ptp(heights)), share


def _board_change(
    result: CameraCalibration, shapes: Callable[[Array], Array]
) -> tuple[Array, float]:
    """Change of the board that fits the images best, to first order.

    It is the same in all images, and fitted together with the camera and the board's poses.

    Args:
        shapes: Derivatives of points on the board, shape (n, 3), by the change, shape (n, 3, k).

    Returns:
        The change, shape (k,), and the share of the corners' squared errors that the fit explains.
    """
    information, score, squares = np.zeros(()), np.zeros(()), 0.0
    for name, seen in result.views.items():
        pose = result.boards[name]
        turn = rotation_vector_from_matrix(pose.rotation)
        there, of_pose, of_camera = result.lens.slopes(
            seen.points, turn, pose.position, result.matrix, result.distortion
        )
        of_points = of_pose[:, 3:].reshape(-1, 2, 3) @ pose.rotation
        of_change = of_points @ shapes(seen.points)
        errors = (seen.corners - there).ravel()
        base = np.linalg.qr(of_pose)[0]
        own = np.column_stack([of_camera, of_change.reshape(len(errors), -1)])
        own = own - base @ (base.T @ own)
        information, score = information + own.T @ own, score + own.T @ errors
        squares += float(errors @ errors)
    scale = np.sqrt(np.diag(information))
    found = np.linalg.pinv(information / np.outer(scale, scale), rcond=1e-12, hermitian=True)
    change = found @ (score / scale) / scale
    return change[len(result.lens.names) :], float(score @ change) / max(squares, 1e-300)


def _bow_shapes(positions: Array) -> Array:
    x, y = positions.T
    return np.column_stack([x * x, x * y, y * y])


def _bow_issues(bow: float, bent: float) -> list[Issue]:
    if bent < _EXPLAINED:
        return []
    what = f"the board is not flat: it bows by {bow * 1e3:.2g} mm"
    return [Issue(what, "glue the print on glass or another flat, stiff plate")]


def _size_issues(result: CameraCalibration) -> list[Issue]:
    """Sizes of the board that the images contradict."""
    what = options = ""
    match result.board:
        case TagGrid() as grid:
            gap, share = _gap_of(result, grid)
            if share > _EXPLAINED:
                options = "--tag-mm or --gap-mm, in Python tag= or gap="
                what = f"gaps of {gap * 1e3:.3g} mm between tags of {grid.tag * 1e3:g} mm"
                what += f", not {grid.gap * 1e3:g} mm"
        case Charuco() as board:
            sides = [s.marker for s in result.views.values() if not math.isnan(s.marker)]
            side = float(np.median(sides or [board.marker]))
            if abs(side / board.marker - 1.0) > _OTHER_MARKER:
                options = "--square-mm or --marker-mm, in Python square= or marker="
                what = f"markers of about {side * 1e3:.2g} mm in squares of {board.square * 1e3:g}"
                what += f" mm, not {board.marker * 1e3:g} mm"
    step = f"measure the print, and correct {options}"
    return [Issue(f"the images fit {what}", step)] if what else []


def _gap_of(result: CameraCalibration, grid: TagGrid) -> tuple[float, float]:
    """Gap between tags of the stated size by the images, [m], and the share that it explains.

    The size of tags at the stated distance is fitted, which is almost linear.
    """
    apart, half = grid.tag + grid.gap, grid.tag / 2.0

    def sides(points: Array) -> Array:
        middles = np.round((points - half) / apart) * apart + half
        return np.asarray(((points - middles) / grid.tag * [1.0, 1.0, 0.0])[:, :, None])

    change, share = _board_change(result, sides)
    return grid.tag * (apart / (grid.tag + float(change[0])) - 1.0), share


def corner_errors(result: CameraCalibration) -> tuple[Array, Array]:
    """Corners of all images and their errors, shape (n, 2) both, [px]."""
    corners, errors = [], []
    for name, seen in result.views.items():
        turn = rotation_vector_from_matrix(result.boards[name].rotation)
        origin = result.boards[name].position
        there = result.lens.slopes(seen.points, turn, origin, result.matrix, result.distortion)[0]
        corners.append(seen.corners)
        errors.append(seen.corners - there)
    return np.concatenate(corners), np.concatenate(errors)


def _lens_issues(result: CameraCalibration, radial: float) -> list[Issue]:
    if radial < RADIAL or result.error < _SEEN:
        return []
    what = (
        f"the lens model {result.lens.name!r} does not fit: {radial:.0%} of the squared corner"
        " errors depend on the distance from the image centre"
    )
    others = [name for name in LENSES if name != result.lens.name]
    step = f"try another model: --lens {', '.join(others[:-1])} or {others[-1]}, in Python lens="
    return [Issue(what, step)]


def _more(result: CameraCalibration) -> str:
    """Next step where more or better images would help."""
    return MORE if len(result.views) < ENOUGH_VIEWS else NEARER


def is_below(share: float, limit: float) -> bool:
    """Whether a share is below a limit, both rounded to whole percent."""
    return round(100.0 * share) < round(100.0 * limit)


def _image_issues(result: CameraCalibration, coverage: Array, tilts: Array) -> list[Issue]:
    """Issues of the set of images."""
    issues = []
    if len(result.views) < GOOD_VIEWS:
        what = f"{len(result.views)} images show the board; {GOOD_VIEWS} are required"
        issues.append(Issue(what, MORE))
    share = float(np.mean(coverage > 0))
    if is_below(share, GOOD_COVERAGE):
        empty = [side for side, axis, at in _SIDES if not coverage.take(at, axis=axis).any()]
        gap = f", none at the {' and '.join(empty)}" if empty else ""
        what = f"the board covered {share:.0%} of the image{gap}; {GOOD_COVERAGE:.0%} is required"
        issues.append(Issue(what, EDGES))
    for axis, name in enumerate(("forward and backward", "left and right")):
        span = float(np.ptp(tilts[:, axis]))
        if span < 2.0 * GOOD_TILT:
            needed = f"{2 * GOOD_TILT:.0f}° is required"
            what = f"the board was tilted {name} over only {span:.0f}°; {needed}"
            issues.append(Issue(what, "tilt the board up to 40° in every direction"))
    return issues


def _error_issues(
    result: CameraCalibration,
    coverage: Array,
    error: float,
    halves: float,
    wanted: float,
    distance: float,
) -> list[Issue]:
    """Issues of the errors."""
    issues = []
    if result.error > GOOD_ERROR:
        what = f"the reprojection error is {result.error:.2f} px"
        step = "take sharp images of a flat board, held still, and check its dimensions"
        issues.append(Issue(what, step))
    if not error <= wanted:
        what = f"points at {distance:.2g} m are measured within {beyond(error, wanted)}"
        issues.append(Issue(what, _more(result)))
        share = float(np.mean(coverage > 0))
        if not is_below(share, GOOD_COVERAGE) and is_below(share, FULL_COVERAGE):
            what = f"the board covered {share:.0%} of the image, {FULL_COVERAGE:.0%} are required"
            issues.append(Issue(what, EDGES))
    if not halves <= 2.0 * wanted:
        what = f"fits to two halves of the images differ by {halves * 1e3:.2g} mm"
        issues.append(Issue(what, _more(result)))
    return issues
