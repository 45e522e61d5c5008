"""Where the tags are on the platform: all of them and all images fitted together.

Every image may be taken from anywhere; its camera pose is an unknown as well (bundle adjustment).
Images give the layout only up to a rigid motion of the platform's frame; it is put where the
layout fits the rig file best, or where one tag is as there. What an image says of the layout, its
camera pose projected out, is added up as in `calibration.intrinsics.calibrate`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares

from calibration.extrinsics.result import widths_of
from calibration.tag_map.observations import TagSights, TagViews, moved_tags
from model.errors import BadInput
from model.pose import Array, Pose, read_only, skew
from model.rig import Camera, Rig, Tag
from tracking.detection.tags import tag_corners
from tracking.pnp import TagView, moved, solve_pnp

# Poses of cameras and tags of a platform fitted together: the start, the fit, what spoils it.


HUBER = 3.0
"""Errors of edges beyond this many deviations count linearly."""
_NARROWING = (1e4, 1e2, 2e1, HUBER)
_FAR_OFF_PX = 2.0
"""An image whose corners are farther off does not show this platform as it is."""


def far_off(sights: TagSights, errors: Sequence[float]) -> dict[str, str]:
    """The image that fits the others least, and why, where it is far off: it smears the fit."""
    name, error = max(zip(sights.squares, errors, strict=True), key=lambda item: item[1])
    if error <= max(_FAR_OFF_PX, 4.0 * float(np.median(errors))):
        return {}
    return {name: f"has a corner error of {error:.2f} px, far more than the others"}


def starts_of(
    camera: Camera, drawn: Mapping[int, Tag], sights: TagSights
) -> tuple[dict[str, Pose], TagSights]:
    """``camera_from_platform`` of each image by the rig file; images without one are named."""
    starts = {}
    for name, squares in sights.squares.items():
        found = solve_pnp(camera, [TagView(drawn[k], s) for k, s in squares.items()])
        if found is not None:
            starts[name] = found.camera_from_body
    strange = {
        name: "fits no platform pose with the rig file's tags"
        for name in sights.squares
        if name not in starts
    }
    return starts, sights.without(strange)


def fitted(
    views: TagViews, cameras: Sequence[Pose], tags: tuple[Tag, ...]
) -> tuple[list[Pose], tuple[Tag, ...]]:
    """Poses of the cameras and tags that fit; the first tag holds still meanwhile."""
    count = 6 * len(cameras)

    def at(x: Array) -> tuple[list[Pose], tuple[Tag, ...]]:
        steps = x[:count].reshape(-1, 6)
        own = np.concatenate([np.zeros(6), x[count:]])
        return (
            [moved(pose, step) for pose, step in zip(cameras, steps, strict=True)],
            moved_tags(tags, own),
        )

    def slopes(x: Array) -> Array:
        whole = views.dense_slopes(*at(x))
        return np.delete(whole, np.s_[count : count + 6], axis=1)

    # The rig file may be many deviations off, where Huber's loss hardly pulls: so it narrows.
    # Each round starts again from the last result: steps are small turns about the present poses.
    for scale in _NARROWING:
        found = least_squares(
            lambda x: views.errors(*at(x)).ravel(),
            np.zeros(count + 6 * (len(tags) - 1)),
            jac=slopes,
            loss="huber",
            f_scale=scale,
            x_scale="jac",
            max_nfev=40,
        )
        cameras, tags = at(found.x)
    return list(cameras), tags


# Where the platform's frame is in a layout: images do not determine it, the rig file does.


def corner_slopes(tags: Sequence[Tag]) -> Array:
    """How corners shift when tags shift and turn, shape (4 t, 3, 6 t)."""
    slopes = np.zeros((4 * len(tags), 3, 6 * len(tags)))
    for k, tag in enumerate(tags):
        for corner, arm in enumerate(tag_corners(tag) - tag.pose.position):
            slopes[4 * k + corner, :, 6 * k : 6 * k + 6] = np.hstack([np.eye(3), -skew(arm)])
    return slopes


def to_drawing(tags: Sequence[Tag], drawn: Sequence[Tag], fixed: int | None) -> tuple[Pose, float]:
    """The motion that puts tags where the rig file has them, and their size by that there.

    Source: Umeyama 1991.
    """
    here = np.concatenate([tag_corners(tag) for tag in tags])
    there = np.concatenate([tag_corners(tag) for tag in drawn])
    a, b = here - here.mean(axis=0), there - there.mean(axis=0)
    left, _, right = np.linalg.svd(b.T @ a)
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(left @ right))])
    rotation = left * sign @ right
    places = [np.array([tag.pose.position for tag in which]) for which in (tags, drawn)]
    sizes = [float(np.linalg.norm(place - place.mean(axis=0))) for place in places]
    scale = sizes[0] / sizes[1]
    if fixed is not None:
        (one,) = (tag for tag in tags if tag.id == fixed)
        (other,) = (tag for tag in drawn if tag.id == fixed)
        return other.pose.compose(one.pose.inverse()), scale
    return Pose(there.mean(axis=0) - rotation @ here.mean(axis=0), rotation), scale


def fix_gauge(tags: Sequence[Tag], fixed: int | None) -> Array:
    """What must not change with the layout, shape (6, 6 t): it would move the platform's frame."""
    if fixed is not None:
        which = [tag.id for tag in tags].index(fixed)
        return np.eye(6 * len(tags))[6 * which : 6 * which + 6]
    corners = np.concatenate([tag_corners(tag) for tag in tags])
    slopes = corner_slopes(tags)
    arms = [skew(corner) for corner in corners - corners.mean(axis=0)]
    turns = np.sum([arm @ slope for arm, slope in zip(arms, slopes, strict=True)], axis=0)
    return np.concatenate([slopes.sum(axis=0), turns / 0.05])


# Which tags can be located: those that images tie to each other.


def connected_tags(pictures: Sequence[Iterable[int]], fixed: int | None = None) -> list[int]:
    """The largest group of tags that are tied by images that show two or more of them.

    Args:
        pictures: Numbers of the tags in each.
        fixed: A tag whose group is wanted instead.

    Returns:
        Their numbers in order; none where nothing was seen.
    """
    groups: list[set[int]] = []
    for numbers in map(set, pictures):
        tied = [group for group in groups if group & numbers]
        groups = [group for group in groups if not group & numbers]
        groups.append(numbers.union(*tied))
    if fixed is not None:
        groups = [group for group in groups if fixed in group]
    largest: set[int] = max(groups, key=lambda group: (len(group), -min(group)), default=set())
    return sorted(largest)


LEAST_PICTURES = 4
"""Of two tags or more; twenty are good."""


@dataclass(frozen=True, slots=True, eq=False)
class TagLayout:
    """Tags of the platform as they were measured.

    Attributes:
        drawn: The tags as the rig file has them, those that were located.
        tags: The same as they are.
        covariance: Of each tag's position [m] and rotation vector [rad] along the platform's axes,
            shape (6 t, 6 t).
        half_widths: Of the 95 % intervals of the same, shape (6 t,).
        fixed: Number of the tag that is as in the rig file; None where all fit the rig file best.
        errors: RMS corner error of each image, by name, [px].
        seen: In how many images each tag was, by number.
        unseen: Why each of the other tags is as in the rig file, by number.
        sides: Largest angle between directions from which images were taken, [rad].
        scale: Size of the layout by that of the rig file.
        unused: Why images are not used, by name.
        data_hash: Of what was seen.
    """

    drawn: tuple[Tag, ...]
    tags: tuple[Tag, ...]
    covariance: Array
    half_widths: Array
    fixed: int | None
    errors: Mapping[str, float]
    seen: Mapping[int, int]
    unseen: Mapping[int, str]
    sides: float
    scale: float
    unused: Mapping[str, str]
    data_hash: str

    @property
    def error(self) -> float:
        """How far off corners of tags may be, 95 %, RMS, [m]."""
        deviations = np.sqrt(np.diag(self.covariance))
        factors = np.where(deviations > 0.0, self.half_widths / np.maximum(deviations, 1e-15), 0.0)
        grown = self.covariance * np.outer(factors, factors)
        slopes = corner_slopes(self.tags)
        return float(np.sqrt(np.mean([np.trace(s @ grown @ s.T) for s in slopes])))

    @property
    def reprojection(self) -> float:
        """RMS corner error over the images, [px]."""
        return float(np.sqrt(np.mean(np.square(list(self.errors.values())))))


def require_tags(rig: Rig, fixed: int | None) -> None:
    """Refuses a rig whose layout cannot be measured.

    Raises:
        BadInput: Its platform has one tag or none, or not the one that is to be as in the rig file.
    """
    numbers = [tag.id for tag in rig.platform_tags]
    told = f"tags of the platform: {', '.join(map(str, numbers)) or 'none'}"
    if len(numbers) < 2:
        raise BadInput(
            "the platform has fewer than two tags, so their poses cannot be compared",
            where=f"rig {rig.name}",
            why=told,
            next_step="add the platform's tags to the rig file under tags: platform",
        )
    if fixed is not None and fixed not in numbers:
        raise BadInput(
            f"no tag {fixed} on the platform",
            where="--fixed-tag",
            why=told,
            next_step="name one of them",
        )


def measure_layout(
    rig: Rig, camera: Camera, sights: TagSights, fixed: int | None = None
) -> TagLayout:
    """Finds the layout of the platform's tags.

    Args:
        rig: Its platform tags as in the rig file; their sizes hold.
        camera: Its matrix and distortion hold.
        sights: Of platform tags, from anywhere.
        fixed: Number of the tag that is as in the rig file; left out, all fit the rig file best.

    Raises:
        BadInput: Too few images show two tags or more, or none shows the fixed tag with others.
    """
    drawn = {tag.id: tag for tag in rig.platform_tags}
    single = {
        name: "shows only one tag, which does not locate the others"
        for name, squares in sights.squares.items()
        if len(squares) < 2
    }
    sights = sights.without(single).each_view_once()
    starts, sights = starts_of(camera, drawn, sights)
    located = connected_tags([tuple(squares) for squares in sights.squares.values()], fixed)
    among = fixed if fixed is not None else next(iter(located), None)
    sights = sights.without(
        {
            name: f"shows only tags that no image shows together with tag {among}"
            for name, squares in sights.squares.items()
            if not set(squares) <= set(located)
        }
    )
    if len(sights.squares) < LEAST_PICTURES:
        raise _too_few(sights, fixed)
    tags = tuple(drawn[number] for number in located)
    views = TagViews.of(camera, sights, tags)
    fit = fitted(views, [starts[name] for name in sights.squares], tags)
    if strange := far_off(sights, views.picture_errors(*fit)):
        sights = sights.without(strange)
        if len(sights.squares) < LEAST_PICTURES:
            raise _too_few(sights, fixed)
        return measure_layout(rig, camera, sights, fixed)
    return _result(rig, views, *fit, fixed, sights)


def _result(
    rig: Rig,
    views: TagViews,
    cameras: list[Pose],
    tags: tuple[Tag, ...],
    fixed: int | None,
    sights: TagSights,
) -> TagLayout:
    drawn = {tag.id: tag for tag in rig.platform_tags}
    at_drawing = tuple(drawn[tag.id] for tag in tags)
    shift, scale = to_drawing(tags, at_drawing, fixed)
    tags = tuple(replace(tag, pose=shift.compose(tag.pose)) for tag in tags)
    cameras = [pose.compose(shift.inverse()) for pose in cameras]
    informations, scores, misfit = views.about_tags(cameras, tags, HUBER)
    gauge = fix_gauge(tags, fixed)
    whole = np.sum(informations, axis=0)
    pinned = gauge.T @ gauge * (1e3 * np.trace(whole) / np.trace(gauge.T @ gauge))
    covariance = max(1.0, misfit) * np.linalg.inv(whole + pinned)
    without = [
        np.linalg.solve(whole - part + pinned, -score)
        for part, score in zip(informations, scores, strict=True)
    ]
    numbers = [number for squares in sights.squares.values() for number in squares]
    return TagLayout(
        drawn=at_drawing,
        tags=tags,
        covariance=read_only(covariance),
        half_widths=read_only(widths_of(covariance, without)),
        fixed=fixed,
        errors=dict(zip(sights.squares, views.picture_errors(cameras, tags), strict=True)),
        seen={tag.id: numbers.count(tag.id) for tag in tags},
        unseen={
            number: "was not detected together with the others"
            for number in drawn
            if number not in {tag.id for tag in tags}
        },
        sides=_sides(cameras),
        scale=scale,
        unused=sights.unused,
        data_hash=sights.data_hash(),
    )


def _sides(cameras: Sequence[Pose]) -> float:
    """Largest angle between directions from the platform to ``camera_from_platform``, [rad]."""
    places = np.array([pose.inverse().position for pose in cameras])
    directions = places / np.linalg.norm(places, axis=1, keepdims=True)
    return float(np.arccos(np.clip(directions @ directions.T, -1.0, 1.0)).max())


def _too_few(sights: TagSights, fixed: int | None) -> BadInput:
    told = "; ".join(f"{name} {why}" for name, why in list(sights.unused.items())[:5])
    together = f", linked to tag {fixed}" if fixed is not None else ""
    return BadInput(
        f"{len(sights.squares)} images show two platform tags or more{together};"
        f" {LEAST_PICTURES} are required",
        why=told,
        next_step="take 20 images from all sides, two or three tags in each",
    )
