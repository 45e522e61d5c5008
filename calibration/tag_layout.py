"""Where the tags are on the platform: all of them and all pictures fitted together.

Every picture may be taken from anywhere; its camera pose is an unknown as well (bundle adjustment).
Pictures tell the layout only up to a rigid motion of the platform's frame; it is put where the
layout fits the rig file best, or where one tag is as there. What a picture says of the layout, its
camera pose projected out, is added up as in `calibration.uncertainty`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calibration.extrinsics import widths_of
from calibration.layout_fit import HUBER, far_off, fitted, starts_of
from calibration.layout_frame import corner_slopes, held_still, to_drawing
from calibration.tag_graph import connected_tags
from calibration.tag_sights import TagSights
from calibration.tag_views import TagViews
from cdpr.errors import BadInput
from cdpr.poses import Array, Pose, read_only
from cdpr.rig import Camera, Rig, Tag

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
        errors: RMS corner error of each picture, by name, [px].
        seen: In how many pictures each tag was, by number.
        unseen: Why each of the other tags is as in the rig file, by number.
        sides: Largest angle between directions from which pictures were taken, [rad].
        scale: Size of the layout by that of the rig file.
        unused: Why pictures are not used, by name.
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
        """RMS corner error over the pictures, [px]."""
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
            "the platform has no two tags whose places could be compared",
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
        BadInput: Too few pictures show two tags or more, or none shows the fixed tag with others.
    """
    drawn = {tag.id: tag for tag in rig.platform_tags}
    single = {
        name: "shows one tag only, which says nothing of the others"
        for name, squares in sights.squares.items()
        if len(squares) < 2
    }
    sights = sights.without(single).each_view_once()
    starts, sights = starts_of(camera, drawn, sights)
    located = connected_tags([tuple(squares) for squares in sights.squares.values()], fixed)
    among = fixed if fixed is not None else next(iter(located), None)
    sights = sights.without(
        {
            name: f"shows only tags that no picture shows with tag {among}"
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
    gauge = held_still(tags, fixed)
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
            number: "was not seen together with the others"
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
    together = f", tied to tag {fixed}" if fixed is not None else ""
    return BadInput(
        f"{len(sights.squares)} pictures show two tags of the platform or more{together};"
        f" {LEAST_PICTURES} are the least",
        why=told,
        next_step="take 20 pictures from all sides, two or three tags in each",
    )
