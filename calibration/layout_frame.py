"""Where the platform's frame is in a layout: pictures cannot tell, the rig file does."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cdpr.poses import Array, Pose, skew
from cdpr.rig import Tag
from tracking.marks import tag_corners


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


def held_still(tags: Sequence[Tag], fixed: int | None) -> Array:
    """What must not change with the layout, shape (6, 6 t): it would move the platform's frame."""
    if fixed is not None:
        which = [tag.id for tag in tags].index(fixed)
        return np.eye(6 * len(tags))[6 * which : 6 * which + 6]
    corners = np.concatenate([tag_corners(tag) for tag in tags])
    slopes = corner_slopes(tags)
    arms = [skew(corner) for corner in corners - corners.mean(axis=0)]
    turns = np.sum([arm @ slope for arm, slope in zip(arms, slopes, strict=True)], axis=0)
    return np.concatenate([slopes.sum(axis=0), turns / 0.05])
