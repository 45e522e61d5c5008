"""Tag layout of the platform by bundle adjustment over all tags and all images.

Images may be taken from anywhere: the camera pose of each is an unknown too. They determine the
layout only up to a rigid motion; the platform frame is set by the best fit to the rig file, or by
one tag kept as there. Each image's information about the layout, its camera pose projected out,
is summed as in `calibration.intrinsics.calibrate`.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares

from calibration.extrinsics.result import widths_of
from calibration.tag_map.observations import (
    TagObservations,
    TagViews,
    connected_tags,
    initial_layout,
    moved_tags,
)
from model.errors import BadInput
from model.pose import Array, Pose, moved, points_by_twist, read_only, skew
from model.rig import Camera, Rig, Tag
from tracking.detection.tags import tag_corners
from tracking.pnp import TagView, solve_pnp

# Joint fit of camera poses and tag poses: initial poses, fit, outliers.


HUBER = 3.0
"""Errors of edges beyond this many deviations count linearly."""
_NARROWING = (1e4, 1e2, 2e1, HUBER)
_FAR_OFF_PX = 2.0
"""Corner errors above this mean that an image does not show this platform as it is."""
_BETTER = 0.5
"""Another fit is preferred if its error is less than this share of the first one's."""
GOOD_ERROR, FAILED_ERROR = 0.3, 1.0
"""Required reprojection error, and that above which a fit describes no layout, [px]."""


def outlier_image(observations: TagObservations, errors: Sequence[float]) -> dict[str, str]:
    """The worst image and the reason, if it is an outlier; else empty."""
    name, error = max(zip(observations.squares, errors, strict=True), key=lambda item: item[1])
    if error <= max(_FAR_OFF_PX, 4.0 * float(np.median(errors))):
        return {}
    return {name: f"has a corner error of {error:.2f} px, far more than the others"}


def _rms(errors: Sequence[float]) -> float:
    return float(np.sqrt(np.mean(np.square(errors))))


def initial_poses(
    camera: Camera, nominal: Mapping[int, Tag], observations: TagObservations
) -> tuple[dict[str, Pose], TagObservations]:
    """``camera_from_platform`` of each image by tags at given poses; drops images without."""
    starts = {}
    for name, squares in observations.squares.items():
        found = solve_pnp(camera, [TagView(nominal[k], s) for k, s in squares.items()])
        if found is not None:
            starts[name] = found.camera_from_body
    outliers = {
        name: "fits no platform pose with the rig file's tags"
        for name in observations.squares
        if name not in starts
    }
    return starts, observations.without(outliers)


def adjust_bundle(
    views: TagViews, cameras: Sequence[Pose], tags: tuple[Tag, ...], with_sizes: bool = False
) -> tuple[list[Pose], tuple[Tag, ...]]:
    """Fitted camera poses and tags; the first tag stays fixed meanwhile.

    Args:
        cameras: ``camera_from_platform`` of each image, to start from.
        tags: To start from.
        with_sizes: Whether sizes relative to the first tag are fitted, too.
    """
    count = 6 * len(cameras)
    last = count + 6 * (len(tags) - 1)

    def at(x: Array) -> tuple[list[Pose], tuple[Tag, ...]]:
        steps = x[:count].reshape(-1, 6)
        own = moved_tags(tags, np.concatenate([np.zeros(6), x[count:last]]))
        factors = np.exp(x[last:]).tolist()
        sized = [replace(tag, size=tag.size * k) for tag, k in zip(own[1:], factors, strict=False)]
        return (
            [moved(pose, step) for pose, step in zip(cameras, steps, strict=True)],
            (own[0], *sized) if with_sizes else own,
        )

    def slopes(x: Array) -> Array:
        whole = np.delete(views.dense_slopes(*at(x)), np.s_[count : count + 6], axis=1)
        return np.hstack([whole, views.size_slopes(*at(x))[:, 1:]]) if with_sizes else whole

    # The rig file may be many deviations off, where Huber's loss has little gradient: so its scale
    # narrows. Each round restarts at the last result: steps are small rotations of current poses.
    for scale in _NARROWING:
        found = least_squares(
            lambda x: views.errors(*at(x)).ravel(),
            np.zeros(last + (len(tags) - 1) * with_sizes),
            jac=slopes,
            loss="huber",
            f_scale=scale,
            x_scale="jac",
            max_nfev=40,
        )
        cameras, tags = at(found.x)
    return list(cameras), tags


# Platform frame of a layout: the rig file determines it, images do not.


def corner_slopes(tags: Sequence[Tag]) -> Array:
    """Derivatives of corners by tag poses, shape (4 t, 3, 6 t)."""
    slopes = np.zeros((4 * len(tags), 3, 6 * len(tags)))
    for k, tag in enumerate(tags):
        arms = tag_corners(tag) - tag.pose.position
        slopes[4 * k : 4 * k + 4, :, 6 * k : 6 * k + 6] = points_by_twist(arms)
    return slopes


def align_to_nominal(
    tags: Sequence[Tag], nominal: Sequence[Tag], fixed: int | None
) -> tuple[Pose, float]:
    """The motion that aligns tags with the rig file, and their scale relative to it.

    Source: Umeyama 1991.
    """
    here = np.concatenate([tag_corners(tag) for tag in tags])
    there = np.concatenate([tag_corners(tag) for tag in nominal])
    a, b = here - here.mean(axis=0), there - there.mean(axis=0)
    left, _, right = np.linalg.svd(b.T @ a)
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(left @ right))])
    rotation = left * sign @ right
    positions = [np.array([tag.pose.position for tag in which]) for which in (tags, nominal)]
    sizes = [float(np.linalg.norm(p - p.mean(axis=0))) for p in positions]
    scale = sizes[0] / sizes[1]
    if fixed is not None:
        (one,) = (tag for tag in tags if tag.id == fixed)
        (other,) = (tag for tag in nominal if tag.id == fixed)
        return other.pose.compose(one.pose.inverse()), scale
    return Pose(there.mean(axis=0) - rotation @ here.mean(axis=0), rotation), scale


def fix_gauge(tags: Sequence[Tag], fixed: int | None) -> Array:
    """Gauge constraints, shape (6, 6 t): layout changes that would move the platform frame."""
    if fixed is not None:
        which = [tag.id for tag in tags].index(fixed)
        return np.eye(6 * len(tags))[6 * which : 6 * which + 6]
    corners = np.concatenate([tag_corners(tag) for tag in tags])
    slopes = corner_slopes(tags)
    arms = [skew(corner) for corner in corners - corners.mean(axis=0)]
    turns = np.sum([arm @ slope for arm, slope in zip(arms, slopes, strict=True)], axis=0)
    return np.concatenate([slopes.sum(axis=0), turns / 0.05])


LEAST_IMAGES = 4
"""Images of two tags or more; twenty are good."""
SIZE_ERROR = 0.02
"""Relative deviation from which a tag's size or the layout's counts as wrong."""


@dataclass(frozen=True, slots=True, eq=False)
class TagLayout:
    """Measured tag layout of the platform.

    Attributes:
        nominal: The located tags as in the rig file.
        tags: The same tags as measured.
        covariance: Of each tag's position [m] and rotation vector [rad] along the platform's axes,
            shape (6 t, 6 t).
        half_widths: Of the 95 % intervals of the same, shape (6 t,).
        fixed: Number of the tag kept as in the rig file; None for the best fit of all.
        errors: RMS corner error of each image, by name, [px].
        seen: Number of images that show each tag, by tag number.
        unseen: Why each other tag keeps its pose of the rig file, by tag number.
        sides: Largest angle between directions from which images were taken, [rad].
        scale: Size of the layout relative to the rig file.
        resized: The tags with fitted sizes, where the stated ones contradict the images.
        family: Of the tags.
        unused: Why images are not used, by name.
        data_hash: Of the observations.
    """

    nominal: tuple[Tag, ...]
    tags: tuple[Tag, ...]
    covariance: Array
    half_widths: Array
    fixed: int | None
    errors: Mapping[str, float]
    seen: Mapping[int, int]
    unseen: Mapping[int, str]
    sides: float
    scale: float
    resized: tuple[Tag, ...] | None
    family: str
    unused: Mapping[str, str]
    data_hash: str

    @property
    def error(self) -> float:
        """Error of tag corners, 95 %, RMS, [m]."""
        deviations = np.sqrt(np.diag(self.covariance))
        factors = np.where(deviations > 0.0, self.half_widths / np.maximum(deviations, 1e-15), 0.0)
        grown = self.covariance * np.outer(factors, factors)
        slopes = corner_slopes(self.tags)
        return float(np.sqrt(np.mean([np.trace(s @ grown @ s.T) for s in slopes])))

    @property
    def reprojection(self) -> float:
        """RMS corner error over the images, [px]."""
        return _rms(list(self.errors.values()))

    @property
    def has_failed(self) -> bool:
        """Whether no layout fits the images, so that the tags' poses mean nothing."""
        return self.reprojection > FAILED_ERROR


def require_tags(rig: Rig, fixed: int | None) -> None:
    """Refuses a rig whose layout cannot be measured.

    Raises:
        BadInput: Its platform has fewer than two tags, or lacks the fixed one.
    """
    numbers = [tag.id for tag in rig.platform_tags]
    known = f"tags of the platform: {', '.join(map(str, numbers)) or 'none'}"
    if len(numbers) < 2:
        raise BadInput(
            "the platform has fewer than two tags, so their poses cannot be compared",
            where=f"rig {rig.name}",
            why=known,
            next_step="add the platform's tags to the rig file under tags: platform",
        )
    if fixed is not None and fixed not in numbers:
        raise BadInput(
            f"no tag {fixed} on the platform",
            where="`fixed_tag=`",
            why=known,
            next_step="name one of them",
        )


def measure_layout(
    rig: Rig, camera: Camera, observations: TagObservations, fixed: int | None = None
) -> TagLayout:
    """Measures the layout of the platform's tags.

    Args:
        rig: Its platform tags as in the rig file; their sizes are taken as known.
        camera: Its matrix and distortion are taken as known.
        observations: Of platform tags, from any camera pose.
        fixed: Number of the tag kept as in the rig file; None for the best fit of all.

    Raises:
        BadInput: Too few images show two tags or more, or the fixed tag with others.
    """
    nominal = {tag.id: tag for tag in rig.platform_tags}
    single = {
        name: "shows only one tag, which does not locate the others"
        for name, squares in observations.squares.items()
        if len(squares) < 2
    }
    observations = observations.without(single).without_duplicates(camera)
    fit = _best_fit(camera, nominal, observations, fixed)
    if len(fit.used.squares) < LEAST_IMAGES:
        raise _too_few(fit.used, fixed)
    original = tuple(nominal[tag.id] for tag in fit.tags)
    resized = _with_fitted_sizes(fit, original)
    if resized is None and (outliers := outlier_image(fit.used, fit.errors)):
        return measure_layout(rig, camera, fit.posed.without(outliers), fixed)
    located = [tag.id for tag in fit.tags]
    unseen = {
        number: _unseen_reason(number, fit.posed, located)
        for number in nominal
        if number not in located
    }
    return _result(original, unseen, fit, fixed, resized, rig.tag_family)


@dataclass(frozen=True, slots=True, eq=False)
class _Fit:
    """A joint fit; without cameras and errors where too few images are left."""

    posed: TagObservations  # images with an initial camera pose
    used: TagObservations  # the located tags in them
    views: TagViews
    cameras: list[Pose]
    tags: tuple[Tag, ...]
    errors: list[float]  # of each image, [px]

    @property
    def error(self) -> float:
        return _rms(self.errors) if self.errors else np.inf


def _best_fit(
    camera: Camera, nominal: Mapping[int, Tag], observations: TagObservations, fixed: int | None
) -> _Fit:
    """The fit from the rig file's layout or, if that leads nowhere, from the images' own."""
    fit = _fit_from(camera, nominal, observations, fixed)
    if max(fit.errors, default=np.inf) <= _FAR_OFF_PX:
        return fit
    own = initial_layout(camera, nominal, observations)
    other = _fit_from(camera, own, observations, fixed)
    return other if other.error < _BETTER * fit.error else fit


def _fit_from(
    camera: Camera, start: Mapping[int, Tag], observations: TagObservations, fixed: int | None
) -> _Fit:
    starts, observations = initial_poses(camera, start, observations)
    located = connected_tags([tuple(squares) for squares in observations.squares.values()], fixed)
    used = _only_located(observations, located, fixed)
    tags = tuple(start[number] for number in located)
    views = TagViews.of(camera, used, tags)
    if len(used.squares) < LEAST_IMAGES:
        return _Fit(observations, used, views, [], tags, [])
    cameras, tags = adjust_bundle(views, [starts[name] for name in used.squares], tags)
    return _Fit(observations, used, views, cameras, tags, views.image_errors(cameras, tags))


def _with_fitted_sizes(fit: _Fit, nominal: Sequence[Tag]) -> tuple[Tag, ...] | None:
    """The tags with sizes that fit the images, where the stated ones do not; else None.

    Images determine sizes relative to each other: at least half of the tags must have the size that
    the rig file states.
    """
    if fit.error <= GOOD_ERROR:
        return None
    cameras, tags = adjust_bundle(fit.views, fit.cameras, fit.tags, with_sizes=True)
    error = _rms(fit.views.image_errors(cameras, tags))
    if error >= min(_BETTER * fit.error, FAILED_ERROR):
        return None
    factors = np.array([tag.size / own.size for tag, own in zip(tags, nominal, strict=True)])
    alike = np.sum(np.abs(factors[:, None] / factors - 1.0) < SIZE_ERROR, axis=1)
    if 2 * alike.max() < len(tags):
        return None
    scale = align_to_nominal(tags, nominal, None)[1]
    unit = min(zip(-alike, np.abs(np.log(scale / factors)), factors, strict=True))[2]
    return tuple(
        Tag(tag.id, tag.size / unit, Pose(tag.pose.position / unit, tag.pose.rotation))
        for tag in tags
    )


def _only_located(
    observations: TagObservations, located: Collection[int], fixed: int | None
) -> TagObservations:
    """The located tags in images that show two of them or more."""
    to = "each other" if fixed is None else f"tag {fixed}"
    remaining = {
        name: {number: square for number, square in squares.items() if number in located}
        for name, squares in observations.squares.items()
    }
    single = {
        name: f"shows fewer than two tags that several images connect to {to}"
        for name, squares in remaining.items()
        if len(squares) < 2
    }
    return replace(observations, squares=remaining).without(single)


def _unseen_reason(number: int, observations: TagObservations, located: Collection[int]) -> str:
    for name, squares in observations.squares.items():
        if number in squares and any(other in located for other in squares):
            return f"is connected to the others by {name} alone"
    return "was not detected together with the others"


def _result(
    nominal: tuple[Tag, ...],
    unseen: Mapping[int, str],
    fit: _Fit,
    fixed: int | None,
    resized: tuple[Tag, ...] | None,
    family: str,
) -> TagLayout:
    observations, views = fit.used, fit.views
    shift, scale = align_to_nominal(fit.tags, nominal, fixed)
    tags = tuple(replace(tag, pose=shift.compose(tag.pose)) for tag in fit.tags)
    cameras = [pose.compose(shift.inverse()) for pose in fit.cameras]
    informations, scores, misfit = views.tag_information(cameras, tags, HUBER)
    gauge = fix_gauge(tags, fixed)
    whole = np.sum(informations, axis=0)
    pinned = gauge.T @ gauge * (1e3 * np.trace(whole) / np.trace(gauge.T @ gauge))
    covariance = max(1.0, misfit) * np.linalg.inv(whole + pinned)
    without = [
        np.linalg.solve(whole - part + pinned, -score)
        for part, score in zip(informations, scores, strict=True)
    ]
    numbers = [number for squares in observations.squares.values() for number in squares]
    return TagLayout(
        nominal=nominal,
        tags=tags,
        covariance=read_only(covariance),
        half_widths=read_only(widths_of(covariance, without)),
        fixed=fixed,
        errors=dict(zip(observations.squares, views.image_errors(cameras, tags), strict=True)),
        seen={tag.id: numbers.count(tag.id) for tag in tags},
        unseen=unseen,
        sides=_sides(cameras),
        scale=scale,
        resized=resized,
        family=family,
        unused=observations.unused,
        data_hash=observations.data_hash(),
    )


def _sides(cameras: Sequence[Pose]) -> float:
    """Largest angle between directions from the platform to ``camera_from_platform``, [rad]."""
    positions = np.array([pose.inverse().position for pose in cameras])
    directions = positions / np.linalg.norm(positions, axis=1, keepdims=True)
    return float(np.arccos(np.clip(directions @ directions.T, -1.0, 1.0)).max())


def _too_few(observations: TagObservations, fixed: int | None) -> BadInput:
    reasons = "; ".join(f"{name} {why}" for name, why in list(observations.unused.items())[:5])
    together = f", linked to tag {fixed}" if fixed is not None else ""
    return BadInput(
        f"{len(observations.squares)} images show two platform tags or more{together};"
        f" {LEAST_IMAGES} are required",
        why=reasons,
        next_step="take 20 images from all sides, two or three tags in each",
    )
