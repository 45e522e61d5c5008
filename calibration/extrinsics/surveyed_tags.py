"""A camera's pose from surveyed tags on the frame.

The mean corners of each tag are fitted with the covariance of image and survey: survey errors are
the same in every image and do not average out.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares

from calibration.extrinsics.result import ExtrinsicCalibration, workspace_corners
from calibration.results import Issue
from calibration.statistics import chi_squared_bound, widened
from calibration.tag_map.observations import TagObservations
from model.cameras import Z_95
from model.errors import BadInput
from model.pose import Array, Pose, moved, points_by_twist, read_only, step_between
from model.rig import Camera, Rig, Tag
from tracking.camera_model import (
    point_slopes,
    project_undistorted,
    reprojection_errors,
    rms,
    sight_offsets,
    undistorted_slopes,
)
from tracking.detection.tags import mounted_rotated, tag_corners
from tracking.edges.refine import RefinedTag
from tracking.pnp import TagView, solve_pnp
from tracking.shared_errors import change_of_inverse

# Survey errors and their effect on pixels.


@dataclass(frozen=True, slots=True)
class Survey:
    """Standard deviations of the tags' survey, along or about any axis.

    Attributes:
        shift: Of each corner, or, where ``turn`` is given, of each tag as a whole, [m].
        turn: Of each tag's rotation, [rad]; 0 for tags at their nominal rotation. None where
            corners were surveyed independently: then they determine a tag's rotation.
    """

    shift: float
    turn: float | None = None

    def slopes(self, tag: Tag) -> Array:
        """Corner shifts by independent errors of unit variance, shape (12, k), [m]."""
        if self.turn is None:
            return self.shift * np.eye(12)
        arms = tag_corners(tag) - tag.pose.position
        return np.concatenate(points_by_twist(arms) * np.repeat([self.shift, self.turn], 3))

    def of_pixels(self, camera: Camera, camera_from_world: Pose, tag: Tag) -> Array:
        """Covariance of a tag's undistorted pixels from survey errors, shape (8, 8), [px²]."""
        spread = pixel_slopes(camera, camera_from_world, tag_corners(tag)) @ self.slopes(tag)
        covariance: Array = spread @ spread.T
        return covariance


def pixel_slopes(camera: Camera, camera_from_world: Pose, points: Array) -> Array:
    """Derivative of undistorted pixels by world points (n, 3), shape (2 n, 3 n), [px/m]."""
    slopes = np.zeros((2 * len(points), 3 * len(points)))
    for k, by_camera in enumerate(point_slopes(camera, camera_from_world.apply(points))):
        slopes[2 * k : 2 * k + 2, 3 * k : 3 * k + 3] = by_camera @ camera_from_world.rotation
    return slopes


LEAST_TAGS = 3
"""Fewer tags cannot show that one of them was surveyed wrongly."""
MANY_TAGS = 8
"""With fewer, the jackknife is unreliable: the stated survey errors count."""
MOVED_PX = 0.5
"""Largest motion of tags between images of a camera at rest, [px]."""
_OFF = 3.0
"""A tag with an error of this many deviations contradicts the survey."""


@dataclass(frozen=True, slots=True, eq=False)
class _SeenTag:
    """A tag over all images: world corners (4, 3), mean pixels (8,), their whitening (8, 8).

    The pixels are without distortion.
    """

    number: int
    corners: Array
    pixels: Array
    whitening: Array

    def errors(self, camera: Camera, camera_from_world: Pose) -> Array:
        """Errors of the corners without distortion, shape (8,), [px]."""
        points = camera_from_world.apply(self.corners)
        return np.asarray(project_undistorted(camera, points).reshape(8) - self.pixels)


def require_frame_tags(rig: Rig) -> None:
    """Refuses a rig without surveyed tags.

    Raises:
        BadInput: It has no frame tags.
    """
    if not rig.frame_tags:
        raise BadInput(
            "the rig has no frame tags to locate the camera",
            where=f"rig {rig.name}",
            next_step="survey tags on the frame and add them to the rig file under tags: frame, or"
            " pass `poses=` to use the rig's own motion",
        )


def locate_by_frame_tags(
    rig: Rig, camera: Camera, observations: TagObservations, survey: Survey
) -> ExtrinsicCalibration:
    """Finds the camera's pose from images taken with the camera at rest.

    Args:
        rig: Its frame tags are the surveyed ones.
        camera: Its matrix and distortion are taken as known; its pose in the rig file is not used.
        observations: Of frame tags.
        survey: Standard deviations of the survey.

    Raises:
        BadInput: The camera moved between the images, or no pose fits the tags.
    """
    observations = _without_moved_images(camera, observations)
    start = _initial_pose(rig, camera, observations)
    if start is None:
        raise BadInput(
            "no camera pose fits the frame tags",
            where=f"camera {camera.name}",
            why="the detected corners contradict their poses and sizes in the rig file",
            next_step="check the tags' positions, rotations and sizes in the rig file",
        )
    tags = _seen_tags(rig, camera, observations, start, survey)
    tags, outliers = _reject_outliers(camera, tags, start)
    best = _fit(camera, tags, start)
    unused = {f"tag {tag.number}": _offset_message(camera, tag, best) for tag in outliers}
    issues = _issues(camera, tags, best)
    if outliers or issues:
        issues = _rotation_issues(rig, camera, observations, survey) or issues
    slopes = _slopes(camera, tags, best)
    by_lens = _by_lens(camera, tags, best, slopes)
    covariance = _covariance(camera, tags, best, slopes)
    pose = best.inverse()
    changes = []
    for k in range(len(tags) if len(tags) >= MANY_TAGS else 0):
        other = _fit(camera, tags[:k] + tags[k + 1 :], best).inverse()
        changes.append(step_between(pose, other))
    if changes:
        covariance = widened(covariance, np.array(changes))
    if by_lens is not None and camera.lens_covariance is not None:
        covariance = covariance + by_lens @ camera.lens_covariance @ by_lens.T
    return ExtrinsicCalibration(
        camera=replace(camera, world_from_camera=pose),
        by="frame tags",
        covariance=read_only(covariance),
        half_widths=read_only(Z_95 * np.sqrt(np.diag(covariance))),
        by_lens=by_lens,
        points=workspace_corners(rig),
        tag_errors={tag.number: _image_error(camera, tag, best) for tag in tags},
        pictures=len(observations.squares),
        unused={**observations.unused, **unused},
        issues=tuple(issues),
        data_hash=observations.data_hash(),
    )


def _rotation_issues(
    rig: Rig, camera: Camera, observations: TagObservations, survey: Survey
) -> list[Issue]:
    """That the tags are mounted rotated about their normals, if all of them fit so."""

    def fit(frame_tags: tuple[Tag, ...]) -> bool:
        rotated = replace(rig, frame_tags=frame_tags)
        start = _initial_pose(rotated, camera, observations)
        if start is None:
            return False
        tags = _seen_tags(rotated, camera, observations, start, survey)
        return len(tags) >= LEAST_TAGS and _misfit(camera, tags, _fit(camera, tags, start)) < _OFF

    found = mounted_rotated(rig.frame_tags, rig.tag_family, fit)
    return [] if found is None else [Issue(*found)]


def _without_moved_images(camera: Camera, observations: TagObservations) -> TagObservations:
    """Without images whose tags have moved relative to the largest group that agrees."""
    corners = observations.corners(camera)
    groups = [
        [one for one in corners.values() if _shift(one, other) <= MOVED_PX]
        for other in corners.values()
    ]
    group = max(groups, key=len)
    middle = {
        number: np.median([one[number] for one in group if number in one], axis=0)
        for number in {number for one in group for number in one}
    }
    shifts = {name: _shift(one, middle) for name, one in corners.items()}
    unused = {
        name: f"shows the tags {shift:.1f} px off the other images: the camera moved"
        for name, shift in shifts.items()
        if shift > MOVED_PX
    }
    if 2 * len(unused) >= len(corners):
        reasons = "; ".join(f"{name} {why}" for name, why in list(unused.items())[:3])
        raise BadInput(
            "the camera moved between the images",
            where=f"camera {camera.name}",
            why=f"only {len(corners) - len(unused)} of {len(corners)} images agree; {reasons}",
            next_step="fix the camera in place and take the images again, or pass only those taken"
            " since it last moved",
        )
    return observations.without(unused)


def _shift(corners: Mapping[int, Array], others: Mapping[int, Array]) -> float:
    """Median motion of the tags in both, by number, [px]; NaN if there is none."""
    off = [
        np.linalg.norm(own - others[number], axis=1).mean()
        for number, own in corners.items()
        if number in others
    ]
    return float(np.median(off)) if off else np.nan


def _initial_pose(rig: Rig, camera: Camera, observations: TagObservations) -> Pose | None:
    """``camera_from_world`` from the tags of one image; None if no pose fits them."""
    tags = {tag.id: tag for tag in rig.frame_tags}
    fullest = max(observations.squares.values(), key=len)
    views = [TagView(tags[number], square) for number, square in fullest.items()]
    found = solve_pnp(camera, views, camera.world_from_camera.inverse())
    return None if found is None else found.camera_from_body


def _seen_tags(
    rig: Rig, camera: Camera, observations: TagObservations, start: Pose, survey: Survey
) -> list[_SeenTag]:
    tags = {tag.id: tag for tag in rig.frame_tags}
    found = []
    for number in observations.numbers:
        squares = [s[number] for s in observations.squares.values() if number in s]
        corners = tag_corners(tags[number])
        covariance = _image_covariance(squares) + survey.of_pixels(camera, start, tags[number])
        pixels = np.mean([square.corners.reshape(8) for square in squares], axis=0)
        whitening = np.linalg.inv(np.linalg.cholesky(covariance))
        found.append(_SeenTag(number, corners, pixels, whitening))
    return found


def _image_covariance(squares: Sequence[RefinedTag]) -> Array:
    """Covariance of corners in one image; errors in images of a static scene correlate."""
    return np.asarray(np.mean([square.covariance for square in squares], axis=0))


def _errors(camera: Camera, tags: Sequence[_SeenTag], pose: Pose) -> Array:
    return np.concatenate([tag.whitening @ tag.errors(camera, pose) for tag in tags])


def _fit(camera: Camera, tags: Sequence[_SeenTag], start: Pose) -> Pose:
    """Fits ``camera_from_world`` with Huber's loss."""
    found = least_squares(
        lambda step: _errors(camera, tags, moved(start, step)),
        np.zeros(6),
        loss="huber",
        f_scale=2.0,
        x_scale=[1e-3] * 6,
        xtol=1e-12,
        ftol=1e-12,
    )
    return moved(start, found.x)


def _misfit(camera: Camera, tags: Sequence[_SeenTag], pose: Pose) -> float:
    """Sum of squared errors, in variances, per degree of freedom."""
    return float(np.sum(_errors(camera, tags, pose) ** 2)) / (8 * len(tags) - 6)


def _reject_outliers(
    camera: Camera, tags: list[_SeenTag], start: Pose
) -> tuple[list[_SeenTag], list[_SeenTag]]:
    """Tags that agree with each other, and outliers."""
    outliers: list[_SeenTag] = []
    while len(tags) > LEAST_TAGS:
        misfit = _misfit(camera, tags, _fit(camera, tags, start))
        rests = [tags[:k] + tags[k + 1 :] for k in range(len(tags))]
        without = [_misfit(camera, rest, _fit(camera, rest, start)) for rest in rests]
        k = int(np.argmin(without))
        if misfit < _OFF or without[k] > 0.5 * misfit:
            break
        outliers.append(tags[k])
        tags = rests[k]
    return tags, outliers


def _image_error(camera: Camera, tag: _SeenTag, best: Pose) -> float:
    """RMS error of a tag's corners in the image, of each coordinate, [px]."""
    points, seen = best.apply(tag.corners), tag.pixels.reshape(4, 2)
    return float(np.sqrt(np.mean(reprojection_errors(camera, points, seen) ** 2)))


def _offset_message(camera: Camera, tag: _SeenTag, best: Pose) -> str:
    away = rms(sight_offsets(camera, best.apply(tag.corners), tag.pixels.reshape(4, 2)))
    return f"is measured at least {away * 1e3:.1f} mm from its position in the rig file"


def _slopes(camera: Camera, tags: Sequence[_SeenTag], best: Pose) -> Array:
    """Jacobian of the whitened errors by the pose, shape (8 t, 6)."""
    step = 1e-6
    return np.column_stack(
        [
            (_errors(camera, tags, moved(best, d)) - _errors(camera, tags, moved(best, -d)))
            / (2 * step)
            for d in step * np.eye(6)
        ]
    )


def _by_lens(camera: Camera, tags: Sequence[_SeenTag], best: Pose, slopes: Array) -> Array | None:
    """Derivatives of ``world_from_camera`` by the lens parameters, shape (6, n)."""
    if camera.lens_covariance is None:
        return None
    by_lens = [
        tag.whitening @ undistorted_slopes(camera, tag.pixels.reshape(4, 2)).reshape(8, -1)
        for tag in tags
    ]
    steps = np.linalg.lstsq(slopes, np.concatenate(by_lens), rcond=None)[0]
    return read_only(change_of_inverse(best) @ steps)


def _covariance(camera: Camera, tags: Sequence[_SeenTag], best: Pose, slopes: Array) -> Array:
    """Covariance of ``world_from_camera``, (6, 6); wider if scatter contradicts the survey."""
    misfit, free = _misfit(camera, tags, best), 8 * len(tags) - 6
    scale = misfit if misfit > chi_squared_bound(free) / free else 1.0
    covariance = scale * np.linalg.inv(slopes.T @ slopes)
    change = change_of_inverse(best)
    return np.asarray(change @ covariance @ change.T)


def _issues(camera: Camera, tags: Sequence[_SeenTag], best: Pose) -> list[Issue]:
    issues = []
    if len(tags) < LEAST_TAGS:
        seen = f"{len(tags)} frame tag{'s are' if len(tags) != 1 else ' is'} visible"
        what = f"{seen}; {LEAST_TAGS} are required"
        step = "survey more tags, all around the camera's view"
        issues.append(Issue(what, step))
    for tag in tags:
        size = np.sqrt(np.mean((tag.whitening @ tag.errors(camera, best)) ** 2))
        if len(tags) >= LEAST_TAGS and size > _OFF:
            what = f"tag {tag.number} {_offset_message(camera, tag, best)}"
            step = f"survey tag {tag.number} again, or remove it from the rig file"
            issues.append(Issue(what, step))
    return issues
